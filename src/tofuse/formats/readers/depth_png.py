"""Reader of depth images as PNG, of a camera given by the user: one, or a folder of them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tofuse.engine import quantities
from tofuse.engine.errors import InputError
from tofuse.engine.parts import part
from tofuse.formats.files import reading
from tofuse.formats.images import read_header
from tofuse.formats.sources import DepthImageSource, Reader, ReaderOptions, Sniff, inputs

_CAMERA = (
    "if these are depth images, use --camera camera.json with lens, depth_unit_m and depth_kind, "
    "or a file of OpenCV or ROS"
)
_SAMPLES = 16  # number of images that tell whether a folder has depth


@part("reader", "depth-png")
class DepthPng(Reader):
    """16-bit .png of depth, one or a folder, with a camera.json given or in its folder."""

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        files = inputs.files_at(path, ".png")
        if not files or _is_native(path):
            return None
        if reading.is_file(path):
            return Sniff(Sniff.CERTAIN, "a 16-bit PNG") if _is_depth(path) else None
        # Colour may lie in between, in any order.
        sampled = files[:: -(-len(files) // _SAMPLES)]
        if not any(_is_depth(file) for file in sampled):
            return None
        evidence = f"{quantities.count(len(files), 'PNG')}, of depth among them"
        # Formats with names of their own come first.
        return Sniff(Sniff.UNCERTAIN / 2, evidence, _CAMERA, needs_camera=True)

    def open(self, path: Path, options: ReaderOptions) -> DepthImageSource:
        """See `Reader.open`."""
        images = inputs.files_at(path, ".png")
        files = inputs.required(
            [f for f in images if _is_depth(f) is not False], "16-bit .png", path
        )
        folder = path.parent if reading.is_file(path) else path
        camera = options.camera
        if camera is None and reading.is_file(folder / "camera.json"):
            camera = folder / "camera.json"
        if camera is None:
            raise InputError("is a depth image without a camera", where=path, remedy=_remedy(path))
        times = np.arange(len(files), dtype=float)
        source = DepthImageSource(files, times, None, options=ReaderOptions(camera))
        if reading.is_folder(path):
            source.read_sidecars(path)
        if len(files) < len(images):
            others = quantities.count(len(images) - len(files), "image")
            source.warnings.append(
                f"{others} without 16-bit depth left out; colour is used from color/ beside depth/"
            )
        return source


def _is_depth(file: Path) -> bool | None:
    """Whether an image has one channel of 16 bits; None if it can't be read: a frame less, then."""
    try:
        header = read_header(file)
    except InputError:
        return None
    return header.bits == 16 and header.channels == 1


def _remedy(path: Path) -> str:
    """The remedy; for an image of a native folder, to open the folder's frame instead."""
    if _is_native(path.parent):
        number = reading.files_with(path.parent, ".png").index(path)
        return f"use {path.parent.parent}#{number}, which is this frame of its recording"
    return _CAMERA


def _is_native(path: Path) -> bool:
    """Whether a folder has the depth images of a native recording."""
    return path.name == "depth" and reading.is_file(path.parent / "camera.json")
