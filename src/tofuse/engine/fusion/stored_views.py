"""The stored views of a recording: in memory up to a limit, the others on disk."""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from tofuse.engine.compute import Spill
from tofuse.engine.frames import CloudFrame
from tofuse.engine.fusion.range_view import RangeView, with_camera_correction


@dataclass(frozen=True)
class ViewSummary:
    """Properties of a view that are needed without its images.

    Attributes
    ----------
    index, depth, pitch, sigma_m, channels
        See `RangeView`.
    """

    index: int
    depth: float
    pitch: float
    sigma_m: float
    channels: int

    @classmethod
    def of(cls, view: RangeView) -> ViewSummary:
        """Return the summary of a view."""
        return cls(view.index, view.depth, view.pitch, view.sigma_m, view.channels)


class Views(Protocol):
    """A sequence of views: a list, or those of a store."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> RangeView: ...

    def __iter__(self) -> Iterator[RangeView]: ...


class StoredViews:
    """Views in a store, read on demand.

    Attributes
    ----------
    summaries
        Of all views, without reading them.
    """

    def __init__(self, spill: Spill[RangeView]) -> None:
        self.summaries: list[ViewSummary] = []
        self._spill = spill
        self._numbers: list[int] = []

    def add(self, view: RangeView) -> None:
        """Store a view.

        Raises
        ------
        OutputError
            If there is no space on the disk.
        """
        self._numbers.append(self._spill.put(view))
        self.summaries.append(ViewSummary.of(view))

    def of(self, indices: Container[int]) -> StoredViews:
        """Select the views of these frame indices, in the same store."""
        selected = StoredViews(self._spill)
        for number, summary in zip(self._numbers, self.summaries, strict=True):
            if summary.index in indices:
                selected._numbers.append(number)
                selected.summaries.append(summary)
        return selected

    def corrected(self, errors: Mapping[str, float]) -> StoredViews:
        """Add the views without these errors of the camera to the store."""
        corrected = StoredViews(self._spill)
        for view in with_camera_correction(self, errors):
            corrected.add(view)
        return corrected

    def drop(self) -> None:
        """Remove these views from the store."""
        for number in self._numbers:
            self._spill.drop(number)
        self.summaries, self._numbers = [], []

    def __len__(self) -> int:
        return len(self._numbers)

    def __getitem__(self, index: int, /) -> RangeView:
        return self._spill.get(self._numbers[index])

    def __iter__(self) -> Iterator[RangeView]:
        return (self._spill.get(number) for number in self._numbers)


class StoredClouds:
    """Clouds in a store, read on demand."""

    def __init__(self, spill: Spill[CloudFrame]) -> None:
        self._spill = spill
        self._numbers: list[tuple[int, int]] = []  # of the frame, and in the store

    def add(self, cloud: CloudFrame) -> None:
        """Store a cloud; raises as `StoredViews.add`."""
        self._numbers.append((cloud.index, self._spill.put(cloud)))

    def of(self, indices: Container[int]) -> Iterator[CloudFrame]:
        """Read the clouds of these frame indices, one at a time."""
        return (self._spill.get(number) for index, number in self._numbers if index in indices)

    def __len__(self) -> int:
        return len(self._numbers)


def summaries(views: Views) -> Sequence[ViewSummary]:
    """Return the summaries of all views, without reading those that are on disk."""
    if isinstance(views, StoredViews):
        return views.summaries
    return [ViewSummary.of(view) for view in views]
