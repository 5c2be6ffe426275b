"""What a training run leaves behind: log.csv, whose rows are numbers, and TensorBoard events with pictures."""

from __future__ import annotations

import csv
import datetime
import os
from pathlib import Path
from typing import Any

import numpy as np
from torch.utils.tensorboard import SummaryWriter

COLUMNS = (
    "step",
    "pictures",
    "pictures_per_s",
    "eta_s",
    "loss",
    "lens",
    "classification",
    "landing",
    "rectification",
    "parsing",
    "validation_displacement_px",
    "validation_psnr",
    "validation_profile_r2",
    "validation_offset_r2",
    "validation_accuracy",
)


def describe(row: dict[str, Any], steps: int) -> str:
    """Put a row of the log of a run of so many steps into a line of text."""
    left = datetime.timedelta(seconds=round(row["eta_s"]))
    line = (
        f"step {row['step']}/{steps}: loss {row['loss']:.3f}, displacement {row['landing']:.2f} px, "
        f"{row['pictures_per_s']:.1f} pictures/s, {left} left"
    )
    if "validation_displacement_px" in row:
        line += f"; unseen: {row['validation_displacement_px']:.2f} px, {row['validation_psnr']:.2f} dB"
    return line


class TrainingLog:
    """The log of one run; only the first of several processes writes.

    Args:
        folder: of the run; made where it is missing.
        writes: whether this process is the one.
    """

    def __init__(self, folder: Path, writes: bool) -> None:
        self.path = folder / "log.csv"
        self._events: SummaryWriter | None = None
        self._folder, self._writes = folder, writes

    def begin(self, step: int) -> None:
        """Drop what was logged after `step`, where training goes on."""
        if not self._writes:
            return
        self._folder.mkdir(parents=True, exist_ok=True)
        text = self.path.read_text() if self.path.exists() else ""
        whole = text[: text.rfind("\n") + 1]  # a killed run may have left half a row
        rows = [row for row in csv.DictReader(whole.splitlines()) if int(row["step"]) <= step]
        temporary = self.path.with_suffix(".csv.part")
        with temporary.open("w", newline="") as file:
            writer = csv.DictWriter(file, COLUMNS)
            writer.writeheader()
            writer.writerows(rows)
        os.replace(temporary, self.path)
        self._events = SummaryWriter(str(self._folder / "events"), purge_step=step + 1)

    def write(self, row: dict[str, Any]) -> None:
        """Append a row; keys are COLUMNS."""
        if self._events is None:
            return
        with self.path.open("a", newline="") as file:
            csv.DictWriter(file, COLUMNS).writerow(
                {name: f"{value:.6g}" if isinstance(value, float) else value for name, value in row.items()}
            )
        for name, value in row.items():
            if name != "step":
                self._events.add_scalar(name, value, row["step"])

    def show(self, step: int, pictures: dict[str, np.ndarray]) -> None:
        """Add pictures (H, W, 3) uint8 to TensorBoard."""
        if self._events is None:
            return
        for name, picture in pictures.items():
            self._events.add_image(name, picture, step, dataformats="HWC")

    def close(self) -> None:
        """Write what is still held back."""
        if self._events is not None:
            self._events.close()
