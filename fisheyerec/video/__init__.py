"""Video files, rectified frame by frame; sound, subtitles and data are taken over as they are.

    file -> packets -> frames -> rectified frames -> packets -> file
         reading.py        frames.py          streams.py
         a thread          a thread           the caller's

Cameras and views refer to pixels as they are stored, whatever their aspect ratio, in frames turned as the file says:
OpenCV and ffmpeg give such frames, so that lenses are calibrated on them. The result is stored upright, and its pixels
are square where the view's two focal lengths agree.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

try:
    import av
except ModuleNotFoundError as error:
    raise ModuleNotFoundError("PyAV is missing: pip install 'fisheyerec[video]'", name="av") from error

from ..cameras import Camera, FisheyeCamera
from ..replacement import replacement
from .frames import quarter_turns, rectified, upright_size
from .reading import Damage, ahead, decoded, open_clip, picture_of, read
from .streams import CopiedStreams, FrameTimes, add_encoder, create

DEFAULT_QUALITY = 60
"""A constant rate factor of 20 for H.264 and HEVC."""

SAMPLED_FRAMES = 9
"""How many frames a camera is estimated from."""

_DELAY = 2  # frames: of clips no longer than its delay, x265 makes up the times to decode at


class VideoReport(NamedTuple):
    """What became of a video."""

    frames: int
    seconds: float
    summary: str
    complaint: str | None
    """What is wrong with the input; None if nothing is."""


def rectify_video(
    source: str | os.PathLike[str],
    target: str | os.PathLike[str],
    camera: FisheyeCamera,
    view: Camera,
    *,
    rotation: np.ndarray | None = None,
    quality: int | None = None,
    on_frame: Callable[[int, int | None], None] = lambda done, total: None,
) -> VideoReport:
    """Rectify the picture of a video file, with time stamps as they are, variable frame rates included.

    Written in 4:2:0, with 8 bits as H.264, with more as HEVC of 10 or 12 bits; in AVI as H.264, in WebM as VP9, of 10
    and 8 bits at most. AVI counts frames instead of timing them: there a variable rate is put on a constant one, which
    is told. Colours keep their range, primaries and transfer; of HDR10 the mastering display is left out, as alpha is.
    What else the file holds is taken over where the container can hold it, and what is left out is told; so are
    chapters and what the file says about itself. What is left of a broken file is written, and told.

    Args:
        source: the file.
        target: the file to write; the suffix names the container.
        camera: the fisheye camera, for upright frames of pixels as they are stored.
        view: the view to make, of even height and width.
        rotation: (3, 3) camera_from_view; None for none.
        quality: from 1 to 100; None for 60. The encoder's constant rate factor falls from 51 (VP9: 63) to 0.
        on_frame: called with the frames that are done and, if known, how many there will be; what it raises ends the
            work, and nothing is written.

    Raises:
        ValueError: source is no video, or not one frame can be decoded; a camera of another size; a view of odd size;
            a container that is unknown or holds no codec of these.
        OSError: a file cannot be read or written.
    """
    if view.image_size[0] % 2 or view.image_size[1] % 2:
        height, width = view.image_size
        raise ValueError(f"rectify_video(): expected a view of even width and height, got {width}x{height}")
    if quality is not None and not 1 <= quality <= 100:
        raise ValueError(f"rectify_video(): expected quality in [1, 100], got {quality}")
    start, frames, damage = time.perf_counter(), 0, Damage()
    with open_clip(source) as clip, replacement(target) as temporary, create(temporary) as out:
        video = picture_of(clip)
        encoder, depth, depth_lost = add_encoder(out, video, view, quality or DEFAULT_QUALITY)
        copied, times = CopiedStreams(clip, out, remade=video), FrameTimes(encoder.codec_context.time_base)
        total = video.frames or None
        with contextlib.closing(ahead(rectified(ahead(read(clip, damage)), camera, view, rotation, depth))) as items:
            for item in items:
                if isinstance(item, av.Packet):
                    copied.mux(item)
                    continue
                times.stamp(item)
                out.mux(encoder.encode(item))
                frames += 1
                on_frame(frames, total)
        if not frames:
            raise ValueError(f"rectify_video(): expected a video with frames, got {os.fspath(source)!r} without")
        for packet in encoder.encode(None):
            if frames <= _DELAY:
                packet.dts = packet.pts
            out.mux(packet)
        duration = None if clip.duration is None else clip.duration / av.time_base
    seconds = time.perf_counter() - start
    lost = [*([f"{depth_lost} of {depth + depth_lost} bits"] if depth_lost else []), *copied.left_out()]
    lost += [] if times.are_kept else ["frame times"]
    summary = f"{frames} frames, {frames / seconds:.1f} a second{', without ' if lost else ''}{' and '.join(lost)}"
    return VideoReport(frames, seconds, summary, damage.complaint(source, duration))


def copy_video(source: str | os.PathLike[str], target: str | os.PathLike[str]) -> None:
    """Copy what a video file holds into another container, or the same, without decoding it.

    Raises:
        ValueError: source is no video, or the container cannot hold its picture.
        OSError: a file cannot be read or written.
    """
    with open_clip(source) as clip, replacement(target) as temporary, create(temporary) as out:
        copied, video = CopiedStreams(clip, out), picture_of(clip)
        if not copied.holds(video):
            raise ValueError(f"copy_video(): expected a container that holds {video.codec_context.name}")
        for packet in clip.demux():
            copied.mux(packet)


def frame_size(source: str | os.PathLike[str]) -> tuple[int, int]:
    """Give the (height, width) of a video's upright frames in pixels as they are stored.

    Raises:
        ValueError: source is no video.
        OSError: it cannot be read.
    """
    with open_clip(source) as clip:
        frame = next(decoded(clip), None)
        if frame is None:
            raise ValueError(f"frame_size(): expected a video with frames, got {os.fspath(source)!r} without")
        return upright_size(frame)


def sample_frames(source: str | os.PathLike[str], count: int = SAMPLED_FRAMES) -> list[np.ndarray]:
    """Decode frames that lie evenly over a video, as players show them, of square pixels: (H, W, 3) uint8 RGB.

    Raises:
        ValueError: source is no video, or not one frame can be decoded.
        OSError: it cannot be read.
    """
    sampled: dict[Any, np.ndarray] = {}
    with open_clip(source) as clip:
        aspect = picture_of(clip).sample_aspect_ratio or 1
        for number in range(count):
            wanted = (clip.start_time or 0) / av.time_base
            if clip.duration is not None:
                wanted += clip.duration / av.time_base * (2 * number + 1) / (2 * count)
                with contextlib.suppress(av.error.FFmpegError):  # what cannot be sought is read on
                    clip.seek(int(wanted * av.time_base))
            frame = None
            for frame in decoded(clip):
                if frame.time is None or frame.time >= wanted:
                    break
            if frame is not None and frame.pts not in sampled:
                rgb = frame.to_ndarray(format="rgb24", width=round(frame.width * aspect), height=frame.height)
                sampled[frame.pts] = np.ascontiguousarray(np.rot90(rgb, quarter_turns(frame)))
    if not sampled:
        raise ValueError(f"sample_frames(): expected a video with frames, got {os.fspath(source)!r} without")
    return list(sampled.values())
