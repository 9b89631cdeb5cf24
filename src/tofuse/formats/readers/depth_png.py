"""Reader of a single depth image as PNG."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tofuse.engine.errors import InputError
from tofuse.engine.parts import part
from tofuse.formats.files import reading
from tofuse.formats.images import read_header
from tofuse.formats.sources import DepthImageSource, Reader, ReaderOptions, Sniff


@part("reader", "depth-png")
class DepthPng(Reader):
    """One 16-bit .png of depth, with a camera.json given or in its folder."""

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        if not (reading.is_file(path) and path.suffix.lower() == ".png"):
            return None
        header = read_header(path)
        if header.bits != 16 or header.channels != 1:
            return None
        return Sniff(Sniff.CERTAIN, "a 16-bit PNG")

    def open(self, path: Path, options: ReaderOptions) -> DepthImageSource:
        """See `Reader.open`."""
        if not reading.is_file(path):
            raise InputError("is not a file", where=path, remedy="pass one depth .png")
        camera = options.camera
        if camera is None and reading.is_file(path.parent / "camera.json"):
            camera = path.parent / "camera.json"
        if camera is None:
            raise InputError("is a depth image without a camera", where=path, remedy=_remedy(path))
        return DepthImageSource([path], np.zeros(1), None, options=ReaderOptions(camera))


def _remedy(path: Path) -> str:
    """The remedy; for an image of a native folder, to open the folder's frame instead."""
    folder = path.parent.parent
    if path.parent.name == "depth" and reading.is_file(folder / "camera.json"):
        number = reading.files_with(path.parent, ".png").index(path)
        return f"use {folder}#{number}, which is this frame of its recording"
    return "pass --camera camera.json with lens, depth_unit_m and depth_kind"
