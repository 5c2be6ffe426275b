"""Clips for the tests of videos: a drawn scene that pans, written by PyAV, and what is found in one."""

from __future__ import annotations

import functools
import struct
import sys
from fractions import Fraction
from pathlib import Path

import av
import numpy as np

import fisheyerec as fr

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))

import scenes

SIZE = (180, 240)
CAMERA = fr.FisheyeCamera.from_projection("equisolid", fov_deg=150, image_size=SIZE)
VIEW = fr.PinholeCamera.edge_matched(CAMERA, SIZE)
TICKS = 90_000  # a second


@functools.cache
def drawn():
    return scenes.render_camera(scenes.room(seed=1), CAMERA.unproject, SIZE, supersample=1).image


def turned(angle_deg):
    """The drawn scene after the camera has panned."""
    a = np.radians(angle_deg)
    rotation = [[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]]
    return fr.numpy.resample(drawn(), CAMERA, CAMERA, source_from_target=rotation, padding="border").image


def make_clip(
    path,
    *,
    times=None,
    codec="libx264",
    pix_fmt="yuv420p",
    sound="aac",
    container_options=None,
    frames=None,
    context=None,
    add=lambda out: [],
):
    """Write a clip of the drawn scene, panning, with a tone.

    Args:
        path: the file.
        times: of the frames, in seconds.
        codec, pix_fmt, sound: encoders and pixels; None for no sound.
        container_options: of the container.
        frames: (H, W, 3) RGB of 8 or 16 bits, instead of the scene.
        context: attributes of the picture's codec context.
        add: adds further streams to the file, and gives their packets.
    """
    times = np.arange(24) / 24 if times is None else times
    with av.open(str(path), "w", container_options=container_options or {}) as out:
        options = {"libx264": {"crf": "8", "g": "12"}, "libx265": {"crf": "4", "x265-params": "log-level=none"}}
        picture = out.add_stream(codec, rate=24, options=options.get(codec, {}))
        picture.height, picture.width = SIZE if frames is None else frames[0].shape[:2]
        picture.pix_fmt = pix_fmt
        for name, value in {"time_base": Fraction(1, TICKS), **(context or {})}.items():
            setattr(picture.codec_context, name, value)
        tone = out.add_stream(sound, rate=48_000) if sound else None
        more = add(out)
        samples = 0
        for number, seconds in enumerate(times):
            image = turned(number / 4) if frames is None else frames[number]
            pixels = "rgb24" if image.dtype == np.uint8 else "rgb48le"
            frame = av.VideoFrame.from_ndarray(image, format=pixels).reformat(format=pix_fmt)
            frame.pts, frame.time_base = round(seconds * TICKS), Fraction(1, TICKS)
            out.mux(picture.encode(frame))
            while tone is not None and samples < seconds * 48_000:
                wave = np.sin(2 * np.pi * 440 * (samples + np.arange(1024)) / 48_000).astype(np.float32)
                block = av.AudioFrame.from_ndarray(wave[None], format="fltp", layout="mono")
                block.sample_rate, block.pts, block.time_base = 48_000, samples, Fraction(1, 48_000)
                out.mux(tone.encode(block))
                samples += 1024
        out.mux(picture.encode(None))
        if tone is not None:
            out.mux(tone.encode(None))
        out.mux(more)


def packet(stream, data, milliseconds, duration=100):
    """Make a packet of a stream that nobody encodes."""
    made = av.Packet(data)
    made.stream, made.time_base = stream, Fraction(1, 1000)
    made.pts = made.dts = milliseconds
    made.duration = duration
    return made


def decoded(path, *, format="rgb24"):
    with av.open(str(path)) as container:
        return [frame.to_ndarray(format=format) for frame in container.decode(video=0)]


def times_of(path):
    with av.open(str(path)) as container:
        return [float(frame.pts * frame.time_base) for frame in container.decode(video=0)]


def packets_of(path, kind):
    with av.open(str(path)) as container:
        stream = next(stream for stream in container.streams if stream.type == kind)
        return [(float(p.pts * p.time_base), bytes(p)) for p in container.demux(stream) if p.dts is not None and p.size]


def psnr(one, two):
    with np.errstate(divide="ignore"):
        return 10 * np.log10(255**2 / np.square(one.astype(float) - two).mean())


def turn_on_its_side(source, target, turns):
    """Write into the track's header how players are to turn the picture, clockwise quarters."""
    data = bytearray(source.read_bytes())
    one = 1 << 16
    matrix = {1: (0, one, 0, -one, 0, 0), 2: (-one, 0, 0, 0, -one, 0), 3: (0, -one, 0, one, 0, 0)}[turns]
    at = data.index(b"tkhd") + 4 + 40  # the picture's track is the first
    data[at : at + 24] = struct.pack(">6i", *matrix)
    target.write_bytes(data)
