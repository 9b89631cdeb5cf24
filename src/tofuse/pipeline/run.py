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
from tofuse.errors import InputError
from tofuse.filters.base import apply_filters
from tofuse.inspection.finding import Finding
from tofuse.inspection.inspect import inspect_recording
from tofuse.parts import name_of
from tofuse.pipeline.budget import voxels_mb
from tofuse.pipeline.checkpoint import Checkpoints, digest
from tofuse.pipeline.config import Config, ViewKind, changed, from_method, read_changes
from tofuse.pipeline.judging import device_sentence
from tofuse.pipeline.learn import learnt
from tofuse.pipeline.paint import TEXTURE, paint
from tofuse.pipeline.priors import Prior, with_prior
from tofuse.pipeline.progress import Progress, Silent, Stopwatch
from tofuse.pipeline.reconstruct import (
    fitted,
    past_frames,
    reconstruct,
    reference_in_world,
    truth_points,
    view_kind,
)
from tofuse.posegraph.given import read_loops
from tofuse.recordings.frames import CloudFrame, Frame
from tofuse.recordings.opening import Opening
from tofuse.recordings.recording import Recording
from tofuse.results.folder import (
    RECORDING,
    OutputFolder,
    check_free,
    component_number,
    is_result,
)
from tofuse.results.output import plain, read_run_json, write_result
from tofuse.results.types import Reason, Reconstruction, in_main_model
from tofuse.results.verdict import ranked, verdict_of

_CLOUDS = 12  # views drawn, where they are clouds
# What may come of a state that was changed.
_STRANGE = (ArithmeticError, AssertionError, AttributeError, LookupError, TypeError, ValueError)
_LOOKED_AT = 8  # frames, for what they hold


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
        check_free(options.out)
    seed = _seed(options)
    watch = Stopwatch()
    with watch.timing("opening"):
        opening = _opening(inputs, options)
        recording = opening.open()
        _preview(recording, progress)
        config = resolve(options, view_kind(recording))
        if not options.object:  # of an object that is the world no sensor knows the motion
            recording, config = with_prior(recording, config, options.prior)
        _check_guess(options, recording)
        if options.unwrap:
            _check_unwrap(recording)
        config = learnt(fitted(config, recording), recording, options.threads, progress)
        loops = (
            read_loops(options.loops, frozenset(recording.indices.tolist()))
            if options.loops
            else ()
        )
        # At the start: what is wrong with a recording is told before hours of work.
        findings = _findings(recording, turning=options.object)
        if any(isinstance(part, Unwrap) for part in config.corrections):
            findings = tuple(f for f in findings if f.code != "phase_wrap")
        for warning in (*recording.warnings, *(str(f) for f in findings)):
            progress.note(warning)
    kept = Checkpoints(options.out, _key(inputs, options, recording, config, seed), progress.note)
    overwrite = options.overwrite or bool(kept.fresh)
    with (
        OutputFolder(options.out, overwrite=overwrite) if folder is None else nullcontext(folder)
    ) as out:
        kept.begin(not is_result(options.out))
        try:
            result = reconstruct(
                recording,
                config,
                seed=seed,
                threads=options.threads,
                loops=loops,
                progress=progress,
                stages=kept,
            )
            size = config.fusion.texture
            texture = None
            if size:
                with watch.timing("texture"):
                    texture = paint(recording, result, size, options.threads, progress)
            if size and texture is None:
                progress.note("no texture: there is no surface, or neither colour nor amplitude")
            result = with_findings(result, findings, turning=options.object)
            result = replace(result, recording={**result.recording, "opening": opening.to_dict()})
            if device := device_sentence(recording, result):
                progress.note(device)
            seconds = {**watch.seconds, **result.diagnostics.seconds}
            result = replace(result, diagnostics=replace(result.diagnostics, seconds=seconds))
            progress.stage("writing")
            # BLAS sums differ with its number of threads, and its threads wait by spinning.
            with threadpool_limits(1):
                write_result(
                    result, out, lambda r, f: write_report_files(recording, config, r, f), texture
                )
            kept.finish()
        except _STRANGE as error:
            kept.give_up(error)
            if kept.used:  # somebody changed it; without it, an error is ours
                raise kept.unusable(error) from error
            raise
        except BaseException as error:
            kept.give_up(error)
            raise
    return result


def _opening(inputs: Sequence[str | Path], options: Options) -> Opening:
    """How the recording is opened, which the result remembers."""
    return Opening(
        tuple(Path(path) for path in inputs),
        options.format,
        options.camera,
        options.topic,
        options.start,
        options.end,
        options.every,
        options.average_still,
    )


def _preview(recording: Recording, progress: Progress) -> None:
    """Show the first frame before any work begins: there the first pose will be."""
    frame = recording.first_readable()
    if frame is not None:
        progress.placed(frame, np.eye(4))


def _key(
    inputs: Sequence[str | Path],
    options: Options,
    recording: Recording,
    config: Config,
    seed: int,
) -> str:
    """Digest of all that decides the result: what is read and how, and the program."""
    facts = {
        "config": plain(config.to_dict()),
        "seed": seed,
        "format": recording.format,
        "topic": options.topic,
        "frames": recording.indices.tolist(),
        "average_still": options.average_still,
    }
    beside = (options.camera, options.loops)
    files = [Path(path) for path in (*inputs, *beside) if path is not None]
    return digest(facts, files, without=options.out)


def _findings(recording: Recording, *, turning: bool) -> tuple[Finding, ...]:
    """What a quick look finds; nothing, if the frames that it looks at can't be read."""
    try:
        return inspect_recording(recording, turning=turning, quick=True).findings
    except InputError:
        return ()


def with_findings(
    result: Reconstruction, findings: Sequence[Finding], *, turning: bool = False
) -> Reconstruction:
    """Return the result with what a look at the recording found, which may change the verdict.

    Behind a turning object it does not matter that what is far is measured as if it were near: the
    background is left out.
    """
    indices = [f.index for f in result.diagnostics.frames]
    everything = ((indices[0], indices[-1]),)
    told = [
        Reason("faulty_recording", everything, f"{f.text} {f.remedy}")
        for f in findings
        if f.severity == "severe" and not (turning and f.code == "phase_wrap")
    ]
    reasons = ranked((*result.diagnostics.reasons, *told))
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
        divided = {"memory_mb": megabytes, "fusion": {"memory_mb": voxels_mb(megabytes)}}
        config = changed(config, divided, where="--memory")
    if options.tolerance is not None:
        config = changed(config, {"tolerance_m": options.tolerance}, where="--tolerance")
    front: list[dict[str, Any]] = []
    if options.min_depth is not None or options.max_depth is not None:
        low = options.min_depth or 0.0
        if options.max_depth is not None and options.max_depth <= low:
            raise InputError(
                f"is {options.max_depth} m and the least depth {low} m",
                where="--max-depth",
                remedy="give a larger one",
            )
        front.append({"part": "distance", "minimum": low, "maximum": options.max_depth})
    chosen = config.to_dict()
    filters = {item["part"] for item in chosen["filters"]}
    corrections = list(chosen["corrections"])
    if options.object:
        if options.max_depth is None and not filters & {"background", "foreground", "mask", "box"}:
            front.append({"part": "background"})
        # What the lens scatters stays where it is in the image, and holds the object back.
        names = [item["part"] for item in corrections]
        if "multipath" in names and "scattering" not in names:
            corrections.insert(names.index("multipath"), {"part": "scattering"})
        # The world is the object, of which neither gravity nor the camera's odometry knows.
        config = changed(config, {"outside": []}, where="--object")
    if options.unwrap and kind == "range" and "unwrap" not in [c["part"] for c in corrections]:
        corrections.insert(0, {"part": "unwrap"})
    if front or corrections != chosen["corrections"]:
        lists = {"filters": [*front, *chosen["filters"]], "corrections": corrections}
        config = changed(config, lists, where="--object" if options.object else "--max-depth")
    return config


def _check_unwrap(recording: Recording) -> None:
    """Refuse what can't be unwrapped before work starts."""
    if not any(range_and_amplitude(frame, None) for frame in recording.readable(_LOOKED_AT)):
        raise InputError(
            "the recording can't be unwrapped: that needs its amplitude, and the range after which "
            "the phase of its camera repeats",
            where="--unwrap",
            remedy='give "ambiguity_m" in a camera.json by --camera, or leave --unwrap out',
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
            "is odometry, and the recording holds none",
            where="--guess",
            remedy="put an odometry.txt beside the images, or use --guess previous",
        )


def exit_status(result: Reconstruction) -> int:
    """Return 0 if every readable frame is in the main model, else 3."""
    readable = (f for f in result.diagnostics.frames if f.status != "skipped")
    return 0 if all(in_main_model(f, result.components) for f in readable) else 3


def write_report_files(
    recording: Recording, config: Config, result: Reconstruction, folder: Path
) -> None:
    """Write what of a result is for people into a folder: `report.html`, and the viewer's data."""
    from tofuse.report.extras import ReportExtras
    from tofuse.report.html import write_report
    from tofuse.report.pictures import draw
    from tofuse.viewer.view_file import NAME, write_view_file

    title = _title(Path(recording.path)) or recording.path
    truth = truth_points(recording)
    component = component_number(folder)
    if component is not None:
        title += f", component {component}"
        truth = None  # nothing connects it to the world of this component
        recording = _frames_of(recording, result)
    pictures = draw(result.diagnostics.samples)
    clouds = () if pictures else recording.sample(_CLOUDS)
    extras = ReportExtras(
        title=title,
        headline=device_sentence(recording, result) if component is None else "",
        filter_steps=_filter_steps(_used(config, result), recording, result),
        reference=reference_in_world(recording, result),
        truth_points=truth,
        pictures=pictures,
        clouds=tuple(item for item in clouds if isinstance(item, CloudFrame)),
    )
    write_report(result, folder / "report.html", extras)
    write_view_file(result, pictures, folder / NAME)


def _frames_of(recording: Recording, result: Reconstruction) -> Recording:
    """The frames of a recording that a result is of."""
    frames = [record.index for record in result.diagnostics.frames]
    return replace(recording, indices=recording.indices[np.isin(recording.indices, frames)])


def _title(path: Path) -> str:
    """What a recording is called: by its folder, where its own name says nothing."""
    return (path.parent.name if path.name == RECORDING else "") or path.name


def _used(config: Config, result: Reconstruction) -> Config:
    """The configuration with the corrections that the result was made with, its camera's too."""
    made = {"corrections": result.config["corrections"]}
    return changed(config, made, where="the result's config")


def _filter_steps(
    config: Config, recording: Recording, result: Reconstruction
) -> tuple[tuple[str, Frame], ...]:
    """One frame, raw and after each filter in turn (figure 3.2)."""
    posed = np.flatnonzero(result.has_pose)
    k = int(posed[len(posed) // 2])
    frame = recording[k]
    index = int(recording.indices[k])
    history = past_frames(recording, index, config.window - 1)
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
