"""The views of a recording until its end: in memory as far as there may be, all others on disk."""

from __future__ import annotations

from collections.abc import Container, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from tofuse.files.spill import Spill
from tofuse.fusion.views import RangeView, without_camera_errors
from tofuse.recordings.frames import CloudFrame


@dataclass(frozen=True)
class About:
    """What is asked of all views at once.

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
    def of(cls, view: RangeView) -> About:
        """Look at a view."""
        return cls(view.index, view.depth, view.pitch, view.sigma_m, view.channels)


class Views(Protocol):
    """Views by their place: a list of them, or those of a store."""

    def __len__(self) -> int: ...

    def __getitem__(self, which: int, /) -> RangeView: ...

    def __iter__(self) -> Iterator[RangeView]: ...


class KeptViews:
    """Views in a store, read when they are asked for.

    Attributes
    ----------
    about
        What is asked of all of them, which reads none.
    """

    def __init__(self, spill: Spill[RangeView]) -> None:
        self.about: list[About] = []
        self._spill = spill
        self._numbers: list[int] = []

    def add(self, view: RangeView) -> None:
        """Keep one more.

        Raises
        ------
        OutputError
            If there is no room on the disk for what memory can't hold.
        """
        self._numbers.append(self._spill.put(view))
        self.about.append(About.of(view))

    def of(self, indices: Container[int]) -> KeptViews:
        """Those of some frames, in the same store."""
        some = KeptViews(self._spill)
        for number, about in zip(self._numbers, self.about, strict=True):
            if about.index in indices:
                some._numbers.append(number)
                some.about.append(about)
        return some

    def corrected(self, errors: Mapping[str, float]) -> KeptViews:
        """Add what they would be to the store, did the camera not err like this."""
        made = KeptViews(self._spill)
        for view in without_camera_errors(self, errors):
            made.add(view)
        return made

    def forget(self) -> None:
        """Take them out of the store."""
        for number in self._numbers:
            self._spill.drop(number)
        self.about, self._numbers = [], []

    def __len__(self) -> int:
        return len(self._numbers)

    def __getitem__(self, which: int, /) -> RangeView:
        return self._spill.get(self._numbers[which])

    def __iter__(self) -> Iterator[RangeView]:
        return (self._spill.get(number) for number in self._numbers)


class KeptClouds:
    """Clouds in a store, read when they are asked for."""

    def __init__(self, spill: Spill[CloudFrame]) -> None:
        self._spill = spill
        self._numbers: list[tuple[int, int]] = []  # of the frame, and in the store

    def add(self, cloud: CloudFrame) -> None:
        """Keep one more; raises as `KeptViews.add`."""
        self._numbers.append((cloud.index, self._spill.put(cloud)))

    def of(self, indices: Container[int]) -> Iterator[CloudFrame]:
        """Those of some frames, one at a time."""
        return (self._spill.get(number) for index, number in self._numbers if index in indices)

    def __len__(self) -> int:
        return len(self._numbers)


def about(views: Views) -> Sequence[About]:
    """What is asked of all views at once, without reading those that are on disk."""
    return views.about if isinstance(views, KeptViews) else [About.of(view) for view in views]
