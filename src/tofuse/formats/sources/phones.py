"""Recordings of phones: ARKit's axes, lenses of larger images, confidence."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tofuse.engine.arrays import Float32, Float64, UInt8
from tofuse.engine.cameras import Pinhole
from tofuse.engine.errors import InputError
from tofuse.engine.frames import POSES_BY, RangeFrame, depth_counts
from tofuse.engine.quantities import count
from tofuse.formats.cameras import camera_file
from tofuse.formats.images import read_color, read_image
from tofuse.formats.sources.file_source import FileSource
from tofuse.formats.sources.inputs import read_matrix_pose
from tofuse.formats.sources.pixels import resized

# ARKit's camera looks along -z with y up.
ARKIT_AXES = np.diag([1.0, -1.0, -1.0, 1.0])
SENSOR = "iPhone or iPad LiDAR (direct ToF)"
IMAGE_SIZE = (1920, 1440)  # of ARKit's colour images, to which its intrinsics refer
CONFIDENCE_MAX = 2.0


def arkit_pose(table: Float64, where: str) -> Float64:
    """Return T_world_camera (4, 4), x right, y down, z forward, of ARKit's pose; NaN if lost."""
    return read_matrix_pose(table, where) @ ARKIT_AXES


def phone_lens(
    K: Float64, image_size: tuple[int, int], size: tuple[int, int], where: str | Path
) -> Pinhole:
    """Return the camera of depth images of `size` from K (3, 3) of larger colour images."""
    full = camera_file.checked_pinhole(K, image_size, where)
    return camera_file.scaled_lens(full, size, where, "export the images again, not turned")


class PhoneSource(FileSource):
    """Depth images in mm with a camera per frame, and confidence and colour if available.

    ARKit's depth has the view of the colour camera, so that downscaled colour is registered to it.

    Parameters
    ----------
    depth
        One 16-bit PNG per frame.
    timestamps
        (N,) seconds.
    confidence, color
        One path per frame; None where there is none.
    """

    def __init__(
        self,
        depth: Sequence[Path],
        timestamps: Float64,
        *,
        confidence: Sequence[Path | None],
        color: Sequence[Path | None],
    ) -> None:
        super().__init__(timestamps)
        self.files = list(depth)
        self.confidence = list(confidence)
        self.color = list(color)
        self.cameras: list[Pinhole | InputError] = []
        # The last colour image, as who reads a frame may want it at its full resolution next.
        self._last_color: tuple[Path, UInt8] | None = None
        self.metadata |= {
            "sensor": SENSOR,
            POSES_BY: "ARKit",
            "depth_kind": "z",
            "depth_unit_m": 0.001,
            "confidence_max": CONFIDENCE_MAX,
        }
        self.note_missing_color(self.color)
        present = sum(path is not None for path in self.confidence)
        if present < len(self.confidence):
            missing = count(len(self.confidence) - present, "frame")
            self.warnings.append(f"no confidence image for {missing}")

    def load(self, index: int) -> RangeFrame:
        """See `FileSource.load`."""
        camera = self.cameras[index]
        if isinstance(camera, InputError):
            raise camera
        size = (camera.width, camera.height)
        confidence = self.confidence[index]
        return self.image(
            index,
            self.read_depth(index, size),
            camera=camera,
            confidence_image=None if confidence is None else self.read_confidence(confidence, size),
            color_image=self.color_if_readable(index, lambda: self._read_color(index, size)),
        )

    def read_depth(self, index: int, size: tuple[int, int]) -> Float32:
        """Return the depth (H, W) of a frame in m."""
        return depth_counts.depth_from_counts(
            read_image(self.files[index], size=size, dtype="uint16"), 0.001
        )

    def read_confidence(self, path: Path, size: tuple[int, int]) -> UInt8:
        """Return the confidence (H, W) of an image file, 0 to `CONFIDENCE_MAX`."""
        return read_image(path, size=size, dtype="uint8").astype(np.uint8, copy=False)

    def full_resolution_color(self, index: int) -> UInt8 | None:
        """See `FileSource.full_resolution_color`."""
        path = self.color[index]
        if path is None:
            return None
        last = self._last_color
        if last is None or last[0] != path:
            self._last_color = last = path, read_color(path)
        return last[1]

    def has_color(self, index: int) -> bool:
        """See `FileSource.has_color`."""
        return self.color[index] is not None

    def color_path(self, index: int) -> Path:
        """Return the file with the colour of a frame."""
        return self.color[index] or self.files[index]

    def _read_color(self, index: int, size: tuple[int, int]) -> UInt8 | None:
        full = self.full_resolution_color(index)
        return None if full is None else resized(full, size, self.color_path(index))
