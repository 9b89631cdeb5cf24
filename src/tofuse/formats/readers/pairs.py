"""Reader of folders with pairs of images of depth and colour, of a camera given by the user."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from tofuse.engine import quantities
from tofuse.engine.parts import part
from tofuse.formats.cameras import camera_file
from tofuse.formats.files import reading
from tofuse.formats.sources import DepthImageSource, Reader, ReaderOptions, Sniff, inputs

_DEPTH = re.compile(r"(.+-)depth\.png|depth([0-9]+)\.png", re.IGNORECASE)
_SUFFIXES = (".png", ".jpg", ".jpeg")


@part("reader", "pairs", label="experimental")
class Pairs(Reader):
    """RGB-D Scenes v2, ZED: N-depth.png, N-color.png or depthN.png, leftN.png; a camera.json."""

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        files = reading.files_named(path, _DEPTH.fullmatch)
        if not files:
            return None
        evidence = f"{quantities.count(len(files), 'image')} like {files[0].name}"
        remedy = "use --format pairs with --camera camera.json, which states lens and depth_unit_m"
        return Sniff.by_camera_file(path, evidence, remedy)

    def open(self, path: Path, options: ReaderOptions) -> DepthImageSource:
        """See `Reader.open`."""
        files = reading.files_named(path, _DEPTH.fullmatch)
        inputs.required(files, "*-depth.png or depth*.png", path)
        camera = camera_file.camera_file_of(path, options.camera, "neither lens nor unit")
        return DepthImageSource(
            files,
            np.arange(len(files), dtype=float),
            None,
            color=[_color(file) for file in files],
            options=ReaderOptions(camera),
        )


def _color(file: Path) -> Path | None:
    match = _DEPTH.fullmatch(file.name)
    assert match is not None
    stem = f"left{match[2]}" if match[1] is None else f"{match[1]}color"
    return reading.first_file(*(file.with_name(stem + suffix) for suffix in _SUFFIXES))
