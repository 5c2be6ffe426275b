"""`fisheyerec evaluate`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .messages import fail
from .progress import progress


def evaluate(
    pairs: Annotated[Path, typer.Option(help="Folder of pairs, as synthesize writes it.")],
    method: Annotated[str, typer.Option(help="Methods to judge, separated by commas.")] = "identity,oracle",
    json: Annotated[Path | None, typer.Option(help="File for the figures.")] = None,
    csv: Annotated[Path | None, typer.Option(help="File for one row a picture and method.")] = None,
    sheet: Annotated[Path | None, typer.Option(help="File for a contact sheet, .png or .jpg.")] = None,
    limit: Annotated[int | None, typer.Option(min=1, help="Only the first so many pairs.")] = None,
) -> None:
    """Judge methods that rectify a single picture by a folder of pairs, and print a table."""
    from ..training import reports
    from ..training.evaluate import evaluate_methods, load_methods
    from ..training.records import write_records

    try:
        methods = load_methods(name.strip() for name in method.split(",") if name.strip())
        with progress("pictures") as advance:
            evaluation = evaluate_methods(pairs, methods, limit=limit, on_picture=advance)
        typer.echo(reports.text_table(evaluation.summary()))
        if json is not None:
            reports.write_json(json, evaluation)
        if csv is not None:
            write_records(csv, evaluation.results)
        if sheet is not None and evaluation.results:
            reports.write_sheet(sheet, pairs, evaluation)
    except (ValueError, OSError, ImportError) as error:
        raise fail("evaluate", error) from error
    for name, reason in evaluation.skipped.items():
        typer.echo(f"fisheyerec evaluate: skipped {name}: {reason}", err=True)
    if evaluation.skipped:
        skipped, count = len(evaluation.skipped), evaluation.count
        typer.echo(f"fisheyerec evaluate: {skipped} of {count} pairs could not be read", err=True)
        raise typer.Exit(1)
