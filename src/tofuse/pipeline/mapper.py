"""The engine: frames go in one at a time, poses come out, and at the end a model."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from tofuse.arrays import Float64
from tofuse.errors import InputError
from tofuse.files.memory import give_back
from tofuse.kernels.threads import serial_chunks, thread_count, threads
from tofuse.odometry.base import Step
from tofuse.odometry.motion import Moment
from tofuse.pipeline.assembly import Assembly
from tofuse.pipeline.behind import Behind
from tofuse.pipeline.checkpoint import NotKept, Stages
from tofuse.pipeline.config import Config, check_views, from_method, kind_of
from tofuse.pipeline.frame_log import FrameLog, record_of
from tofuse.pipeline.intake import Intake
from tofuse.pipeline.live import LivePoses
from tofuse.pipeline.observations import Observations
from tofuse.pipeline.preparation import Preparation, Prepared, Ready
from tofuse.pipeline.progress import Progress, Silent, Stopwatch
from tofuse.posegraph.loops import GivenLoop
from tofuse.posegraph.view_store import PosedView
from tofuse.recordings.frames import Frame
from tofuse.registration.prepared_view import PreparedView
from tofuse.results.types import FrameRecord, Reconstruction


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
        self.watch = Stopwatch()
        self._given = tuple(loops)
        self._progress = progress or Silent()
        self._intake = Intake()
        self._log = FrameLog()
        self._behind = Behind()
        self._ended = self._finished = False
        self._begin()

    def _begin(self) -> None:
        self._preparation = Preparation(self.config)
        self._tracker = self.config.odometry.start(self.seed)
        self._kept = Observations(self.config, self.seed, self._given)
        self._live = LivePoses(self._kept.loops)
        self._component = 0

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
        T_world_camera (4, 4) as known so far, or None where the frame is lost or in a component
        that is not connected to the first one yet. A loop that closes on the way counts some frames
        later; the end joins components and moves all poses once more.

        Raises
        ------
        InputError
            If the frame is of another kind than those before, or one that the configuration
            can't work on, or its index does not grow.
        """
        self._check(frame)
        repeated = self._intake.is_repeated(frame)
        if repeated:
            self._log.repeated.append(frame.index)
        # A search for a lost camera is worth dividing, while those who prepare frames are waiting.
        busy = prepared is not None and prepared.ready is not None
        with threads(self.threads), serial_chunks(busy):
            ready = self._prepare(frame, history, prepared)
            step = self._track(ready, T_odometry, repeated)
            self._remember(ready, step, T_odometry, gravity)
            self._close_loops(step)
            return self._report(ready, step)

    def _prepare(
        self, frame: Frame, history: Sequence[Frame] | None, prepared: Prepared | None
    ) -> Ready:
        with self.watch.timing("filters"):
            expected = None
            if self._log.entries and self._log.entries[-1].has_pose:
                expected = self._tracker.expected(Moment(frame.index, frame.timestamp))
            return self._preparation.ready(frame, expected, history, prepared)

    def _track(self, ready: Ready, T_odometry: Float64 | None, repeated: bool) -> Step:
        with self.watch.timing("tracking"):
            step = self._tracker.push(ready.filtered, T_odometry, ready.surface)
        if repeated and step.status == "tracked":
            reason = f"the same image as frame {self._log.entries[-1].record.index}"
            step = replace(step, status="predicted", reason=reason)
        if step.component != self._component:
            self._component = step.component
            self._preparation.begin_component()
        if step.status == "tracked" and step.T_component_camera is not None:
            self._preparation.placed(ready.filtered, step.T_component_camera)
        return step

    def _remember(
        self, ready: Ready, step: Step, T_odometry: Float64 | None, gravity: Float64 | None
    ) -> None:
        frame = ready.frame
        self._log.add(record_of(frame, step), step, T_odometry, gravity)
        lost = step.T_component_camera is None
        if step.moving is not None:
            ready = replace(ready, clean=ready.clean.keep(~step.moving))
        if not lost:
            with self.watch.timing("loops"):
                self._kept.add(ready, step)
            with self.watch.timing("fusion"):
                self._behind.do(lambda: self._kept.add_to_model(frame, ready.clean, step))
        self._behind.do(lambda: self._kept.sample(ready, lost=lost))

    def _close_loops(self, step: Step) -> None:
        """Let loops that were found some frames ago count in the present component."""
        with self.watch.timing("loops"):
            loops = self._live.follow(step, self._log)
            if loops:
                graph = self._assembly().graph(self._log, step.component, loops)
                self._live.close(graph, self.config.optimiser.optimise(graph).graph)

    def _report(self, ready: Ready, step: Step) -> Float64 | None:
        self._progress.advance(self._log.entries[-1].record)
        T_world_camera = self._live.pose(step)
        if T_world_camera is not None:
            self._progress.placed(ready.clean, T_world_camera)
        return T_world_camera

    def prepare(self, frame: Frame) -> Prepared | None:
        """Make what can be made of a frame before its turn, for `push`; None if nothing can.

        Other threads may ask for it while frames before it are pushed. It makes no difference to
        what comes out.
        """
        return self._preparation.ahead(frame, self._tracker)

    def skip(self, index: int, timestamp: float, reason: str) -> None:
        """Record that a frame could not be read.

        Parameters
        ----------
        index, timestamp
            Frame index, larger than those before (else InputError), and s.
        reason
            Why it could not be read.
        """
        self._check_open()
        self._intake.check_order(index)
        self._intake.accept(index)
        self._log.add(FrameRecord(index, timestamp, "skipped", reason), None)
        self._progress.advance(self._log.entries[-1].record)

    def interrupt(self, config: Config | None = None) -> None:
        """Say that the next frame begins another recording: the camera may be elsewhere by then.

        Parameters
        ----------
        config
            Its corrections, filters and odometry are for the frames of this recording, where they
            are others than so far. Numbers of its components must not have been used before.
        """
        if self._log.entries:
            self._log.interruptions.append(len(self._log.entries))
        self._tracker.interrupt()
        if config is not None:
            self._preparation = Preparation(config, self._preparation.counts)
            self._tracker = config.odometry.start(self.seed)

    @property
    def log(self) -> FrameLog:
        """What became of every frame so far."""
        return self._log

    @property
    def views(self) -> Sequence[PosedView[PreparedView]]:
        """Prepared views of frames with a pose, spaced by motion, in the order of their frames."""
        return self._kept.views.views

    def end(self) -> None:
        """Say that no frame follows: what only they would ask for need not be kept any longer."""
        if not self._ended:
            self._intake.end()
            self._ended = True
            give_back()

    def finish(self, stages: Stages | None = None) -> Reconstruction:
        """Join components, close loops, optimise, refine, fuse and judge.

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
        self._log.check_posed()
        self._live.finish()
        with self.watch.timing("fusion"):
            self._behind.finish()
        self.end()
        result = self._assembly().run(self._log, stages or NotKept())
        diagnostics = replace(
            result.diagnostics,
            removed=self._preparation.counts.shares,
            seconds=dict(self.watch.seconds),
            samples=self._kept.samples.all,
        )
        return replace(result, diagnostics=diagnostics)

    def _assembly(self) -> Assembly:
        return Assembly(
            self.config,
            self._kept,
            self._given,
            self._progress,
            self.watch,
            self.seed,
            self.threads,
        )

    def _check(self, frame: Frame) -> None:
        self._check_open()
        self._intake.check_order(frame.index)
        kind = kind_of(frame)
        if self._intake.check_kind(frame):
            if self._method is not None and kind == "cloud":
                self.config = from_method(self._method, kind)
                self._begin()
            check_views(self.config, kind)
        self._intake.accept(frame.index, kind)

    def _check_open(self) -> None:
        if self._finished or self._ended:
            raise InputError("is finished", where="mapper", remedy="make a new Mapper")

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
        for entry in self._log.entries:
            progress.advance(entry.record)
