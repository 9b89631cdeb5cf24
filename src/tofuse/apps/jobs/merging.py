"""Multi-session mapping: merging the results of several runs into one map.

Each session, a recording with the poses of its result, is a component of one large run. Its further
stages are those of a run: components are joined where registered views of both confirm it and none
contradicts, loops between them are closed, all views are refined jointly, and fused. The world
frame is that of the first result. Sessions that can't be joined remain separate components.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import accumulate
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from tofuse.apps.jobs.run_options import ModelOptions
from tofuse.apps.jobs.session_pairs import SessionModel, session_changes, session_pairs
from tofuse.apps.jobs.sessions import Session, read_sessions
from tofuse.apps.report import session_words
from tofuse.apps.results import folders, write_result
from tofuse.engine.arrays import Float64
from tofuse.engine.bounds import Bounds
from tofuse.engine.compute import threads as use_threads
from tofuse.engine.frames import Recording
from tofuse.engine.fusion import Textured
from tofuse.engine.geometry import se3
from tofuse.engine.graph import external_sensors
from tofuse.engine.loops import PriorLoop
from tofuse.engine.mapping import Config, Mapper, from_method, reconstructing
from tofuse.engine.parts import check_number
from tofuse.engine.progress import Progress, Silent
from tofuse.engine.quality import trajectory_errors
from tofuse.engine.quantities import percent, probability
from tofuse.engine.results import Reason, Reconstruction, SessionRecord, verdicts
from tofuse.engine.stored_views import PosedView
from tofuse.engine.tracking import given
from tofuse.engine.views import PreparedView
from tofuse.formats.recordings import JoinedSource

# Maximum number of view pairs that are registered to join two sessions, and number of searches per
# session to be joined.
_TRIES, _SEARCHES = 24, 48
# Minimum probability that a join is correct.
_MIN_PROBABILITY = 0.99


@dataclass(frozen=True)
class MergeOptions(ModelOptions):
    """The options of ``tofuse merge``; see its ``--help``."""

    out: Path
    overwrite: bool = False
    seed: int = 0
    threads: int | None = None


def merge(
    results: Sequence[str | Path],
    *,
    tolerance_m: float | None = None,
    seed: int = 0,
    threads: int | None = None,
    progress: Progress | None = None,
) -> Reconstruction:
    """Merge the results of several runs into one map, in the world frame of the first.

    Parameters
    ----------
    results
        Output folders of `tofuse run` or `tofuse merge`; at least two sessions. Their recordings
        must still be available.
    tolerance_m
        As in `Config`, m; by default that of the first result.
    seed, threads, progress
        As in `reconstruct`.

    Returns
    -------
    A result like that of a run, with `sessions` and `session_pairs`. Sessions that can't be joined
    to the first one are components with their own models.

    Raises
    ------
    InputError
        If a folder is not a result, or its recording is missing or has changed.
    """
    progress = progress or Silent()
    if tolerance_m is not None:
        tolerance_m = check_number(tolerance_m, Bounds(0, exclusive=True), "tolerance_m")
    sessions = read_sessions(results, threads, progress)
    config = merged_config(sessions)
    if tolerance_m is not None:
        config = replace(config, tolerance_m=tolerance_m)
    return merge_sessions(sessions, config, seed=seed, threads=threads, progress=progress)


def merged_config(sessions: Sequence[Session]) -> Config:
    """Return the configuration of a merge: the default, with the model options of the first.

    And with the external sensors of all, unless one of them used none.
    """
    first = sessions[0].config
    default = from_method("default")
    sensors = [p for s in sessions for p in s.config.priors]
    priors = {type(p): p for p in sensors}
    odometry = [p for p in sensors if isinstance(p, external_sensors.OdometryEdges)]
    if odometry:  # the least accurate
        priors[external_sensors.OdometryEdges] = max(odometry, key=lambda p: p.scale or 0)
    # A phone may be upright in one session and on its side in another.
    rolls = np.exp(1j * np.array([s.roll for s in sessions]))
    apart = float(np.abs(np.angle(rolls[:, None] / rolls)).max())
    search = default.search
    if apart > search.roll:
        search = replace(search, roll=min(search.roll + apart, np.pi))
    searches = _SEARCHES * (len(sessions) - 1)
    moved = [_given_poses(s).moved_m for s in sessions for _ in s.posed]
    moved_m = float(np.sqrt(np.mean(np.square(moved)))) if moved else 0.0
    joining = replace(
        default.joining,
        main="first",
        tries=_TRIES,
        searches=searches,
        min_probability=_MIN_PROBABILITY,
    )
    return replace(
        default,
        corrections=first.corrections,
        filters=first.filters,
        model_filters=first.model_filters,
        odometry=replace(_given_poses(sessions[0]), moved_m=moved_m),
        fusion=first.fusion,
        tolerance_m=first.tolerance_m,
        priors=tuple(priors.values()) if all(s.config.priors for s in sessions) else (),
        joining=joining,
        search=search,
        self_calibration=False,  # done for each session
    )


def _given_poses(session: Session) -> given.GivenPoses:
    odometry = session.config.odometry
    assert isinstance(odometry, given.GivenPoses)
    return odometry


def merge_sessions(
    sessions: Sequence[Session],
    config: Config,
    *,
    seed: int = 0,
    threads: int | None = None,
    progress: Progress | None = None,
) -> Reconstruction:
    """Join, refine and fuse sessions; see `merge`."""
    progress = progress or Silent()
    recording, offsets = joined_recording(sessions)
    # The loops that earlier merges closed between sessions, to be registered again: the loop search
    # selects the pairs with the largest overlap, which need not connect all sessions.
    links = [
        PriorLoop(i + offset, j + offset, by_user=False)
        for session, offset in zip(sessions, offsets, strict=True)
        for i, j in session.links
    ]
    mapper = Mapper(config, seed=seed, threads=threads, loops=links, progress=progress)
    progress.stage("reading sessions", len(recording))
    with threadpool_limits(1):
        for session, offset in zip(sessions, offsets, strict=True):
            odometry = _given_poses(session)
            stated = {k + offset: pose for k, pose in session.stated.items()}
            mapper.interrupt(replace(session.config, odometry=given.StatedPoses(stated, odometry)))
            session_recording = replace(recording, indices=session.recording.indices + offset)
            reconstructing.push_frames(mapper, session_recording, session.config.window)
        result = mapper.finish()
        progress.stage("comparing sessions")
        with use_threads(mapper.threads):
            return _with_sessions(result, sessions, offsets, mapper.views, recording)


def joined_recording(sessions: Sequence[Session]) -> tuple[Recording, list[int]]:
    """Return the recordings of all sessions as one, and the first frame index of each."""
    sources = [session.recording.source for session in sessions]
    counts = [len(source.timestamps) for source in sources]
    offsets = list(accumulate(counts, initial=0))[:-1]
    indices = [s.recording.indices + offset for s, offset in zip(sessions, offsets, strict=True)]
    formats = dict.fromkeys(s.recording.format for s in sessions)
    path = " ".join(s.recording.path for s in sessions)
    joined = JoinedSource(sources, [session.name for session in sessions])
    return Recording(joined, path, "+".join(formats), np.concatenate(indices)), offsets


def _with_sessions(
    result: Reconstruction,
    sessions: Sequence[Session],
    offsets: Sequence[int],
    views: Sequence[PosedView[PreparedView]],
    recording: Recording,
) -> Reconstruction:
    """Return the result with its sessions, their overlaps and changes."""
    merged_poses = SessionModel.of(result).poses
    records = tuple(
        SessionRecord(
            session.name,
            str(session.result.absolute()),
            session.opening.to_dict(),
            session.config.to_dict(),
            offset,
            len(session.recording.source.timestamps),
            _T_main_session(session.posed, offset, merged_poses, fixed=k == 0),
        )
        for k, (session, offset) in enumerate(zip(sessions, offsets, strict=True))
    )
    components_before = [{s.component for s in session.posed.values()} for session in sessions]
    pairs = session_pairs(result, records, components_before, views)
    result = replace(
        reconstructing.with_recording_facts(result, reconstructing.recording_facts(recording)),
        sessions=records,
        session_pairs=pairs,
        changes=session_changes(result, records, views),
    )
    reasons = tuple(_reasons(result))
    diagnostics = replace(result.diagnostics, reasons=reasons, verdict=verdicts.verdict_of(reasons))
    return replace(result, diagnostics=diagnostics)


def _T_main_session(
    posed: dict[int, given.StatedPose],
    offset: int,
    merged_poses: dict[int, Float64],
    *,
    fixed: bool,
) -> Float64 | None:
    """Return (4, 4) T_main_session between the world frames; None if the session is not joined.

    Refinement has changed the relative poses of its frames, so this is a least squares alignment;
    for the first session (`fixed`), whose world frame is the main one, that of its first frame.
    """
    main = min((s.component for s in posed.values()), default=None)
    common = [k for k, s in posed.items() if s.component == main and k + offset in merged_poses]
    if not common:
        return None
    stated = np.array([posed[k].T_component_camera for k in common])
    merged = np.array([merged_poses[k + offset] for k in common])
    if fixed:
        return np.asarray(merged[0] @ se3.inverse(stated[0]), np.float64)
    return trajectory_errors.align(stated, merged)


def _reasons(result: Reconstruction) -> Iterator[Reason]:
    """Return the reasons, with the names of sessions that are not joined."""
    unjoined = [s.name for s in result.sessions if s.T_main_session is None]
    for reason in result.diagnostics.reasons:
        if unjoined and reason.code == "disconnected":
            main = [s.name for s in result.sessions if s.T_main_session is not None]
            text = f"No overlap could be confirmed between {' or '.join(main)} and "
            text += ", ".join(unjoined)
            reached = max((c.reached for c in result.components), default=0.0)
            if reached > 0:
                text += (
                    f": the likeliest pose is right with a probability of {probability(reached)}, "
                    f"and {percent(_MIN_PROBABILITY)} are required; more views of the same "
                    "surfaces, from other directions and places, would raise it"
                )
            yield replace(reason, text=f"{text}. {reason.text}")
        else:
            yield reason


def merge_files(
    results: Sequence[str | Path], options: MergeOptions, progress: Progress | None = None
) -> Reconstruction:
    """Merge results and write the output folder.

    Raises
    ------
    InputError
        See `merge`.
    OutputError
        If the result can't be written; an existing folder is then unchanged.
    """
    progress = progress or Silent()
    # Claimed before the results are read: it may be one of them.
    with folders.OutputFolder(options.out, overwrite=options.overwrite) as folder:
        progress.stage("opening")
        sessions = read_sessions(results, options.threads, progress)
        config = options.applied(merged_config(sessions))
        result = merge_sessions(
            sessions, config, seed=options.seed, threads=options.threads, progress=progress
        )
        recording, _ = joined_recording(sessions)
        texture = options.make_texture(recording, result, config, options.threads, progress)
        progress.stage("writing")
        with threadpool_limits(1):
            write_result(result, folder, partial(_report, texture, result), texture)
    return result


def _report(
    texture: Textured | None, merged: Reconstruction, result: Reconstruction, folder: Path
) -> None:
    from tofuse.apps.report import ReportExtras, write_report

    names = ", ".join(session.name for session in result.sessions)
    extras = ReportExtras(
        title=f"{names} merged" if names else f"{folder.name} of a merged result",
        headline=" ".join(session_words.session_sentences(result)),
        texture=texture if result is merged else None,
    )
    write_report(result, folder / "report.html", extras)
