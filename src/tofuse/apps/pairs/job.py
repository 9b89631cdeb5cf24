"""Registration of two files or frames: open, move near the origin, register, write."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter

from threadpoolctl import threadpool_limits

from tofuse.apps.pairs.registering import (
    MAX_RISK,
    RISKS,
    at_risk,
    registered_near,
    registered_scaled,
    registrar_of,
    with_factor,
)
from tofuse.apps.pairs.result import CONTRACT, MARKER, PairResult, pair_json, write_aligned
from tofuse.apps.pairs.views import named_view
from tofuse.apps.results import folders, run_json
from tofuse.engine.arrays import Float64
from tofuse.engine.clouds import NearOrigin
from tofuse.engine.compute import threads
from tofuse.engine.errors import InputError
from tofuse.engine.parts import check_number
from tofuse.engine.progress import Progress, Silent
from tofuse.formats.files import atomic
from tofuse.formats.poses import pose_text, read_pose
from tofuse.formats.recordings import ReadingOptions, SingleView


@dataclass(frozen=True)
class PairOptions(ReadingOptions, folders.OutputOptions):
    """Options of the registration of two views, `factor` of the source's coordinates alone.

    Attributes
    ----------
    guess
        File with the initial T_target_source; see `read_pose`.
    method
        Name of a registration method; None for `AnyPair`.
    scale
        Whether the source is of unknown scale.
    risk
        Largest probability, up to `MAX_RISK`, with which an accepted pose may be wrong.
    threads
        Number of threads; None for all cores.
    """

    guess: Path | None = None
    method: str | None = None
    scale: bool = False
    risk: float = MAX_RISK
    threads: int | None = None


def register_files(
    source: str, target: str, options: PairOptions | None = None, progress: Progress | None = None
) -> PairResult:
    """Register the views called `source` and `target` (see `named_view`), and write the result.

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
    check_number(options.risk, RISKS, "--risk")
    with threads(options.threads), threadpool_limits(1):
        progress.stage("opening")
        guess = None if options.guess is None else read_pose(options.guess)
        with options.folder(CONTRACT) as folder:
            result = _registered(source, target, guess, options, progress)
            if folder is not None:
                progress.stage("writing")
                _write(result, folder)
    return result


def pair_exit_status(result: PairResult) -> int:
    """Return 0 if the pose is accepted, 3 if not or if it can't be verified."""
    return 0 if result.registration.believed else 3


def _registered(
    source: str, target: str, guess: Float64 | None, options: PairOptions, progress: Progress
) -> PairResult:
    if options.scale and options.factor is not None:
        raise InputError("are exclusive", where="--scale, --factor", remedy="leave one out")
    views = _open_both(source, target, options)
    near = NearOrigin.of(views[0].frame, views[1].frame, guess)
    progress.stage("registering")
    start_s = perf_counter()
    if options.scale:
        near, registration = registered_scaled(near, options.method)
    else:
        registration = registered_near(near, registrar_of(options.method))
    registration = with_factor(registration, options.factor)
    seconds = perf_counter() - start_s
    name = None if options.guess is None else str(options.guess)
    near_source = replace(views[0], frame=near.source)
    near_target = replace(views[1], frame=near.target)
    registration = at_risk(registration, options.risk)
    return PairResult(near_source, near_target, registration, name, seconds)


def _open_both(source: str, target: str, options: PairOptions) -> tuple[SingleView, SingleView]:
    """Open both views; one of them may be a cloud, which needs no camera."""
    views: list[SingleView] = []
    refusals: list[InputError] = []
    for name, reading in ((source, options), (target, replace(options, factor=None))):
        try:
            views.append(named_view(name, reading))
        except InputError as error:
            if error.where != "--camera":
                raise
            refusals.append(error)
            views.append(named_view(name, replace(reading, camera=None)))
    if len(refusals) == 2:
        raise refusals[0]
    return views[0], views[1]


def _write(result: PairResult, folder: folders.OutputFolder) -> None:
    from tofuse.apps.pairs.page import write_pair_report

    with folder.staging() as staging:
        atomic.write_text(staging / "transform.txt", pose_text(result.similarity))
        write_aligned(result, staging / "aligned.ply")
        write_pair_report(result, staging / "report.html")
        run_json.write_object(staging / MARKER, pair_json(result))
