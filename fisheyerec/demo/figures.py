"""What is said beneath the pictures, as HTML."""

from __future__ import annotations

import html
import math

from .preview import Preview


def figures(preview: Preview, size: tuple[int, int]) -> str:
    """Tell a preview in three figures, and where the lens folds.

    Args:
        preview: what is shown.
        size: (height, width) of the whole result.
    """
    height, width = size
    tiles = {
        "Bend of lines": _bend(preview),
        "Filled": f"{100 * preview.valid_share:.1f} %",
        "Result": f"{width} × {height} px",
    }
    told = [f"<div><span>{label}</span><b>{value}</b></div>" for label, value in tiles.items()]
    if preview.fold_deg is not None:
        told.append(
            f"<p>The coefficients fold back {preview.fold_deg:.0f}° off the axis, within the photo: "
            "what lies beyond is not shown.</p>"
        )
    return f'<div class="figures">{"".join(told)}</div>'


def trouble(message: str) -> str:
    """Tell why there is no preview."""
    return f'<div class="figures"><p>{html.escape(message)}</p></div>'


def _bend(preview: Preview) -> str:
    before, after = preview.bend_before, preview.bend_after
    if math.isnan(before):
        return "no lines"
    return f"{before:.2f} → {'?' if math.isnan(after) else f'{after:.2f}'} %"
