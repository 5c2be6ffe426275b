"""Running methods over a folder of pairs and gathering how far each is from the truth.

Every method rectifies into the edge-matched view of the camera it found. Where it finds none, or fails, the fisheye
picture itself counts as its result: as the identity.
"""

from __future__ import annotations

import functools
import math
import os
import time
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from PIL import Image

from .. import pixel
from ..baselines import aleman_flores, bukhari, rong
from ..cameras import FisheyeCamera, PinholeCamera
from ..lens_chart import camera_from_chart, population
from ..numpy import rectify
from ..rectifier import Rectifier
from ..refinement import Prior, refine
from . import metrics
from .pairs import PairFiles, read_manifest
from .sources import read_labels, read_rgb

Method = Callable[[np.ndarray], FisheyeCamera | None]
"""From an uncalibrated picture (H, W, 3) RGB uint8 to its camera, of image size (H, W); None for no estimate."""

# Equal pictures have an infinite PSNR; in a mean they count as this.
PSNR_MAX = 100.0

MEASURES = ("psnr", "ssim", "psnr_valid", "ssim_valid", "displacement_px", "displacement_median_px", "label_miou")


def identity(image: np.ndarray) -> FisheyeCamera | None:
    """Do nothing."""
    return None


def oracle(image: np.ndarray) -> FisheyeCamera | None:
    """Stand for the true camera, which `judge_pair` hands over by itself."""
    raise RuntimeError("oracle(): the true camera is known to judge_pair only")


def oracle_centred(image: np.ndarray) -> FisheyeCamera | None:
    """Stand for the true camera with its principal point in the middle: what not telling the principal point costs."""
    raise RuntimeError("oracle_centred(): the true camera is known to judge_pair only")


def mean_lens(image: np.ndarray) -> FisheyeCamera:
    """Say of every picture that it was taken by the mean lens of the population."""
    size = (image.shape[0], image.shape[1])
    return FisheyeCamera(camera_from_chart(population()[0], size).numpy(), size)


def lines(image: np.ndarray) -> FisheyeCamera | None:
    """Refine the mean lens on the picture's lines, with the population as prior: no network."""
    mean, basis = (value.numpy() for value in population())
    refinement = refine(image, mean_lens(image), prior=Prior(mean, basis @ basis.T))
    return refinement.camera if refinement.accepted else None


def _one_call(refined: bool, weights: str | os.PathLike[str] | None = None) -> Method:
    rectifier = Rectifier.from_pretrained(weights)
    return lambda image: rectifier.estimate(image, refine=refined).camera


def _zhang() -> Method:
    from ..baselines import zhang  # needs scipy, which others do not

    return zhang.estimate


METHODS: dict[str, Callable[[], Method]] = {
    "identity": lambda: identity,
    "mean-lens": lambda: mean_lens,
    "lines": lambda: lines,
    "rong": lambda: functools.partial(rong.estimate, network=rong.load()),
    "network": lambda: _one_call(False),
    "ours": lambda: _one_call(True),
    "bukhari": lambda: bukhari.estimate,
    "zhang": _zhang,
    "aleman-flores": lambda: aleman_flores.estimate,
    "oracle-centred": lambda: oracle_centred,
    "oracle": lambda: oracle,
}
"""What `fisheyerec evaluate --method` knows: names and how to make the method, which may load weights. "network" is the
shipped one alone, "ours" the one call: network, then refinement on lines. Those of baselines/ bear their authors'
names."""


def load_methods(
    names: Iterable[str], weights: Mapping[str, str | os.PathLike[str]] | None = None
) -> dict[str, Method]:
    """Make the methods of these names.

    Args:
        names: out of METHODS and of `weights`.
        weights: networks by another name, each a file that `fisheyerec train` wrote; without the refinement.

    Raises:
        ValueError: an unknown name, or a file of another kind.
        OSError: a weights file cannot be read.
        ImportError: a method's extra is not installed.
    """
    names = list(names)
    known = METHODS | {name: functools.partial(_one_call, False, path) for name, path in (weights or {}).items()}
    unknown = [name for name in names if name not in known]
    if unknown or not names:
        raise ValueError(f"expected methods out of {', '.join(known)}, got {', '.join(unknown) or 'none'}")
    return {name: known[name]() for name in names}


@dataclass(frozen=True)
class PictureResult:
    """What one method did with one picture."""

    picture: str
    """The fisheye picture's path within the folder."""
    source: str
    kind: str | None
    method: str
    params: np.ndarray | None
    """(8,) of the estimated camera; None where there is no estimate."""
    error: str | None
    """What went wrong inside the method, if anything did."""
    ms: float
    """Estimating and rectifying, files not included."""
    psnr: float
    ssim: float
    psnr_valid: float
    """Over the pixels that the method's view is valid at; the same for ssim_valid."""
    ssim_valid: float
    valid: float
    """How much of the frame that is."""
    displacement_px: float
    displacement_median_px: float
    label_miou: float
    """Of the labels rectified with the estimate against those rectified with the truth; NaN without labels."""
    fov_error_deg: float
    """Estimated minus true diagonal field of view, which a single photo hardly tells; NaN without an estimate."""
    parameter_errors: dict[str, float]
    """Relative; NaN without an estimate."""


@dataclass
class Evaluation:
    """What came out."""

    methods: list[str]
    count: int
    """How many pairs there were."""
    results: list[PictureResult] = field(default_factory=list)
    """Picture by picture, each by method."""
    skipped: dict[str, str] = field(default_factory=dict)
    """Pairs that could not be read, and why."""

    def of(self, method: str) -> list[PictureResult]:
        """Give the results of one method."""
        return [result for result in self.results if result.method == method]

    def summary(self) -> dict[str, Any]:
        """Give {"methods": {NAME: {"psnr", "ssim", ...}}, "skipped": ...}: means over pictures, NaN as None.

        Each method has the means of MEASURES, their 95 % bootstrap intervals over sources under "intervals", counts
        ("count", "no_estimate", "failed"), the median "ms", and medians of what single outliers would spoil
        ("parameter_errors", "fov_error_deg", the latter of absolute values); "kinds" has means, intervals and "count"
        by kind of lens.
        """
        return {
            "methods": {method: _summarise(self.of(method)) for method in self.methods},
            "skipped": self.skipped,
        }


def evaluate_methods(
    folder: str | os.PathLike[str],
    methods: dict[str, Method],
    *,
    limit: int | None = None,
    on_picture: Callable[[int], None] = lambda total: None,
) -> Evaluation:
    """Run methods over a folder of pairs; a picture or a method that fails is recorded and the run goes on.

    Args:
        folder: pairs with a manifest, as training/pairs.py describes them.
        methods: by name; `identity` and `oracle` are among them if wanted.
        limit: only the first so many pairs.
        on_picture: called after each pair with how many there are in all.

    Raises:
        ValueError: no folder of pairs, or a malformed manifest.
    """
    pairs = read_manifest(folder)[:limit]
    evaluation = Evaluation(list(methods), len(pairs))
    for files in pairs:
        try:
            evaluation.results += judge_pair(files, methods)
        except (ValueError, OSError) as error:
            evaluation.skipped[files.name] = str(error)
        on_picture(len(pairs))
    return evaluation


def judge_pair(files: PairFiles, methods: Mapping[str, Method]) -> list[PictureResult]:
    """Run methods on one picture; one that fails is recorded.

    Raises:
        ValueError: a picture is broken, or of another size than the manifest tells.
        OSError: a file cannot be read.
    """
    pair = _read(files)
    return [_judge(pair, name, method) for name, method in methods.items()]


class Decoded(NamedTuple):
    """A pair read from its files, and what judging all methods needs of it."""

    files: PairFiles
    fisheye: np.ndarray
    rectified: np.ndarray
    labels: np.ndarray | None
    positions: np.ndarray
    """(h, w, 2): where the truth looks."""
    positions_identity: np.ndarray


def _read(files: PairFiles) -> Decoded:
    fisheye, rectified = read_rgb(files.fisheye), read_rgb(files.rectified)
    labels = None if files.labels is None else read_labels(files.labels)
    for path, array, camera in (
        (files.fisheye, fisheye, files.camera),
        (files.rectified, rectified, files.view),
        (files.labels, labels, files.camera),
    ):
        if array is not None and array.shape[:2] != camera.image_size:
            (height, width), (rows, columns) = camera.image_size, array.shape[:2]
            raise ValueError(f"expected {path} of the manifest's size, {width}x{height}, got {columns}x{rows}")
    positions = metrics.look_up(files.camera, files.view)
    return Decoded(files, fisheye, rectified, labels, positions, metrics.look_up_identity(files.camera, files.view))


def _judge(pair: Decoded, name: str, method: Method) -> PictureResult:
    truth, view = pair.files.camera, pair.files.view
    camera, error = None, None
    start = time.perf_counter()
    try:
        if method is oracle:
            camera = truth
        else:
            camera = _centred(truth) if method is oracle_centred else method(pair.fisheye)
            if camera is not None:
                _check_estimate(camera, truth.image_size)
                view = PinholeCamera.edge_matched(camera, view.image_size)
        image, valid = straighten(pair.fisheye, camera, view)
    except Exception as failure:  # whatever a method does, the run goes on
        camera, error = None, " ".join(f"{type(failure).__name__}: {failure}".split())
        image, valid = straighten(pair.fisheye, None, view)
    ms = (time.perf_counter() - start) * 1e3

    positions = pair.positions_identity if camera is None else metrics.look_up(camera, view)
    distances = metrics.displacement(positions, pair.positions, pair.positions_identity)
    distances = distances[np.isfinite(distances)]
    label_miou = math.nan
    if pair.labels is not None:
        true_labels, _ = straighten(pair.labels, truth, pair.files.view)
        label_miou = metrics.mean_iou(straighten(pair.labels, camera, view)[0], true_labels)
    fov_error_deg, parameter_errors = math.nan, dict.fromkeys(FisheyeCamera.parameter_names, math.nan)
    if camera is not None:
        fov_error_deg = metrics.field_of_view_deg(camera) - metrics.field_of_view_deg(truth)
        parameter_errors = metrics.parameter_errors(camera, truth)
    psnr, ssim = metrics.psnr(image, pair.rectified), metrics.ssim(image, pair.rectified)
    psnr_valid, ssim_valid = psnr, ssim
    if not valid.all():
        psnr_valid = metrics.psnr(image, pair.rectified, valid)
        ssim_valid = metrics.ssim(image, pair.rectified, valid)
    return PictureResult(
        picture=pair.files.name,
        source=pair.files.source,
        kind=pair.files.kind,
        method=name,
        params=None if camera is None else np.asarray(camera.numpy().params),
        error=error,
        ms=ms,
        psnr=psnr,
        ssim=ssim,
        psnr_valid=psnr_valid,
        ssim_valid=ssim_valid,
        valid=float(valid.mean()),
        displacement_px=float(np.mean(distances)) if distances.size else math.nan,
        displacement_median_px=float(np.median(distances)) if distances.size else math.nan,
        label_miou=label_miou,
        fov_error_deg=fov_error_deg,
        parameter_errors=parameter_errors,
    )


def straighten(picture: np.ndarray, camera: FisheyeCamera | None, view: PinholeCamera) -> tuple[np.ndarray, np.ndarray]:
    """Rectify a picture (H, W, 3), or labels (H, W), into a view (h, w); without a camera, only resize it.

    Returns:
        the result, and where it is valid (h, w).
    """
    resampling, interpolation = Image.Resampling.BILINEAR, "bilinear"
    if picture.ndim == 2:
        resampling, interpolation = Image.Resampling.NEAREST, "nearest"
    if camera is not None:
        return rectify(picture, camera.numpy(), view.numpy(), interpolation=interpolation)
    height, width = view.image_size
    resized = Image.fromarray(picture).resize((width, height), resampling)
    return np.asarray(resized), np.ones((height, width), dtype=bool)


def _centred(camera: FisheyeCamera) -> FisheyeCamera:
    height, width = camera.image_size
    params = np.array(camera.numpy().params)
    params[2:4] = pixel.centre(width), pixel.centre(height)
    return FisheyeCamera(params, camera.image_size)


def _check_estimate(camera: FisheyeCamera, image_size: tuple[int, int]) -> None:
    if not isinstance(camera, FisheyeCamera) or camera.image_size != image_size or camera.params.ndim != 1:
        raise ValueError(f"expected one FisheyeCamera of image size {image_size}, got {camera!r}")
    if not np.isfinite(np.asarray(camera.numpy().params)).all():
        raise ValueError(f"expected finite parameters, got {camera!r}")


def _summarise(results: list[PictureResult]) -> dict[str, Any]:
    summary = _means(results)
    summary["no_estimate"] = sum(result.params is None for result in results)
    summary["failed"] = sum(result.error is not None for result in results)
    summary["ms"] = _median([result.ms for result in results])
    summary["fov_error_deg"] = _median([abs(result.fov_error_deg) for result in results])
    summary["parameter_errors"] = {
        name: _median([result.parameter_errors[name] for result in results]) for name in FisheyeCamera.parameter_names
    }
    kinds = sorted({result.kind for result in results if result.kind is not None})
    summary["kinds"] = {kind: _means([result for result in results if result.kind == kind]) for kind in kinds}
    return summary


def _means(results: list[PictureResult]) -> dict[str, Any]:
    """Give the mean of each measure, with its interval under "intervals", and how many results there are."""
    sources = [result.source for result in results]
    means: dict[str, Any] = {}
    intervals = {}
    for measure in MEASURES:
        values = values_of(results, measure)
        finite = values[np.isfinite(values)]
        means[measure] = float(finite.mean()) if finite.size else None
        intervals[measure] = [_or_none(bound) for bound in metrics.bootstrap_interval(values, sources)]
    return means | {"intervals": intervals, "count": len(results)}


def values_of(results: list[PictureResult], measure: str) -> np.ndarray:
    """Give one of MEASURES over results, as means take it: NaN where it is not known, an infinite PSNR as PSNR_MAX."""
    return np.minimum([getattr(result, measure) for result in results], PSNR_MAX if "psnr" in measure else math.inf)


def _median(values: list[float]) -> float | None:
    finite = [value for value in values if math.isfinite(value)]
    return float(np.median(finite)) if finite else None


def _or_none(value: float) -> float | None:
    return value if math.isfinite(value) else None
