"""Views of a recording, prepared when they are first asked for."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Generic, TypeVar

from tofuse.engine.compute import run_all
from tofuse.engine.frames import RangeFrame, Recording

C = TypeVar("C")
V = TypeVar("V")


class RecordedViews(Generic[C, V]):
    """Views by their position in a recording.

    Parameters
    ----------
    recording
        The recording.
    correct
        Called one after the other, as corrections may depend on the frames before; None where an
        image is of no use.
    prepare
        Called in parallel, with what `correct` returns; None likewise.
    """

    def __init__(
        self,
        recording: Recording,
        correct: Callable[[RangeFrame], C | None],
        prepare: Callable[[C], V | None],
    ) -> None:
        self._recording, self._correct, self._prepare = recording, correct, prepare
        self._views: dict[int, V | None] = {}

    def get(self, k: int) -> V | None:
        """Return the k-th view; None if there is none, or if it is of no use."""
        self.load([k])
        return self._views[k]

    def load(self, positions: Sequence[int]) -> None:
        """Prepare views that will be asked for."""
        missing = [k for k in positions if k not in self._views]
        corrected = [self._corrected(k) for k in missing]
        views = run_all([partial(self._prepared, item) for item in corrected])
        self._views.update(zip(missing, views, strict=True))

    def _corrected(self, k: int) -> C | None:
        image = self._recording.image(k) if k < len(self._recording) else None
        return None if image is None else self._correct(image)

    def _prepared(self, corrected: C | None) -> V | None:
        return None if corrected is None else self._prepare(corrected)
