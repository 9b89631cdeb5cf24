"""Keep what the camera itself is confident of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from tofuse.filters._options import whole
from tofuse.filters.base import Bool, Filter
from tofuse.parts import part
from tofuse.recordings.frames import Frame, RangeFrame


@part("filter", "confidence", label="validated")
@dataclass(frozen=True)
class Confidence(Filter):
    """Keep points of at least a level of the camera's confidence map (section 2.8).

    The SR4000 gives levels 0 to 7; chapter 4 keeps 7 alone. Other cameras count differently. A
    view without a confidence map is kept whole.

    Attributes
    ----------
    minimum
        Lowest level that is kept, 0 to 255.
    """

    minimum: int = 7

    takes: ClassVar[frozenset[str]] = frozenset({"range", "cloud"})

    def __post_init__(self) -> None:
        whole("minimum", self.minimum, 0)
        if self.minimum > 255:
            raise ValueError(f"minimum must be at most 255, not {self.minimum}")

    def mask(self, frame: Frame, history: Sequence[Frame]) -> Bool:
        """See `Filter.mask`."""
        if not isinstance(frame, RangeFrame) or frame.confidence_image is None:
            return np.ones(frame.valid.shape, bool)
        return frame.confidence_image >= self.minimum
