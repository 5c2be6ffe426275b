"""From a video file to its frames and packets, as far as it is whole."""

from __future__ import annotations

import contextlib
import os
from collections import deque
from collections.abc import Generator, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, TypeVar

import av

T = TypeVar("T")

_AHEAD = 4  # frames
_SLACK = 1 / 4  # s, by which a complete file may end before its header says


@dataclass
class Damage:
    """What a reader finds wrong with a file."""

    lost_packets: int = 0
    reached: float = 0.0  # s
    broke_off: bool = False

    def complaint(self, source: str | os.PathLike[str], duration: float | None) -> str | None:
        """Say what is wrong, given how long the file should be in seconds."""
        found = []
        if duration is not None and self.reached < duration - _SLACK:
            found.append(f"ends after {self.reached:.2f} of {duration:.2f} s")
        elif self.broke_off:
            found.append(f"breaks off after {self.reached:.2f} s")
        if self.lost_packets:
            plural = "" if self.lost_packets == 1 else "s"
            found.append(f"has {self.lost_packets} packet{plural} that cannot be decoded")
        return f"{os.fspath(source)}: {' and '.join(found)}; what is there was written" if found else None


@contextlib.contextmanager
def open_clip(source: str | os.PathLike[str]) -> Iterator[Any]:
    """Open a video file; raises ValueError if it is none that can be decoded, OSError if it cannot be read."""
    try:
        clip = av.open(os.fspath(source), metadata_errors="replace")
    except av.error.InvalidDataError as error:
        raise ValueError(f"expected a video, got {os.fspath(source)!r} of an unknown format, or broken") from error
    with clip:
        video = picture_of(clip)
        if video is None or video.codec_context is None:
            raise ValueError(f"expected a video, got {os.fspath(source)!r} without a picture that can be decoded")
        video.thread_type = "AUTO"
        yield clip


def picture_of(clip: Any) -> Any:
    """Give the video stream that players show, which is not always the first: that may be a cover."""
    return clip.streams.best("video")


def decoded(clip: Any) -> Generator[Any, None, None]:
    """Give the frames until the file ends or breaks."""
    return (item for item in read(clip, Damage()) if isinstance(item, av.VideoFrame))


def read(clip: Any, damage: Damage) -> Generator[Any, None, None]:
    """Give the frames of the picture, and the packets of all other streams."""
    video = picture_of(clip)
    start = (clip.start_time or 0) / av.time_base
    packets = clip.demux()
    while True:
        try:
            packet = next(packets)
        except StopIteration:
            return
        except av.error.FFmpegError:
            damage.broke_off = True
            with contextlib.suppress(av.error.FFmpegError):
                yield from video.decode(None)
            return
        if packet.pts is not None:
            end = float((packet.pts + (packet.duration or 0)) * packet.time_base) - start
            damage.reached = max(damage.reached, end)
        if packet.stream.index != video.index:
            yield packet
            continue
        try:
            frames = packet.decode()
        except av.error.InvalidDataError:
            damage.lost_packets += 1
            continue
        yield from frames


def ahead(items: Generator[T, None, None]) -> Generator[T, None, None]:
    """Compute items in a thread of their own, a few more than have been taken."""
    end: Any = object()
    thread = ThreadPoolExecutor(1)
    waiting = deque(thread.submit(next, items, end) for _ in range(_AHEAD))
    try:
        while (item := waiting.popleft().result()) is not end:
            waiting.append(thread.submit(next, items, end))
            yield item
    finally:
        thread.shutdown(cancel_futures=True)
        items.close()
