"""Reader of scenes of the BOP benchmark of object poses (Hodan et al. 2018)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.errors import InputError
from tofuse.engine.frames import RangeFrame, depth_counts
from tofuse.engine.geometry import se3
from tofuse.engine.parts import part
from tofuse.formats.cameras import camera_file
from tofuse.formats.files import reading
from tofuse.formats.images import read_image
from tofuse.formats.sources import FileSource, Reader, ReaderOptions, Sniff, inputs

_CAMERAS, _COLOR = "scene_camera.json", ("rgb", "gray")
_SUFFIXES = (".png", ".jpg", ".tif")
_MM = 0.001
_MIN_SCALE, _MAX_SCALE = 1e-3, 100.0  # mm per count of depth
_REMEDY = "correct it there, or download it again"


@part("reader", "bop", label="experimental")
class Bop(Reader):
    """BOP: a folder of a scene, with depth/, rgb/ (or gray/) and scene_camera.json."""

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        if reading.is_file(path / _CAMERAS) and reading.is_folder(path / "depth"):
            return Sniff(1.0, f"depth/ and {_CAMERAS}")
        return None

    def open(self, path: Path, options: ReaderOptions) -> BopSource:
        """See `Reader.open`."""
        inputs.refuse_camera(options, "bop", inputs.PER_FRAME)
        return BopSource(path)


class BopSource(FileSource):
    """Depth images with a lens, a unit and maybe a pose for each."""

    concurrent = True

    def __init__(self, folder: Path) -> None:
        depth = folder / "depth"
        named = reading.files_named(depth, lambda name: name.lower().endswith(".png"))
        self.files = inputs.required(named, ".png files", depth)
        if not all(file.stem.isdecimal() and len(file.stem) <= 9 for file in self.files):
            raise InputError("has names that are no numbers", where=depth, remedy=_REMEDY)
        self.numbers = [int(file.stem) for file in self.files]
        super().__init__(np.arange(len(self.files), dtype=float))
        self.file, self.entries = folder / _CAMERAS, reading.read_json(folder / _CAMERAS)
        self.color = [
            reading.first_file(
                *(folder / name / f"{f.stem}{end}" for name in _COLOR for end in _SUFFIXES)
            )
            for f in self.files
        ]
        self.note_missing_color(self.color)
        self.metadata["depth_kind"] = "z"
        self.reference = inputs.poses_of(self, self.numbers, self._pose)

    def has_color(self, index: int) -> bool:
        """See `FileSource.has_color`."""
        return self.color[index] is not None

    def load(self, index: int) -> RangeFrame:
        """See `FileSource.load`."""
        counts = read_image(self.files[index], dtype="uint16")
        size = (counts.shape[1], counts.shape[0])
        entry, where = self._entry(self.numbers[index])
        K = reading.numbers_in(entry, "cam_K", where, (3, 3), _REMEDY)
        camera = camera_file.checked_pinhole(K, size, f"{where}: cam_K")
        scale = reading.number_in(entry, "depth_scale", where, remedy=_REMEDY)
        if not _MIN_SCALE <= scale <= _MAX_SCALE:
            raise InputError(f"is {scale:g}", where=f"{where}: depth_scale", remedy=_REMEDY)
        return self.image(
            index,
            depth_counts.depth_from_counts(counts, _MM * scale),
            camera=camera,
            color_image=self.color_from_file(index, self.color[index], size),
        )

    def _entry(self, number: int) -> tuple[dict[str, Any], str]:
        """The parameters of an image, and their place."""
        where = f"{self.file}: image {number}"
        entry = self.entries.get(str(number))
        if not isinstance(entry, dict):
            raise InputError("is missing", where=where, remedy=_REMEDY)
        return entry, where

    def _pose(self, number: int) -> Float64 | None:
        """T_world_camera (4, 4); None if it is not stated."""
        entry, where = self._entry(number)
        if "cam_R_w2c" not in entry:
            return None
        T_camera_world = np.eye(4)
        T_camera_world[:3, :3] = reading.numbers_in(entry, "cam_R_w2c", where, (3, 3), _REMEDY)
        T_camera_world[:3, 3] = _MM * reading.numbers_in(entry, "cam_t_w2c", where, (3,), _REMEDY)
        return se3.inverse(inputs.read_matrix_pose(T_camera_world, f"{where}: cam_R_w2c"))
