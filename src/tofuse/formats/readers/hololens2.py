"""Reader of HoloLens 2 research mode recordings by Microsoft's sample StreamRecorder."""

from __future__ import annotations

import re
import tarfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tofuse.engine.arrays import Float32, Float64
from tofuse.engine.cameras import RayTable
from tofuse.engine.errors import InputError
from tofuse.engine.frames import POSES_BY, RangeFrame, depth_counts
from tofuse.engine.geometry import se3
from tofuse.engine.parts import part
from tofuse.formats.files import reading, tables
from tofuse.formats.images import parse_image, read_raw
from tofuse.formats.sources import FileSource, Reader, ReaderOptions, Sniff, inputs

# The streams by preference, with their ambiguity range in m.
_STREAMS: dict[str, float | None] = {"Depth Long Throw": None, "Depth AHaT": 1.0}
_NAME = re.compile(r"(?:.*/)?([0-9]{1,19})(_ab)?\.pgm", re.IGNORECASE)
_TICKS = 1e7  # per second
_MAX_BYTES = 1 << 24
_REMEDY = "copy the recording again"


@part("reader", "hololens2", label="experimental")
class HoloLens2(Reader):
    """HoloLens 2: folders with 'Depth Long Throw_lut.bin' and .tar, or those of 'Depth AHaT'."""

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        streams = _streams(path)
        return Sniff(1.0, f"{streams[0]}_lut.bin") if streams else None

    def open(self, path: Path, options: ReaderOptions) -> HoloLens2Source:
        """See `Reader.open`."""
        inputs.refuse_camera(options, "hololens2", inputs.PER_FRAME)
        streams = _streams(path)
        with reading.about(path, _REMEDY):
            if not streams:
                raise InputError("has no 'Depth Long Throw_lut.bin' with images")
            source = HoloLens2Source(path, streams[0])
        if len(streams) > 1:
            source.warnings.append(f"{streams[1]} is ignored: {streams[0]} reaches farther")
        return source


class HoloLens2Source(FileSource):
    """Radial range in mm with active brightness, and the headset's poses as reference."""

    concurrent = True
    remedy = _REMEDY
    kind = "range"
    amplitude_kind = "ir"

    def __init__(self, folder: Path, stream: str) -> None:
        self.images, complete = _images(folder, stream)
        self.ticks = sorted(tick for tick, bright in self.images if not bright)
        if not self.ticks:
            raise InputError("contains no images", where=folder / f"{stream}.tar")
        super().__init__(np.array(self.ticks, float) / _TICKS)
        if not complete:
            archive = folder / f"{stream}.tar"
            self.warnings.append(f"{archive} is cut off or damaged: its end is left out")
        self.ambiguity_m = _STREAMS[stream]
        self.metadata |= {
            "sensor": f"HoloLens 2, {stream} (ToF)",
            "depth_kind": "range",
            "depth_unit_m": 0.001,
            POSES_BY: "HoloLens",
        }
        if self.ambiguity_m is not None:
            self.metadata["ambiguity_m"] = self.ambiguity_m
        self.camera = RayTable(_rays(folder / f"{stream}_lut.bin", self._size()))
        self._read_poses(folder, stream)

    def _size(self) -> tuple[int, int]:
        """(height, width) of the first image that can be read."""
        nothing = InputError("contains no images")
        image = reading.first_readable(self.ticks, lambda t: self._image(t, bright=False), nothing)
        return image.shape[0], image.shape[1]

    def _read_poses(self, folder: Path, stream: str) -> None:
        """Read T_world_rig of each frame, and the pose of the camera in the rig."""
        extrinsics = folder / f"{stream}_extrinsics.txt"
        trajectory = folder / f"{stream}_rig2world.txt"
        if not reading.is_file(extrinsics) or not reading.is_file(trajectory):
            missing = trajectory if reading.is_file(extrinsics) else extrinsics
            self.warnings.append(f"{missing.name} is missing: there are no reference poses")
            return
        try:
            T_camera_rig = inputs.read_matrix_pose(
                tables.read_numbers(extrinsics).reshape(4, 4), str(extrinsics)
            )
            table = tables.read_numbers(trajectory)
            if table.shape[-1] != 17:
                raise InputError("has no rows of 17 numbers", where=trajectory)
        except (InputError, ValueError) as error:
            self.warnings.append(f"no reference poses: {error}")
            return
        # Ticks have more digits than float64.
        row_ticks = np.where(np.isfinite(table[:, 0]), table[:, 0], -1).astype(float)
        order = np.argsort(row_ticks, kind="stable")
        nearest = np.searchsorted(row_ticks[order], np.array(self.ticks, float) - 64)

        def pose(item: tuple[int, int]) -> Float64 | None:
            tick, position = item
            if position == len(row_ticks) or abs(row_ticks[order[position]] - tick) > 64:
                return None
            row = order[position]
            table_of_row = table[row, 1:].reshape(4, 4)
            T_world_rig = inputs.read_matrix_pose(table_of_row, f"{trajectory}, row {row}")
            return T_world_rig @ se3.inverse(T_camera_rig)

        self.reference = inputs.poses_of(self, zip(self.ticks, nearest.tolist(), strict=True), pose)

    def load(self, index: int) -> RangeFrame:
        """See `FileSource.load`."""
        tick = self.ticks[index]
        depth = self._image(tick, bright=False)
        bright = self._image(tick, bright=True) if (tick, True) in self.images else None
        for image in (depth, bright):
            if image is not None and image.shape != (self.camera.height, self.camera.width):
                size = f"{image.shape[1]} x {image.shape[0]} pixels"
                first = f"{self.camera.width} x {self.camera.height}"
                raise InputError(f"is {size}, the first image {first}", where=f"{tick}.pgm")
        amplitude = None if bright is None else bright.astype(np.float32)
        return self.image(
            index, depth_counts.depth_from_counts(depth, self.unit), amplitude_image=amplitude
        )

    def _image(self, tick: int, *, bright: bool) -> NDArray[np.generic]:
        path, begin, size = self.images[tick, bright]
        where = f"{path}: {tick}{'_ab' if bright else ''}.pgm"
        if size > _MAX_BYTES:
            raise InputError("is too large", where=where)
        image = parse_image(reading.read_part(path, begin, size), where)
        if image.dtype != np.uint16 or min(image.shape) < 2:
            raise InputError("is not a 16-bit image", where=where)
        return image


def _streams(path: Path) -> list[str]:
    """The depth streams with a lens and images."""
    if not reading.is_folder(path):
        return []
    return [
        name
        for name in _STREAMS
        if reading.is_file(path / f"{name}_lut.bin")
        and (reading.is_file(path / f"{name}.tar") or reading.is_folder(path / name))
    ]


# Location of an image (file, offset, size), keyed by (time, is amplitude).
_Images = dict[tuple[int, bool], tuple[Path, int, int]]


def _images(folder: Path, stream: str) -> tuple[_Images, bool]:
    """All images of a stream: from its folder if extracted, else from its archive.

    Also whether the archive is complete: it ends with blocks of zeros.
    """
    images: _Images = {}
    if reading.is_folder(folder / stream):
        for path in reading.list_folder(folder / stream):
            match = _NAME.fullmatch(path.name)
            if match and reading.is_file(path):
                images[int(match[1]), match[2] is not None] = (path, 0, path.stat().st_size)
    path = folder / f"{stream}.tar"
    if images or not reading.is_file(path):
        return images, True
    try:
        with tarfile.open(path, "r:") as archive:
            for member in archive:
                match = _NAME.fullmatch(member.name)
                if match and member.isfile():
                    location = (path, member.offset_data, member.size)
                    images[int(match[1]), match[2] is not None] = location
            end = archive.offset
        with path.open("rb") as file:
            file.seek(end)
            complete = file.read(tarfile.BLOCKSIZE) == bytes(tarfile.BLOCKSIZE)
    except OSError as error:
        raise reading.input_error(error, path) from error
    except (tarfile.TarError, ValueError, EOFError) as error:
        if not images:
            raise InputError("is a damaged archive", where=path) from error
        complete = False
    return images, complete


def _rays(path: Path, shape: tuple[int, int]) -> Float32:
    """Rays (H, W, 2) from a table of unit vectors; NaN where undefined."""
    with np.errstate(all="ignore"):
        table = read_raw(path, "3<f4", (shape[1], shape[0]), _REMEDY).astype(float)
        rays = table[..., :2] / table[..., 2:]
        valid = np.isfinite(rays).all(-1) & (table[..., 2] > 0) & (np.abs(rays) < 1e4).all(-1)
    return np.where(valid[..., None], rays, np.nan).astype(np.float32)
