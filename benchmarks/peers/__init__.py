"""Trackers to compare with, all behind one interface. Each file names one; none is needed."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tofuse.arrays import Bool, Float64, Intp
from tofuse.geometry.cameras import Camera, Pinhole
from tofuse.recordings.frames import RangeFrame

MAX_DEPTH_M = 12.0


class Session(Protocol):
    """A tracker at work on one sequence."""

    def prepare(self, frame: RangeFrame) -> Any:
        """Bring a frame into the type that the tracker takes. Not timed."""
        ...

    def push(self, prepared: Any) -> Float64 | None:
        """Track, and return T_world_camera (4, 4) or None where lost. Timed."""
        ...


class Method(Protocol):
    """A tracker with its tuning."""

    @property
    def label(self) -> str:
        """Its name."""
        ...

    @property
    def tuning(self) -> str:
        """Every setting that is not its default, for people."""
        ...

    def resolution(self, frame: RangeFrame) -> str:
        """Say on what grid or voxels it works."""
        ...

    def start(self, frame: RangeFrame, threads: int) -> Session:
        """Begin a sequence whose first frame is given."""
        ...


def grid(frame: RangeFrame) -> str:
    """Size of the images."""
    return f"{frame.camera.width} x {frame.camera.height}"


@dataclass
class PinholeImages:
    """Images as a pinhole camera would have taken them: nearest pixels, where a lens distorts.

    Peers that know no distortion get these.
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
        rays = self.pinhole.rays()
        pixels = c.project(np.concatenate([rays, np.ones_like(rays[..., :1])], -1))
        columns, rows = np.round(np.moveaxis(np.nan_to_num(pixels, nan=-1), -1, 0)).astype(int)
        self._inside = (rows >= 0) & (rows < c.height) & (columns >= 0) & (columns < c.width)
        self._rows, self._columns = rows.clip(0, c.height - 1), columns.clip(0, c.width - 1)

    def take(self, image: NDArray[Any]) -> NDArray[Any]:
        """Resample an image; 0 where the camera did not look."""
        if type(self.camera) is Pinhole:
            return np.ascontiguousarray(image)
        taken = image[self._rows, self._columns]
        taken[~self._inside] = 0
        return taken


def all_methods(frame: RangeFrame) -> list[list[Method]]:
    """Return the peers that can work on such frames; of each, the tunings to choose from."""
    from peers import kiss, o3d, sgicp

    return [*o3d.methods(frame), *sgicp.methods(frame), *kiss.methods(frame)]
