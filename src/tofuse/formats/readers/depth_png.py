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


@part("reader", "depth-png")
class DepthPng(Reader):
    """16-bit .png of depth, one or a folder, with a camera.json given or in its folder."""

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        files = inputs.files_at(path, ".png")
        if not files or _is_native(path):
            return None
        nothing = InputError("has no images", where=path)
        header = reading.first_readable(files, read_header, nothing)
        if header.bits != 16 or header.channels != 1:
            return None
        if reading.is_file(path):
            return Sniff(Sniff.CERTAIN, "a 16-bit PNG")
        evidence = f"{quantities.count(len(files), '16-bit PNG')}"
        # Formats with names of their own come first.
        return Sniff(Sniff.UNCERTAIN / 2, evidence, _CAMERA, needs_camera=True)

    def open(self, path: Path, options: ReaderOptions) -> DepthImageSource:
        """See `Reader.open`."""
        files = inputs.required(inputs.files_at(path, ".png"), ".png of depth", path)
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
        return source


def _remedy(path: Path) -> str:
    """The remedy; for an image of a native folder, to open the folder's frame instead."""
    if _is_native(path.parent):
        number = reading.files_with(path.parent, ".png").index(path)
        return f"use {path.parent.parent}#{number}, which is this frame of its recording"
    return _CAMERA


def _is_native(path: Path) -> bool:
    """Whether a folder has the depth images of a native recording."""
    return path.name == "depth" and reading.is_file(path.parent / "camera.json")
