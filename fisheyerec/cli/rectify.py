"""`fisheyerec rectify`."""

from __future__ import annotations

import contextlib
import functools
import os
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from .along import Annotations, FromTo, along, annotations_of, with_companions
from .convert import MAX_FIT_ERROR_HELP
from .estimating import OVERWRITE_HELP, REFINE_HELP, SAVE_CAMERA_HELP, WEIGHTS_HELP, check_save_camera
from .messages import check_new, fail, say
from .progress import file_progress
from .sizes import parse_size

if TYPE_CHECKING:
    import numpy as np

    from ..bulk import OnFrame, Outcome
    from ..cameras import Camera, FisheyeCamera
    from ..file_rectifiers import BlindRectifier, CalibratedRectifier, FileRectifier, ViewOptions
    from ..folders import Plan, Task
    from ..manifest import Manifest


def rectify(
    inputs: Annotated[
        list[Path],
        typer.Argument(
            metavar="INPUT",
            help="Fisheye pictures and videos, folders of them, or patterns in quotes such as 'days/**/*.jpg'.",
            show_default=False,
        ),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="File to write; for several files, a folder and patterns, a folder.")
    ],
    camera: Annotated[
        Path | None,
        typer.Option(
            help="Lens file of the camera that took them (JSON, YAML, OpenCV, kalibr...); estimated if left out."
        ),
    ] = None,
    max_fit_error_px: Annotated[float, typer.Option(help=MAX_FIT_ERROR_HELP)] = 1.0,
    view: Annotated[
        str | None,
        typer.Option(help="edge-matched, keep-all, valid-only or valid-rectangle (the largest, off centre)."),
    ] = None,
    projection: Annotated[
        str, typer.Option(help="pinhole, cylindrical, equirectangular, stereographic or panini.")
    ] = "pinhole",
    fov_deg: Annotated[
        float | None, typer.Option(help="Field of view across the result's width; below 180 for pinhole.")
    ] = None,
    focal: Annotated[float | None, typer.Option(help="Focal length of the result in pixels.")] = None,
    balance: Annotated[
        float | None, typer.Option(help="0: only valid pixels; 1: keep the whole picture; or between.")
    ] = None,
    pan: Annotated[float, typer.Option(help="Turn the view to the right, in degrees.")] = 0,
    tilt: Annotated[float, typer.Option(help="Turn the view upwards, in degrees.")] = 0,
    roll: Annotated[float, typer.Option(help="Turn the view clockwise, in degrees.")] = 0,
    size: Annotated[str | None, typer.Option(help="WIDTHxHEIGHT of the result; the picture's own if left out.")] = None,
    interpolation: Annotated[str, typer.Option(help="bilinear, or nearest for label maps.")] = "bilinear",
    antialias: Annotated[
        bool,
        typer.Option("--antialias", help="Average where a picture shrinks, so that fine texture does not flicker."),
    ] = False,
    labels: Annotated[FromTo, along("Label maps (PNG, TIFF, BMP, NPY): numbers are never mixed.")] = None,
    mask: Annotated[FromTo, along("Masks: whatever is not 0 is inside. Written as 0 and 255.")] = None,
    depth: Annotated[FromTo, along("Depth along the camera's axis, in any unit; 0 is unknown.")] = None,
    distance: Annotated[FromTo, along("Depth along each pixel's ray, likewise.")] = None,
    points: Annotated[
        FromTo,
        along("CSV whose header names x and y, whole at pixel centres; other columns are kept, 'valid' is added."),
    ] = None,
    annotations: Annotated[
        FromTo, along("COCO files: boxes, polygons, masks and keypoints of all pictures, found by file_name.")
    ] = None,
    refine: Annotated[bool, typer.Option(help=REFINE_HELP)] = True,
    save_camera: Annotated[Path | None, typer.Option(help=SAVE_CAMERA_HELP)] = None,
    weights: Annotated[Path | None, typer.Option(help=WEIGHTS_HELP)] = None,
    format: Annotated[
        str | None, typer.Option(help="Format of what is written to a folder: jpg, png, tif, mp4...; as it was.")
    ] = None,
    quality: Annotated[
        int | None, typer.Option(min=1, max=100, help="Of JPEG, WebP and AVIF (95 if left out) and of video (60).")
    ] = None,
    jobs: Annotated[int | None, typer.Option(min=1, help="Files at a time; one a core if left out.")] = None,
    cluster: Annotated[
        str | None,
        typer.Option(
            metavar="ADDRESS",
            help="Work on a Ray cluster, a core for each of the --jobs: local (this machine), auto (the cluster it "
            "belongs to) or HOST:PORT. All its machines must see the files under the same names.",
        ),
    ] = None,
    overwrite: Annotated[bool, typer.Option("--overwrite", help=OVERWRITE_HELP)] = False,
    resume: Annotated[
        bool,
        typer.Option("--resume", help="Leave out what manifest.jsonl in the folder says is done; redo what changed."),
    ] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Say what would be done, and write nothing.")] = False,
) -> None:
    """Make fisheye pictures and videos straight: with the lens file of a calibrated camera, or by what each shows.

    Without --camera, what has no fisheye distortion is written as it is.

    Without --view, --fov-deg, --focal or --balance the view is edge-matched: the nearest edge of the fisheye picture
    stays at the edge of the result, so nothing in it is empty.

    Whatever moves along takes the camera and the view of its picture. FROM and TO are files for one picture, and for
    several folders of the same relative paths, with other suffixes; of --annotations, one file for all.

    A lens file describes pictures upright, as they are shown, and pixels that are not square as they are stored.

    A folder is searched to the bottom and made again below the output, with a record of what was done and with which
    camera, manifest.jsonl. A file that fails does not stop the rest: the exit status is 1 then.
    """
    from .._arguments import check_antialias, check_interpolation
    from ..file_rectifiers import SUFFIXES, ViewOptions
    from ..folders import plan
    from ..manifest import Manifest

    try:
        if (view, fov_deg, focal, balance).count(None) < 3:
            raise ValueError("expected one of --view, --fov-deg, --focal and --balance, got several")
        check_interpolation("rectify", interpolation)
        check_antialias("rectify", antialias, interpolation)
        mode = view.replace("-", "_") if view is not None else None
        options = ViewOptions(mode, fov_deg, focal, balance, projection, parse_size(size), pan, tilt, roll)
        planned = plan(inputs, output, suffixes=SUFFIXES, target_suffix=_target_suffix(format))
        companions = {"labels": labels, "mask": mask, "depth": depth, "distance": distance, "points": points}
        planned = with_companions(planned, companions)
        coco = annotations_of(planned, annotations)
        check_save_camera([task.source for task in planned.tasks], save_camera, overwrite=overwrite)
        todo, manifest = planned.tasks, None
        count = jobs or min(os.cpu_count() or 1, len(todo))
        if camera is None:
            rectifier: FileRectifier = _blind(options, interpolation, antialias, quality, weights, refine)
        else:
            if save_camera is not None or weights is not None:
                raise ValueError("expected --camera, or --save-camera and --weights to estimate one, got both")
            threads = 1 if cluster is not None else max(1, (os.cpu_count() or 1) // count)
            rectifier = _calibrated(camera, max_fit_error_px, options, interpolation, antialias, quality, threads)
        if planned.folder is not None:
            manifest = Manifest(planned.folder)
        elif resume or format is not None:
            raise ValueError("expected a folder as --output with --resume and --format, got a file")
        if resume and manifest is not None:
            settings = rectifier.settings()
            todo = [task for task in todo if not manifest.is_done(task, settings)]
        if antialias or interpolation != "bilinear" or coco is not None or planned.tasks[0].companions:
            _refuse_videos(planned.tasks)
        files = [file for task in todo for file in task.files]
        if coco is not None:
            files.append((coco.source.path, coco.target))
        targets = [target for _, target in files]
        _check_files(todo, targets, may_replace=overwrite or resume)
        if cluster is not None:
            from ..cluster import check_address  # says what to install

            check_address(cluster)
        if dry_run:
            for source, target in files:
                typer.echo(f"{source} -> {target}")
            return
        beside = {target.parent for target in targets} - {task.target.parent for task in todo}
        if planned.folder is not None:
            beside |= {planned.folder, *(task.target.parent for task in todo)}
        for folder in sorted(beside):
            folder.mkdir(parents=True, exist_ok=True)
    except (ValueError, OSError, ImportError) as error:
        raise fail("rectify", error) from error
    work = functools.partial(_work, todo, rectifier, count if cluster is None else jobs, cluster)
    _run(planned, todo, work, rectifier.settings(), manifest, save_camera, coco, options.rotation())


def _work(
    todo: list[Task], rectifier: FileRectifier, jobs: int | None, cluster: str | None, on_frame: OnFrame
) -> Generator[Outcome, None, None]:
    """Rectify with this process, or on a cluster, which does not tell how far videos have come."""
    if cluster is None:
        from ..bulk import run

        return run(todo, rectifier, jobs=jobs or 1, on_frame=on_frame)
    from ..cluster import run as run_on_cluster

    return run_on_cluster(todo, rectifier, address=cluster, jobs=jobs)


def _run(
    planned: Plan,
    todo: list[Task],
    work: Callable[[OnFrame], Generator[Outcome, None, None]],
    settings: dict[str, Any],
    manifest: Manifest | None,
    save_camera: Path | None,
    annotations: Annotations | None,
    rotation: np.ndarray | None,
) -> None:
    """Rectify, say and write down what became of each file."""
    from ..replacement import remove_leftovers

    failures, made = 0, 0
    cameras: dict[Task, tuple[FisheyeCamera, Camera | None]] = {}
    complaints: Sequence[str] = []
    targets = [target for task in todo for _, target in task.files]
    try:
        remove_leftovers(targets if annotations is None else [*targets, annotations.target])
        with (
            file_progress(len(todo)) as progress,
            contextlib.closing(work(progress.on_frame)) as outcomes,
        ):
            for task, seconds, report, error in outcomes:
                progress.on_file(task)
                if manifest is not None:
                    camera, view = (None, None) if report is None else (report.camera, report.view)
                    manifest.add(task, settings, seconds=seconds, camera=camera, view=view, error=error)
                if report is not None:
                    made += 1
                    cameras[task] = report.camera, report.view
                    progress.echo(f"{task.target}: {report.summary}, {seconds * 1e3:.1f} ms")
                    if save_camera is not None:
                        report.camera.save(save_camera)
                if error is not None:
                    failures += 1
                    progress.complain(f"fisheyerec rectify: {error}")
        if annotations is not None:
            if manifest is not None:
                cameras |= {task: manifest.cameras(task) for task in set(planned.tasks) - set(todo)}
            complaints = annotations.write(planned, cameras, rotation) if cameras else []
    except OSError as error:
        raise fail("rectify", error) from error
    except KeyboardInterrupt:
        say("rectify", f"interrupted after {made} of {len(todo)} files")
        raise typer.Exit(130) from None
    skipped = len(planned.tasks) - len(todo)
    if skipped:
        typer.echo(f"{planned.folder}: {skipped} of {len(planned.tasks)} files were done before")
    if failures and len(planned.tasks) > 1:
        say("rectify", f"{failures} of {len(todo)} files failed")
    for complaint in complaints:
        say("rectify", complaint)
    if failures or complaints:
        raise typer.Exit(1 if made or len(planned.tasks) > 1 else 2)


def _target_suffix(format: str | None) -> Callable[[str], str]:
    from ..file_rectifiers import SUFFIXES, VIDEO_SUFFIXES, target_suffix

    if format is None:
        return functools.partial(target_suffix, picture_suffix=None, video_suffix=None)
    suffix = f".{format.lower().removeprefix('.')}"
    if suffix not in SUFFIXES:
        raise ValueError(f"expected --format such as jpg, png or mp4, got {format!r}")
    if suffix in VIDEO_SUFFIXES:
        return functools.partial(target_suffix, picture_suffix=None, video_suffix=suffix)
    return functools.partial(target_suffix, picture_suffix=suffix, video_suffix=None)


def _calibrated(
    camera: Path,
    max_fit_error_px: float,
    options: ViewOptions,
    interpolation: str,
    antialias: bool,
    quality: int | None,
    threads: int,
) -> CalibratedRectifier:
    from ..cameras import FisheyeCamera
    from ..file_rectifiers import CalibratedRectifier, describe_fit

    fisheye = FisheyeCamera.load(camera, max_fit_error_px=max_fit_error_px)
    if fit := describe_fit(fisheye):
        typer.echo(f"{camera}: {fit}")
    options.view_of(fisheye)  # what is wrong with the options is told before anything is done
    return CalibratedRectifier(fisheye, options, interpolation, quality, threads, antialias)


def _blind(
    options: ViewOptions,
    interpolation: str,
    antialias: bool,
    quality: int | None,
    weights: Path | None,
    refine: bool,
) -> BlindRectifier:
    from ..file_rectifiers import BlindRectifier

    rectifier = BlindRectifier(options, interpolation, quality, weights, refine, antialias)
    rectifier.rectifier()  # broken weights are told before anything is done
    return rectifier


def _refuse_videos(tasks: list[Task]) -> None:
    from ..file_rectifiers import is_video

    for task in tasks:
        if is_video(task.source):
            raise ValueError(
                f"expected pictures with --antialias, --interpolation nearest and what moves along, got {task.source}"
            )


def _check_files(tasks: list[Task], targets: list[Path], *, may_replace: bool) -> None:
    """Refuse what would fail at the end only: a picture's suffix, files that are there, PyAV that is not."""
    from ..file_rectifiers import is_video
    from ..pictures import picture_format_of

    for task in tasks:
        if not is_video(task.source):
            picture_format_of(task.target)
    if any(is_video(task.source) for task in tasks):
        from .. import video  # noqa: F401  says what to install
    check_new(targets, overwrite=may_replace)
