"""What is made of a frame before it is tracked: corrected, filtered, and prepared for alignment."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from tofuse.arrays import Float64
from tofuse.errors import InputError
from tofuse.filters.base import Removal, apply_filters
from tofuse.odometry.base import Tracker
from tofuse.pipeline.config import Config, check_views
from tofuse.recordings.frames import Frame, RangeFrame
from tofuse.registration.prepared_view import PreparedView


@dataclass(frozen=True, eq=False)
class Ready:
    """A frame as corrected, as filtered for tracking, and as cleaned for the model.

    Attributes
    ----------
    removals
        What each filter removed.
    surface
        The filtered view prepared for tracking, where that could be done before its turn.
    """

    frame: Frame
    filtered: Frame
    clean: Frame
    removals: tuple[Removal, ...]
    surface: PreparedView | None = None


@dataclass(frozen=True, eq=False)
class Prepared:
    """What can be made of a frame before its turn.

    Attributes
    ----------
    frame
        Corrected by so many (`corrected`) of the corrections: those up to the first that must wait.
    ready
        What was made of it then, if none had to.
    """

    frame: Frame
    corrected: int
    ready: Ready | None


@dataclass(frozen=True)
class Counts:
    """How many points filters saw and removed, by name."""

    seen: dict[str, int] = field(default_factory=dict)
    removed: dict[str, int] = field(default_factory=dict)

    def add(self, removal: Removal) -> None:
        """Count what a filter removed of a frame."""
        self.seen[removal.name] = self.seen.get(removal.name, 0) + removal.seen
        self.removed[removal.name] = self.removed.get(removal.name, 0) + removal.removed

    @property
    def shares(self) -> dict[str, float]:
        """Fraction of the points that each filter removed."""
        return {name: self.removed[name] / max(seen, 1) for name, seen in self.seen.items()}


class Preparation:
    """Corrections and filters at work on one recording.

    Parameters
    ----------
    counts
        Of the recordings before, which these are added to.

    Attributes
    ----------
    counts
        What filters removed so far.
    """

    def __init__(self, config: Config, counts: Counts | None = None) -> None:
        self.counts = Counts() if counts is None else counts
        self._config = config
        self._correctors = [correction.start() for correction in config.corrections]
        self._history: deque[Frame] = deque(maxlen=config.window - 1)

    def ahead(self, frame: Frame, tracker: Tracker) -> Prepared | None:
        """Make what can be made of a frame before its turn; None if nothing can.

        Other threads may call it while frames before it are tracked; results don't depend on it.
        """
        if not isinstance(frame, RangeFrame):
            return None
        try:
            check_views(self._config, "range")
        except InputError:  # reported when it is pushed
            return None
        corrected = 0
        for corrector in self._correctors:
            if not corrector.is_independent(frame):
                return Prepared(frame, corrected, None)
            frame, corrected = corrector.apply(frame), corrected + 1
        if self._config.window > 1:
            return Prepared(frame, corrected, None)
        ready = self._filtered(frame, ())
        return Prepared(frame, corrected, replace(ready, surface=tracker.prepare(ready.filtered)))

    def ready(
        self,
        frame: Frame,
        T_expected: Float64 | None,
        history: Sequence[Frame] | None,
        prepared: Prepared | None,
    ) -> Ready:
        """Correct and filter the frame whose turn it is.

        Parameters
        ----------
        T_expected
            (4, 4) where the camera is expected, in the frame of the present component.
        history
            Unfiltered frames just before this one, oldest first; those of before unless given.
        prepared
            What `ahead` made of it.
        """
        past = tuple(self._corrected(f) for f in (self._history if history is None else history))
        frame = self._corrected(frame, T_expected, prepared)
        ready = prepared.ready if prepared is not None else None
        if ready is None:
            ready = self._filtered(frame, past)
        self._history.append(frame)
        for removal in ready.removals:
            self.counts.add(removal)
        return ready

    def placed(self, frame: Frame, T_component_camera: Float64) -> None:
        """Tell the corrections where a frame is, in the frame of the present component."""
        for corrector in self._correctors:
            corrector.add_pose(frame, T_component_camera)

    def begin_component(self) -> None:
        """Forget what corrections know of places: their frame is another one now."""
        for corrector in self._correctors:
            corrector.reset_poses()

    def _corrected(
        self, frame: Frame, T_expected: Float64 | None = None, prepared: Prepared | None = None
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

    def _filtered(self, frame: Frame, past: Sequence[Frame]) -> Ready:
        filtered, removals = apply_filters(self._config.filters, frame, past)
        clean, more = apply_filters(self._config.model_filters, filtered, past)
        return Ready(frame, filtered, clean, (*removals, *more))
