"""Reader of the TUM RGB-D benchmark (Sturm et al. 2012)."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.cameras import BrownConrady, Pinhole
from tofuse.engine.errors import InputError
from tofuse.engine.parts import part
from tofuse.engine.times import partners
from tofuse.formats.cameras import camera_file
from tofuse.formats.files import reading, tables
from tofuse.formats.images import first_size
from tofuse.formats.sources import DepthImageSource, Reader, ReaderOptions, Sniff, inputs

DEPTH_UNIT_M = 1 / 5000
LENS = "lens.json"  # a camera.json, written by `tofuse convert`
COLOR_LIMIT_S = 0.1
_PAIRS = re.compile(r"assoc[a-z]*\.txt")
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
    "bonn": BrownConrady(
        640, 480, 542.822841, 542.576870, 315.593520, 237.756098,
        0.039903, -0.099343, -0.000730, -0.000144, 0.0,
    ),
}  # fmt: skip


@part("reader", "tum")
class Tum(Reader):
    """TUM RGB-D, Bonn, ETH3D: folders with depth.txt, maybe rgb.txt, or with associations.txt."""

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        if reading.is_folder(path) and reading.is_file(path / "depth.txt"):
            return Sniff(1.0, "depth.txt")
        pairs = _pairs_file(path)
        return None if pairs is None else Sniff(1.0, f"{pairs.name} with depth images")

    def open(self, path: Path, options: ReaderOptions) -> DepthImageSource:
        """See `Reader.open`."""
        lists = _read_lists(path)
        times, files = lists[0]
        named = camera_of(path)
        if options.camera is None and reading.is_file(path / LENS):
            options, named = replace(options, camera=path / LENS), None
        camera = _calibrated(path / "calibration.txt", files) or named
        if camera is None and options.camera is None:
            raise InputError(
                "is a TUM folder without calibration.txt, or a camera in its name (freiburg1, 2 "
                "or 3, rgbd_bonn)",
                where=path,
                remedy="pass the colour camera with --camera camera.json, where the unit of TUM's "
                f"depth is depth_unit_m {DEPTH_UNIT_M:g}",
            )
        warnings: list[str] = []
        inputs.check_timestamps(times, path / "depth.txt", warnings)
        color: list[Path | None] | None = None
        if len(lists) > 1:
            color_times, color_files = lists[1]
            pairs = partners(times, color_times, COLOR_LIMIT_S)
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
            sensor="" if named is None else SENSOR,
            options=options,
        )
        source.warnings += warnings
        if reading.is_file(path / "groundtruth.txt"):
            source.reference = inputs.tum_poses(source, path / "groundtruth.txt")
        return source


def camera_of(path: Path) -> BrownConrady | None:
    """Return the colour camera, identified by the name of the folder or its parent."""
    for name in (path.absolute().name.lower(), path.absolute().parent.name.lower()):
        match = re.search(r"(?<![a-z])(?:freiburg|fr)([123])(?![0-9])", name)
        if match:
            return CAMERAS[f"freiburg{match.group(1)}"]
        if "rgbd_bonn" in name:
            return CAMERAS["bonn"]
    return None


def _calibrated(path: Path, files: list[Path]) -> Pinhole | None:
    """The camera of a calibration.txt, as of ETH3D: fx, fy, cx and cy in one line."""
    if not reading.is_file(path):
        return None
    table = tables.read_numbers(path)
    if table.shape != (1, 4):
        raise InputError("is not one line of fx fy cx cy", where=path, remedy="correct it there")
    fx, fy, cx, cy = table[0]
    K = camera_file.intrinsic_matrix(fx, fy, cx, cy)
    return camera_file.checked_pinhole(K, first_size(files), path)


def _pairs_file(path: Path) -> Path | None:
    """The list of pairs of images that associate.py writes, if there is one that names depth."""
    files = reading.files_named(path, _PAIRS.fullmatch)
    return next((f for f in files if b"depth" in reading.read_head(f, 4096)), None)


def _read_lists(path: Path) -> list[tuple[Float64, list[Path]]]:
    """The times and files of depth, and of colour if there is any."""
    if reading.is_file(path / "depth.txt"):
        names = ["depth.txt", *(["rgb.txt"] if reading.is_file(path / "rgb.txt") else [])]
        return [_read_list(path / name) for name in names]
    pairs = _pairs_file(path)
    if pairs is None:
        raise InputError("has no depth.txt", where=path, remedy="check the path")
    lists = [_read_list(pairs, column) for column in (0, 2)]
    # Depth comes first or second.
    return lists if "depth" in str(lists[0][1][0].relative_to(path)) else lists[::-1]


def _read_list(path: Path, column: int = 0) -> tuple[Float64, list[Path]]:
    times, files = [], []
    for number, line in enumerate(reading.read_text(path).splitlines(), 1):
        cells = line.split("#", 1)[0].split()
        if not cells:
            continue
        cells = cells[column:]
        try:
            times.append(float(cells[0]))
            name = Path(cells[1].replace("\\", "/"))
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
