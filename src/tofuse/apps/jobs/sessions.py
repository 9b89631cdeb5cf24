"""Results of earlier runs as sessions: reopened recordings with their poses."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, count
from pathlib import Path
from typing import Any, get_args

import numpy as np

from tofuse.apps.results import folders, reopening, run_json, stated_accuracy
from tofuse.engine.arrays import Float64
from tofuse.engine.errors import InputError
from tofuse.engine.frames import Recording
from tofuse.engine.graph import external_sensors
from tofuse.engine.mapping import Config, adaptation, kind_of
from tofuse.engine.progress import Progress
from tofuse.engine.tracking import Keyframes, Status, given
from tofuse.formats.files import reading
from tofuse.formats.recordings import Opening


@dataclass(frozen=True, eq=False)
class Session:
    """One recording, and the poses that a result states for its frames.

    Attributes
    ----------
    name
        Unique name for display.
    result
        Folder of the result.
    opening
        How its recording was opened.
    recording
        The frames of the result.
    config
        Their corrections and filters, with odometry "given".
    stated
        By the index of a frame in the recording. Components are numbered over all sessions: joined
        components of one result have the same number and coordinate frame.
    stored
        The recording as the result states it.
    links
        (i, j) frames in the result, of the loop closures between its sessions; empty for all but
        the first session of a result.
    roll
        Mean angle of the camera about its optical axis, rad: 0 if up is at the top of the images.
    """

    name: str
    result: Path
    opening: Opening
    recording: Recording
    config: Config
    stated: Mapping[int, given.StatedPose]
    stored: reopening.StoredRecording
    links: tuple[tuple[int, int], ...] = ()
    roll: float = 0.0

    @property
    def posed(self) -> dict[int, given.StatedPose]:
        """The stated frames with a pose."""
        return {k: s for k, s in self.stated.items() if s.T_component_camera is not None}


def read_sessions(
    results: Sequence[str | Path], threads: int | None, progress: Progress
) -> list[Session]:
    """Read the sessions of several results, in order; a merged result yields all of its sessions.

    Raises
    ------
    InputError
        If a folder contains no result, its recording is missing, has changed or contains clouds;
        or if a result was given twice, or only one session.
    """
    remedy = "pass folders, to which result.save(folder) writes results"
    if isinstance(results, str) or not isinstance(results, Iterable):
        raise InputError("is not several paths", where="results", remedy=remedy)
    folders = [reading.path_of(each, "results", remedy) for each in results]
    for a, b in combinations(folders, 2):
        if a.resolve() == b.resolve():
            raise InputError("is given twice", where=b, remedy="pass each result once")
    sessions: list[Session] = []
    components = 0
    for folder in folders:
        new_sessions = sessions_of(folder, components, threads, progress)
        sessions += new_sessions
        numbers = [s.component for session in new_sessions for s in session.posed.values()]
        components = max([components, *(number + 1 for number in numbers)])
    if len(sessions) < 2:
        raise InputError(
            "is a single session",
            where=folders[0] if folders else None,
            remedy="pass two or more results of `tofuse run`",
        )
    for first, second in combinations(sessions, 2):
        _check_different(first, second)
    return _uniquely_named(sessions)


def sessions_of(
    folder: Path, components: int, threads: int | None, progress: Progress
) -> list[Session]:
    """Read the sessions of one result; its components are numbered from `components`.

    Raises
    ------
    InputError
        If the result can't be merged with any other; see `read_sessions`.
    """
    folders.check_result(folder)
    with run_json.opened(folder) as run:
        stated = _stated(folder, run, components)
        parts = list(reopening.stored_recordings(folder, run))
        posed = [{k: stated[part.first + k] for k in part.frames} for part in parts]
        links = _links(run, parts)
        odometry = _odometry(run)
        up = run_json.rotation_up_world(run, folder / "run.json")[1]
    sessions = [
        replace(
            _session(part, poses, odometry, folder, threads, progress),
            roll=_mean_roll(poses.values(), components, up),
        )
        for part, poses in zip(parts, posed, strict=True)
    ]
    return [replace(sessions[0], links=links), *sessions[1:]]


def _mean_roll(stated: Iterable[given.StatedPose], component: int, up: Float64) -> float:
    """Return the mean roll of the poses in a component, of which `up` (3,) is a direction."""
    found = [s.T_component_camera for s in stated if s.component == component]
    poses = np.array([T for T in found if T is not None]).reshape(-1, 4, 4)
    x, y, _ = np.swapaxes(poses[:, :3, :3], 1, 2).sum(0) @ up
    return float(np.arctan2(x, -y)) if len(poses) else 0.0


def _links(
    run: Mapping[str, Any], parts: Sequence[reopening.StoredRecording]
) -> tuple[tuple[int, int], ...]:
    """Return the loop closures (i, j) of a result between its sessions."""
    starts = sorted(p.first for p in parts)
    loops = ((int(p["i"]), int(p["j"])) for p in run.get("loops", ()) if p["accepted"])
    return tuple((i, j) for i, j in loops if bisect_right(starts, i) != bisect_right(starts, j))


def _odometry(run: Mapping[str, Any]) -> external_sensors.SensorRecord | None:
    """Return the use of the odometry that a path rests on; None if it doesn't."""
    records = (external_sensors.SensorRecord(**p) for p in run.get("priors", ()))
    used = [r for r in records if r.sensor == "odometry" and r.used]
    reliable = external_sensors.SensorPriors(records=tuple(used)).is_reliable
    return used[0] if used and reliable else None


def _session(
    part: reopening.StoredRecording,
    stated: dict[int, given.StatedPose],
    odometry: external_sensors.SensorRecord | None,
    folder: Path,
    threads: int | None,
    progress: Progress,
) -> Session:
    """Reopen the recording of a part of a result."""
    recording = reopening.reopen(part, folder)
    frame = recording.first_readable()
    if frame is not None and kind_of(frame) != "range":
        raise InputError(
            "is of clouds, and only results of images can be merged",
            where=folder,
            remedy="pass their clouds together to one `tofuse run`",
        )
    config = with_given_poses(
        reopening.stored_config(part, folder), stated_accuracy(folder).moved_m
    )
    config = adaptation.adapted(config, recording, threads, progress)
    recording, config = adaptation.with_known_odometry(recording, config, odometry)
    opening = reopening.locate_recording(part.opening, folder)
    return Session(part.name, folder, opening, recording, config, stated, part)


def _stated(folder: Path, run: dict[str, Any], components: int) -> dict[int, given.StatedPose]:
    """Return the pose and status that a result states for each frame, by index."""
    poses = _poses(folder, run)
    main = {k: (T, components) for k, T in poses.items()}
    separate = [k for k, c in enumerate(run["components"]) if c["T_main_component"] is None]
    for number, k in enumerate(separate, components + 1):
        component_folder = folder / folders.component_name(k)
        if folders.is_result(component_folder):
            component_run = run_json.read_run_json(component_folder / "run.json")
            poses = _poses(component_folder, component_run)
            main |= {i: (T, number) for i, T in poses.items()}
    stated = {}
    for frame in run["frames"]:
        index, status = int(frame["index"]), frame["status"]
        if status not in get_args(Status):
            raise ValueError(f"frame {index} is {status!r}")
        if index in main:
            T, component = main[index]
            C = run_json.frame_covariance(frame) if component == components else None
            stated[index] = given.StatedPose(status, str(frame["reason"]), T, component, C)
        else:
            reason = str(frame["reason"]) if status in ("lost", "skipped") else "was in no model"
            stated[index] = given.StatedPose("lost", reason)
    return stated


def _poses(folder: Path, run: dict[str, Any]) -> dict[int, Float64]:
    """Return (4, 4) T_world_camera by index, of the frames in a folder's main model."""
    return dict(zip(*run_json.main_poses(folder, run), strict=True))


def with_given_poses(config: Config, moved_m: float = 0.0) -> Config:
    """Return a configuration that adopts given poses, and prepares images as before.

    A refinement moved them by `moved_m` rms.
    """
    given_poses = given.GivenPoses(moved_m=moved_m)
    if isinstance(odometry := config.odometry, Keyframes | given.GivenPoses):
        given_poses = given.GivenPoses(
            odometry.views, odometry.keyframe_angle, odometry.keyframe_distance, moved_m
        )
    return replace(config, odometry=given_poses)


def _check_different(first: Session, second: Session) -> None:
    """Raise InputError if frames of one recording are in both sessions."""
    common = first.posed.keys() & second.posed.keys()
    if common and reopening.is_same(first.stored, second.stored):
        raise InputError(
            f"is of the same recording as {first.result}: {len(common)} frames are in both",
            where=second.result,
            remedy="pass one of the two results",
        )


def _uniquely_named(sessions: list[Session]) -> list[Session]:
    """Return the sessions with unique names."""
    names = [session.name for session in sessions]
    out: list[Session] = []
    for session in sessions:
        taken = {*names[len(out) :], *(earlier.name for earlier in out)}
        numbered = (f"{session.name} ({number})" for number in count(2))
        is_first = session.name not in names[: len(out)]
        unique = session.name if is_first else next(n for n in numbered if n not in taken)
        out.append(replace(session, name=unique))
    return out
