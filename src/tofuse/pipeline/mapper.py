"""The engine: frames go in one at a time, poses come out, and at the end a model."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from tofuse.errors import InputError
from tofuse.evaluation.sightings import Sightings, sightings, whole
from tofuse.filters.base import Removal, apply_filters
from tofuse.fusion.cloud import Cloud, as_cloud
from tofuse.fusion.model import Model, ModelBuilder
from tofuse.geometry import se3
from tofuse.geometry.cameras import ray_lengths
from tofuse.kernels.threads import thread_count, threads, undivided
from tofuse.maps.surface_map import SurfaceMap
from tofuse.odometry.base import Step
from tofuse.odometry.motion import Motion
from tofuse.odometry.prediction import prediction_sigma, with_prediction
from tofuse.pipeline.behind import Behind
from tofuse.pipeline.checkpoint import NotKept, Stages
from tofuse.pipeline.config import Config, ViewKind, check_views, from_method, kind_of
from tofuse.pipeline.judge import Evidence, judge
from tofuse.pipeline.live import LiveLoops
from tofuse.pipeline.memory import give_back
from tofuse.pipeline.progress import Progress, Silent, Stopwatch
from tofuse.posegraph.build import Measured, build_graph
from tofuse.posegraph.graph import Optimisation, PoseGraph
from tofuse.posegraph.loops import ClosedLoop, GivenLoop
from tofuse.posegraph.outside import Sensed, Told, told_by, with_outside
from tofuse.posegraph.refinement import Refinement
from tofuse.posegraph.trust import LEFT_OUT, pose_covariances, without_left_out
from tofuse.recordings.frames import Frame, RangeFrame
from tofuse.results.samples import FrameSample, FrameSamples
from tofuse.results.types import Diagnostics, FrameRecord, Reason, Reconstruction

T = TypeVar("T")

Float64 = NDArray[np.float64]

_KEPT_POINTS = 50_000  # of each cloud, and of each view for loops; bounds the memory of a run
# So few poses, and so many lost frames after them, may be a start that shows nothing of the scene.
_STARTED, _NOT_FOLLOWED = 3, 10
_FALSE_START = "the frames after it hang together, but not with it: they are the start"
_CHECKED_IMAGES = 60  # how many images are compared with each other in the end


@dataclass(frozen=True, eq=False)
class _Place:
    """A frame as corrected, as filtered for tracking, and as cleaned for the model; its number."""

    position: int
    frame: Frame
    filtered: Frame
    clean: Frame


@dataclass(frozen=True, eq=False)
class Prepared:
    """What can be made of a frame before its turn, by `Mapper.prepare`.

    Attributes
    ----------
    frame
        Corrected by so many (`corrected`) of the corrections: those up to the first that must wait.
    ready
        What was made of it then, if none had to.
    """

    frame: Frame
    corrected: int
    ready: _Ready | None


@dataclass(frozen=True, eq=False)
class _Ready:
    """A frame, filtered for tracking and cleaned for the model, and what that removed."""

    filtered: Frame
    clean: Frame
    removals: tuple[Removal, ...]
    surface: SurfaceMap | None = None


@dataclass(frozen=True, eq=False)
class _Judged:
    """What the verdict looks at: without sensors beside the camera, but for how they led."""

    sequential: Float64
    optimisation: Optimisation
    covariances: Float64


@dataclass(frozen=True, eq=False)
class _Closed:
    """What there is once loops are closed."""

    loops: list[ClosedLoop]
    sequential: Float64
    optimisation: Optimisation
    covariances: Float64
    told: Told
    judged: _Judged


@dataclass(frozen=True, eq=False)
class _Refined:
    """What there is once all views are refined."""

    graph: PoseGraph
    refinement: Refinement


@dataclass(frozen=True, eq=False)
class _Fused:
    """The model, and how it looked before poses moved; None where none did."""

    model: Model
    before: Cloud | None


class Mapper:
    """Turns frames into a trajectory and a model, online.

    >>> mapper = Mapper("default")
    >>> for frame in frames:
    ...     T_world_camera = mapper.push(frame)   # None where lost
    >>> result = mapper.finish()

    Parameters
    ----------
    config
        A configuration, or the name of one.
    seed
        One seed, one result.
    threads
        How many threads to use; None: all cores. The result does not depend on it.
    loops
        Loops known beforehand, in frame indices.
    progress
        Hears about frames and stages.
    """

    def __init__(
        self,
        config: Config | str = "default",
        *,
        seed: int = 0,
        threads: int | None = None,
        loops: Sequence[GivenLoop] = (),
        progress: Progress | None = None,
    ) -> None:
        self.config = from_method(config) if isinstance(config, str) else config
        self._method = config if isinstance(config, str) else None
        self.seed = seed
        self.threads = threads if threads is not None else thread_count()
        self._given_loops = tuple(loops)
        self._progress = progress or Silent()
        self.watch = Stopwatch()
        self._kind: ViewKind | None = None
        self._begin()
        self._records: list[FrameRecord] = []
        self._steps: list[Step | None] = []  # None where a frame could not be read
        self._samples = FrameSamples()
        self._ambiguity_m: float | None = None
        self._before: RangeFrame | None = None  # as the camera gave it
        self._repeated: list[int] = []
        self._lost: dict[int, _Place] = {}  # that may yet get a pose
        self._not_followed = _NOT_FOLLOWED  # lost frames at which another start is tried
        self._interruptions: list[int] = []
        self._sensed: dict[int, tuple[Float64 | None, Float64 | None]] = {}
        self._seen: dict[str, int] = {}
        self._removed: dict[str, int] = {}
        self._ended = self._finished = False

    def _begin(self) -> None:
        self._correctors = [correction.start() for correction in self.config.corrections]
        self._tracker = self.config.odometry.start(self.seed)
        self._behind = Behind()
        self._history: deque[Frame] = deque(maxlen=self.config.window - 1)
        self._begin_map()

    def _begin_map(self) -> None:
        """Begin with what is made of frames that have a pose."""
        self._loops = self.config.loops.start(self.seed, self._given_loops)
        self._live = LiveLoops(self._loops)
        self._T_map_tracked = np.eye(4)  # what loops that closed on the way have moved
        self._refiner = self.config.refinement.start()
        self._motion = Motion()
        self._model = ModelBuilder(self.config.fusion)
        self._checks = _EvenSample(_CHECKED_IMAGES)
        self._depths: list[float] = []  # typical ranges, m
        self._posed = 0
        self._knows_errors = False

    def push(
        self,
        frame: Frame,
        *,
        T_odometry: Float64 | None = None,
        gravity: Float64 | None = None,
        history: Sequence[Frame] | None = None,
        prepared: Prepared | None = None,
    ) -> Float64 | None:
        """Add the next frame.

        Parameters
        ----------
        frame
            As the camera gave it. Its `index` must be larger than those before.
        T_odometry
            (4, 4) T_world_camera from odometry, in any fixed world frame.
        gravity
            (4,) unit vector in which things fall in the camera's frame, and its sigma in rad.
        history
            Unfiltered frames just before this one, oldest first, for temporal filters; the
            frames pushed before it unless given.
        prepared
            What `prepare` made of the frame, if it was asked to.

        Returns
        -------
        T_world_camera (4, 4) as known so far, or None where it is lost. A loop that closes on the
        way counts some frames later; the end moves all poses once more.

        Raises
        ------
        InputError
            If the frame is of another kind than those before, or one that the configuration
            can't work on, or its index does not grow.
        """
        self._check(frame)
        self._sensed[frame.index] = (T_odometry, gravity)
        repeated = self._is_repeated(frame)
        # A search for a lost camera is worth dividing, while those who prepare frames are waiting.
        busy = prepared is not None and prepared.ready is not None and not self._is_lost
        with threads(self.threads), undivided(busy):
            with self.watch.timing("filters"):
                before = self._history if history is None else history
                past = tuple(self._corrected(f) for f in before)
                frame = self._corrected(frame, self._expected(), prepared)
                ready = prepared.ready if prepared is not None else None
                if ready is None:
                    ready = self._filtered(frame, past)
                filtered, clean = ready.filtered, ready.clean
                self._history.append(frame)
            for removal in ready.removals:
                self._seen[removal.name] = self._seen.get(removal.name, 0) + removal.seen
                self._removed[removal.name] = self._removed.get(removal.name, 0) + removal.removed
            with self.watch.timing("tracking"):
                step = self._tracker.push(filtered, T_odometry, ready.surface)
            if repeated and step.status == "tracked":
                reason = f"the same image as frame {self._records[-1].index}, to the last pixel"
                step = replace(step, status="predicted", reason=reason)
            self._follow(filtered, step)
            self._take_lost(step.earlier)
            place = _Place(len(self._records), frame, filtered, clean)
            self._records.append(FrameRecord(frame.index, frame.timestamp, "lost"))
            self._steps.append(None)
            self._take(place, replace(step, earlier=()))
            if step.T_world_camera is None:
                self._lost[frame.index] = place
            else:
                with self.watch.timing("loops"):
                    if self._live.step():
                        self._follow_loops()
            self._keep_waiting()
            if self._posed <= _STARTED and len(self._lost) >= self._not_followed:
                self._not_followed *= 2
                if self._start_later(last=False):
                    step = self._steps[-1] or step
            if (
                isinstance(frame, RangeFrame)
                and isinstance(filtered, RangeFrame)
                and isinstance(clean, RangeFrame)
            ):
                make = partial(FrameSample.of, frame, filtered, clean)
                lost = step.T_world_camera is None
                self._behind.do(lambda: self._samples.take(lost=lost, make=make))
        self._progress.advance(self._records[-1])
        if step.T_world_camera is None:
            return None
        T_world_camera = self._T_map_tracked @ step.T_world_camera
        self._progress.placed(clean, T_world_camera)
        return T_world_camera

    def prepare(self, frame: Frame) -> Prepared | None:
        """Make what can be made of a frame before its turn, for `push`; None if nothing can.

        Other threads may ask for it while frames before it are pushed. It makes no difference to
        what comes out.
        """
        if not isinstance(frame, RangeFrame):
            return None
        try:
            check_views(self.config, "range")
        except InputError:  # said when it is pushed
            return None
        corrected = 0
        for corrector in self._correctors:
            if not corrector.alone(frame):
                return Prepared(frame, corrected, None)
            frame, corrected = corrector.apply(frame), corrected + 1
        if self.config.window > 1:
            return Prepared(frame, corrected, None)
        ready = self._filtered(frame, ())
        surface = self._tracker.prepare(ready.filtered)
        return Prepared(frame, corrected, replace(ready, surface=surface))

    def _filtered(self, frame: Frame, past: Sequence[Frame]) -> _Ready:
        filtered, removals = apply_filters(self.config.filters, frame, past)
        clean, more = apply_filters(self.config.model_filters, filtered, past)
        return _Ready(filtered, clean, (*removals, *more))

    def _follow_loops(self) -> None:
        """Move the newest pose to where the loops so far put it."""
        graph = self._graph(self._live.closed)
        moved = self.config.optimiser.optimise(graph).graph
        self._T_map_tracked = moved.poses[-1] @ se3.inverse(graph.poses[-1])

    def skip(self, index: int, timestamp: float, reason: str) -> None:
        """Say that a frame could not be read; InputError if its index does not grow."""
        self._check_order(index)
        self._records.append(FrameRecord(index, timestamp, "skipped", reason))
        self._steps.append(None)
        self._progress.advance(self._records[-1])

    def interrupt(self) -> None:
        """Say that the next frame begins another recording: the camera may be elsewhere by then."""
        self._interruptions.append(len(self._records))
        self._tracker.interrupt()
        self._motion.interrupt()

    def _is_repeated(self, frame: Frame) -> bool:
        """Whether an image is the one before: a camera that hangs, as noise never repeats."""
        if not isinstance(frame, RangeFrame):
            return False
        before, self._before = self._before, frame
        if before is None or not np.array_equal(before.depth[0], frame.depth[0]):
            return False  # most differ there already
        if not np.array_equal(before.depth, frame.depth) or not len(frame):
            return False
        self._repeated.append(frame.index)
        return True

    def _corrected(
        self,
        frame: Frame,
        T_expected: Float64 | None = None,
        prepared: Prepared | None = None,
    ) -> Frame:
        """Correct a frame, unless it is among those that were corrected last."""
        for before in self._history:
            if before.index == frame.index:
                return before
        done = 0
        if prepared is not None:
            frame, done = prepared.frame, prepared.corrected
        for corrector in self._correctors[done:]:
            frame = corrector.apply(frame, T_expected)
        return frame

    def _expected(self) -> Float64 | None:
        """Where the camera is expected; None where that is not known, or the camera was lost."""
        return None if self._is_lost else self._motion.expected

    @property
    def _is_lost(self) -> bool:
        """Whether the newest frame has no pose."""
        return bool(self._steps) and (self._steps[-1] is None or self._steps[-1].status == "lost")

    def _follow(self, frame: Frame, step: Step) -> None:
        """Tell the corrections where a frame is, and note how the camera moves."""
        T = step.T_world_camera
        if T is None:
            self._motion.miss()
            return
        self._motion.follow(T)
        if step.status == "tracked":
            for corrector in self._correctors:
                corrector.placed(frame, T)

    def _check(self, frame: Frame) -> None:
        self._check_order(frame.index)
        kind = kind_of(frame)
        if self._kind and kind != self._kind:
            raise InputError(
                f"is a {kind} view among {self._kind} views",
                where=f"frame {frame.index}",
                remedy="give images only, or clouds only",
            )
        if self._kind is None:
            if self._method is not None and kind == "cloud":
                self.config = from_method(self._method, kind)
                self._begin()
            check_views(self.config, kind)
            self._kind = kind

    def _check_order(self, index: int) -> None:
        if self._finished or self._ended:
            raise InputError("is finished", where="mapper", remedy="make a new Mapper")
        if self._records and index <= self._records[-1].index:
            raise InputError(
                f"comes after frame {self._records[-1].index}",
                where=f"frame {index}",
                remedy="number the frames in the order in which they are pushed",
            )

    def _take_lost(self, found: Sequence[tuple[int, Step]]) -> None:
        """Take what became of frames that had been lost."""
        for index, step in found:
            self._take(self._lost.pop(index), step)

    def _start_later(self, *, last: bool) -> bool:
        """Start with the first lost frame, if more of them hang together than have a pose so far.

        The first frames may show a hand, or the table from which the camera was lifted, and nothing
        of the scene. `last` says that no frame follows.
        """
        tracker = self.config.odometry.start(self.seed)
        places = list(self._lost.values())
        parts = np.searchsorted(self._interruptions, [p.position for p in places], side="right")
        steps: dict[int, Step] = {}
        with self.watch.timing("tracking"):
            for k, place in enumerate(places):
                if k and parts[k] != parts[k - 1]:
                    tracker.interrupt()
                step = tracker.push(place.filtered, self._sensed[place.frame.index][0])
                steps |= {**dict(step.earlier), place.frame.index: replace(step, earlier=())}
            if last:
                steps |= dict(tracker.finish())
        if sum(step.T_world_camera is not None for step in steps.values()) <= self._posed:
            return False
        for position, before in enumerate(self._steps):
            if before is not None and before.T_world_camera is not None:
                record = self._records[position]
                gone = FrameRecord(record.index, record.timestamp, "lost", _FALSE_START)
                self._records[position] = replace(gone, valid_share=record.valid_share)
                self._steps[position] = Step("lost", _FALSE_START, None)
        self._live.finish()
        self._behind.wait()
        self._begin_map()
        self._tracker = tracker
        for corrector in self._correctors:
            corrector.forget()
        for place in places:
            step = steps[place.frame.index]
            self._take(place, step)
            if step.T_world_camera is None:
                self._motion.miss()
            else:
                self._motion.follow(step.T_world_camera)
        self._keep_waiting()
        return True

    def _keep_waiting(self) -> None:
        """Keep no lost frame that can't be found any more."""
        waiting = self._tracker.waiting
        self._lost = {index: place for index, place in self._lost.items() if index in waiting}

    def _take(self, place: _Place, step: Step) -> None:
        """Take what became of a frame, or what it turns out later to have been."""
        frame, clean, registration = place.frame, place.clean, step.registration
        self._records[place.position] = FrameRecord(
            frame.index,
            frame.timestamp,
            step.status,
            step.reason,
            valid_share=len(frame) / frame.valid.size if frame.valid.size else 0.0,
            inlier_share=None if registration is None else registration.share,
            rms_m=None if registration is None else registration.rms_m,
            unobservable=np.zeros((0, 6)) if registration is None else registration.unobservable,
        )
        # The surface is kept by the refiner as far as it is needed, and large.
        self._steps[place.position] = replace(step, surface=None)
        if step.T_world_camera is None:
            return
        self._posed += 1
        if isinstance(frame, RangeFrame):
            self._ambiguity_m = frame.ambiguity_m
        with self.watch.timing("loops"):
            # Who looks at surfaces leaves the points alone, which take long to make.
            looked_at = step.surface is None or self._loops.points or self._refiner.points
            view = as_cloud(clean, _KEPT_POINTS) if looked_at else clean
            self._loops.push(view, step.T_world_camera, step.surface)
        self._refiner.push(view, step.surface, step.T_world_camera)
        with self.watch.timing("fusion"):
            self._behind.do(lambda: self._keep(frame, clean, step.surface))
        if step.surface is not None:
            # Only who looks at surfaces states errors that hold; ICP's are too small.
            self._knows_errors = True

    def _keep(self, frame: Frame, clean: Frame, surface: SurfaceMap | None) -> None:
        """Keep what the model and the verdict need of a frame with a pose."""
        if isinstance(frame, RangeFrame):
            self._depths.append(_typical_range(frame))
            if isinstance(clean, RangeFrame):
                self._checks.add(lambda: whole(frame, clean))
        self._model.add(clean, surface, _KEPT_POINTS)

    def __getstate__(self) -> dict[str, Any]:
        """Everything but who hears of it, so that a copy can go on elsewhere."""
        self._live.wait()  # they change what is kept here
        self._behind.wait()
        return {name: value for name, value in self.__dict__.items() if name != "_progress"}

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, _progress=Silent())

    def go_on(self, threads: int | None, progress: Progress) -> None:
        """Go on as a copy: with so many threads (None: all cores), and telling `progress`."""
        self.threads = threads if threads is not None else thread_count()
        self._progress = progress
        for record in self._records:
            progress.advance(record)

    def end(self) -> None:
        """Say that no frame follows: what only they would ask for need not be kept any longer."""
        if not self._ended:
            with threads(self.threads):
                with self.watch.timing("tracking"):
                    found = self._tracker.finish()
                self._take_lost(found)
                self._keep_waiting()
                if len(self._lost) > self._posed:
                    self._start_later(last=True)
            del self._tracker, self._correctors, self._history
            self._before = None
            self._lost.clear()
            self._ended = True
            give_back()

    def finish(self, stages: Stages | None = None) -> Reconstruction:
        """Close the loops, optimise, fuse and judge.

        Parameters
        ----------
        stages
            Keeps what there is after each of these stages, and knows what a stopped job had.

        Raises
        ------
        InputError
            If no frame has a pose: there is nothing to make a model of.
        """
        if self._finished:
            raise InputError("is finished", where="mapper", remedy="make a new Mapper")
        self._finished = True
        if not self._posed:
            raise InputError(
                f"none of the {len(self._records)} frames has enough valid points for a pose"
                + (f" (first: {self._records[0].reason})" if self._records else ""),
                where="recording",
                remedy="look at it with `tofuse inspect`; the filters may be too strict for it",
            )
        self._live.finish()
        with self.watch.timing("fusion"):
            self._behind.finish()
        stages = stages or NotKept()
        self.end()
        with threads(self.threads):
            closed = self._staged(stages, "loops", self._close)
            # What a stage was the last to look at makes room for the next one.
            del self._live, self._loops
            give_back()
            refined = self._staged(stages, "refinement", lambda: self._refine(closed))
            del self._refiner
            give_back()
            fused = self._staged(stages, "fusion", lambda: self._fuse(closed, refined))
            del self._model
            give_back()
            return self._check_all(closed, refined, fused)

    def _staged(self, stages: Stages, name: str, work: Callable[[], T]) -> T:
        """Do the work of a stage, unless a stopped job has done it; its time counts either way."""
        kept = stages.load(name)
        if kept is not None:
            found: T = kept[0]
            self.watch.seconds.update(kept[1])
            return found
        found = work()
        with self.watch.timing("keeping"):
            stages.save(name, (found, dict(self.watch.seconds)))
        return found

    def _close(self) -> _Closed:
        self._progress.stage("closing loops")
        with self.watch.timing("loops"):
            loops = self._loops.finish()
            graph = self._graph(loops)
        sequential = led = graph.poses
        told = told_by(self.config.outside, self._all_sensed(graph), self._graph(()))
        graph = with_outside(graph, told)
        optimisation = Optimisation(graph, (), True)
        if graph.loop.any() or told:
            self._progress.stage("optimising")
            with self.watch.timing("optimisation"):
                optimisation = self.config.optimiser.optimise(graph)
                if told and graph.loop.any():  # what loops are to be held against
                    alone = with_outside(self._graph(()), told)
                    led = self.config.optimiser.optimise(alone).graph.poses
            loops = _decided(loops, optimisation)
            optimisation = without_left_out(optimisation)
        graph = optimisation.graph
        covariances = pose_covariances(graph)
        judged = _Judged(led, optimisation, covariances)
        if told:
            # The verdict stays with what was seen: no file beside the images makes it better.
            seen = self._graph(loops).with_poses(graph.poses)
            judged = _Judged(led, replace(optimisation, graph=seen), pose_covariances(seen))
        return _Closed(loops, sequential, optimisation, covariances, told, judged)

    def _refine(self, closed: _Closed) -> _Refined:
        graph = closed.optimisation.graph
        self._progress.stage("refining")
        with self.watch.timing("refinement"):
            refinement = self._refiner.finish(graph.ids.tolist(), graph.poses, closed.told)
            if refinement.kept:
                graph = with_outside(self._graph(closed.loops, refinement), closed.told)
        return _Refined(graph, refinement)

    def _fuse(self, closed: _Closed, refined: _Refined) -> _Fused:
        graph, refinement = refined.graph, refined.refinement
        moved = bool(graph.loop.any()) or refinement.kept or bool(closed.told)
        self._progress.stage("fusing", self._model.views)
        with self.watch.timing("fusion"):
            ids = graph.ids.tolist()
            model = self._model.fuse(
                dict(zip(ids, graph.poses, strict=True)),
                self._progress.advance,
                refinement.errors,
            )
            started = dict(zip(ids, closed.sequential, strict=True))
            return _Fused(model, self._model.sketch(started) if moved else None)

    def _check_all(self, closed: _Closed, refined: _Refined, fused: _Fused) -> Reconstruction:
        loops, optimisation, covariances = closed.loops, closed.optimisation, closed.covariances
        graph, refinement, model = refined.graph, refined.refinement, fused.model
        sequential, judged = closed.sequential, closed.judged
        self._progress.stage("checking")
        records = self._finished_records(covariances)
        with self.watch.timing("checking"):
            evidence = Evidence(
                records,
                tuple(s.registration if s else None for s in self._steps),
                tuple(c.record for c in loops),
                judged.sequential,
                judged.optimisation,
                self._sightings(graph),
                judged.covariances if self._knows_errors else None,
                refinement,
                frozenset((g.i, g.j) for g in self._given_loops),
                tuple(d for d in self._depths if d > 0),
                self._ambiguity_m,
                tuple(self._repeated),
                tuple(self._interruptions),
                closed.told.records,
            )
            verdict, reasons = judge(evidence)
        reasons = (*reasons, *self._about_surface(model))
        return Reconstruction(
            trajectory=self._scatter(graph.poses),
            timestamps=np.array([r.timestamp for r in self._records]),
            graph=graph,
            cloud=model.cloud,
            mesh=model.mesh,
            diagnostics=Diagnostics(
                verdict,
                reasons,
                records,
                tuple(c.record for c in loops),
                self._scatter(sequential),
                optimisation.objective,
                {n: self._removed[n] / max(self._seen[n], 1) for n in self._seen},
                dict(self.watch.seconds),
                fused.before,
                refinement,
                optimisation.parts,
                closed.told.records,
                self._samples.all,
            ),
            config=self.config.to_dict(),
            recording={"path": None, "format": "frames", "frames": len(self._records)},
            seed=self.seed,
            threads=self.threads,
        )

    def _all_sensed(self, graph: PoseGraph) -> Sensed:
        """What the recording holds of the frames of a graph, beside their views."""
        n = len(graph.ids)
        odometry, gravity = np.full((n, 4, 4), np.nan), np.full((n, 4), np.nan)
        for k, index in enumerate(graph.ids.tolist()):
            T, down = self._sensed[index]
            if T is not None:
                odometry[k] = T
            if down is not None:
                gravity[k] = down
        posed = [
            position
            for position, step in enumerate(self._steps)
            if step is not None and step.T_world_camera is not None
        ]
        parts = np.searchsorted(self._interruptions, posed, side="right")
        return Sensed(graph.ids, odometry, gravity, parts)

    def _graph(self, loops: Sequence[ClosedLoop], refined: Refinement | None = None) -> PoseGraph:
        """The graph as the tracker left it, or with what the refinement measured instead."""
        posed = [
            (record, step, step.T_world_camera)
            for record, step in zip(self._records, self._steps, strict=True)
            if step is not None and step.T_world_camera is not None
        ]
        ids = [record.index for record, _, _ in posed]
        tracked = np.array([T for _, _, T in posed])
        poses = tracked if refined is None else refined.poses
        again = () if refined is None else refined.edges
        replaced = {index for edge in again for index in (edge.i, edge.j)}
        place = {index: k for k, index in enumerate(ids)}
        sigma = prediction_sigma(tracked, [record.unobservable for record, _, _ in posed])
        sequence = []
        for record, step, _ in posed:
            r = step.registration
            if {step.reference, record.index} <= replaced:
                continue
            if step.reference is not None and r is not None:
                # What was predicted frame by frame since then adds up.
                frames = abs(place[record.index] - place[step.reference])
                predicted = (sigma[0] * frames, sigma[1] * frames)
                information = with_prediction(r.information, r.unobservable, predicted)
                edge = Measured(step.reference, record.index, r.T_target_source, information)
                sequence.append(edge)
        closed = [
            Measured(c.record.i, c.record.j, c.T_i_j, c.information)
            for c in loops
            if c.T_i_j is not None and c.information is not None
        ]
        return build_graph(ids, poses, [*sequence, *again], closed)

    def _about_surface(self, model: Model) -> tuple[Reason, ...]:
        """What is to be said where there is no surface."""
        if model.mesh is not None and len(model.mesh):
            return ()
        text = "the views show no surface of some size; mesh.ply and mesh.glb are empty"
        if model.mesh is None:
            text = "clouds without a camera make no surface; there is no mesh.ply and no mesh.glb"
        return (Reason("no_surface", ((self._records[0].index, self._records[-1].index),), text),)

    def _finished_records(self, covariances: Float64) -> tuple[FrameRecord, ...]:
        """The records with the covariances (P, 6, 6) of the frames that have a pose."""
        known = iter(covariances)
        out = []
        for record, step in zip(self._records, self._steps, strict=True):
            C = next(known) if step is not None and step.T_world_camera is not None else None
            if C is not None and np.isfinite(C).all():
                record = replace(record, covariance=C)
            out.append(record)
        return tuple(out)

    def _sightings(self, graph: PoseGraph) -> Sightings | None:
        """What overlapping images say of the final poses."""
        frames = self._checks.items
        if len(frames) < 2:
            return None
        row = {int(frame): k for k, frame in enumerate(graph.ids)}
        return sightings(frames, np.stack([graph.poses[row[f.index]] for f in frames]))

    def _scatter(self, poses: Float64) -> Float64:
        out = np.full((len(self._records), 4, 4), np.nan)
        has = [s is not None and s.T_world_camera is not None for s in self._steps]
        out[np.array(has, bool)] = poses
        return out


def _typical_range(frame: RangeFrame) -> float:
    """Median radial range of some of the pixels, m; 0 where nothing is valid."""
    ranges = frame.depth[::4, ::4]
    if frame.depth_kind == "z":
        ranges = ranges * ray_lengths(frame.camera)[::4, ::4]
    known = ranges[ranges > 0]
    return float(np.median(known)) if len(known) else 0.0


class _EvenSample:
    """Keeps at most `size` items of an endless stream, evenly spaced."""

    def __init__(self, size: int) -> None:
        self.items: list[RangeFrame] = []
        self._size, self._step, self._count = size, 1, 0

    def add(self, made: Callable[[], RangeFrame]) -> None:
        if self._count % self._step == 0:
            self.items.append(made())
            if len(self.items) > self._size:
                self.items = self.items[::2]
                self._step *= 2
        self._count += 1


def _decided(loops: Sequence[ClosedLoop], optimisation: Optimisation) -> list[ClosedLoop]:
    """The loops, those rejected that the optimiser left out because they contradict the others."""
    if optimisation.weights is None:
        return list(loops)
    weights = iter(optimisation.weights[optimisation.graph.loop])
    out = []
    for loop in loops:
        if loop.T_i_j is not None and next(weights) < LEFT_OUT:
            reason = f"contradicts the rest of the graph ({loop.record.reason})"
            loop = ClosedLoop(replace(loop.record, accepted=False, reason=reason))
        out.append(loop)
    return out
