"""Reader of depth saved by the examples of Arducam's ToF camera."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tofuse.engine.arrays import Float32, UInt8
from tofuse.engine.frames import RangeFrame, depth_counts
from tofuse.engine.parts import part
from tofuse.formats.cameras import camera_file
from tofuse.formats.files import reading
from tofuse.formats.images import read_raw
from tofuse.formats.sources import FileSource, Reader, ReaderOptions, Sniff, inputs

# Width and height in pixels, and the time at which the file was written in ms.
_NAME = re.compile(r"(depth|confidence)_(\d{1,5})_(\d{1,5})_f32_(\d{1,15})\.raw")
CONFIDENCE_MAX = 255.0


@part("reader", "arducam", label="experimental")
class Arducam(Reader):
    """Arducam ToF: folders of depth_W_H_f32_T.raw, with the camera in a camera.json."""

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        images = _images(path, "depth")
        if not images:
            return None
        evidence = f"{len(images)} depth images of Arducam's examples"
        remedy = "use --format arducam with --camera: lens and unit are not in such files"
        return Sniff.by_camera_file(path, evidence, remedy)

    def open(self, path: Path, options: ReaderOptions) -> ArducamSource:
        """See `Reader.open`."""
        remedy = "save depth, not the sensor's raw phases"
        inputs.required(_images(path, "depth"), "depth_*_f32_*.raw", path, remedy)
        camera = camera_file.camera_file_of(path, options.camera, "neither lens nor unit")
        return ArducamSource(path, camera)


@dataclass(frozen=True)
class _Image:
    path: Path
    size: tuple[int, int]
    time_ms: int


class ArducamSource(FileSource):
    """Depth images, each with the confidence image that was saved before the next depth image."""

    concurrent = True

    def __init__(self, path: Path, camera: Path) -> None:
        description = self.use_camera(camera)
        self.depth = _images(path, "depth")
        super().__init__(np.array([image.time_ms for image in self.depth]) / 1000)
        self.confidence = _next_image(self.depth, _images(path, "confidence"))
        self.metadata |= {**description.metadata, "confidence_max": CONFIDENCE_MAX}
        missing = sum(image is None for image in self.confidence)
        if missing > 0:
            self.warnings.append(f"{missing} of {len(self.depth)} frames have no confidence")

    def load(self, index: int) -> RangeFrame:
        """See `FileSource.load`."""
        depth = depth_counts.depth_from_numbers(self._floats(self.depth[index]), self.unit)
        return self.image(index, depth, confidence_image=self._confidence(self.confidence[index]))

    def _confidence(self, image: _Image | None) -> UInt8 | None:
        if image is None:
            return None
        values = np.nan_to_num(self._floats(image), nan=0.0)
        return values.clip(0, CONFIDENCE_MAX).astype(np.uint8)

    def _floats(self, image: _Image) -> Float32:
        """(H, W) values of a file."""
        values = read_raw(image.path, "<f4", image.size, "save it again")
        camera_file.check_size(values, self.camera, image.path)
        return values.astype(np.float32)


def _images(path: Path, kind: str) -> list[_Image]:
    """The images of a kind in a folder, in the order of time."""
    images = []
    for file in reading.files_named(path, _NAME.fullmatch):
        match = _NAME.fullmatch(file.name)
        assert match is not None
        if match[1] == kind:
            images.append(_Image(file, (int(match[2]), int(match[3])), int(match[4])))
    return sorted(images, key=lambda image: (image.time_ms, image.path.name))


def _next_image(depth: list[_Image], others: list[_Image]) -> list[_Image | None]:
    """For each depth image, the first of the others from its time on and before the next one."""
    times = np.array([image.time_ms for image in depth])
    matched: list[_Image | None] = [None] * len(depth)
    for image in reversed(others):
        k = int(np.searchsorted(times, image.time_ms, side="right")) - 1
        if k >= 0:
            matched[k] = image
    return matched
