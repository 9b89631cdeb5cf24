"""Reader of images saved by kinect2_viewer of iai_kinect2: Kinect v2 with libfreenect2."""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.cameras import Pinhole
from tofuse.engine.errors import InputError
from tofuse.engine.parts import part
from tofuse.formats.cameras import camera_file
from tofuse.formats.files import reading
from tofuse.formats.images import first_size
from tofuse.formats.sources import DepthImageSource, Reader, ReaderOptions, Sniff, inputs

_DEPTH = re.compile(r"([0-9]{1,9})_depth\.png", re.IGNORECASE)
# Camera of an image, and its scale relative to the calibration, by the image size.
_VIEWS = {
    (512, 424): ("calib_ir.yaml", 1.0),
    (960, 540): ("calib_color.yaml", 0.5),
    (1920, 1080): ("calib_color.yaml", 1.0),
}
_MATRIX = re.compile(r"^cameraMatrix:.*?data:\s*\[(.*?)\]", re.DOTALL | re.MULTILINE)


@part("reader", "kinect2", label="experimental")
class Kinect2(Reader):
    """Kinect v2 by iai_kinect2: folders of NNNN_depth.png, NNNN_color.jpg and calib_*.yaml."""

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        files = reading.files_named(path, _DEPTH.fullmatch)
        if not files:
            return None
        if any(_calibration(path, name) is not None for name, _ in _VIEWS.values()):
            return Sniff(1.0, f"{len(files)} *_depth.png and calib_*.yaml")
        return Sniff(
            Sniff.UNCERTAIN,
            f"{len(files)} *_depth.png but no calibration",
            "put kinect2_bridge's calib_ir.yaml and calib_color.yaml into the same folder",
        )

    def open(self, path: Path, options: ReaderOptions) -> DepthImageSource:
        """See `Reader.open`."""
        files = inputs.required(reading.files_named(path, _DEPTH.fullmatch), "NNNN_depth.png", path)
        color = [_color(file) for file in files]
        source = DepthImageSource(
            files,
            np.arange(len(files), dtype=float),
            None if options.camera else _camera(path, first_size(files)),
            color=color if any(color) else None,
            sensor="Kinect v2 (ToF)",
            options=options,
        )
        source.warnings.append("no timestamps: frame numbers serve as seconds")
        return source


def _color(file: Path) -> Path | None:
    stem = file.name[: -len("_depth.png")]
    return reading.first_file(*(file.with_name(f"{stem}_color{s}") for s in (".jpg", ".png")))


def _calibration(folder: Path, name: str) -> Path | None:
    """The calibration in the folder of the images, or in its only subfolder that has one."""
    if reading.is_file(folder / name):
        return folder / name
    try:
        files = [
            p / name
            for p in reading.list_folder(folder)
            if reading.is_folder(p) and reading.is_file(p / name)
        ]
    except InputError:
        return None
    return files[0] if len(files) == 1 else None


def _camera(folder: Path, size: tuple[int, int]) -> Pinhole:
    """Return the pinhole camera of rectified images: the calibration's matrix."""
    if size not in _VIEWS:
        raise InputError(
            f"has images of {size[0]} x {size[1]} pixels, unlike any Kinect v2",
            where=folder,
            remedy="pass their camera with --camera",
        )
    name, scale = _VIEWS[size]
    path = _calibration(folder, name)
    if path is None:
        raise InputError(
            f"has no {name}",
            where=folder,
            remedy="copy it from kinect2_bridge/data/ and your camera's number, or use --camera",
        )
    match = _MATRIX.search(reading.read_text(path, limit=1 << 20))
    numbers = _numbers(match[1]) if match else np.zeros(0)
    if numbers.shape != (9,):
        raise InputError("has no cameraMatrix of 9 numbers", where=path, remedy="copy it again")
    return camera_file.checked_pinhole(scale * numbers.reshape(3, 3), size, path)


def _numbers(text: str) -> Float64:
    with suppress(ValueError):
        return np.array([float(cell) for cell in text.replace(",", " ").split()])
    return np.zeros(0)
