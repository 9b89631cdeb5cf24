"""The images of a result with their poses, as a folder for other programs."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofuse.apps.export.posed_frames import posed_frames
from tofuse.apps.results import read_cloud
from tofuse.engine.arrays import Float32, Float64, UInt8, UInt16
from tofuse.engine.cameras import Camera, Pinhole, ray_lengths
from tofuse.engine.errors import InputError
from tofuse.formats.files import atomic
from tofuse.formats.images import write_png

DEPTH_UNIT_M, SIGMA_UNIT_M = 1e-3, 1e-4  # m per count
IMAGES, DEPTH, SIGMA, MASKS = "images", "depth", "sigma", "masks"
_MAX_COUNT = 65535
_MAX_POINTS = 200_000


@dataclass(frozen=True, eq=False)
class PosedImage:
    """One frame of a result with its pose, as its files were written.

    Attributes
    ----------
    name
        File name of the frame's images; its number is the index in `run.json`.
    timestamp
        Of the frame, s.
    camera
        Camera of the image, at its resolution, as the result calibrated it; rectified if requested.
    masked
        Whether the image has unknown pixels.
    T_world_camera
        (4, 4).
    covariance
        (6, 6) of the pose (docs/conventions.md); None where not known.
    """

    name: str
    timestamp: float
    camera: Pinhole
    masked: bool
    T_world_camera: Float64
    covariance: Float64 | None


def write_images(
    result: Path, folder: Path, every: int, is_supported: Callable[[Camera], bool]
) -> list[PosedImage]:
    """Write images, depth, sigma and masks of the main model of a result, in order.

    Frames that can't be read, or have neither colour nor amplitude, are left out. Colour that is
    registered to depth keeps its recorded resolution, which may be larger than that of depth.

    Parameters
    ----------
    result
        The result.
    folder
        Where to write.
    every
        Every n-th of the frames with a pose.
    is_supported
        Whether the target format supports a camera's lens model; others are rectified.

    Raises
    ------
    InputError
        If the recording is missing or has changed, contains clouds, no image can be read, or none
        has colour or amplitude.
    """
    written: list[PosedImage] = []
    unmasked: list[tuple[str, tuple[int, ...]]] = []
    skipped: list[str] = []
    for posed in posed_frames(result, every, is_supported):
        if posed.image is None:
            skipped.append(posed.where)
            continue
        name = f"frame_{posed.index:06d}.png"
        frame, is_known = posed.frame, posed.image.any(-1)
        assert frame.sigma_image is not None
        z_sigma = np.where(frame.valid, frame.sigma_image / ray_lengths(frame.camera), 0)
        masked = not is_known.all()
        _write(folder / IMAGES, name, posed.image)
        _write(folder / DEPTH, name, counts(frame.depth, DEPTH_UNIT_M))
        _write(folder / SIGMA, name, counts(z_sigma, SIGMA_UNIT_M))
        if masked:
            _write(folder / MASKS, name, np.where(is_known, 255, 0).astype(np.uint8))
        else:
            unmasked.append((name, is_known.shape))
        pose = posed.T_world_camera, posed.covariance
        written.append(PosedImage(name, frame.timestamp, posed.image_camera, masked, *pose))
    if not written:
        raise InputError(
            "has neither colour nor amplitude" if skipped else "has no readable frame with a pose",
            where=skipped[0] if skipped else result,
            remedy="record one of them: the target programs need images" if skipped else None,
        )
    # If any frame has a mask, all get one.
    for name, shape in unmasked if len(unmasked) < len(written) else ():
        _write(folder / MASKS, name, np.full(shape, 255, np.uint8))
    return written


def _write(folder: Path, name: str, image: NDArray[Any]) -> None:
    write_png(atomic.make_folder(folder) / name, image)


def counts(metres: Float32, unit_m: float) -> UInt16:
    """Return 16-bit counts; 0 where they exceed the range."""
    counts = np.rint(metres.astype(float) / unit_m)
    return np.where(counts < _MAX_COUNT, counts, 0).astype(np.uint16)


def subsampled_points(folder: Path) -> tuple[Float32, UInt8]:
    """Return evenly sampled points (N, 3) of a result's cloud, and their colours (N, 3)."""
    cloud = read_cloud(folder)
    step = max(1, -(-len(cloud) // _MAX_POINTS))
    points, color = cloud.points[::step].astype(np.float32), cloud.color
    color = np.full((len(points), 3), 128, np.uint8) if color is None else color[::step]
    return points, color
