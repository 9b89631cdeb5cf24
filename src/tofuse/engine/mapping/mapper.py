"""The mapper: takes frames one at a time, returns their poses, and finally the model."""

from __future__ import annotations

import os
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import wraps
from threading import RLock
from typing import Any, Concatenate, ParamSpec, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from tofuse.engine import quantities
from tofuse.engine.arrays import Float64
from tofuse.engine.bounds import Bounds
from tofuse.engine.compute import ahead, thread_count, threads, trim_memory
from tofuse.engine.errors import InputError, signals_as_themselves
from tofuse.engine.frames import CloudFrame, Frame, RangeFrame
from tofuse.engine.geometry import se3
from tofuse.engine.loops import PriorLoop
from tofuse.engine.mapping import adaptation
from tofuse.engine.mapping.assembly import Assembly
from tofuse.engine.mapping.backend import Job
from tofuse.engine.mapping.color_frames import ColorFrames
from tofuse.engine.mapping.config import Config, check_views, kind_of
from tofuse.engine.mapping.frame_log import FrameLog, FrameSequence, record_of
from tofuse.engine.mapping.live_poses import LivePoses
from tofuse.engine.mapping.methods import configured
from tofuse.engine.mapping.observations import Observations
from tofuse.engine.mapping.preparation import FilteredFrame, Preparation, Prepared
from tofuse.engine.parts import check_number
from tofuse.engine.progress import OnlineMap, Progress, receiver
from tofuse.engine.results import FrameRecord, Reconstruction
from tofuse.engine.stopwatch import current, timing
from tofuse.engine.stored_views import PosedView
from tofuse.engine.times import check_frame_time
from tofuse.engine.tracking import FrameTime, Step, Tracker
from tofuse.engine.views import PreparedView

_UNIT = 1e-3  # tolerance of the length of a unit vector

P = ParamSpec("P")
R = TypeVar("R")


def _in_turn(method: Callable[Concatenate[Mapper, P], R]) -> Callable[Concatenate[Mapper, P], R]:
    """Let threads call a method of a mapper one after another."""

    @wraps(method)
    def call(mapper: Mapper, /, *args: P.args, **options: P.kwargs) -> R:
        if mapper._process != os.getpid():  # before the lock, which may be held for ever there
            raise InputError(
                "belongs to another process, as its threads do",
                where="mapper",
                remedy="make the Mapper in the process that uses it",
            )
        with mapper._lock, signals_as_themselves():
            return method(mapper, *args, **options)

    return call


class Mapper:
    """Turns frames into a trajectory and a model, online.

    >>> mapper = Mapper("default")
    >>> for frame in frames:
    ...     T_world_camera = mapper.push(frame)   # None where lost
    >>> result = mapper.finish()

    Several threads may push: they take turns, and a frame that comes too late is an InputError.

    Parameters
    ----------
    config
        A configuration, or the name of one; or options that differ from the default, as in a TOML
        file of ``--config``: ``{"fusion": {"voxel_m": 0.01}}``.
    seed
        The result is reproducible for each seed.
    threads
        Number of threads; None: all cores. The result does not depend on it.
    loops
        Given loops, in frame indices: pairs (i, j), or (i, j, T_i_j) with the measured motion.
    progress
        Receives frames and stages.
    tracker
        Replaces that of the configuration's odometry.
    surface
        Whether images make a surface; otherwise the model is a sketch, for judging poses alone.
    colors
        Reads the colour of pushed frames again, at its full resolution, so that `finish` can
        measure motions by it; None: colour counts at the size of the depth only.
    """

    def __init__(
        self,
        config: Config | str | Mapping[str, Any] = "default",
        *,
        seed: int = 0,
        threads: int | None = None,
        loops: Sequence[PriorLoop | Sequence[Any]] = (),
        progress: Progress | None = None,
        tracker: Tracker | None = None,
        surface: bool = True,
        colors: ColorFrames | None = None,
    ) -> None:
        check_number(seed, Bounds(0), "seed", whole=True)
        if threads is not None:
            check_number(threads, Bounds(1), "threads", whole=True)
        self.config = configured(config)
        self._given = config
        self.seed = seed
        self._lock, self._process = RLock(), os.getpid()
        self.threads = threads if threads is not None else thread_count()
        if self.threads > 1:
            ahead.load_in_background()
        self.watch = current()
        self._prior_loops, self._surface = prior_loops(loops), surface
        self._progress = receiver(progress)
        self._sequence = FrameSequence()
        self._log = FrameLog()
        self._closed = self._finished = False  # takes no more frames; has returned its result
        self._shift: Float64 = np.zeros(3)
        self._up: Float64 | None = None
        self._given_tracker, self._colors = tracker, colors
        self._start_method()
        self._progress.began(self.so_far)

    def _start_method(self) -> None:
        self._preparation = Preparation(self.config)
        started = self._given_tracker or self.config.odometry.start(self.seed, self.config.search)
        self._tracker: Tracker = started
        self._observations = Observations(
            self.config, self.seed, self._prior_loops, surface=self._surface
        )
        self._live_poses = LivePoses(self._observations.loops, self.config.optimiser)
        self._component = 0

    @_in_turn
    def push(
        self,
        frame: Frame,
        *,
        T_odometry: ArrayLike | None = None,
        gravity: ArrayLike | None = None,
        history: Sequence[Frame] | None = None,
        prepared: Prepared | None = None,
    ) -> Float64 | None:
        """Add the next frame.

        Parameters
        ----------
        frame
            Uncorrected and unfiltered. Its `index` must be larger than those before. Without
            `history` it is copied, as a camera may write the next image into the same arrays, and
            an InputWarning says once if timestamps do not ascend, or are not in seconds.
        T_odometry
            (4, 4) T_world_camera from odometry or a phone, in any fixed world frame; None or NaN
            where there is none. It is a prior if the configuration has the part "odometry", or is
            given by name or options and uses gravity.
        gravity
            (4,) unit vector of gravity in the camera's frame, (0, 1, 0) if it is level, and its
            sigma in rad; None or NaN where there is none. An accelerometer at rest measures the
            opposite.
        history
            Unfiltered frames just before this one, oldest first, for temporal filters; by default
            the frames pushed before.
        prepared
            The result of `prepare` for the frame, if it was called.

        Returns
        -------
        Current estimate of T_world_camera (4, 4); None if the frame is lost, or in a component that
        is not yet connected to the first one. Loops take effect some frames later; `finish` joins
        components and optimises all poses again. Status and covariance are in `last`.

        Raises
        ------
        InputError
            If the frame is of another kind than those before, or of one that the configuration
            does not support, or its index is not larger than those before; if the odometry is no
            rigid motion, or gravity no direction. The mapper is as before, and goes on.
        """
        T_given, down = _odometry(T_odometry), _direction(gravity)
        frame, T_given = self._check(frame, T_given)
        if history is None:
            self._sequence.check_time(frame)
            frame = frame.copy()
        repeated = self._sequence.is_repeated(frame)
        if repeated:
            self._log.repeated.append(frame.index)
        # Chunks run serially while other threads prepare frames; else relocalization uses all.
        busy = prepared is not None and prepared.filtered is not None
        with threads(self.threads, serial=busy), self.watch.running(), timing("tracking"):
            filtered = self._prepare(frame, history, prepared)
            step = self._track(filtered, T_given, repeated)
            record = record_of(filtered.corrected, step, frame.mean_depth)
            self._log.add(record, step, T_given, down)
            self._store(filtered, step)
            with timing("loops"):
                self._live_poses.update(step, self._log)
            return self._report(filtered, step)

    @timing("filters")
    def _prepare(
        self, frame: Frame, history: Sequence[Frame] | None, prepared: Prepared | None
    ) -> FilteredFrame:
        T_expected = None
        if self._log.entries and self._log.entries[-1].has_pose:
            T_expected = self._tracker.predicted_pose(FrameTime(frame.index, frame.timestamp))
        return self._preparation.process(frame, T_expected, history, prepared)

    def _track(self, filtered: FilteredFrame, T_odometry: Float64 | None, repeated: bool) -> Step:
        step = self._tracker.push(filtered.for_tracking, T_odometry, filtered.surface)
        if repeated and step.status == "tracked":
            reason = f"the same image as frame {self._log.entries[-1].record.index}"
            step = replace(step, status="predicted", reason=reason)
        if step.T_component_camera is None:  # a lost frame is in no component
            return step
        if step.component != self._component:
            self._component = step.component
            self._preparation.begin_component()
        if step.status == "tracked":
            self._preparation.add_pose(filtered.for_tracking, step.T_component_camera)
        return step

    def _store(self, filtered: FilteredFrame, step: Step) -> None:
        lost = step.T_component_camera is None
        if step.moving is not None:
            filtered = replace(filtered, for_model=filtered.for_model.keep(~step.moving))
        if not lost:
            with timing("loops"):
                self._observations.add(filtered, step)
            with timing("fusion"):
                self._observations.add_to_model(filtered, step)
        self._observations.sample(filtered, lost=lost)

    def _report(self, filtered: FilteredFrame, step: Step) -> Float64 | None:
        self._progress.advance(self._log.entries[-1].record)
        T_world_camera = self._live_poses.pose(step)
        if T_world_camera is not None:
            self._progress.placed(filtered.for_model, T_world_camera)
        return T_world_camera

    def prepare(self, frame: Frame) -> Prepared | None:
        """Prepare a frame for `push` in advance, as far as that depends on this frame alone.

        May be called by other threads while earlier frames are pushed. The result of `push` does
        not depend on it.
        """
        return self._preparation.prepare_ahead(frame, self._tracker)

    @_in_turn
    def skip(self, index: int, timestamp: float, reason: str) -> None:
        """Record that a frame could not be read.

        Parameters
        ----------
        index, timestamp
            Frame index, larger than those before, and s.
        reason
            Why it could not be read.

        Raises
        ------
        InputError
            If no frame can have that index or timestamp.
        """
        self._check_open()
        index, timestamp = check_frame_time(index, timestamp)
        self._sequence.check_order(index)
        self._sequence.accept(index)
        self._log.add(FrameRecord(index, timestamp, "skipped", reason), None)
        self._progress.advance(self._log.entries[-1].record)

    @_in_turn
    def interrupt(self, config: Config | None = None) -> None:
        """Begin another recording with the next frame: the motion is not continuous.

        Parameters
        ----------
        config
            Provides corrections, filters and odometry of the new recording; None keeps the current
            ones. Its component numbers must not have been used before.
        """
        self._check_open()
        if self._log.entries:
            self._log.interruptions.append(len(self._log.entries))
        for part in (self._tracker, self._preparation, self._sequence, self._observations):
            part.interrupt()
        if config is not None:
            self._preparation = Preparation(config, self._preparation.counts)
            self._tracker = config.odometry.start(self.seed, config.search)

    @property
    def last(self) -> FrameRecord | None:
        """The record of the latest frame: status, reason, residuals, covariance of the pose.

        The covariance is that of tracking alone: it knows neither loops nor systematic errors,
        which `finish` takes into account. None where a direction is not measured, and for
        components that began after a gap.
        """
        if not self._log.entries:
            return None
        entry = self._log.entries[-1]
        if entry.step is None or entry.step.T_component_camera is None or entry.step.component:
            return entry.record
        covariance = self._live_poses.covariance(entry.record.index, self._log)
        return replace(entry.record, covariance=covariance)

    @property
    def log(self) -> FrameLog:
        """The log of all frames so far."""
        return self._log

    @property
    def views(self) -> Sequence[PosedView[PreparedView]]:
        """Prepared views of frames with a pose, spaced by motion, in the order of their frames."""
        return self._observations.views.views

    def so_far(self) -> OnlineMap:
        """Return what is known of the component of the latest frame."""
        log = self._log.of_component(self._component)
        graph = self._live_poses.graph(self._component, log)
        times = {e.record.index: e.record.timestamp for e in log.entries}
        views = [v for v in self.views if v.component == self._component]
        degenerate = frozenset(e.record.index for e in log.entries if len(e.record.unobservable))
        timestamps = np.array([times[i] for i in graph.ids.tolist()])
        return OnlineMap(graph, timestamps, views, degenerate)

    @_in_turn
    def finish(self) -> Reconstruction:
        """Join components, close loops, optimise, refine, fuse and judge.

        If it is interrupted, it can be called again.

        Raises
        ------
        InputError
            If no frame has a pose.
        """
        if self._finished:
            self._check_open()
        self._log.check_posed()
        self._closed = True
        with self.watch.running():
            with timing("loops"):
                self._live_poses.finish()
            with timing("fusion"):
                self._observations.finish()
            for name in ("_sequence", "_tracker", "_given_tracker"):  # the last frame, keyframes
                vars(self).pop(name, None)
            trim_memory()
            is_fixed = isinstance(self._given, Config)
            if not is_fixed and any(e.T_odometry is not None for e in self._log.entries):
                self.config = adaptation.with_odometry_prior(self.config)
            job = Job(
                self.config, self._observations, self._prior_loops, self._progress, self._colors
            )
            result = Assembly(job, self.seed, self.threads).run(self._log)
        diagnostics = replace(
            result.diagnostics,
            removed=self._preparation.counts.fractions,
            samples=self._observations.samples.all,
        )
        up = self._up if result.up is None else result.up
        self._finished = True
        return replace(result, diagnostics=diagnostics, shift=self._shift, up=up)

    def _check(self, frame: Frame, T_odometry: Float64 | None) -> tuple[Frame, Float64 | None]:
        """Return the frame and the odometry, those of clouds relative to the first one's shift."""
        self._check_open()
        if not isinstance(frame, RangeFrame | CloudFrame):
            raise InputError(
                f"is {quantities.one(type(frame).__name__)}, not a frame",
                where="frame",
                remedy="pass a RangeFrame or a CloudFrame",
            )
        self._sequence.check_order(frame.index)
        kind = kind_of(frame)
        if self._sequence.check_kind(frame):
            if isinstance(frame, CloudFrame):
                self.config = configured(self._given, kind)
                self._shift = frame.shift
                self._up = frame.likely_up
                self._prior_loops = tuple(p.about(-self._shift) for p in self._prior_loops)
                self._start_method()
            check_views(self.config, kind)
        self._sequence.accept(frame.index, kind)
        if not isinstance(frame, CloudFrame) or not self._shift.any():
            return frame, T_odometry
        if T_odometry is not None:
            T_odometry = se3.about(-self._shift, T_odometry)
        return frame.relative_to(self._shift), T_odometry

    def _check_open(self) -> None:
        if self._closed:
            raise InputError("is finished", where="mapper", remedy="make a new Mapper")


def prior_loops(
    loops: Sequence[PriorLoop | Sequence[Any]], frames: Collection[int] | None = None
) -> tuple[PriorLoop, ...]:
    """Return the loops that the user gives, of the indices of existing `frames`, if known.

    Raises
    ------
    InputError
        If one is not a loop, or joins a frame that doesn't exist.
    """
    if not isinstance(loops, Sequence) or isinstance(loops, str):
        raise InputError(
            f"is {quantities.one(type(loops).__name__)}",
            where="loops",
            remedy="pass a list of pairs (i, j)",
        )
    found = tuple(PriorLoop.of(loop) for loop in loops)
    for index in (index for loop in found for index in (loop.i, loop.j)):
        if frames is not None and index not in frames:
            remedy = "use indices of frames, counted before any selection"
            raise InputError(f"there is no frame {index}", where="loops", remedy=remedy)
    return found


def _odometry(T: ArrayLike | None) -> Float64 | None:
    """Return the pose (4, 4) of odometry; None where it is unknown."""
    if T is None:
        return None
    with suppress(TypeError, ValueError, OverflowError):
        if np.shape(T) == (4, 4) and se3.is_unknown(T):
            return None
    return se3.check_pose(T, where="T_odometry")


def _direction(gravity: ArrayLike | None) -> Float64 | None:
    """Return the unit vector of gravity and its sigma (4,); None where it is unknown."""
    if gravity is None:
        return None
    remedy = "pass the unit vector in the camera's frame, and its sigma in rad"
    try:
        values = np.array(gravity, float)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError("is not an array of numbers", where="gravity", remedy=remedy) from error
    if values.shape != (4,):
        raise InputError(f"has shape {values.shape}", where="gravity", remedy=remedy)
    if np.isnan(values).any():
        return None
    length, sigma = np.linalg.norm(values[:3]), values[3]
    if not (abs(length - 1) <= _UNIT and 0 < sigma < np.inf):
        problem = f"has the length {length:.3g}, and a sigma of {sigma:.3g}"
        raise InputError(problem, where="gravity", remedy=remedy)
    return values
