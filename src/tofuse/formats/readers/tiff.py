"""Reader of depth images stored as TIFF: DLR's Tiff3D, and exports of viewers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from tofuse.engine import quantities
from tofuse.engine.errors import InputError
from tofuse.engine.frames import RangeFrame, depth_counts
from tofuse.engine.parts import part
from tofuse.formats.files import reading
from tofuse.formats.images import read_tiff
from tofuse.formats.sources import FileSource, Reader, ReaderOptions, Sniff, inputs, pixels

_SUFFIXES = (".tif", ".tiff")
_RANGE = ".range"
_AMPLITUDE_KEYWORDS = ("intens", "ampl")
_NOT_DEPTH = (*_AMPLITUDE_KEYWORDS, "conf")


@part("reader", "tiff")
class Tiff(Reader):
    """Tiff3D, viewers: a folder of depth images as .tif, with `--camera`."""

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        files = reading.files_with(path, *_SUFFIXES) if reading.is_folder(path) else []
        if any(_is_range(file) for file in files):
            return Sniff(1.0, f"{len(files)} .tif files, *.range.tif among them")
        if not files:
            return None
        return Sniff(
            Sniff.UNCERTAIN,
            f"{len(files)} .tif files",
            "use --format tiff and --camera camera.json",
            needs_camera=True,
        )

    def open(self, path: Path, options: ReaderOptions) -> TiffSource:
        """See `Reader.open`."""
        files = reading.files_with(path, *_SUFFIXES) if reading.is_folder(path) else []
        depth = [f for f in files if _is_range(f)] or [
            f for f in files if not _is_named(f, _NOT_DEPTH)
        ]
        inputs.required(depth, ".tif of depth", path, "pass the folder of images")
        if options.camera is None:
            raise InputError(
                "has no camera: the layout of .t3c files isn't published, and TIFF has none",
                where=path,
                remedy="use --camera camera.json with lens, depth_unit_m and depth_kind",
            )
        amplitude = [f for f in files if f not in depth and _is_named(f, _AMPLITUDE_KEYWORDS)]
        return TiffSource(path, depth, amplitude, options.camera)


class TiffSource(FileSource):
    """Depth, and amplitude if every frame has one; times and poses as in native folders.

    Values, floats too, are scaled by `depth_unit_m`, as the images don't state their unit.
    """

    concurrent = True

    def __init__(
        self, folder: Path, depth: Sequence[Path], amplitude: Sequence[Path], camera: Path
    ) -> None:
        nothing = InputError("has no images", where=folder)
        description = self.use_camera(
            camera,
            size_of_images=lambda: reading.first_readable(depth, read_tiff, nothing).shape[::-1],
        )
        super().__init__(np.arange(len(depth)) / (description.frame_rate_hz or 1.0))
        self.depth, self.amplitude = list(depth), list(amplitude)
        self.amplitude_kind = description.amplitude_kind or "raw"
        self.ambiguity_m = description.ambiguity_m
        if self.amplitude and len(self.amplitude) != len(self.depth):
            self.warnings.append(
                f"{quantities.count(len(self.amplitude), 'image')} of amplitude "
                f"for {len(self.depth)} of depth: left out"
            )
            self.amplitude = []
        self.read_sidecars(folder)
        self.metadata |= {"depth_unit_m": self.unit, "depth_kind": self.kind}
        self.metadata |= description.stated("sensor", "serial", "frame_rate_hz", "ambiguity_m")

    def load(self, index: int) -> RangeFrame:
        """See `FileSource.load`."""
        size = (self.camera.width, self.camera.height)
        amplitude = None
        if self.amplitude:
            amplitude = pixels.finite_float32(read_tiff(self.amplitude[index], size))
        depth = depth_counts.depth_from_numbers(read_tiff(self.depth[index], size), self.unit)
        return self.image(index, depth, amplitude_image=amplitude)


def _is_range(file: Path) -> bool:
    return Path(file.stem).suffix.lower() == _RANGE


def _is_named(file: Path, keywords: Sequence[str]) -> bool:
    return any(keyword in file.stem.lower() for keyword in keywords)
