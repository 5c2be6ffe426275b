"""The command line. What it calls is imported inside each command, so that `fisheyerec --help` is immediate."""

from __future__ import annotations

from typing import Annotated

import typer

from . import convert, demo, estimate, evaluate, rectify, synthesize, train

app = typer.Typer(
    name="fisheyerec",
    help="Make fisheye pictures straight.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",
)


def main() -> None:
    """Run the command line. Exits 0; 1 where some of several files failed; 2 on bad input, with one line why."""
    app()


@app.callback(invoke_without_command=True)
def version(show: Annotated[bool, typer.Option("--version", help="Print the version and exit.")] = False) -> None:
    """Make fisheye pictures straight."""
    if show:
        from .. import __version__

        typer.echo(__version__)
        raise typer.Exit


for command in (
    rectify.rectify,
    estimate.estimate,
    convert.convert,
    synthesize.synthesize,
    evaluate.evaluate,
    train.train,
    demo.demo,
):
    app.command()(command)
