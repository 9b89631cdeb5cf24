"""The whole job of ``tofuse run``: options, recording, reconstruction, output folder."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from threadpoolctl import threadpool_limits

from tofuse.corrections.raw_amplitude import range_and_amplitude
from tofuse.corrections.unwrap import Unwrap
from tofuse.errors import InputError, UnreadableFrameError
from tofuse.files.memory import give_back
from tofuse.filters.base import apply_filters
from tofuse.fusion.texture import Textured
from tofuse.inspection.finding import Finding
from tofuse.inspection.inspect import inspect_recording
from tofuse.parts import name_of
from tofuse.pipeline.adaptation import adapted
from tofuse.pipeline.checkpoint import Checkpoints, digest
from tofuse.pipeline.config import Config, ViewKind, changed, from_method, read_changes
from tofuse.pipeline.judging import device_sentence
from tofuse.pipeline.paint import TEXTURE, paint
from tofuse.pipeline.priors import Prior, with_prior
from tofuse.pipeline.progress import Progress, Silent, Stopwatch
from tofuse.pipeline.reconstruct import (
    past_frames,
    reconstruct,
    reference_in_world,
    truth_points,
    view_kind,
)
from tofuse.posegraph.given import read_loops
from tofuse.posegraph.loops import GivenLoop
from tofuse.recordings.frames import CloudFrame, Frame
from tofuse.recordings.opening import Opening
from tofuse.recordings.recording import Recording
from tofuse.results.folder import (
    RECORDING,
    OutputFolder,
    check_output,
    component_number,
    is_result,
)
from tofuse.results.output import plain, read_run_json, write_result
from tofuse.results.types import Reason, Reconstruction, in_main_model
from tofuse.results.verdict import ranked, verdict_of

_DRAWN_CLOUDS = 12  # views in the report, if they are clouds
# Errors that a modified checkpoint may cause.
_STATE_ERRORS = (
    ArithmeticError,
    AssertionError,
    AttributeError,
    LookupError,
    TypeError,
    ValueError,
)
_SAMPLED = 8  # frames that are checked for what --unwrap needs


@dataclass(frozen=True)
class Options:
    """The options of ``tofuse run``; see its ``--help``."""

    out: Path
    method: str | None = None
    config: Path | None = None
    camera: Path | None = None
    topic: str | None = None
    format: str | None = None
    seed: int | None = None
    threads: int | None = None
    start: int = 0
    end: int | None = None
    every: int = 1
    average_still: bool = False
    min_depth: float | None = None
    max_depth: float | None = None
    guess: Literal["identity", "previous", "odometry"] | None = None
    prior: Prior = "auto"
    loops: Path | None = None
    object: bool = False
    unwrap: bool = False
    tolerance: float | None = None
    texture: bool = False
    faces: int | None = None
    voxel: float | None = None
    memory: int | None = None
    overwrite: bool = False


def run(
    inputs: Sequence[str | Path],
    options: Options,
    progress: Progress | None = None,
    folder: OutputFolder | None = None,
) -> Reconstruction:
    """Reconstruct recordings and write the output folder, which may be claimed already.

    Raises
    ------
    InputError, OutputError
        If nothing could be written; see the message for the remedy.
    """
    progress = progress or Silent()
    if folder is None:
        check_output(options.out, overwrite=options.overwrite)
    watch = Stopwatch()
    with watch.timing("opening"):
        job = _open(inputs, options, progress)
    checkpoints = Checkpoints(options.out, _key(inputs, options, job), progress.note)
    overwrite = options.overwrite or bool(checkpoints.fresh)
    with (
        OutputFolder(options.out, overwrite=overwrite) if folder is None else nullcontext(folder)
    ) as out:
        checkpoints.begin(not is_result(options.out))
        try:
            result = reconstruct(
                job.recording,
                job.config,
                seed=job.seed,
                threads=options.threads,
                loops=job.loops,
                progress=progress,
                stages=checkpoints,
            )
            texture = _texture(job, result, options, progress, watch)
            result = _with_job(result, job, options, watch)
            if device := device_sentence(job.recording, result):
                progress.note(device)
            progress.stage("writing")
            give_back()
            # BLAS sums differ with its number of threads, and its threads wait by spinning.
            with threadpool_limits(1):
                write_result(
                    result,
                    out,
                    lambda r, f: write_report_files(job.recording, job.config, r, f),
                    texture,
                )
            checkpoints.finish()
        except _STATE_ERRORS as error:
            checkpoints.give_up(error)
            if checkpoints.used:  # it was modified; without a checkpoint, an error is ours
                raise checkpoints.unusable(error) from error
            raise
        except BaseException as error:
            checkpoints.give_up(error)
            raise
    return result


@dataclass(frozen=True, eq=False)
class _Job:
    """A recording and how it is reconstructed.

    `findings` are problems of the recording that a quick inspection found.
    """

    opening: Opening
    recording: Recording
    config: Config
    seed: int
    loops: tuple[GivenLoop, ...]
    findings: tuple[Finding, ...]


def _open(inputs: Sequence[str | Path], options: Options, progress: Progress) -> _Job:
    """Open and inspect the recording, and resolve its configuration."""
    seed = _seed(options)
    opening = Opening.of(inputs, options)
    recording = opening.open()
    _preview(recording, progress)
    config = resolve(options, view_kind(recording))
    if not options.object:  # no sensor measures the motion relative to a moving object
        recording, config = with_prior(recording, config, options.prior)
    _check_guess(options, recording)
    if options.unwrap:
        _check_unwrap(recording)
    config = adapted(config, recording, options.threads, progress)
    indices = frozenset(recording.indices.tolist())
    loops = tuple(read_loops(options.loops, indices)) if options.loops else ()
    # At the start, so that problems of the recording are reported before hours of work.
    findings = _findings(recording, turning=options.object)
    if any(isinstance(part, Unwrap) for part in config.corrections):
        findings = tuple(f for f in findings if f.code != "phase_wrap")
    for warning in (*recording.warnings, *(str(f) for f in findings)):
        progress.note(warning)
    return _Job(opening, recording, config, seed, loops, findings)


def _texture(
    job: _Job, result: Reconstruction, options: Options, progress: Progress, watch: Stopwatch
) -> Textured | None:
    """Make the texture if one is configured, and note if there is nothing to make it of."""
    size = job.config.fusion.texture
    if not size:
        return None
    with watch.timing("texture"):
        texture = paint(job.recording, result, size, options.threads, progress)
    if texture is None:
        progress.note("no texture: there is no surface, or neither colour nor amplitude")
    return texture


def _with_job(
    result: Reconstruction, job: _Job, options: Options, watch: Stopwatch
) -> Reconstruction:
    """Add findings, how the recording was opened, and times to the result."""
    result = with_findings(result, job.findings, turning=options.object)
    seconds = {**watch.seconds, **result.diagnostics.seconds}
    return replace(
        result,
        recording={**result.recording, "opening": job.opening.to_dict()},
        diagnostics=replace(result.diagnostics, seconds=seconds),
    )


def _preview(recording: Recording, progress: Progress) -> None:
    """Show the first frame before any work begins, at the first pose."""
    frame = recording.first_readable()
    if frame is not None:
        progress.placed(frame, np.eye(4))


def _key(inputs: Sequence[str | Path], options: Options, job: _Job) -> str:
    """Return a digest of everything that determines the result: input, options, program."""
    facts = {
        "config": plain(job.config.to_dict()),
        "seed": job.seed,
        "format": job.recording.format,
        "topic": options.topic,
        "frames": job.recording.indices.tolist(),
        "average_still": options.average_still,
    }
    option_files = (options.camera, options.loops)
    files = [Path(path) for path in (*inputs, *option_files) if path is not None]
    return digest(facts, files, without=options.out)


def _findings(recording: Recording, *, turning: bool) -> tuple[Finding, ...]:
    """Return the findings of a quick inspection; none if its frames can't be read."""
    try:
        return inspect_recording(recording, turning=turning, quick=True).findings
    except InputError:
        return ()


def with_findings(
    result: Reconstruction, findings: Sequence[Finding], *, turning: bool = False
) -> Reconstruction:
    """Return the result with the findings of an inspection, which may change the verdict.

    Two faults do not matter: wrapped background behind a turning object, which is left out, and a
    focal length that self-calibration has corrected.
    """
    indices = [f.index for f in result.diagnostics.frames]
    whole = ((indices[0], indices[-1]),)
    calibrated = result.diagnostics.calibrated
    harmless = {"phase_wrap"} if turning else set()
    if calibrated is not None and calibrated.focal:
        harmless.add("focal_length")
    severe = [
        Reason("faulty_recording", whole, f"{f.text} {f.remedy}")
        for f in findings
        if f.severity == "severe" and f.code not in harmless
    ]
    reasons = ranked((*result.diagnostics.reasons, *severe))
    verdict = verdict_of(reasons)
    recording = {
        **result.recording,
        "warnings": [*result.recording["warnings"], *(str(f) for f in findings)],
        "findings": [f.to_dict() for f in findings],
    }
    diagnostics = replace(result.diagnostics, verdict=verdict, reasons=reasons)
    components = tuple(
        c
        if c.result is None
        else replace(c, result=with_findings(c.result, findings, turning=turning))
        for c in result.components
    )
    return replace(result, recording=recording, diagnostics=diagnostics, components=components)


def resolve(options: Options, kind: ViewKind = "range") -> Config:
    """Return the configuration that the options ask for, for a kind of view."""
    changes: dict[str, Any] = read_changes(options.config) if options.config else {}
    method = options.method or changes.get("method") or "default"
    if not isinstance(method, str):
        raise InputError(f"is {method!r}", where=f"{options.config}: method")
    config = from_method(method, kind)
    config = changed(config, {**changes, "method": method}, where=str(options.config or "--config"))
    if options.guess:
        config = changed(config, {"odometry": {"guess": options.guess}}, where="--guess")
    if options.texture and not config.fusion.texture:
        config = changed(config, {"fusion": {"texture": TEXTURE}}, where="--texture")
    if options.faces is not None:
        config = changed(config, {"fusion": {"faces": options.faces}}, where="--faces")
    if options.voxel is not None:
        config = changed(config, {"fusion": {"voxel_m": options.voxel}}, where="--voxel")
    if options.memory is not None:
        megabytes = options.memory // 1_000_000
        config = changed(config, {"memory_mb": megabytes}, where="--memory")
    if options.tolerance is not None:
        config = changed(config, {"tolerance_m": options.tolerance}, where="--tolerance")
    front: list[dict[str, Any]] = []
    if options.min_depth is not None or options.max_depth is not None:
        low = options.min_depth or 0.0
        if options.max_depth is not None and options.max_depth <= low:
            raise InputError(
                f"is {options.max_depth} m and the minimum depth {low} m",
                where="--max-depth",
                remedy="use a larger one",
            )
        front.append({"part": "distance", "minimum": low, "maximum": options.max_depth})
    chosen = config.to_dict()
    filters = {item["part"] for item in chosen["filters"]}
    corrections = list(chosen["corrections"])
    if options.object:
        if options.max_depth is None and not filters & {"background", "foreground", "mask", "box"}:
            front.append({"part": "background"})
        # Scattered light of the background is fixed to the image, and drags the object along.
        names = [item["part"] for item in corrections]
        if "multipath" in names and "scattering" not in names:
            corrections.insert(names.index("multipath"), {"part": "scattering"})
        # Neither gravity nor the camera's odometry applies to the frame of a moving object.
        config = changed(config, {"priors": []}, where="--object")
    if options.unwrap and kind == "range" and "unwrap" not in [c["part"] for c in corrections]:
        corrections.insert(0, {"part": "unwrap"})
    if front or corrections != chosen["corrections"]:
        lists = {"filters": [*front, *chosen["filters"]], "corrections": corrections}
        config = changed(config, lists, where="--object" if options.object else "--max-depth")
    return config


def _check_unwrap(recording: Recording) -> None:
    """Raise InputError if the recording can't be unwrapped."""
    if not any(range_and_amplitude(frame, None) for frame in recording.readable(_SAMPLED)):
        raise InputError(
            "the recording can't be unwrapped: that needs its amplitude, and the ambiguity range "
            "of its camera",
            where="--unwrap",
            remedy='set "ambiguity_m" in a camera.json passed with --camera, or omit --unwrap',
        )


def _seed(options: Options) -> int:
    if options.seed is not None:
        return options.seed
    if options.config is not None and options.config.suffix == ".json":
        seed = read_run_json(options.config).get("seed", 0)
        if isinstance(seed, int) and seed >= 0:
            return seed
    return 0


def _check_guess(options: Options, recording: Recording) -> None:
    if options.guess == "odometry" and recording.odometry is None:
        raise InputError(
            "is odometry, and the recording has none",
            where="--guess",
            remedy="put an odometry.txt next to the images, or use --guess previous",
        )


def exit_status(result: Reconstruction) -> int:
    """Return 0 if every readable frame is in the main model, else 3."""
    readable = (f for f in result.diagnostics.frames if f.status != "skipped")
    return 0 if all(in_main_model(f, result.components) for f in readable) else 3


def write_report_files(
    recording: Recording, config: Config, result: Reconstruction, folder: Path
) -> None:
    """Write `report.html` and the data of the viewer into a folder."""
    from tofuse.report.extras import ReportExtras
    from tofuse.viewer.view_file import write_report_and_view

    title = _title(Path(recording.path)) or recording.path
    truth = truth_points(recording)
    component = component_number(folder)
    if component is not None:
        title += f", component {component}"
        truth = None  # its pose relative to this component is unknown
        recording = _frames_of(recording, result)
    clouds = () if result.diagnostics.samples else recording.sample(_DRAWN_CLOUDS)
    extras = ReportExtras(
        title=title,
        headline=device_sentence(recording, result) if component is None else "",
        filter_steps=_filter_steps(_final_config(config, result), recording, result),
        reference=reference_in_world(recording, result),
        truth_points=truth,
        clouds=tuple(item for item in clouds if isinstance(item, CloudFrame)),
    )
    write_report_and_view(result, folder, extras)


def _frames_of(recording: Recording, result: Reconstruction) -> Recording:
    """Select the frames of a result."""
    frames = [record.index for record in result.diagnostics.frames]
    return replace(recording, indices=recording.indices[np.isin(recording.indices, frames)])


def _title(path: Path) -> str:
    """Return the name of a recording; that of its folder for a native recording in a result."""
    return (path.parent.name if path.name == RECORDING else "") or path.name


def _final_config(config: Config, result: Reconstruction) -> Config:
    """Return the configuration with the corrections of the result, after self-calibration.

    Self-calibration adds its corrections before the others. Those are kept as they are, as parts
    contain what they estimated from the recording, which their options don't state.
    """
    final = {"corrections": result.config["corrections"]}
    corrections = changed(config, final, where="the result's config").corrections
    added = len(corrections) - len(config.corrections)
    return replace(config, corrections=(*corrections[:added], *config.corrections))


def _filter_steps(
    config: Config, recording: Recording, result: Reconstruction
) -> tuple[tuple[str, Frame], ...]:
    """Return one frame, raw and after each filter (figure 3.2); none if it can't be read again."""
    posed = np.flatnonzero(result.has_pose)
    k = int(posed[len(posed) // 2])
    index = int(recording.indices[k])
    try:
        frame = recording[k]
        history = past_frames(recording, index, config.window - 1)
    except UnreadableFrameError:  # the recording has been moved or deleted
        return ()
    steps: list[tuple[str, Frame]] = [("raw", frame)]
    for correction in config.corrections:
        corrector = correction.start()
        frame = corrector.apply(frame)
        history = [corrector.apply(past) for past in history]
        steps.append((name_of(correction), frame))
    for item in (*config.filters, *config.model_filters):
        frame, removals = apply_filters([item], frame, history)
        steps.append((removals[0].name, frame))
    return tuple(steps)
