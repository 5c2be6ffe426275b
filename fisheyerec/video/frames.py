"""Frames, rectified as they are stored.

Luma and chroma are resampled each plane by its own camera, so that no colour is converted. Chroma is taken to lie where
H.264 and MPEG-2 put it if nothing is said ("left"): level with every other luma sample of a row, half-way between two
rows.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Generator
from typing import Any

import av
import numpy as np

from .. import numpy as door
from ..cameras import Camera, FisheyeCamera

LIMITED_RANGE, FULL_RANGE, BT709 = 1, 2, 1  # AVCOL_RANGE_MPEG, AVCOL_RANGE_JPEG, AVCOL_SPC_BT709

_LEFT_SITING = 1 / 4  # chroma samples, from the middle of the luma samples that one stands for


def planar_format(depth: int, subsampling: str = "420") -> str:
    """Give FFmpeg's name for planes of luma and chroma of so many bits; more than 8 lie in the low bits of 16."""
    return f"yuv{subsampling}p{f'{depth}le' if depth > 8 else ''}"


def has_full_range(frame: Any) -> bool:
    """Tell whether black is 0, not 16, in a frame or a stream."""
    return bool(frame.color_range == FULL_RANGE or frame.format.name.startswith("yuvj"))


def quarter_turns(frame: Any) -> int:
    """How many times a player turns the frame by 90 degrees, counter-clockwise."""
    turns: int = round(frame.rotation / 90) % 4
    return turns


def upright_size(frame: Any) -> tuple[int, int]:
    """(height, width) of a frame as a player turns it."""
    return (frame.height, frame.width) if quarter_turns(frame) % 2 == 0 else (frame.width, frame.height)


def rectified(
    items: Generator[Any, None, None], camera: FisheyeCamera, view: Camera, rotation: np.ndarray | None, depth: int
) -> Generator[Any, None, None]:
    """Rectify frames into planes of so many bits, and let packets pass.

    Raises:
        ValueError: a frame of another size than the camera's.
    """
    planned, planes = None, []
    with contextlib.closing(items):
        for item in items:
            if isinstance(item, av.Packet):
                yield item
                continue
            frame, turns = _planar(item, depth), quarter_turns(item)
            layout = (frame.format.name, has_full_range(frame), upright_size(item), turns)
            if layout != planned:
                _check_size(item, camera)
                black = 0 if has_full_range(frame) else 16 << depth - 8
                empty = (black, 128 << depth - 8, 128 << depth - 8)
                planes = [_Plane(*each, frame, turns, camera, view, rotation) for each in enumerate(empty)]
                planned = layout
            height, width = view.image_size
            out = av.VideoFrame(width, height, planar_format(depth))
            for number, plane in enumerate(planes):
                plane.rectify(_pixels(frame.planes[number], depth), _pixels(out.planes[number], depth))
            out.pts, out.time_base = item.pts, item.time_base
            yield out


def _check_size(frame: Any, camera: FisheyeCamera) -> None:
    (height, width), (got_height, got_width) = camera.image_size, upright_size(frame)
    if (height, width) != (got_height, got_width):
        raise ValueError(
            f"rectify_video(): expected frames of the camera's size {width}x{height}, got {got_width}x{got_height}"
        )


def _planar(frame: Any, depth: int) -> Any:
    """Give a frame in planes of luma and chroma of so many bits; it is the same where it has such."""
    name = frame.format.name
    if name in {planar_format(depth, subsampling) for subsampling in ("420", "422", "444")}:
        return frame
    if depth == 8 and name in ("yuvj420p", "yuvj422p", "yuvj444p"):
        return frame
    if frame.format.is_rgb:
        return frame.reformat(format=planar_format(depth), dst_colorspace=BT709, dst_color_range=LIMITED_RANGE)
    color_range = FULL_RANGE if has_full_range(frame) else LIMITED_RANGE
    return frame.reformat(format=planar_format(depth), dst_color_range=color_range)


def _pixels(plane: Any, depth: int) -> np.ndarray:
    """The pixels (height, width) of a plane, in its own memory."""
    dtype = np.dtype(np.uint8 if depth == 8 else "<u2")
    return np.frombuffer(plane, dtype).reshape(-1, plane.line_size // dtype.itemsize)[: plane.height, : plane.width]


class _Plane:
    """Rectifies one plane of every frame: 0 is luma, 1 and 2 are chroma; `empty` is written where nothing is seen."""

    def __init__(
        self,
        number: int,
        empty: int,
        frame: Any,
        turns: int,
        camera: FisheyeCamera,
        view: Camera,
        rotation: np.ndarray | None,
    ) -> None:
        plane = frame.planes[number]
        steps = (math.ceil(frame.height / plane.height), math.ceil(frame.width / plane.width))
        # One thread: the others decode and encode. Beyond the edge, zero would be green.
        self._plan = door.Plan(
            _plane_camera(camera, steps, turns),
            _plane_camera(view, (1, 1) if number == 0 else (2, 2), 0),
            source_from_target=rotation,
            padding="border",
            threads=1,
        )
        self._turns, self._empty, self._invalid = turns, empty, np.flatnonzero(~self._plan.valid)

    def rectify(self, pixels: np.ndarray, out: np.ndarray) -> None:
        image = self._plan(np.rot90(pixels, self._turns)).image
        image.reshape(-1)[self._invalid] = self._empty
        out[:] = image


def _plane_camera(camera: Any, steps: tuple[int, int], turns: int) -> Any:
    """Give the camera of a plane that has one sample for so many rows and columns of the stored frame.

    Args:
        camera: the camera of the frame, upright.
        steps: rows and columns, each 1 or 2.
        turns: from the stored frame to the upright one, in quarters and counter-clockwise.
    """
    left = _LEFT_SITING if steps[1] == 2 else 0.0
    if turns % 2:
        steps = (steps[1], steps[0])
    height, width = (math.ceil(side / step) for side, step in zip(camera.image_size, steps, strict=True))
    small = camera.crop(0, 0, (height * steps[0], width * steps[1])).resize((height, width))
    to_the_right, downwards = ((1, 0), (0, -1), (-1, 0), (0, 1))[turns]
    return small.crop(-left * to_the_right, -left * downwards, (height, width))
