"""Reader of Android's DEPTH16: 13 bits of depth and 3 of confidence (ARCore and others)."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tofuse.engine.frames import RangeFrame
from tofuse.engine.parts import part
from tofuse.formats.cameras import camera_file
from tofuse.formats.files import reading
from tofuse.formats.images import read_raw
from tofuse.formats.sources import FileSource, Reader, ReaderOptions, Sniff, inputs

_SUFFIXES = ("_depth16.bin", ".depth16")
_BITS = 13
CONFIDENCE_MAX = 7.0


@part("reader", "depth16", label="experimental")
class Depth16(Reader):
    """Android, ARCore: folders of *_depth16.bin or *.depth16 with a camera.json."""

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        files = _files(path)
        if not files:
            return None
        evidence = f"{len(files)} DEPTH16 images"
        remedy = "use --format depth16 with --camera: size and lens are not in such files"
        return Sniff.by_camera_file(path, evidence, remedy)

    def open(self, path: Path, options: ReaderOptions) -> Depth16Source:
        """See `Reader.open`."""
        files = inputs.required(_files(path), "*_depth16.bin or *.depth16", path)
        camera = camera_file.camera_file_of(path, options.camera, "neither size nor lens")
        return Depth16Source(files, camera)


class Depth16Source(FileSource):
    """Depth with confidence, and colour if there is an image of the same name."""

    concurrent = True

    def __init__(self, files: list[Path], camera: Path) -> None:
        description = self.use_camera(camera)
        super().__init__(np.arange(len(files)) / (description.frame_rate_hz or 1.0))
        self.files = files
        self.color = [_color(file) for file in files]
        self.metadata |= description.metadata
        self.metadata |= {"depth_unit_m": self.unit, "confidence_max": CONFIDENCE_MAX}
        self.note_missing_color(self.color)

    def load(self, index: int) -> RangeFrame:
        """See `FileSource.load`."""
        size = (self.camera.width, self.camera.height)
        remedy = "pass the camera of these images with --camera"
        samples = read_raw(self.files[index], "<u2", size, remedy)
        counts = samples & ((1 << _BITS) - 1)
        depth = counts.astype(np.float32) * np.float32(self.unit)
        # 0 means unknown and counts as full confidence; 1 is 0 %, 7 is 6/7.
        level = (samples >> _BITS).astype(np.uint8)
        confidence = np.where(level == 0, np.uint8(CONFIDENCE_MAX), level - np.uint8(1))
        return self.image(
            index,
            depth,
            confidence_image=confidence.astype(np.uint8),
            color_image=self.color_from_file(index, self.color[index], size),
        )


def _files(path: Path) -> list[Path]:
    return reading.files_named(path, lambda name: name.lower().endswith(_SUFFIXES))


def _color(file: Path) -> Path | None:
    suffix = next(suffix for suffix in _SUFFIXES if file.name.lower().endswith(suffix))
    return reading.if_file(file.with_name(f"{file.name[: -len(suffix)]}_image.jpg"))
