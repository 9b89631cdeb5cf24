"""The store of observations: data of frames with a pose for all stages after tracking."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from functools import cache, partial

import numpy as np

from tofuse.engine.cameras import ray_lengths
from tofuse.engine.compute import Scratch, Spill, job_pool, thread_count
from tofuse.engine.frames import Frame, RangeFrame
from tofuse.engine.fusion import ModelBuilder, as_cloud
from tofuse.engine.loops import PriorLoop
from tofuse.engine.mapping.config import Config, checked_bytes, views_bytes
from tofuse.engine.mapping.preparation import FilteredFrame
from tofuse.engine.quality import cross_view_agreement, frame_samples
from tofuse.engine.results import checks
from tofuse.engine.stored_views import PosedView, Spacing, Spilled, ViewStore
from tofuse.engine.tracking import Step
from tofuse.engine.views import PreparedView

_MAX_POINTS = 50_000  # of each cloud, and of each view for loops; bounds the memory of a run
_CHECKED_IMAGES = 60  # images of the final comparison, and as many in which much moves
# Width of stored views: more pixels do not improve loops and refinement.
_COLUMNS = 200
# Number of images of a place that are all fused into the model; of further ones a decreasing
# fraction, as their noise is then averaged.
_VIEWS_PER_PLACE = 32
# Bounds memory, as waiting jobs reference frames.
_MAX_WAITING = 4


@dataclass(frozen=True, eq=False)
class CheckedImage:
    """An image for the final comparison, possibly on disk, and the index of its frame."""

    index: int
    image: Spilled[RangeFrame]


class Observations:
    """Prepared views spaced by motion, small images for the model, and some for the checks.

    Attributes
    ----------
    views
        Prepared views of all components, for joining, loops and refinement.
    loops
        The loop detector, which receives every frame.
    refiner
        The refinement, which receives every frame.
    model
        Stored views of the model.
    depths
        Typical radial range of each posed frame, m, by index.
    color_depths
        Those of the frames with registered colour.
    ambiguity_m
        Ambiguity range of the camera, if known.
    samples
        Some frames for the report.
    newest
        The last posed view, which `views` may not have, as tracked.
    """

    def __init__(
        self, config: Config, seed: int, prior_loops: Sequence[PriorLoop], *, surface: bool = True
    ) -> None:
        loop_frames = [frame for loop in prior_loops for frame in (loop.i, loop.j)]
        scratch = Scratch(views_bytes(config.memory_mb))
        self.views: ViewStore[PreparedView] = ViewStore(
            Spacing(), always=loop_frames, scratch=scratch
        )
        self.loops = config.loops.start(seed, prior_loops, self.views, config.search)
        self.samples = frame_samples.FrameSamples()
        self.newest: PosedView[PreparedView] | None = None
        self.refiner = config.refinement.start(self.views)
        self.model = ModelBuilder(config.fusion, surface=surface)
        self._places = Spacing(views_per_place=_VIEWS_PER_PLACE).places()
        self._checks = frame_samples.EvenSample[CheckedImage](_CHECKED_IMAGES)
        self._open_checks = frame_samples.EvenSample[CheckedImage](_CHECKED_IMAGES)
        self._checks_spill: Spill[RangeFrame] = Spill(checked_bytes(config.memory_mb))
        self.depths: dict[int, float] = {}
        self.color_depths: dict[int, float] = {}
        self.ambiguity_m: float | None = None
        self._needs_points = self.loops.needs_points or self.refiner.needs_points
        self._queue = _BackgroundQueue()

    @property
    def has_covariances(self) -> bool:
        """Whether covariances of registrations are realistic.

        Those between prepared views are; those of ICP, whose trackers prepare none, are too small.
        """
        return len(self.views.views) > 0

    def add(self, filtered: FilteredFrame, step: Step) -> None:
        """Store the data of a frame with a pose for joining, loops and refinement."""
        T = step.T_component_camera
        assert T is not None
        if isinstance(filtered.corrected, RangeFrame):
            self.ambiguity_m = filtered.corrected.ambiguity_m
        if step.surface is not None:
            self.views.push(step.surface, T, step.component, _reduced)
            of = self.views.recording
            self.newest = PosedView(step.surface, T, step.component, recording=of)
        view = filtered.for_model
        if self._needs_points:
            view = as_cloud(view, _MAX_POINTS)
        self.loops.push(view, T)
        self.refiner.push(view, T)

    def add_to_model(self, filtered: FilteredFrame, step: Step) -> None:
        """Store the data of a frame with a pose for the model and the verdict, in the background.

        Waits while too many frames are waiting.
        """
        self._queue.submit(partial(self._add_to_model, filtered, step))

    def sample(self, filtered: FilteredFrame, *, lost: bool) -> None:
        """Store small images of some frames for the report, in the background."""
        self._queue.submit(partial(self._sample, filtered, lost=lost))

    def interrupt(self) -> None:
        """Begin another recording."""
        self.views.recording += 1

    def finish(self) -> None:
        """Wait until everything is stored."""
        self._queue.finish()

    def _add_to_model(self, filtered: FilteredFrame, step: Step) -> None:
        frame, clean = filtered.corrected, filtered.for_model
        depth = _typical_range(frame)
        if isinstance(frame, RangeFrame):
            self.depths[frame.index] = depth
            if frame.color_image is not None and frame.color_registered:
                self.color_depths[frame.index] = depth
            if isinstance(clean, RangeFrame):

                @cache
                def restored() -> CheckedImage:
                    image = cross_view_agreement.restore_thinned(frame, clean)
                    return CheckedImage(image.index, Spilled(image, self._checks_spill))

                self._checks.offer(restored)
                if max(step.moving_fraction, step.rival) > checks.MAX_MOVING:
                    self._open_checks.offer(restored)
        assert step.T_component_camera is not None
        if self._places.keeps(depth, step.T_component_camera, step.component):
            self.model.add(clean, step.surface, _MAX_POINTS)

    def _sample(self, filtered: FilteredFrame, *, lost: bool) -> None:
        frame, tracked, modelled = filtered.corrected, filtered.for_tracking, filtered.for_model
        if (
            isinstance(frame, RangeFrame)
            and isinstance(tracked, RangeFrame)
            and isinstance(modelled, RangeFrame)
        ):
            self.samples.take(
                lost=lost, make=partial(frame_samples.FrameSample.of, frame, tracked, modelled)
            )

    @property
    def checks(self) -> Sequence[CheckedImage]:
        """Images that are compared with each other at the final poses."""
        return self._checks.items

    @property
    def open_checks(self) -> Sequence[CheckedImage]:
        """Images of which so much moves that it is open what stands still."""
        return self._open_checks.items


def _reduced(view: PreparedView) -> PreparedView:
    return view.subsampled(_COLUMNS).without_caches()


def _typical_range(frame: Frame) -> float:
    """Return the median radial range of a subset of the pixels, m; 0 without valid ones."""
    if isinstance(frame, RangeFrame):
        ranges = frame.depth[::4, ::4]
        if frame.depth_kind == "z":
            ranges = ranges * ray_lengths(frame.camera)[::4, ::4]
    else:
        ranges = np.linalg.norm(frame.points[::16], axis=1)
    valid = ranges[ranges > 0]
    return float(np.median(valid)) if len(valid) else 0.0


class _BackgroundQueue:
    """Runs jobs in order on a background thread; with a single thread, immediately.

    An error of a job is raised by one of the next calls.
    """

    def __init__(self) -> None:
        self._pool: ThreadPoolExecutor | None = None
        self._jobs: deque[Future[None]] = deque()

    def submit(self, job: Callable[[], None]) -> None:
        """Queue a job; waits while the queue is full."""
        if thread_count() == 1:
            self.wait()
            job()
            return
        if self._pool is None:
            self._pool = job_pool(1, "tofuse-behind")
        self._jobs.append(self._pool.submit(job))
        while len(self._jobs) > _MAX_WAITING:
            self._jobs.popleft().result()

    def wait(self) -> None:
        """Wait for all jobs."""
        while self._jobs:
            self._jobs.popleft().result()

    def finish(self) -> None:
        """Wait for all jobs, and end the thread."""
        self.wait()
        if self._pool is not None:
            self._pool.shutdown()
        self._pool = None
