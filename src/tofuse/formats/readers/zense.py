"""Reader of Pico Zense folders: depth images, and a .toml with the intrinsics."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from tofuse.engine.cameras import Pinhole
from tofuse.engine.parts import part
from tofuse.formats.cameras import camera_file
from tofuse.formats.files import reading
from tofuse.formats.images import first_size
from tofuse.formats.sources import DepthImageSource, Reader, ReaderOptions, Sniff, inputs

FRAME_RATE_HZ = 30.0
_LENS = {"fx": "camera_fx", "fy": "camera_fy", "cx": "camera_cx", "cy": "camera_cy"}


@part("reader", "zense", label="validated")
class Zense(Reader):
    """Pico Zense: folders of depth*.png in mm and a .toml with camera_fx and so on."""

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        settings = _settings(path)
        if settings is not None and (files := _depth_files(path)):
            return Sniff(1.0, f"{len(files)} depth*.png and {settings.name}")
        return None

    def open(self, path: Path, options: ReaderOptions) -> DepthImageSource:
        """See `Reader.open`."""
        files = _depth_files(path) if reading.is_folder(path) else []
        inputs.required(files, "depth*.png", path, "pass the recording's folder")
        settings = _settings(path)
        camera: Pinhole | None = None
        rate = FRAME_RATE_HZ
        if settings is not None:
            values = _read(settings)
            rate = reading.number_in(values, "capture_fps", settings, FRAME_RATE_HZ)
            if options.camera is None:
                lens = {
                    name: reading.number_in(values, key, settings) for name, key in _LENS.items()
                }
                camera = camera_file.checked_lens(
                    Pinhole, _size(values, files, settings), lens, settings
                )
        if not 0.01 <= rate <= 1e4:
            rate = FRAME_RATE_HZ
        source = DepthImageSource(
            files, np.arange(len(files)) / rate, camera, sensor="Pico Zense (ToF)", options=options
        )
        source.metadata["frame_rate_hz"] = rate
        source.warnings.append(f"no timestamps: a frame rate of {rate:g} Hz is assumed")
        return source


def _depth_files(path: Path) -> list[Path]:
    return [p for p in reading.files_with(path, ".png") if p.name.lower().startswith("depth")]


def _settings(path: Path) -> Path | None:
    """The .toml with intrinsics, if there is one."""
    if not reading.is_folder(path):
        return None
    files = [p for p in reading.files_with(path, ".toml") if reading.is_file(p)]
    candidates = [p for p in files if "camera_fx" in reading.read_text(p, limit=1 << 20)]
    return candidates[0] if candidates else None


def _read(path: Path) -> dict[str, Any]:
    """Return the values of all tables of a file, keyed without table names."""
    data = reading.parse_toml(reading.read_text(path), where=path)
    values: dict[str, Any] = {}
    for key, value in data.items():
        values |= value if isinstance(value, dict) else {key: value}
    return values


def _size(values: dict[str, Any], files: list[Path], path: Path) -> tuple[int, int]:
    """(width, height) as given in the file, else of the images."""
    if "image_width" not in values or "image_height" not in values:
        return first_size(files)
    width, height = (
        reading.number_in(values, key, path) for key in ("image_width", "image_height")
    )
    return camera_file.image_size(width, height, f"{path}: image_width")
