"""The complete job of ``tofuse run``: options, recording, reconstruction, output folder."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from tofuse._version import __version__
from tofuse.apps.inspection import Finding, inspect_recording
from tofuse.apps.jobs.report_files import write_report_files
from tofuse.apps.jobs.run_options import Options, check_guess, check_unwrap, resolve, seed_of
from tofuse.apps.jobs.tracked_file import TrackedFile
from tofuse.apps.results import folders, run_json, write_result
from tofuse.engine.compute import threads, trim_memory
from tofuse.engine.errors import InputError
from tofuse.engine.frames import Recording
from tofuse.engine.loops import PriorLoop
from tofuse.engine.mapping import Config, adaptation, reconstructing
from tofuse.engine.normal import OF_99_PERCENT
from tofuse.engine.progress import Progress, Silent
from tofuse.engine.results import Reason, Reconstruction, SelfCalibration, in_main_model, verdicts
from tofuse.engine.sensor import Unwrap
from tofuse.engine.stopwatch import timing
from tofuse.formats.files import stamps
from tofuse.formats.poses import read_loops
from tofuse.formats.recordings import Opening
from tofuse.formats.rigs import check_one_camera


def run(
    inputs: Sequence[str | Path],
    options: Options,
    progress: Progress | None = None,
    folder: folders.OutputFolder | None = None,
) -> Reconstruction:
    """Reconstruct recordings and write the output folder.

    The folder may be claimed already; the recording is then temporary, and an interrupted run can't
    go on.

    Raises
    ------
    InputError, OutputError
        If nothing could be written; see the message for the remedy.
    """
    progress = progress or Silent()
    if options.share and options.no_report:
        raise InputError("is a part of the report", where="--share", remedy="leave --no-report out")
    if folder is None:
        folders.check_output(options.out, overwrite=options.overwrite)
    job = _open(inputs, options, progress)
    tracked_file = _tracked_file(inputs, options, job, progress) if folder is None else None
    with (
        folders.OutputFolder(options.out, overwrite=options.overwrite)
        if folder is None
        else nullcontext(folder)
    ) as out:
        try:
            result = reconstructing.reconstruct(
                job.recording,
                job.config,
                seed=job.seed,
                threads=options.threads,
                loops=job.loops,
                progress=progress,
                tracked_frames=tracked_file,
            )
            for note in result.recording["warnings"]:
                if note not in job.notes:
                    progress.note(note)
            if options.mirrors:
                result = _without_mirrors(job, result, options, progress)
            texture = options.make_texture(
                job.recording, result, job.config, options.threads, progress
            )
            result = with_findings(result, job.findings, turning=options.object)
            opening = job.opening.to_dict()
            result = replace(result, recording={**result.recording, "opening": opening})
            progress.stage("writing")
            # BLAS results depend on its number of threads, and idle threads busy-wait.
            with threadpool_limits(1), timing("writing"):
                trim_memory()
                report = partial(
                    write_report_files,
                    job.recording,
                    job.config,
                    texture=texture,
                    share=options.share,
                )
                write_result(
                    result, out, None if options.no_report else report, texture, options.share
                )
        except BaseException as error:
            if tracked_file is not None:
                tracked_file.keep_after(error)
            raise
        if tracked_file is not None:
            tracked_file.remove()
    return result


@dataclass(frozen=True, eq=False)
class _Job:
    """A recording and the settings of its reconstruction.

    `findings` are problems of the recording that a quick inspection found, `notes` those of its
    reader that were shown.
    """

    opening: Opening
    recording: Recording
    config: Config
    seed: int
    loops: tuple[PriorLoop, ...]
    findings: tuple[Finding, ...]
    notes: tuple[str, ...]


@timing("opening")
def _open(inputs: Sequence[str | Path], options: Options, progress: Progress) -> _Job:
    """Open and inspect the recording, and resolve its configuration."""
    progress.stage("opening")
    seed = seed_of(options)
    opening = Opening.of(inputs, options)
    recording = opening.open()
    check_one_camera(recording)
    notes = tuple(recording.warnings)  # before most frames are read, which may add some
    if (frame := recording.first_readable()) is not None:  # shown before any work begins
        progress.placed(frame, np.eye(4))
    config = resolve(options, reconstructing.view_kind(recording))
    if not options.object:  # no sensor measures the motion relative to a moving object
        recording, config = adaptation.with_prior(recording, config, options.prior, where="--prior")
    check_guess(options, recording)
    if options.unwrap:
        check_unwrap(recording)
    config = adaptation.adapted(config, recording, options.threads, progress)
    indices = frozenset(recording.indices.tolist())
    loops = tuple(read_loops(options.loops, indices)) if options.loops else ()
    # At the start, so that problems of the recording are reported before hours of work.
    findings = quick_findings(recording, config, turning=options.object)
    for note in (*notes, *(str(f) for f in findings)):
        progress.note(note)
    return _Job(opening, recording, config, seed, loops, findings, notes)


@timing("mirrors")
def _without_mirrors(
    job: _Job, result: Reconstruction, options: Options, progress: Progress
) -> Reconstruction:
    """Find the mirrors of the main model; with a note on each, or that there is none."""
    from tofuse.apps.mirrors import find_mirrors, sentences

    progress.stage("looking for mirrors")
    with threads(options.threads), threadpool_limits(1):
        result = find_mirrors(job.recording, result, job.seed)
    for sentence in sentences(result) or ["no mirror was found"]:
        progress.note(sentence)
    return result


@timing("opening")
def _tracked_file(
    inputs: Sequence[str | Path], options: Options, job: _Job, progress: Progress
) -> TrackedFile:
    """Return the file of the tracked frames for this input, these options and this version."""
    out = options.out.absolute()
    paths = [Path(path) for path in (*inputs, options.camera, options.loops) if path is not None]
    facts = {
        "version": __version__,
        "options": repr(replace(options, out=Path(), overwrite=False, threads=None)),
        "config": run_json.plain(job.config.to_dict()),
        "seed": job.seed,
        "files": [stamps.stamps_of(path.absolute(), out) for path in paths],
    }
    key = hashlib.sha256(json.dumps(facts).encode()).hexdigest()
    return TrackedFile(out / folders.TRACKED, key, progress.note)


@timing("inspection")
def quick_findings(
    recording: Recording, config: Config, *, turning: bool = False
) -> tuple[Finding, ...]:
    """Return the findings of a quick inspection; none if no frames can be read.

    Parameters
    ----------
    recording
        The recording.
    config
        Configuration of the run; faults that its corrections remove are no findings.
    turning
        Whether the camera shows a turning object.
    """
    try:
        findings = inspect_recording(recording, turning=turning, quick=True).findings
    except InputError:
        return ()
    unwraps = any(isinstance(part, Unwrap) for part in config.corrections)
    removed = {"phase_wrap", "some_phase_wrap"} if unwraps else set()
    return tuple(f for f in findings if f.code not in removed)


def with_findings(
    result: Reconstruction, findings: Sequence[Finding], *, turning: bool = False
) -> Reconstruction:
    """Return the result with the findings of an inspection, which may change the verdict.

    Two kinds of faults are ignored: wrapped background behind a turning object, as it is removed,
    and intrinsics that self-calibration has corrected as the finding says. With any other severe
    fault no bound is stated: its evidence supposes a sound recording. Nor is one if the object does
    not turn: the poses are then those of something else.
    """
    indices = [f.index for f in result.diagnostics.frames]
    full_range = ((indices[0], indices[-1]),)
    calibrated = result.diagnostics.calibrated
    severe = [
        Reason("faulty_recording", full_range, f"{f.text} {f.remedy}")
        for f in findings
        if f.severity == "severe"
        and not (turning and f.code == "phase_wrap")
        and not _is_corrected(f, calibrated)
    ]
    known, accuracy = result.diagnostics.reasons, result.diagnostics.accuracy
    if turning and any(reason.code == "stood_still" for reason in known):
        text = "Nothing in the model turned: it stood still, or looks the same from all sides."
        severe.append(Reason("object_still", full_range, text))
    if severe:
        accuracy = accuracy.without_bound()
        known = tuple(reason for reason in known if reason.code != "uncertain_poses")
    reasons = verdicts.ranked((*known, *severe))
    verdict = verdicts.verdict_of(reasons)
    recording = {
        **result.recording,
        "warnings": [*result.recording["warnings"], *(str(f) for f in findings)],
        "findings": [f.to_dict() for f in findings],
    }
    diagnostics = replace(result.diagnostics, verdict=verdict, reasons=reasons, accuracy=accuracy)
    components = tuple(
        c
        if c.result is None
        else replace(c, result=with_findings(c.result, findings, turning=turning))
        for c in result.components
    )
    return replace(result, recording=recording, diagnostics=diagnostics, components=components)


def _is_corrected(finding: Finding, calibrated: SelfCalibration | None) -> bool:
    """Whether self-calibration has corrected what a finding reports, by the amount it states."""
    if calibrated is None:
        return False
    if finding.code == "focal_length" and calibrated.focal and "factor" in finding.evidence:
        difference = finding.evidence["factor"] - 1 / (1 + calibrated.focal)
        sigma = np.hypot(finding.evidence["sigma"], dict(calibrated.sigmas).get("focal", 0.0))
        return bool(abs(difference) <= OF_99_PERCENT * sigma)
    corrections = {
        "focal_length": calibrated.focal,
        "other_intrinsics": calibrated.center_x or calibrated.center_y,
        "lens_distortion": calibrated.distortion,
    }
    return bool(corrections.get(finding.code))


def exit_status(result: Reconstruction) -> int:
    """Return 0 if every readable frame is in the main model, else 3."""
    readable = (f for f in result.diagnostics.frames if f.status != "skipped")
    return 0 if all(in_main_model(f, result.components) for f in readable) else 3
