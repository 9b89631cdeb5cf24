"""Preparation of a frame for tracking: corrected, filtered, and prepared for alignment."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from tofuse.engine.arrays import Float64
from tofuse.engine.errors import InputError
from tofuse.engine.filters import Removal, apply_filters
from tofuse.engine.frames import Frame, RangeFrame
from tofuse.engine.mapping.config import Config, check_views
from tofuse.engine.tracking import Tracker
from tofuse.engine.views import PreparedView


@dataclass(frozen=True, eq=False)
class FilteredFrame:
    """A frame as corrected, as filtered for tracking, and as filtered for the model.

    Attributes
    ----------
    corrected, for_tracking, for_model
        Corrected; filtered for tracking; filtered for the model.
    removals
        Number of points that each filter removed.
    surface
        The filtered view prepared for tracking, if that was done in advance.
    """

    corrected: Frame
    for_tracking: Frame
    for_model: Frame
    removals: tuple[Removal, ...]
    surface: PreparedView | None = None


@dataclass(frozen=True, eq=False)
class Prepared:
    """The result of preparing a frame in advance.

    Attributes
    ----------
    frame
        The frame after the first `corrected` corrections, up to one that depends on other frames.
    corrected
        Number of corrections that were applied.
    filtered
        The filtered frame, if no step depends on other frames.
    """

    frame: Frame
    corrected: int
    filtered: FilteredFrame | None


@dataclass(frozen=True)
class Counts:
    """Number of points that each filter received and removed, by its name.

    A filter that is used twice, for tracking and for the model, received what reached it first.
    """

    received: dict[str, int] = field(default_factory=dict)
    removed: dict[str, int] = field(default_factory=dict)

    def add(self, removals: Sequence[Removal]) -> None:
        """Count the points that the filters, in their order, removed from a frame."""
        first: set[str] = set()
        for removal in removals:
            if removal.name not in first:
                self.received[removal.name] = self.received.get(removal.name, 0) + removal.received
                first.add(removal.name)
            self.removed[removal.name] = self.removed.get(removal.name, 0) + removal.removed

    @property
    def fractions(self) -> dict[str, float]:
        """Fraction of the points that each filter removed."""
        return {
            name: self.removed[name] / max(received, 1) for name, received in self.received.items()
        }


class Preparation:
    """Corrects and filters the frames of one recording.

    Parameters
    ----------
    config
        Provides the corrections and filters.
    counts
        Counts of earlier recordings, to add to.

    Attributes
    ----------
    counts
        Points removed by filters so far.
    """

    def __init__(self, config: Config, counts: Counts | None = None) -> None:
        self.counts = Counts() if counts is None else counts
        self._config = config
        self._correctors = [correction.start() for correction in config.corrections]
        self._history: deque[Frame] = deque(maxlen=config.window - 1)

    def prepare_ahead(self, frame: Frame, tracker: Tracker) -> Prepared | None:
        """Prepare a frame in advance, as far as that depends on it alone; None if unsupported.

        May be called by other threads while earlier frames are tracked; results don't depend on it.
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
        filtered = self._filtered(frame, ())
        surface = tracker.prepare(filtered.for_tracking)
        return Prepared(frame, corrected, replace(filtered, surface=surface))

    def process(
        self,
        frame: Frame,
        T_expected: Float64 | None,
        history: Sequence[Frame] | None,
        prepared: Prepared | None,
    ) -> FilteredFrame:
        """Correct and filter the next frame.

        Parameters
        ----------
        frame
            As recorded.
        T_expected
            (4, 4) predicted pose in the current component.
        history
            Unfiltered frames just before this one, oldest first; None for the preceding frames.
        prepared
            The result of `prepare_ahead`, if it was called.
        """
        past = tuple(self._corrected(f) for f in (self._history if history is None else history))
        frame = self._corrected(frame, T_expected, prepared)
        filtered = prepared.filtered if prepared is not None else None
        if filtered is None:
            filtered = self._filtered(frame, past)
        self._history.append(frame)
        self.counts.add(filtered.removals)
        return filtered

    def interrupt(self) -> None:
        """Begin another recording: its first frames have no neighbours in time before them."""
        self._history.clear()

    def add_pose(self, frame: Frame, T_component_camera: Float64) -> None:
        """Pass the pose (4, 4) of a frame in the current component to the corrections."""
        for corrector in self._correctors:
            corrector.add_pose(frame, T_component_camera)

    def begin_component(self) -> None:
        """Reset the maps of corrections: a new coordinate frame begins."""
        for corrector in self._correctors:
            corrector.reset_poses()

    def _corrected(
        self, frame: Frame, T_expected: Float64 | None = None, prepared: Prepared | None = None
    ) -> Frame:
        """Correct a frame, or return it from the history if it was corrected before."""
        for previous in self._history:
            if previous.index == frame.index:
                return previous
        n_corrected = 0
        if prepared is not None:
            frame, n_corrected = prepared.frame, prepared.corrected
        for corrector in self._correctors[n_corrected:]:
            frame = corrector.apply(frame, T_expected)
        return frame

    def _filtered(self, frame: Frame, past: Sequence[Frame]) -> FilteredFrame:
        filtered, removals = apply_filters(self._config.filters, frame, past)
        clean, more = apply_filters(self._config.model_filters, filtered, past)
        return FilteredFrame(frame, filtered, clean, (*removals, *more))
