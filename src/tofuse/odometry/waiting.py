"""Views that were lost, kept for as long as a later one may show where they were."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from typing import Generic, Protocol, TypeVar

# Pixels of all that wait together: 10 images of 640x480, or 120 of 176x144.
_PIXELS = 3_100_000


class Seen(Protocol):
    """What is asked of a view that waits."""

    @property
    def index(self) -> int:
        """Of the frame in its recording."""
        ...

    @property
    def pixels(self) -> int:
        """How many pixels it has."""
        ...


V = TypeVar("V", bound=Seen)


class Waiting(Generic[V]):
    """Lost views in the order of time, never more than fit into a fixed memory.

    Parameters
    ----------
    pixels
        Of all views together. When there are more, every other view is given up, and of those to
        come as many; but the newest one stays until the next, as it is the likeliest to be found.
    """

    def __init__(self, pixels: int = _PIXELS) -> None:
        self._views: dict[int, V] = {}
        self._most = pixels
        self._step, self._count = 1, 0
        self._extra: int | None = None  # the newest one, if it stays for that alone

    def __len__(self) -> int:
        return len(self._views)

    def __getitem__(self, index: int) -> V:
        return self._views[index]

    @property
    def indices(self) -> Collection[int]:
        """Of the views that wait."""
        return self._views.keys()

    @property
    def views(self) -> list[V]:
        """All of them, oldest first."""
        return list(self._views.values())

    def add(self, view: V) -> None:
        """Let the newest view wait."""
        if self._extra is not None:
            self._views.pop(self._extra, None)
        self._views[view.index] = view
        self._extra = view.index if self._count % self._step else None
        self._count += 1
        while len(self) > 1 and sum(v.pixels for v in self._views.values()) > self._most:
            kept = [v for v in self.views if v.index != self._extra][::2]
            self._step *= 2
            self._views = {v.index: v for v in kept} | {view.index: view}
            self._extra = None if kept[-1] is view else view.index

    def remove(self, index: int) -> None:
        """Wait no longer for a view."""
        del self._views[index]

    def away_from(self, index: int) -> Iterator[Iterator[V]]:
        """Views before a frame, newest first, and those after it, oldest first."""
        views = self.views
        yield (view for view in reversed(views) if view.index < index)
        yield (view for view in views if view.index > index)
