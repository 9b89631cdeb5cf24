"""Reader of Replica (Straub et al. 2019) as rendered for NICE-SLAM (Zhu et al. 2022)."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np

from tofuse.engine import quantities
from tofuse.engine.cameras import Pinhole
from tofuse.engine.errors import InputError
from tofuse.engine.parts import part
from tofuse.formats.cameras import camera_file
from tofuse.formats.files import reading, tables
from tofuse.formats.sources import DepthImageSource, Reader, ReaderOptions, Sniff, inputs

_DEPTH = re.compile(r"depth([0-9]{1,9})\.png", re.IGNORECASE)
_CAMERA, _POSES = "cam_params.json", "traj.txt"
_SUFFIXES = (".jpg", ".png")
_REMEDY = "correct it there, or use --camera"


@part("reader", "replica", label="experimental")
class Replica(Reader):
    """Replica, of NICE-SLAM: results/ and traj.txt, with cam_params.json there or above."""

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        if reading.is_file(path / _POSES) and reading.files_named(path / "results", _DEPTH.match):
            return Sniff(1.0, f"results/depth*.png and {_POSES}")
        return None

    def open(self, path: Path, options: ReaderOptions) -> DepthImageSource:
        """See `Reader.open`."""
        files = reading.files_named(path / "results", _DEPTH.fullmatch)
        inputs.required(files, "depth*.png", path / "results")
        numbers = [file.stem[len("depth") :] for file in files]
        color = [
            reading.first_file(*(file.with_name(f"frame{n}{suffix}") for suffix in _SUFFIXES))
            for file, n in zip(files, numbers, strict=True)
        ]
        lens, unit = (None, 1.0) if options.camera is not None else _read_camera(path)
        source = DepthImageSource(
            files,
            np.arange(len(files), dtype=float),
            lens,
            depth_unit_m=unit,
            color=color,
            options=options,
        )
        if reading.is_file(path / _POSES):
            table = tables.read_numbers(path / _POSES)
            if table.shape != (len(table), 16) or len(table) <= int(numbers[-1]):
                raise InputError(
                    f"has {quantities.count(len(table), 'line')} of {table.shape[-1]} numbers, "
                    "not 16 for each frame",
                    where=path / _POSES,
                    remedy="download it again, or remove it",
                )
            source.reference = inputs.poses_of(
                source,
                (int(number) for number in numbers),
                lambda n: inputs.read_matrix_pose(
                    table[n].reshape(4, 4), f"{path / _POSES}, line {n + 1}"
                ),
            )
        return source


def _read_camera(path: Path) -> tuple[Pinhole, float]:
    """The lens, and the metres per count of depth."""
    file = reading.first_file(path / _CAMERA, path.absolute().parent / _CAMERA)
    if file is None:
        raise InputError(
            f"has no {_CAMERA}, nor has the folder above",
            where=path,
            remedy="copy it there, or use --camera",
        )
    data: Any = reading.read_json(file).get("camera")
    data = data if isinstance(data, dict) else {}
    fx, fy, cx, cy, width, height, scale = (
        reading.number_in(data, name, f"{file}: camera", remedy=_REMEDY)
        for name in ("fx", "fy", "cx", "cy", "w", "h", "scale")
    )
    unit = camera_file.depth_unit(scale, f"{file}: scale")
    size = camera_file.image_size(width, height, f"{file}: w")
    K = camera_file.intrinsic_matrix(fx, fy, cx, cy)
    return camera_file.checked_pinhole(K, size, file), unit
