"""Where the page is served: on one machine, with nothing fetched from or sent to any other."""

from __future__ import annotations

import errno
import os
import signal
import socket
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from ..file_rectifiers import BlindRectifier, ViewOptions

FIRST_PORT = 7860
"""Tried first where no port is asked for, then the next ones."""

_PORTS = 100
_SECONDS_TO_FINISH = 1  # for requests in progress, once the server is to end


def listen(host: str, port: int | None) -> socket.socket:
    """Give a socket that listens.

    Args:
        host: name or address.
        port: 0 for any; None for the first free one from FIRST_PORT on.

    Raises:
        OSError: the port is taken, or there is no such host.
    """
    if port is not None:
        return _bound(host, port)
    for candidate in range(FIRST_PORT, FIRST_PORT + _PORTS):
        try:
            return _bound(host, candidate)
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
    raise OSError(errno.EADDRINUSE, os.strerror(errno.EADDRINUSE), f"{host}:{FIRST_PORT} to {candidate}")


def address_of(listening: socket.socket) -> str:
    """Give what to type into a browser on this machine."""
    host, port = listening.getsockname()[:2]
    name = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(host, f"[{host}]" if ":" in host else host)
    return f"http://{name}:{port}"


def serve(listening: socket.socket, first: Path | None, weights: Path | None, *, on_ready: Callable[[], None]) -> None:
    """Serve the page until the process is interrupted or terminated; no file is left behind.

    Args:
        listening: where.
        first: the picture to begin with; None for the example.
        weights: what lenses are estimated with; None for the package's own.
        on_ready: called once, before the page is served.

    Raises:
        ModuleNotFoundError: Gradio is not installed.
    """
    # Uvicorn ends in order on either signal, then raises it anew.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    with tempfile.TemporaryDirectory(prefix="fisheyerec-demo-") as folder, suppress(KeyboardInterrupt):
        os.environ["GRADIO_TEMP_DIR"] = folder  # Gradio makes it as soon as it is imported
        try:
            import gradio as gr
            import uvicorn
            from fastapi import FastAPI
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError("Gradio is missing: pip install 'fisheyerec[demo]'", name="gradio") from error
        from .page import STYLE, THEME, Page

        page = Page(first, BlindRectifier(ViewOptions(), weights=weights), Path(folder))
        app = gr.mount_gradio_app(
            FastAPI(), page.blocks, "/", footer_links=[], run_history=False, theme=THEME, css_paths=STYLE
        )
        config = uvicorn.Config(app, log_level="critical", timeout_graceful_shutdown=_SECONDS_TO_FINISH)
        on_ready()
        uvicorn.Server(config).run(sockets=[listening])


def _bound(host: str, port: int) -> socket.socket:
    """Listen at an address, or say which one it could not be."""
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )[0]
        bound = socket.socket(family, kind, protocol)
        try:
            if os.name == "posix":  # elsewhere this would share the port with who has it
                bound.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            bound.bind(address)
            bound.listen()
        except OSError:
            bound.close()
            raise
        return bound
    except OSError as error:
        raise OSError(error.errno, error.strerror, f"{host}:{port}") from error
