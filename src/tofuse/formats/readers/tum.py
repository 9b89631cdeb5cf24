"""Reader of the TUM RGB-D benchmark (Sturm et al. 2012)."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.cameras import BrownConrady
from tofuse.engine.errors import InputError
from tofuse.engine.parts import part
from tofuse.formats.files import reading
from tofuse.formats.poses import associate
from tofuse.formats.sources import DepthImageSource, Reader, ReaderOptions, Sniff, inputs

DEPTH_UNIT_M = 1 / 5000
COLOR_LIMIT_S = 0.1
SENSOR = "Kinect v1 or Xtion (structured light)"  # of the benchmark

# Of the colour cameras: depth is registered to colour (infrared ones nearly double errors).
CAMERAS = {
    "freiburg1": BrownConrady(
        640, 480, 517.306408, 516.469215, 318.643040, 255.313989,
        0.262383, -0.953104, -0.005358, 0.002628, 1.163314,
    ),
    "freiburg2": BrownConrady(
        640, 480, 520.908620, 521.007327, 325.141442, 249.701764,
        0.231222, -0.784899, -0.003257, -0.000105, 0.917205,
    ),
    "freiburg3": BrownConrady(640, 480, 535.4, 539.2, 320.1, 247.6),
}  # fmt: skip


@part("reader", "tum")
class Tum(Reader):
    """TUM RGB-D: folders with depth.txt (timestamp and file name), maybe rgb.txt."""

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        if reading.is_folder(path) and reading.is_file(path / "depth.txt"):
            return Sniff(1.0, "depth.txt")
        return None

    def open(self, path: Path, options: ReaderOptions) -> DepthImageSource:
        """See `Reader.open`."""
        times, files = _read_list(path / "depth.txt")
        camera = camera_of(path)
        if camera is None and options.camera is None:
            raise InputError(
                "is a TUM folder without a camera in its name (freiburg1, 2 or 3)",
                where=path,
                remedy="pass the colour camera with --camera camera.json",
            )
        warnings: list[str] = []
        inputs.check_timestamps(times, path / "depth.txt", warnings)
        color: list[Path | None] | None = None
        if reading.is_file(path / "rgb.txt"):
            color_times, color_files = _read_list(path / "rgb.txt")
            # A depth image without a colour image takes that of a neighbour: only for display.
            pairs = associate(times, color_times, limit=COLOR_LIMIT_S, exclusive=False)
            if (pairs >= 0).any():
                exists = [reading.is_file(file) for file in color_files]
                color = [color_files[k] if k >= 0 and exists[k] else None for k in pairs]
                if not any(color):
                    warnings.append("none of the colour images exists: colour is ignored")
            else:
                warnings.append(
                    f"no depth image has a colour image within {COLOR_LIMIT_S} s: colour is ignored"
                )
        source = DepthImageSource(
            files,
            times,
            camera,
            depth_unit_m=DEPTH_UNIT_M,
            color=color,
            sensor="" if camera is None else SENSOR,
            options=options,
        )
        source.warnings += warnings
        if reading.is_file(path / "groundtruth.txt"):
            source.reference = inputs.tum_poses(source, path / "groundtruth.txt")
        return source


def camera_of(path: Path) -> BrownConrady | None:
    """Return the colour camera, identified by the name of the folder or its parent."""
    for name in (path.absolute().name, path.absolute().parent.name):
        match = re.search(r"(?<![a-z])(?:freiburg|fr)([123])(?![0-9])", name.lower())
        if match:
            return CAMERAS[f"freiburg{match.group(1)}"]
    return None


def _read_list(path: Path) -> tuple[Float64, list[Path]]:
    times, files = [], []
    for number, line in enumerate(reading.read_text(path).splitlines(), 1):
        cells = line.split("#", 1)[0].split()
        if not cells:
            continue
        try:
            times.append(float(cells[0]))
            name = Path(cells[1])
        except (ValueError, IndexError) as error:
            raise InputError(
                "isn't a timestamp and a file name", where=f"{path}, line {number}"
            ) from error
        if name.is_absolute() or ".." in name.parts or "\0" in cells[1]:
            raise InputError(
                f"names {cells[1]!r}, outside the folder", where=f"{path}, line {number}"
            )
        files.append(path.parent / name)
    if not files:
        raise InputError("names no images", where=path, remedy="check the recording")
    return np.array(times), files
