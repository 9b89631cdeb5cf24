"""Reader of PCD clouds; organised ones become range images if they fit a camera."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tofuse.arrays import Float32, Float64
from tofuse.errors import InputError
from tofuse.files.pcd import Pcd, read_pcd
from tofuse.geometry.cameras import Camera
from tofuse.parts import part
from tofuse.recordings.cloud_files import CloudFileSource, required_files, sniff_clouds
from tofuse.recordings.frames import CloudFrame, Frame
from tofuse.recordings.organised import SAMPLES, common_camera, find_raster, organised_frame
from tofuse.recordings.reader import Reader, ReaderOptions, Sniff, refuse_camera
from tofuse.recordings.sources import cloud_frame, to_float32


@part("reader", "pcd", label="validated")
@dataclass(frozen=True)
class PcdClouds(Reader):
    """A .pcd file, or a folder of them; images if organised; metres."""

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        return sniff_clouds(path, ".pcd")

    def open(self, path: Path, options: ReaderOptions) -> CloudFileSource:
        """See `Reader.open`."""
        refuse_camera(options, "pcd")
        files = required_files(path, ".pcd")
        camera = _camera(files)
        if camera is None:
            return CloudFileSource(path, files, pcd_cloud, pcd_cloud)
        source = CloudFileSource(
            path, files, lambda file, index, time: pcd_image(file, index, time, camera)
        )
        source.metadata["depth_kind"] = "z"
        return source


def pcd_cloud(path: Path, index: int, timestamp: float, shift: Float64 | None = None) -> CloudFrame:
    """Read a file as a cloud, minus `shift` (3,) in m; its viewpoint is the sensor's position."""
    pcd = read_pcd(path)
    cloud = pcd.cloud
    return cloud_frame(
        index,
        timestamp,
        cloud.points,
        cloud.normals,
        amplitude=cloud.amplitude,
        color=cloud.color,
        origin=pcd.viewpoint[:3],
        shift=shift,
    )


def pcd_image(path: Path, index: int, timestamp: float, camera: Camera) -> Frame:
    """Read an organised file as an image of `camera`; see `organised_frame`."""
    pcd = read_pcd(path)
    return organised_frame(
        _image(pcd),
        camera,
        index,
        timestamp,
        path,
        amplitude=pcd.cloud.amplitude,
        color=pcd.cloud.color,
        normals=pcd.cloud.normals,
    )


def _camera(files: list[Path]) -> Camera | None:
    """Return the camera of organised files, from up to `SAMPLES` readable ones; or None."""
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
        points = images[-1].reshape(-1, 3)
        if find_raster(points, pcd.width) is None and find_raster(points, pcd.height) is not None:
            raise InputError(
                f"has WIDTH {pcd.width} and HEIGHT {pcd.height}, but rows of {pcd.height} points",
                where=file,
                remedy="swap WIDTH and HEIGHT",
            )
    return common_camera(images)


def _image(pcd: Pcd) -> Float32:
    return to_float32(pcd.cloud.points).reshape(pcd.height, pcd.width, 3)
