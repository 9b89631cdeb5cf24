"""Reader of PCD clouds; organised ones become images of a camera where they fit one."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from tofuse.errors import InputError
from tofuse.files.pcd import Pcd, read_pcd
from tofuse.geometry.cameras import Camera, RayTable
from tofuse.parts import part
from tofuse.recordings.cloud_files import CloudFileSource, needed_files, sniff_clouds
from tofuse.recordings.frames import CloudFrame, Frame, RangeFrame
from tofuse.recordings.reader import ReaderOptions, Sniff, refuse_camera
from tofuse.recordings.sources import FARTHEST_M, cloud_frame

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]

SAMPLES = 8
# How far a point may lie from its pixel's ray: what rounding to 0.1 mm and float32 can do.
TOLERANCE_M = 5e-4
TOLERANCE_SHARE = 1e-4
# A lens this near to a pinhole is one: 0.01 px is 0.2 mm at 10 m.
PINHOLE_PIXELS = 0.01
STEEPEST = 100.0  # slope of a ray: 89.4 degrees off the axis


@part("reader", "pcd", label="validated")
@dataclass(frozen=True)
class PcdClouds:
    """A .pcd file, or a folder of them; metres."""

    joinable: ClassVar[bool] = False

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        return sniff_clouds(path, ".pcd")

    def open(self, path: Path, options: ReaderOptions) -> CloudFileSource:
        """See `Reader.open`."""
        refuse_camera(options, "pcd")
        files = needed_files(path, ".pcd")
        camera = common_camera(files)
        if camera is None:
            return CloudFileSource(path, files, pcd_cloud)
        source = CloudFileSource(
            path, files, lambda file, index, time: pcd_image(file, index, time, camera)
        )
        source.metadata["depth_kind"] = "z"
        return source


def pcd_cloud(path: Path, index: int, timestamp: float) -> CloudFrame:
    """Read a file as a cloud; the declared viewpoint is the sensor's position."""
    pcd = read_pcd(path)
    return cloud_frame(
        index,
        timestamp,
        pcd.points,
        pcd.normals,
        amplitude=pcd.amplitude,
        color=pcd.color,
        origin=pcd.viewpoint[:3],
    )


def pcd_image(path: Path, index: int, timestamp: float, camera: Camera) -> Frame:
    """Read an organised file as an image of `camera`.

    Raises
    ------
    InputError
        If it isn't one.
    """
    pcd = read_pcd(path)
    shape = (camera.height, camera.width)
    if (pcd.height, pcd.width) != shape:
        raise InputError(
            f"is organised as {pcd.width} x {pcd.height}, the files before it "
            f"{camera.width} x {camera.height}",
            where=path,
            remedy="keep the files of each camera in a folder of their own",
        )
    points = _image(pcd)
    z = points[..., 2]
    measured = _measured(points)
    rays = camera.rays()
    known = np.asarray(np.isfinite(rays).all(-1))
    if not _fits(points, measured & known, rays):
        raise InputError(
            "has points off the rays of the files before it",
            where=path,
            remedy="keep the files of each camera in a folder of their own",
        )
    if (measured & ~known).any():
        # A pixel that saw nothing in the files looked at first brings its own ray.
        own = points[..., :2] / np.where(measured, z, np.nan)[..., None]
        camera = RayTable(np.where(known[..., None], rays, own))
    amplitude, color, normals = pcd.amplitude, pcd.color, pcd.normals
    return RangeFrame(
        index,
        timestamp,
        camera,
        np.where(measured, z, np.float32(0)),
        "z",
        amplitude_image=None if amplitude is None else np.nan_to_num(amplitude).reshape(shape),
        color_image=None if color is None else color.reshape(*shape, 3),
        normal_image=None if normals is None else normals.reshape(*shape, 3),
    )


def common_camera(files: list[Path]) -> Camera | None:
    """Return the camera whose pixels' rays the points of organised files lie on, or None.

    Looks at up to `SAMPLES` files; those that can't be read are passed over.
    """
    step = max(1, len(files) // SAMPLES)
    images: list[Float32] = []
    for file in files[::step][:SAMPLES]:
        try:
            pcd = read_pcd(file)
        except InputError:
            continue
        if not pcd.organised or pcd.viewpoint[:3].any():
            return None
        images.append(_image(pcd))
    if not images or len({image.shape for image in images}) > 1:
        return None
    rays = _common_rays(images)
    if rays is None:
        return None
    try:
        table = RayTable(rays)
        fit = table.fit
    except (InputError, np.linalg.LinAlgError):
        return None
    if min(fit.fx, fit.fy) < 0.1:
        return table
    known = np.asarray(np.isfinite(rays).all(-1))
    error = np.abs((fit.rays() - rays)[known]) * (fit.fx, fit.fy)
    return fit if error.max() < PINHOLE_PIXELS else table


def _common_rays(images: list[Float32]) -> Float32 | None:
    """Rays (H, W, 2) by least squares over the images, NaN where never seen; None if unfit."""
    above = np.zeros((*images[0].shape[:2], 2))
    below = np.zeros(images[0].shape[:2])
    masks = []
    for image in images:
        if (image[..., 2] < 0).any():
            return None
        measured = _measured(image)
        z = np.where(measured, image[..., 2], 0).astype(float)
        masks.append(measured)
        above += np.where(measured[..., None], image[..., :2], 0) * z[..., None]
        below += z**2
    with np.errstate(invalid="ignore", divide="ignore"):
        slopes = above / np.where(below > 0, below, np.nan)[..., None]
    if (np.abs(slopes) > STEEPEST).any():
        return None
    rays = slopes.astype(np.float32)
    fits = all(_fits(image, mask, rays) for image, mask in zip(images, masks, strict=True))
    return rays if fits else None


def _fits(points: Float32, mask: NDArray[np.bool_], rays: Float32) -> bool:
    z = points[mask][:, 2:]
    off = np.abs(points[mask][:, :2] - rays[mask] * z)
    return bool((off <= TOLERANCE_M + TOLERANCE_SHARE * z).all())


def _measured(points: Float32) -> NDArray[np.bool_]:
    """Mask of points; some programs write the origin, not NaN, where nothing came back."""
    return np.asarray((np.abs(points) < FARTHEST_M).all(-1) & (points[..., 2] > 0))


def _image(pcd: Pcd) -> Float32:
    return pcd.points.reshape(pcd.height, pcd.width, 3)
