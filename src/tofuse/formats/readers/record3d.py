"""Reader of Record3D's exports (iPhone and iPad): the EXR + JPG folder, and .r3d files."""

from __future__ import annotations

import re
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

from tofuse.engine.arrays import Float32, Float64, UInt8
from tofuse.engine.cameras import Pinhole
from tofuse.engine.errors import InputError
from tofuse.engine.frames import POSES_BY, RangeFrame, depth_counts
from tofuse.engine.geometry import quaternion
from tofuse.engine.parts import part
from tofuse.formats.cameras import camera_file
from tofuse.formats.files import reading
from tofuse.formats.images import as_color, parse_image, read_exr_depth
from tofuse.formats.sources import FileSource, Reader, ReaderOptions, Sniff, inputs, phones, pixels

MAX_MEMBER_BYTES = 1 << 26
_SIZES = ((192, 256), (480, 640))  # of LiDAR and TrueDepth cameras; old archives don't state it
_MEMBER = re.compile(r"rgbd/([0-9]{1,9})\.depth")
_EXR = re.compile(r"([0-9]{1,9})\.exr", re.IGNORECASE)
_REMEDY = "export the recording again"


@part("reader", "record3d", label="validated")
class Record3D(Reader):
    """Record3D: folders with metadata.json and depth/*.exr; or .r3d files (extra `phones`)."""

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        if reading.is_folder(path):
            if reading.is_file(path / "metadata.json") and _images(path / "depth"):
                return Sniff(1.0, "metadata.json and depth/*.exr")
            if reading.is_file(path / "metadata") and reading.is_folder(path / "rgbd"):
                return Sniff(1.0, "metadata and rgbd/, an unpacked .r3d archive")
        matches = inputs.begins_with(inputs.file_of(path, ".r3d"), b"PK\x03\x04")
        return Sniff(1.0, "a .r3d archive") if matches else None

    def open(self, path: Path, options: ReaderOptions) -> Record3DSource:
        """See `Reader.open`."""
        inputs.refuse_camera(options, "record3d", inputs.PER_FRAME)
        if reading.is_file(path / "metadata"):
            return Record3DSource(_UnpackedArchive(path))
        if reading.is_file(path / "metadata.json"):
            return Record3DSource(_Folder(path))
        return Record3DSource(_Archive(inputs.required_file(path, ".r3d")))


class Record3DSource(FileSource):
    """Frames of one lens with ARKit's poses; colour is registered after downscaling."""

    def __init__(self, store: _Folder | _Archive) -> None:
        self.store = store
        metadata = _Metadata(store.metadata(), store.where)
        self.size = metadata.depth_size() or store.depth_size()
        times = metadata.times()
        numbers = np.array(store.numbers)
        # Poses and timestamps cover all frames; an export may contain a subset.
        has_times = times is not None and numbers.max() < len(times)
        if times is None or not has_times:
            times = np.arange(numbers.max() + 1) / metadata.frame_rate()
        super().__init__(times[numbers])
        self.cameras = metadata.lenses(self.size, store.numbers)
        if not has_times:
            self.warnings.append(
                f"{store.where}: no timestamps for all frames: assumed to be evenly spaced"
            )
        poses = metadata.poses()
        if poses is not None:
            inside = numbers < len(poses)
            self.reference = np.full((len(numbers), 4, 4), np.nan)
            self.reference[inside] = poses[numbers[inside]]
            if not np.isfinite(self.reference).any():
                self.reference = None
        self.metadata |= {"sensor": phones.SENSOR, "depth_kind": "z", POSES_BY: "ARKit"}
        if store.has_confidence:
            self.metadata["confidence_max"] = phones.CONFIDENCE_MAX
        else:
            self.warnings.append("the export contains no confidence")

    def full_resolution_color(self, index: int) -> UInt8 | None:
        """See `FileSource.full_resolution_color`."""
        color = self.store.color(self.store.numbers[index])
        return None if color is None else as_color(parse_image(*color))

    def load(self, index: int) -> RangeFrame:
        """See `FileSource.load`."""
        number = self.store.numbers[index]
        depth = self.store.depth(number, self.size)
        confidence = self.store.confidence(number, self.size)
        return self.image(
            index,
            depth,
            camera=self.cameras[index],
            confidence_image=confidence,
            color_image=self.color_if_readable(index, lambda: self._read_color(number)),
        )

    def _read_color(self, number: int) -> UInt8 | None:
        """The colour (H, W, 3) of a frame, at the size of depth."""
        stored = self.store.color(number)
        if stored is None:
            return None
        return pixels.resized(as_color(parse_image(*stored)), self.size, stored[1])


class _Folder:
    """The EXR + JPG export."""

    has_confidence = False

    def __init__(self, path: Path) -> None:
        self.where = path / "metadata.json"
        self.path = path
        self.files = _images(path / "depth")
        self.numbers = inputs.required(sorted(self.files), ".exr files", path / "depth", _REMEDY)

    def metadata(self) -> dict[str, Any]:
        return reading.read_json(self.where)

    def depth_size(self) -> tuple[int, int]:
        raise InputError("is missing", where=f"{self.where}: dw", remedy=_REMEDY)

    def depth(self, number: int, size: tuple[int, int]) -> Float32:
        path = self.files[number]
        return _checked(read_exr_depth(path), size, path)

    def confidence(self, number: int, size: tuple[int, int]) -> None:
        return None

    def color(self, number: int) -> tuple[bytes, Path] | None:
        path = reading.first_file(*(self.path / "rgb" / f"{number}{s}" for s in (".jpg", ".png")))
        return None if path is None else (reading.read_bytes(path, limit=MAX_MEMBER_BYTES), path)


class _Archive:
    """A .r3d file: a ZIP archive of `metadata` and, for each frame, rgbd/N.depth, .conf, .jpg."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.where = Path(f"{path}: metadata")
        reading.required_package("lzfse", "phones", path)
        self.names = self._open()
        matches = (_MEMBER.fullmatch(name) for name in self.names)
        self.numbers = sorted({int(m.group(1)) for m in matches if m})
        if not self.numbers:
            raise InputError("contains no rgbd/*.depth", where=path, remedy="export it again")
        self.has_confidence = f"rgbd/{self.numbers[0]}.conf" in self.names

    def _open(self) -> set[str]:
        path = self.path
        try:
            self.archive = zipfile.ZipFile(path)
            return set(self.archive.namelist())
        except OSError as error:
            raise reading.input_error(error, path) from error
        except (zipfile.BadZipFile, ValueError, NotImplementedError, RuntimeError) as error:
            raise InputError(
                f"is a damaged archive ({error})", where=path, remedy="copy the file again"
            ) from error

    def depth_size(self) -> tuple[int, int]:
        """The size of depth for which the first readable frame has the right length."""
        trials = [(number, size) for number in self.numbers for size in _SIZES]
        nothing = InputError("is missing", where=f"{self.where}: dw", remedy=_REMEDY)
        return reading.first_readable(trials, lambda t: self.depth(*t).shape[::-1], nothing)

    def metadata(self) -> dict[str, Any]:
        return reading.parse_json(self._member("metadata"), self.where, _REMEDY)

    def depth(self, number: int, size: tuple[int, int]) -> Float32:
        name = f"rgbd/{number}.depth"
        raw = self._unpacked(name, 4 * size[0] * size[1])
        return _checked(
            np.frombuffer(raw, "<f4").reshape(size[1], size[0]), size, f"{self.path}: {name}"
        )

    def confidence(self, number: int, size: tuple[int, int]) -> UInt8 | None:
        name = f"rgbd/{number}.conf"
        if name not in self.names:
            return None
        raw = self._unpacked(name, size[0] * size[1])
        return np.frombuffer(raw, np.uint8).reshape(size[1], size[0])

    def color(self, number: int) -> tuple[bytes, Path] | None:
        name = f"rgbd/{number}.jpg"
        if name not in self.names:
            return None
        return self._member(name), Path(f"{self.path}: {name}")

    def _unpacked(self, name: str, size: int) -> bytes:
        return lzfse_decompress(self._member(name), size, f"{self.path}: {name}")

    def _member(self, name: str) -> bytes:
        where = f"{self.path}: {name}"
        try:
            with self.archive.open(name) as file:
                data = file.read(MAX_MEMBER_BYTES + 1)
        except KeyError as error:
            raise InputError("is missing", where=where, remedy="export it again") from error
        except OSError as error:
            raise reading.input_error(error, where) from error
        except Exception as error:
            raise InputError("is damaged", where=where, remedy="copy the file again") from error
        if len(data) > MAX_MEMBER_BYTES:
            raise InputError("is too large", where=where, remedy="check the file")
        return data


class _UnpackedArchive(_Archive):
    """The same files in a folder."""

    def _open(self) -> set[str]:
        return {f"rgbd/{file.name}" for file in reading.list_folder(self.path / "rgbd")}

    def _member(self, name: str) -> bytes:
        return reading.read_bytes(self.path / name, limit=MAX_MEMBER_BYTES)


class _Metadata:
    """Checked access to Record3D's metadata."""

    def __init__(self, data: dict[str, Any], where: Path) -> None:
        self.data, self.where = data, where

    def depth_size(self) -> tuple[int, int] | None:
        """Return (width, height) of depth; None in older versions, which don't state it."""
        if not ("dw" in self.data and "dh" in self.data):
            return None
        return camera_file.image_size(self._number("dw"), self._number("dh"), f"{self.where}: dw")

    def lenses(self, size: tuple[int, int], numbers: list[int]) -> list[Pinhole]:
        """Return the lens of each frame; autofocus moves it, which older versions don't state."""
        K = reading.numbers_in(self.data, "K", self.where, (3, 3), _REMEDY).T
        full_size = camera_file.image_size(self._number("w"), self._number("h"), f"{self.where}: w")
        field, table = "perFrameIntrinsicCoeffs", np.zeros((0, 4))
        if self.data.get(field):
            table = reading.numbers_in(self.data, field, self.where, (-1, 4), _REMEDY, finite=False)
        lenses = [phones.phone_lens(K, full_size, size, f"{self.where}: K")] * len(numbers)
        for k, number in enumerate(numbers):
            if number < len(table) and np.isfinite(table[number]).all():
                K[[0, 1, 0, 1], [0, 1, 2, 2]] = table[number]
                lenses[k] = phones.phone_lens(K, full_size, size, f"{self.where}: {field}")
        return lenses

    def frame_rate(self) -> float:
        rate = self._number("fps", 60.0)
        return rate if 0.01 <= rate <= 1e4 else 60.0

    def times(self) -> Float64 | None:
        """Return the timestamps in s of all frames, or None if they aren't given."""
        if "frameTimestamps" not in self.data:
            return None
        times = reading.numbers_in(self.data, "frameTimestamps", self.where, (-1,), _REMEDY)
        return times if len(times) else None

    def poses(self) -> Float64 | None:
        """T_world_camera (N, 4, 4) of all frames, NaN where tracking was lost; or None."""
        if "poses" not in self.data:
            return None
        table = reading.numbers_in(self.data, "poses", self.where, (-1, 7), _REMEDY, finite=False)
        norms = quaternion.length(table[:, :4])
        valid = (np.abs(norms - 1) < 0.01) & (np.abs(table[:, 4:]) < 1e6).all(1)
        poses = np.full((len(table), 4, 4), np.nan)
        poses[valid] = quaternion.to_pose(table[valid, :4], table[valid, 4:])
        return poses @ phones.ARKIT_AXES

    def _number(self, field: str, default: float | None = None) -> float:
        return reading.number_in(self.data, field, self.where, default, _REMEDY)


def _images(folder: Path) -> dict[int, Path]:
    return {int(file.stem): file for file in reading.files_named(folder, _EXR.fullmatch)}


def _checked(depth: Float32, size: tuple[int, int], where: str | Path) -> Float32:
    """Return depth (H, W) in m; non-finite and implausible values become 0."""
    if depth.shape != (size[1], size[0]):
        raise InputError(
            f"is {depth.shape[1]} x {depth.shape[0]} pixels, metadata states {size[0]} x {size[1]}",
            where=where,
            remedy="export the recording again",
        )
    return depth_counts.depth_from_numbers(depth, 1.0)


# Each block begins with these letters. It has at most 40,000 literals and 10,000 copies of up to
# 2359 bytes, and the encoder fills it with at least a few kilobytes.
_MAGIC = b"bvx"
_MIN_BLOCK_BYTES, _MORE_BLOCKS, _HEADERS = 8192, 8, 1024


def lzfse_decompress(data: bytes, size: int, path: str | Path) -> bytes:
    """Decompress a stream of exactly `size` bytes; `path` names it in errors.

    Raises
    ------
    InputError
        If it is damaged, cut off, or of another size, or the package `lzfse` is not installed.
    """
    lzfse = reading.required_package("lzfse", "phones", path)
    # The package has no limit of the size.
    if (
        len(data) > 2 * size + _HEADERS
        or data.count(_MAGIC) > _MORE_BLOCKS + size // _MIN_BLOCK_BYTES
    ):
        raise InputError(f"has more than {size} bytes", where=path, remedy="copy it again")
    try:
        out: bytes = lzfse.decompress(data)
    except (lzfse.error, MemoryError) as error:
        raise InputError(
            "is a damaged or cut off LZFSE stream", where=path, remedy="copy it again"
        ) from error
    if len(out) != size:
        raise InputError(
            f"decompresses to {len(out)} bytes, not {size}", where=path, remedy="copy it again"
        )
    return out
