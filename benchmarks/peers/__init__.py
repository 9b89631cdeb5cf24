"""Trackers of other programs behind one interface, one file each; all are optional."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tofuse.engine.arrays import Bool, Float64, Intp
from tofuse.engine.cameras.cameras import Camera, Pinhole
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.geometry.rays import homogeneous

MAX_DEPTH_M = 12.0


class Session(Protocol):
    """A tracker running on one sequence."""

    def prepare(self, frame: RangeFrame) -> Any:
        """Convert a frame to the data type of the tracker. Not timed."""
        ...

    def push(self, prepared: Any) -> Float64 | None:
        """Track a frame; return T_world_camera (4, 4) or None if lost. Timed."""
        ...


class Method(Protocol):
    """A tracker with its tuning."""

    @property
    def label(self) -> str:
        """Its name."""
        ...

    @property
    def tuning(self) -> str:
        """All non-default settings, as text."""
        ...

    def resolution(self, frame: RangeFrame) -> str:
        """Describe the grid or voxels that it uses."""
        ...

    def start(self, frame: RangeFrame, threads: int) -> Session:
        """Start a sequence, given its first frame."""
        ...


def grid(frame: RangeFrame) -> str:
    """Size of the images."""
    return f"{frame.camera.width} x {frame.camera.height}"


@dataclass
class PinholeImages:
    """Images of an ideal pinhole camera, resampled by nearest pixels if the lens distorts.

    For peers without a distortion model.
    """

    camera: Camera
    pinhole: Pinhole = field(init=False)
    _rows: Intp = field(init=False, repr=False)
    _columns: Intp = field(init=False, repr=False)
    _inside: Bool = field(init=False, repr=False)

    def __post_init__(self) -> None:
        c = self.camera
        assert isinstance(c, Pinhole)
        self.pinhole = Pinhole(c.width, c.height, c.fx, c.fy, c.cx, c.cy)
        pixels = c.project(homogeneous(self.pinhole.rays()))
        columns, rows = np.round(np.moveaxis(np.nan_to_num(pixels, nan=-1), -1, 0)).astype(int)
        self._inside = (rows >= 0) & (rows < c.height) & (columns >= 0) & (columns < c.width)
        self._rows, self._columns = rows.clip(0, c.height - 1), columns.clip(0, c.width - 1)

    def take(self, image: NDArray[Any]) -> NDArray[Any]:
        """Resample an image; 0 outside the field of view."""
        if type(self.camera) is Pinhole:
            return np.ascontiguousarray(image)
        taken = image[self._rows, self._columns]
        taken[~self._inside] = 0
        return taken


def all_methods(frame: RangeFrame) -> list[list[Method]]:
    """Return the peers that support such frames; for each, its candidate tunings."""
    from peers import kiss, o3d, sgicp

    return [*o3d.methods(frame), *sgicp.methods(frame), *kiss.methods(frame)]
