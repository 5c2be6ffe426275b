"""`fisheyerec demo`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from .estimating import WEIGHTS_HELP, load_rectifier
from .messages import fail


def demo(
    picture: Annotated[
        Path | None, typer.Argument(help="Picture to begin with; an example if left out.", show_default=False)
    ] = None,
    host: Annotated[str, typer.Option(help="Address to listen at; 0.0.0.0 lets other machines in.")] = "127.0.0.1",
    port: Annotated[
        int | None, typer.Option(min=0, max=65535, help="The first free one from 7860 on if left out; 0 for any.")
    ] = None,
    open: Annotated[bool, typer.Option("--open", help="Open the page in the browser.")] = False,
    weights: Annotated[Path | None, typer.Option(help=WEIGHTS_HELP)] = None,
) -> None:
    """Show a page to try lenses and views on a picture, before and after; its address is printed.

    Drop a picture; its lens is estimated, read from a lens file, or an ideal one. Every parameter has a slider.
    Pictures never leave the machine that this runs on, unless --host lets others in. Ctrl-C ends it.
    """
    import webbrowser

    from ..demo.server import address_of, listen, serve
    from ..pictures import read_picture

    def announce() -> None:
        address = address_of(listening)
        typer.echo(address)
        if open:
            webbrowser.open(address)

    try:
        if picture is not None:
            read_picture(picture)
        if weights is not None:
            load_rectifier(weights)
        listening = listen(host, port)
        serve(listening, picture, weights, on_ready=announce)
    except (ValueError, OSError, ImportError) as error:
        raise fail("demo", error) from error
