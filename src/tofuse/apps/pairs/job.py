"""Registration of two files or frames: open, move near the origin, register, write."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter

import numpy as np
from threadpoolctl import threadpool_limits

from tofuse.apps.pairs.result import (
    CONTRACT,
    MARKER,
    LocalView,
    PairResult,
    pair_json,
    write_aligned,
)
from tofuse.apps.results import folders
from tofuse.engine.arrays import Float64
from tofuse.engine.clouds import register
from tofuse.engine.compute import threads
from tofuse.engine.errors import InputError
from tofuse.engine.frames import CloudFrame
from tofuse.engine.geometry import se3
from tofuse.engine.progress import Progress, Silent
from tofuse.formats.files import atomic
from tofuse.formats.poses import pose_text, read_pose
from tofuse.formats.recordings import SingleView, open_view

# Clouds farther from the origin are centred first: rotation errors would have long lever arms.
MAX_ORIGIN_DISTANCE_M = 1000.0


@dataclass(frozen=True)
class PairOptions:
    """Options of the registration of two views.

    Attributes
    ----------
    guess
        File with the initial T_target_source; see `read_pose`.
    out
        Folder for the result; None writes none.
    overwrite
        Whether an earlier registration there is replaced.
    format, camera, topic
        As in `open_recording`. The camera is that of all inputs that store images.
    threads
        Number of threads; None for all cores.
    """

    guess: Path | None = None
    out: Path | None = None
    overwrite: bool = False
    format: str | None = None
    camera: Path | None = None
    topic: str | None = None
    threads: int | None = None


def register_files(
    source: str, target: str, options: PairOptions | None = None, progress: Progress | None = None
) -> PairResult:
    """Register the views called `source` and `target` (see `open_view`), and write the result.

    Raises
    ------
    InputError
        If a view or the guess can't be used.
    RegistrationError
        If the views can't be registered.
    OutputError
        If the result can't be written; existing files are then unchanged.
    """
    options, progress = options or PairOptions(), progress or Silent()
    with threads(options.threads), threadpool_limits(1):
        progress.stage("opening")
        guess = None if options.guess is None else read_pose(options.guess)
        if options.out is None:
            return _registered(source, target, guess, options, progress)
        with folders.OutputFolder(
            options.out, overwrite=options.overwrite, contract=CONTRACT
        ) as folder:
            result = _registered(source, target, guess, options, progress)
            progress.stage("writing")
            _write(result, folder)
    return result


def pair_exit_status(result: PairResult) -> int:
    """Return 0 if the pose is accepted, 3 if not or if it can't be verified."""
    return 0 if result.registration.believed else 3


def _registered(
    source: str, target: str, guess: Float64 | None, options: PairOptions, progress: Progress
) -> PairResult:
    views = _open_both(source, target, options)
    local_source, local_target = _near_origin(*views, guess)
    T_start = None
    if guess is not None:
        T_start = guess.copy()
        T_start[:3, 3] += guess[:3, :3] @ local_source.center - local_target.center
        # Projected onto a rotation: rounded entries would move points far from the origin.
        T_start = se3.orthonormalise(T_start)
    progress.stage("registering")
    start_s = perf_counter()
    registration = register(local_source.frame, local_target.frame, guess=T_start)
    seconds = perf_counter() - start_s
    name = None if options.guess is None else str(options.guess)
    return PairResult(local_source, local_target, registration, name, seconds)


def _open_both(source: str, target: str, options: PairOptions) -> tuple[SingleView, SingleView]:
    """Open both views; one of them may be a cloud, which needs no camera."""
    views: list[SingleView] = []
    refusals: list[InputError] = []
    for name in (source, target):

        def open_with(camera: Path | None, name: str = name) -> SingleView:
            return open_view(name, format=options.format, camera=camera, topic=options.topic)

        try:
            views.append(open_with(options.camera))
        except InputError as error:
            if error.where != "--camera":
                raise
            refusals.append(error)
            views.append(open_with(None))
    if len(refusals) == 2:
        raise refusals[0]
    return views[0], views[1]


def _near_origin(
    source: SingleView, target: SingleView, guess: Float64 | None
) -> tuple[LocalView, LocalView]:
    """Move clouds that are far from the origin near it.

    Without a guess, clouds close to each other are shifted equally, which preserves the identity as
    initial pose; else each is centred.
    """
    boxes = [_box(view) for view in (source, target)]
    if not any(np.abs(box).max() > MAX_ORIGIN_DISTANCE_M for box in boxes):
        zero = np.zeros(3)
        return LocalView(source, source.frame, zero), LocalView(target, target.frame, zero)
    centers = [np.round(box.mean(0)) for box in boxes]
    for k, view in enumerate((source, target)):
        if not isinstance(view.frame, CloudFrame):
            centers[k] = np.zeros(3)
    if guess is None and all(isinstance(v.frame, CloudFrame) for v in (source, target)):
        max_distance = np.ptp(boxes[0], axis=0).max() + np.ptp(boxes[1], axis=0).max()
        if np.linalg.norm(centers[0] - centers[1]) <= max_distance:
            centers[0] = centers[1]
    return _shifted(source, centers[0]), _shifted(target, centers[1])


def _box(view: SingleView) -> Float64:
    """Return the corners (2, 3) of the box of 90 % of the points, in the file's coordinates."""
    box: Float64 = np.percentile(view.frame.points.astype(float), [5, 95], axis=0)
    return box + view.shift


def _shifted(view: SingleView, center: Float64) -> LocalView:
    frame = view.frame
    if isinstance(frame, CloudFrame):
        step = view.shift - center
        points = (frame.points.astype(np.float64) + step).astype(np.float32)
        frame = replace(frame, points=points, origin=frame.origin + step)
    return LocalView(view, frame, center)


def _write(result: PairResult, folder: folders.OutputFolder) -> None:
    from tofuse.apps.pairs.page import write_pair_report

    with folder.staging() as staging:
        atomic.write_text(staging / "transform.txt", pose_text(result.T_target_source))
        write_aligned(result, staging / "aligned.ply")
        write_pair_report(result, staging / "report.html")
        text = json.dumps(pair_json(result), indent=1, allow_nan=False)
        atomic.write_text(staging / MARKER, text + "\n")
