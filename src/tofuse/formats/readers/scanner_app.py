"""Reader of the "all data" export of 3d Scanner App (iPhone and iPad)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.cameras import Pinhole
from tofuse.engine.errors import InputError
from tofuse.engine.parts import part
from tofuse.formats.files import reading
from tofuse.formats.images import first_size
from tofuse.formats.sources import Reader, ReaderOptions, Sniff, inputs, phones

_DEPTH = re.compile(r"depth_([0-9]{1,9})\.png", re.IGNORECASE)
_REMEDY = "export the recording again"


@part("reader", "3dscannerapp", label="validated")
class ScannerApp(Reader):
    """3d Scanner App, "all data": folders of depth_NNNNN.png, frame_NNNNN.json and some .jpg."""

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        files = reading.files_named(path, _DEPTH.fullmatch)
        if any(reading.if_file(_file_of_frame(file, "frame", ".json")) for file in files[:9]):
            return Sniff(1.0, f"{len(files)} depth_*.png with frame_*.json")
        if any(reading.if_file(_file_of_frame(file, "conf", ".png")) for file in files[:9]):
            return Sniff(
                Sniff.UNCERTAIN,
                f"{len(files)} depth_*.png without frame_*.json",
                "share 'All data' from 3d Scanner App again, as these state the lens",
            )
        return None

    def open(self, path: Path, options: ReaderOptions) -> phones.PhoneSource:
        """See `Reader.open`."""
        inputs.refuse_camera(options, "3dscannerapp", inputs.PER_FRAME)
        files = reading.files_named(path, _DEPTH.fullmatch)
        inputs.required(files, "depth_*.png", path, "export with all data")
        size = first_size(files)
        source = phones.PhoneSource(
            files,
            np.full(len(files), np.nan),
            confidence=[reading.if_file(_file_of_frame(file, "conf", ".png")) for file in files],
            color=[reading.if_file(_file_of_frame(file, "frame", ".jpg")) for file in files],
        )
        entries: list[_FrameMetadata | None] = []
        for k, file in enumerate(files):
            entry = None
            try:
                facts = _file_of_frame(file, "frame", ".json")
                metadata = _FrameMetadata.read(reading.if_file(facts) or facts)
                source.timestamps[k] = metadata.time
                source.cameras.append(metadata.lens(size))
                entry = metadata
            except InputError as error:
                # Only this frame is unusable without its camera.
                source.cameras.append(error)
            entries.append(entry)
        if not np.isfinite(source.timestamps).any():
            raise next(c for c in source.cameras if isinstance(c, InputError))
        source.timestamps = inputs.interpolated(source.timestamps)
        source.reference = inputs.poses_of(
            source, entries, lambda entry: None if entry is None else entry.pose()
        )
        return source


@dataclass(frozen=True)
class _FrameMetadata:
    """The content of a frame_NNNNN.json."""

    path: Path
    data: dict[str, Any]
    time: float

    @classmethod
    def read(cls, path: Path) -> _FrameMetadata:
        data = reading.read_json(path)
        return cls(path, data, float(reading.numbers_in(data, "time", path, (1,), _REMEDY)[0]))

    def lens(self, size: tuple[int, int]) -> Pinhole:
        K = reading.numbers_in(self.data, "intrinsics", self.path, (3, 3), _REMEDY)
        image = phones.IMAGE_SIZE
        if "projectionMatrix" in self.data:
            # Its diagonal is 2 * focal length / image size.
            P = reading.numbers_in(self.data, "projectionMatrix", self.path, (4, 4), _REMEDY)
            with np.errstate(all="ignore"):
                width, height = 2 * np.diag(K)[:2] / np.diag(P)[:2]
            if 100 < width < 16384 and 100 < height < 16384:
                image = (round(float(width)), round(float(height)))
        return phones.phone_lens(K, image, size, f"{self.path}: intrinsics")

    def pose(self) -> Float64 | None:
        if "cameraPoseARFrame" not in self.data:
            return None
        table = reading.numbers_in(
            self.data, "cameraPoseARFrame", self.path, (4, 4), _REMEDY, finite=False
        )
        return phones.arkit_pose(table, f"{self.path}: cameraPoseARFrame")


def _file_of_frame(file: Path, name: str, suffix: str) -> Path:
    return file.with_name(f"{name}_{file.stem.split('_', 1)[1]}{suffix}")
