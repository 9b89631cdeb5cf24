"""Registering two files or frames: opened, moved near the origin, registered, written."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter

import numpy as np
from threadpoolctl import threadpool_limits

from tofuse.arrays import Float64
from tofuse.errors import InputError
from tofuse.files.pose import read_pose
from tofuse.geometry import se3
from tofuse.kernels.threads import threads
from tofuse.pipeline.progress import Progress, Silent
from tofuse.recordings.frames import CloudFrame
from tofuse.recordings.single import SingleView, open_view
from tofuse.registration.register import register
from tofuse.results.folder import OutputFolder
from tofuse.results.pair import LocalView, PairResult, pair_folder, write_pair

# Clouds this far out are registered about their middle: errors of rotation would have long levers.
FAR_M = 1000.0


@dataclass(frozen=True)
class PairOptions:
    """What can be asked for beside the two views.

    Attributes
    ----------
    guess
        File with the T_target_source to start from; see `read_pose`.
    out
        Folder for the result, which is only returned unless given.
    overwrite
        Whether an earlier registration there is replaced.
    format, camera, topic
        As of `open_recording`. The camera is that of all inputs that store images.
    threads
        How many are used; None for all.
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
        If the result can't be written; nothing that was there before has changed then.
    """
    options, progress = options or PairOptions(), progress or Silent()
    with threads(options.threads), threadpool_limits(1):
        progress.stage("opening")
        guess = None if options.guess is None else read_pose(options.guess)
        if options.out is None:
            return _registered(source, target, guess, options, progress)
        with pair_folder(options.out, overwrite=options.overwrite) as folder:
            result = _registered(source, target, guess, options, progress)
            progress.stage("writing")
            _write(result, folder)
    return result


def exit_status(result: PairResult) -> int:
    """Return 0 if the pose is believed, 3 if it is not, or cannot be verified."""
    return 0 if result.found.believed else 3


def _registered(
    source: str, target: str, guess: Float64 | None, options: PairOptions, progress: Progress
) -> PairResult:
    views = _open_both(source, target, options)
    data, model = _near_origin(*views, guess)
    start = np.eye(4)
    if guess is not None:
        start = guess.copy()
        start[:3, 3] += guess[:3, :3] @ data.center - model.center
        # Made a rotation here: rounded entries would move what lies far from the origin.
        start = se3.orthonormalise(start)
    progress.stage("registering")
    began = perf_counter()
    found = register(data.frame, model.frame, guess=None if guess is None else start)
    seconds = perf_counter() - began
    name = None if options.guess is None else str(options.guess)
    return PairResult(data, model, found, start, name, seconds)


def _open_both(source: str, target: str, options: PairOptions) -> tuple[SingleView, SingleView]:
    """Open both views; one of two may be a cloud, for which a camera means nothing."""
    views: list[SingleView] = []
    refusals: list[InputError] = []
    for name in (source, target):

        def opened(camera: Path | None, name: str = name) -> SingleView:
            return open_view(name, format=options.format, camera=camera, topic=options.topic)

        try:
            views.append(opened(options.camera))
        except InputError as error:
            if error.where != "--camera":
                raise
            refusals.append(error)
            views.append(opened(None))
    if len(refusals) == 2:
        raise refusals[0]
    return views[0], views[1]


def _near_origin(
    source: SingleView, target: SingleView, guess: Float64 | None
) -> tuple[LocalView, LocalView]:
    """Move clouds that lie far out near the origin.

    Without a guess, clouds that lie near each other are moved by the same, so that the identity
    stays what it is; else each goes to its own middle, where the registration starts.
    """
    boxes = [_box(view) for view in (source, target)]
    if not any(np.abs(box).max() > FAR_M for box in boxes):
        zero = np.zeros(3)
        return LocalView(source, source.frame, zero), LocalView(target, target.frame, zero)
    centers = [np.round(box.mean(0)) for box in boxes]
    for k, view in enumerate((source, target)):
        if not isinstance(view.frame, CloudFrame):
            centers[k] = np.zeros(3)
    if guess is None and all(isinstance(v.frame, CloudFrame) for v in (source, target)):
        reach = np.ptp(boxes[0], axis=0).max() + np.ptp(boxes[1], axis=0).max()
        if np.linalg.norm(centers[0] - centers[1]) <= reach:
            centers[0] = centers[1]
    return _moved(source, centers[0]), _moved(target, centers[1])


def _box(view: SingleView) -> Float64:
    """Corners (2, 3) around the middle of a view's points, in the coordinates of its file."""
    middle: Float64 = np.percentile(view.frame.points.astype(float), [5, 95], axis=0)
    return middle + view.shift


def _moved(view: SingleView, center: Float64) -> LocalView:
    frame = view.frame
    if isinstance(frame, CloudFrame):
        step = view.shift - center
        points = (frame.points.astype(np.float64) + step).astype(np.float32)
        frame = replace(frame, points=points, origin=frame.origin + step)
    return LocalView(view, frame, center)


def _write(result: PairResult, folder: OutputFolder) -> None:
    def page(result: PairResult, path: Path) -> None:
        from tofuse.report.pair import write_pair_report

        write_pair_report(result, path)

    report: Callable[[PairResult, Path], None] = page
    write_pair(result, folder, report)
