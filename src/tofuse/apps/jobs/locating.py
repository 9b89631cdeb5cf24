"""Frames, clips and clouds located in a finished map: `tofuse locate`.

The index of a map is made of its own images, corrected and filtered as in its run, at its final
poses. The frames of a clip are tracked, and a few of them located together.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from threadpoolctl import threadpool_limits

from tofuse._version import __version__
from tofuse.apps.jobs.sessions import sessions_of, with_given_poses
from tofuse.apps.pairs import PairOptions, pair_words, register_files
from tofuse.apps.results import folders, run_json
from tofuse.engine import quantities
from tofuse.engine.arrays import Float64
from tofuse.engine.cameras import Camera
from tofuse.engine.compute import threads
from tofuse.engine.errors import InputError
from tofuse.engine.frames import CloudFrame, Frame, RangeFrame, Recording, evenly_spaced
from tofuse.engine.geometry import se3
from tofuse.engine.loops import locating
from tofuse.engine.mapping import Config, adaptation, clips, from_method, kind_of
from tofuse.engine.progress import Progress
from tofuse.engine.quantities import probability
from tofuse.engine.results import Reconstruction
from tofuse.engine.search import pose_probability
from tofuse.engine.stored_views import PosedView
from tofuse.engine.tracking import Keyframes, given
from tofuse.formats.poses import write_tum
from tofuse.formats.recordings import Opening, OpeningOptions, open_view, split_name
from tofuse.formats.rigs import check_one_camera

# Frames of a clip that are located.
_LOCATED = 4
_NOWHERE = "no place in the map resembles it"
MARKER, TRAJECTORY = "locations.json", "trajectory.txt"
_CONTRACT = folders.Contract.of_files(MARKER, TRAJECTORY, keys=("frames",))


@dataclass(frozen=True, eq=False)
class LocatedFrame:
    """A frame and its pose in a map.

    Attributes
    ----------
    index, timestamp
        Of the frame in its recording, and s.
    location
        Its pose; None if there is none.
    reason
        Why there is none, or it is not accepted; empty otherwise.
    reference_point
        (3,) m, about which its pose is perturbed: of a cloud in map coordinates a point of it, else
        the origin.
    """

    index: int
    timestamp: float
    location: locating.Location | None
    reason: str
    reference_point: Float64 = field(default_factory=lambda: np.zeros(3))

    def __repr__(self) -> str:
        place = self.location and np.round(self.location.T_map_camera[:3, 3], 3).tolist()
        found = f"at {place} m" if place else "without a pose"
        return f"LocatedFrame {self.index}: {found}, {self.reason or 'accepted'}"

    @property
    def accepted(self) -> bool:
        """Whether the frame has an accepted pose."""
        return self.location is not None and self.location.accepted

    def to_dict(self) -> dict[str, Any]:
        """Return plain data: SI units and radians."""
        found: dict[str, Any] = {
            "index": self.index,
            "timestamp": self.timestamp,
            "accepted": self.accepted,
            "reason": self.reason,
        }
        location = self.location
        if location is not None:
            sigma_m, sigma_rad = se3.largest_sigmas(location.covariance).tolist()
            found |= {
                "T_world_camera": location.T_map_camera,
                "covariance": location.covariance.ravel(),
                "sigma_m": sigma_m,
                "sigma_rad": sigma_rad,
                "unobservable": location.unobservable,
                "reference_point_m": self.reference_point,
                "probability": location.probability,
                "runner_up": location.runner_up,
            }
        return run_json.plain(found)


@dataclass(frozen=True, eq=False)
class ResultMap:
    """The index of a map.

    Attributes
    ----------
    locator
        Finds views in it.
    config
        How its images were corrected and filtered, with `GivenPoses`.
    camera
        Its camera.
    """

    locator: locating.Locator
    config: Config
    camera: Camera | None

    @classmethod
    def of(cls, sessions: Sequence[tuple[Recording, Config, dict[int, Float64]]]) -> ResultMap:
        """Make the index from recordings, their configurations, and T_world_camera by index."""
        views = [view for session in sessions for view in clips.map_views(*session)]
        if not views:
            raise InputError("has no image with a pose", where="the result")
        recording, config, _ = sessions[0]
        frame = recording.first_readable()
        camera = frame.camera if isinstance(frame, RangeFrame) else None
        return cls(locating.Locator(views), config, camera)

    @classmethod
    def of_result(cls, recording: Recording, config: Config, result: Reconstruction) -> ResultMap:
        """Make the index of a result, and of the recording and configuration it was made with."""
        indices = [frame.index for frame in result.diagnostics.frames]
        poses = {
            index: T
            for index, T in zip(indices, result.trajectory, strict=True)
            if np.isfinite(T).all()
        }
        return cls.of([(recording, with_given_poses(config), poses)])

    @classmethod
    def read(cls, folder: Path, threads: int | None, progress: Progress) -> ResultMap:
        """Make the index of an output folder from its recordings.

        Raises
        ------
        InputError
            If it is not a result of images, or its recording is missing or has changed.
        """
        sessions = sessions_of(folder, 0, threads, progress)
        return cls.of(
            [
                (
                    session.recording,
                    session.config,
                    {
                        k: s.T_component_camera
                        for k, s in session.posed.items()
                        if s.component == 0 and s.T_component_camera is not None
                    },
                )
                for session in sessions
            ]
        )

    def locate_frame(self, frame: Frame, recording: Recording | None = None) -> LocatedFrame:
        """Locate a single frame, of a recording if that is known."""
        if not isinstance(frame, RangeFrame):
            kind = "cloud" if isinstance(frame, CloudFrame) else type(frame).__name__
            raise InputError(
                f"is {quantities.one(kind)}, not an image of a camera",
                where="frame",
                remedy="pass a frame of tofuse.open or tofuse.from_arrays; register a cloud with "
                "the points of the map: tofuse.register",
            )
        view = clips.prepared_view(frame, self._config_of(frame, recording))
        found = self.locator.locate([PosedView(view, np.eye(4))])
        return _located(frame.index, frame.timestamp, found.get(view.index))

    def locate_clip(self, recording: Recording, progress: Progress) -> list[LocatedFrame]:
        """Track the frames of a recording, and locate them together."""
        config = self._config_of(recording.first_readable(), recording)
        assert isinstance(config.odometry, given.GivenPoses)
        tracking = replace(config, odometry=Keyframes(views=config.odometry.views))
        tracked, lost = clips.tracked_clips(recording, tracking, progress)
        found: dict[int, locating.Location] = {}
        for clip in tracked:
            found |= self._in_clip(clip)
        return [
            _located(index, time, found.get(index), lost.get(index))
            for index, time in zip(
                recording.indices.tolist(), recording.timestamps.tolist(), strict=True
            )
        ]

    def _in_clip(self, clip: clips.Clip) -> dict[int, locating.Location]:
        """Return the locations of the frames of a clip, each from the nearest located one.

        Those that are not accepted are passed over, but where tracking must have drifted: they are
        elsewhere than an accepted one and the motion in between say. Frames to which tracking did
        not constrain the motion are aligned with the map.
        """
        views = clip.store.views
        chosen = evenly_spaced(views, _LOCATED)
        located = self.locator.locate(chosen)
        depths = {view.index: view.depth for view in chosen}
        accepted = {k: location for k, location in located.items() if location.accepted}

        def carried(index: int, locations: dict[int, locating.Location]) -> locating.Location:
            motions = {k: clip.motion(k, index) for k in locations}
            k = min(motions, key=lambda k: (len(motions[k][1]) > 0, abs(k - index)))
            return locations[k].carried(*motions[k], depths[k])

        if accepted:
            located = accepted | {
                k: location
                for k, location in located.items()
                if k not in accepted
                and not se3.is_within(
                    se3.inverse(carried(k, accepted).T_map_camera) @ location.T_map_camera,
                    pose_probability.RIGHT_FRACTION * depths[k],
                    pose_probability.RIGHT_RAD,
                )
            }
        if not located:
            return {}
        found = {index: carried(index, located) for index in clip.poses}
        for view in views:
            near = found[view.index]
            if accepted and not near.accepted:
                aligned = self.locator.follow(view, near)
                if aligned is not None and aligned.accepted:
                    found[view.index] = aligned
        return found

    def _config_of(self, frame: Frame | None, recording: Recording | None = None) -> Config:
        """Return how a frame is corrected: as those of the map if it is of the same camera."""
        if isinstance(frame, RangeFrame) and _is_same(frame.camera, self.camera):
            return self.config
        config = replace(from_method("default"), odometry=self.config.odometry)
        return config if recording is None else adaptation.adapted(config, recording)


def _is_same(camera: Camera, known: Camera | None) -> bool:
    """Whether two cameras have the same pixels: phones focus, which moves their rays by less."""
    if known is None or known.rays().shape != camera.rays().shape:
        return False
    pitch = np.nanmedian(np.abs(np.diff(known.rays()[..., 0], axis=1)))
    return bool(np.nanmax(np.abs(camera.rays() - known.rays())) < pitch)


def _located(
    index: int, timestamp: float, location: locating.Location | None, lost: str | None = None
) -> LocatedFrame:
    reason = (lost or _NOWHERE) if location is None else location.reason
    return LocatedFrame(index, timestamp, location, reason)


@dataclass(frozen=True)
class LocateOptions(OpeningOptions, folders.OutputOptions):
    """The options of ``tofuse locate``; see its ``--help``."""

    threads: int | None = None


def locate_files(
    result: Path, name: str, options: LocateOptions, progress: Progress
) -> list[LocatedFrame]:
    """Locate a frame (REC#12), a clip or a cloud in a result, and write the poses.

    Raises
    ------
    InputError
        If the result or the input can't be used.
    OutputError
        If the poses can't be written; existing files are then unchanged.
    """
    with threads(options.threads), threadpool_limits(1):
        progress.stage("opening")
        with options.folder(_CONTRACT) as folder:
            located = _located_in(result, name, options, progress)
            if folder is not None:
                progress.stage("writing")
                _write(located, result, name, folder)
    return located


def _located_in(
    result: Path, name: str, options: LocateOptions, progress: Progress
) -> list[LocatedFrame]:
    folders.check_result(result)
    path, number = split_name(name)
    frame: Frame | None
    recording: Recording | None
    if number is None:
        recording = Opening.of([path], options).open()
        check_one_camera(recording)
        frame = recording.first_readable()
        is_clip = len(recording) > 1
    elif (options.start, options.end, options.every) != (0, None, 1):
        raise InputError(
            "names one frame already", where=name, remedy="leave out --start, --end and --every"
        )
    else:
        view = open_view(name, options)
        frame, recording, is_clip = view.frame, view.recording, False
    if frame is not None and kind_of(frame) == "cloud":
        return [_located_cloud(result, name, options, progress)]
    progress.stage("reading the map")
    index = ResultMap.read(result, options.threads, progress)
    progress.stage("locating")
    if recording is not None and (frame is None or is_clip):
        return index.locate_clip(recording, progress)
    assert frame is not None
    return [index.locate_frame(frame, recording)]


def _located_cloud(
    result: Path, name: str, options: LocateOptions, progress: Progress
) -> LocatedFrame:
    """Register a cloud with the points of a result."""
    cloud = next((p for p in (result / "cloud.ply", result / "cloud.laz") if p.exists()), None)
    if cloud is None:
        raise InputError("has no cloud.ply", where=result, remedy="run `tofuse run` again")
    pair = register_files(
        name, str(cloud), PairOptions(factor=options.factor, threads=options.threads), progress
    )
    registration, C = pair.in_files, pair.registration.covariance
    location = locating.Location(
        registration.T_target_source,
        np.full((6, 6), np.nan) if C is None else C,
        registration.unobservable,
        registration.probability or 0.0,
        "" if registration.believed else registration.reason or "the pose can't be verified",
        registration.runner_up,
    )
    located = _located(pair.source.index, pair.source.frame.timestamp, location)
    return replace(located, reference_point=registration.reference_point)


def sentence(frame: LocatedFrame) -> str:
    """Describe the pose of a frame: position, rotation, sigma and probability."""
    words = [f"frame {frame.index}"]
    location = frame.location
    if location is not None:
        T = location.T_map_camera
        rotation = np.degrees(se3.so3_log(T[:3, :3]))
        (place,) = se3.transform(T, frame.reference_point[None])
        words.append(
            f"at {pair_words.vector(place, 3)} m, rotation {pair_words.vector(rotation, 1)} deg"
        )
        sigma_m, sigma_rad = se3.largest_sigmas(location.covariance).tolist()
        if np.isfinite(sigma_m) and not len(location.unobservable):
            words.append(f"sigma {1e3 * sigma_m:.0f} mm, {np.degrees(sigma_rad):.2f} deg")
        words.append(f"probability {probability(location.probability)}")
        if location.runner_up is not None:
            other = se3.transform(location.runner_up, frame.reference_point[None])
            apart = np.linalg.norm(other - place)
            words.append(f"runner-up {apart:.2f} m away")
    return "; ".join([*words, *([frame.reason] if frame.reason else [])])


def locations_json(located: Sequence[LocatedFrame], result: Path, name: str) -> dict[str, Any]:
    """Return the content of `locations.json`."""
    return {
        "schema": 1,
        "version": __version__,
        "result": str(result.absolute()),
        "input": name,
        "accepted": sum(frame.accepted for frame in located),
        "frames": [frame.to_dict() for frame in located],
    }


def _write(
    located: Sequence[LocatedFrame], result: Path, name: str, folder: folders.OutputFolder
) -> None:
    accepted = [f for f in located if f.location is not None and f.accepted]
    poses = np.array([f.location.T_map_camera for f in accepted if f.location]).reshape(-1, 4, 4)
    with folder.staging() as staging:
        write_tum(staging / TRAJECTORY, [f.timestamp for f in accepted], poses)
        run_json.write_object(staging / MARKER, locations_json(located, result, name))
