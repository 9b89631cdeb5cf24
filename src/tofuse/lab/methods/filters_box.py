"""Filter by a box."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from tofuse.engine.arrays import Bool
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.filters import Filter
from tofuse.engine.frames import Frame, RangeFrame
from tofuse.engine.parts import part


@part("filter", "box")
@dataclass(frozen=True)
class Box(Bounded, Filter):
    """Remove points outside (or inside) a box along the axes of the camera frame (section 2.8).

    Attributes
    ----------
    lower, upper
        Opposite corners (x, y, z) in m: x right, y down, z forward. Points on the faces are
        inside.
    remove
        "outside" keeps the points in the box, "inside" removes them.
    """

    lower: tuple[float, float, float]
    upper: tuple[float, float, float]
    remove: Literal["outside", "inside"] = "outside"

    def __post_init__(self) -> None:
        super().__post_init__()
        for name, corner in (("lower", self.lower), ("upper", self.upper)):
            if len(corner) != 3:
                raise ValueError(f"{name} must have 3 numbers, not {len(corner)}")
            for axis, value in zip("xyz", corner, strict=True):
                if value not in Bounds():
                    raise ValueError(f"{name} {axis} must be a finite number, not {value!r}")
        if not all(a < b for a, b in zip(self.lower, self.upper, strict=True)):
            raise ValueError("lower must be below upper on every axis")

    def mask(self, frame: Frame, history: Sequence[Frame]) -> Bool:
        """See `Filter.mask`."""
        points = frame.point_image if isinstance(frame, RangeFrame) else frame.points
        inside: Bool = np.all((points >= self.lower) & (points <= self.upper), axis=-1)
        return inside if self.remove == "outside" else ~inside
