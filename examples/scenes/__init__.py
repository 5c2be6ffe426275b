"""Synthetic rooms and streets full of straight lines, drawn through any camera with exact truth.

`room`, `street`, `corridor` and `chessboard` make a `Scene` from a seed; `render` looks along rays
and `render_camera` through a camera. Everything is in metres, x right, y down, z forward.
"""

from .gallery import chessboard, corridor
from .rendering import Rendering, Scene, render, render_camera
from .room import room
from .solids import Label
from .street import street

CLASSES = tuple(label.name.lower() for label in Label)
"""Class names in the order of their ids in the label images."""

__all__ = [
    "CLASSES",
    "Label",
    "Rendering",
    "Scene",
    "chessboard",
    "corridor",
    "render",
    "render_camera",
    "room",
    "street",
]
