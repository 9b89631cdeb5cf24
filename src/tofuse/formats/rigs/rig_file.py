"""rig.json: rigidly connected cameras, and their recordings as one."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from tofuse.engine import quantities
from tofuse.engine.arrays import Float64
from tofuse.engine.errors import InputError
from tofuse.engine.geometry import se3
from tofuse.formats.files import atomic, reading

SCHEMA = 1
FILE_NAME = "rig.json"
# Larger clock and depth offsets, and distances of cameras, are in wrong units.
_MAX_SECONDS, _MAX_METRES, _MAX_DISTANCE_M = 1e10, 10.0, 100.0

_REMEDY = "correct it, or write the file again by `tofuse rig calibrate`"


@dataclass(frozen=True, eq=False)
class RigCamera:
    """One camera of a rig.

    Attributes
    ----------
    name
        Unique name.
    recording
        The recording used for its calibration, as given.
    T_rig_camera
        (4, 4) mounting pose.
    covariance
        (6, 6) of its right perturbation, m and rad.
    random_covariance
        (6, 6) the part of it due to errors that differ between two calibrations in the same scene,
        without systematic ones such as multipath; None if unknown.
    first_image
        Digest of the depth of the first image of `recording`; empty if unknown.
    time_offset_s
        The rig's time is the camera's timestamp plus this.
    depth_offset_m
        Excess of its ranges over those of the first camera, m.
    """

    name: str
    recording: str
    T_rig_camera: Float64
    covariance: Float64
    time_offset_s: float = 0.0
    depth_offset_m: float = 0.0
    random_covariance: Float64 | None = None
    first_image: str = ""


@dataclass(frozen=True)
class Disagreement:
    """Median distance in m between surfaces of two cameras (by name), and the number of pixels."""

    a: str
    b: str
    median_m: float
    pixels: int


@dataclass(frozen=True, eq=False)
class Rig:
    """Rigidly connected cameras; the frame of the first is that of the rig.

    Attributes
    ----------
    cameras
        Those with known poses.
    disagreement
        Of pairs of cameras.
    unplaced
        Reasons why other cameras could not be located, by name.
    """

    cameras: tuple[RigCamera, ...]
    disagreement: tuple[Disagreement, ...] = ()
    unplaced: Mapping[str, str] = field(default_factory=dict)

    def camera(self, name: str) -> RigCamera | None:
        """Return the camera called `name`; None if there is none."""
        return next((camera for camera in self.cameras if camera.name == name), None)

    def check_count(self, count: int, where: str | Path) -> None:
        """Raise InputError unless there are as many recordings as cameras with known poses."""
        if count == len(self.cameras):
            return
        names = ", ".join(camera.name for camera in self.cameras)
        remedy = "pass one recording for each, in this order"
        if self.unplaced:
            remedy += f", and none of {', '.join(self.unplaced)}, whose pose was not found"
        raise InputError(
            f"has {quantities.count(len(self.cameras), 'camera')} ({names}), "
            f"and {count} recordings are given",
            where=where,
            remedy=remedy,
        )

    def with_same_images(self, other: Rig) -> tuple[str, ...]:
        """Return the names of the cameras whose first image is that in another rig."""
        images = {(c.name, c.first_image) for c in other.cameras if c.first_image}
        return tuple(c.name for c in self.cameras if (c.name, c.first_image) in images)

    def to_dict(self) -> dict[str, Any]:
        """Return plain data, as stored in rig.json."""
        data: dict[str, Any] = {
            "schema": SCHEMA,
            "cameras": [_camera_data(c) for c in self.cameras],
            "disagreement": [asdict(pair) for pair in self.disagreement],
        }
        if self.unplaced:
            data["unplaced"] = [{"name": n, "reason": r} for n, r in self.unplaced.items()]
        return data


def _camera_data(camera: RigCamera) -> dict[str, Any]:
    data: dict[str, Any] = {
        "name": camera.name,
        "recording": camera.recording,
        "T_rig_camera": camera.T_rig_camera.tolist(),
        "covariance": camera.covariance.ravel().tolist(),
        "time_offset_s": camera.time_offset_s,
        "depth_offset_m": camera.depth_offset_m,
    }
    if camera.random_covariance is not None:
        data["random_covariance"] = camera.random_covariance.ravel().tolist()
    if camera.first_image:
        data["first_image"] = camera.first_image
    return data


def write_rig(path: str | Path, rig: Rig) -> None:
    """Write a rig.json; see `replacing` for errors."""
    atomic.write_text(path, json.dumps(rig.to_dict(), indent=1) + "\n")


def read_rig(path: str | Path) -> Rig:
    """Read and check a rig.json.

    Raises
    ------
    InputError
        Naming the invalid field.
    """
    data = reading.read_json(path)
    with reading.about(path, _REMEDY):
        reading.check_schema(data, SCHEMA)
        cameras = tuple(
            _camera(row, f"{path}: cameras[{k}]")
            for k, row in enumerate(reading.rows_in(data, "cameras", path))
        )
        names = [camera.name for camera in cameras]
        twice = [name for k, name in enumerate(names) if name in names[:k]]
        if twice or not names:
            raise InputError(f"has two cameras called {twice[0]!r}" if twice else "has no cameras")
        if not np.allclose(cameras[0].T_rig_camera, np.eye(4), atol=1e-6):
            raise InputError(f"the first camera, {names[0]!r}, is not the identity")
        pairs = tuple(
            _disagreement(row, names, f"{path}: disagreement[{k}]")
            for k, row in enumerate(reading.rows_in(data, "disagreement", path, []))
        )
        unplaced = {
            str(row.get("name", "")): str(row.get("reason", ""))
            for row in reading.rows_in(data, "unplaced", path, [])
        }
    return Rig(cameras, pairs, unplaced)


def rig_file_in(folder: str | Path) -> Path | None:
    """Return the rig.json in a folder; None if there is none."""
    return reading.if_file(Path(folder) / FILE_NAME)


def recordings_of(rig_file: Path) -> dict[str, Path]:
    """Return the recordings in the folder of a rig.json, by the names of its cameras."""
    return {c.name: rig_file.parent / c.name for c in read_rig(rig_file).cameras}


def _is_plain_name(name: str) -> bool:
    """Whether a name can't refer to another folder on any system."""
    return name not in (".", "..") and not any(c in "/\\:" or ord(c) < 32 for c in name)


def _camera(row: dict[str, Any], where: str) -> RigCamera:
    name, recording = row.get("name"), row.get("recording", "")
    with reading.about(where):
        if not isinstance(name, str) or not name.strip() or not _is_plain_name(name):
            raise InputError(
                f"name is {name!r:.80}, which is not a folder name",
                remedy="choose one without / \\ : and not . or ..",
            )
        if not isinstance(recording, str):
            raise InputError("recording is not a path")
    matrix = reading.numbers_in(row, "T_rig_camera", where, (4, 4), _REMEDY)
    distance = np.linalg.norm(matrix[:3, 3])
    if not distance <= _MAX_DISTANCE_M:
        raise InputError(
            f"is {distance:.0f} m from the first camera",
            where=f"{where}: T_rig_camera",
            remedy="use metres",
        )
    random = None
    if row.get("random_covariance") is not None:
        random = _covariance(row, "random_covariance", where)
    return RigCamera(
        name,
        recording,
        se3.check_pose(matrix, where=where),
        _covariance(row, "covariance", where) if "covariance" in row else np.zeros((6, 6)),
        _number(row, "time_offset_s", _MAX_SECONDS, where, 0.0),
        _number(row, "depth_offset_m", _MAX_METRES, where, 0.0),
        random,
        str(row.get("first_image", "")),
    )


def _covariance(row: dict[str, Any], name: str, where: str) -> Float64:
    C = reading.numbers_in(row, name, where, (6, 6), _REMEDY)
    min_eigenvalue = float(np.linalg.eigvalsh(0.5 * (C + C.T))[0])
    tolerance = 1e-6 * max(np.abs(C).max(), 1e-9)
    if not np.allclose(C, C.T, rtol=1e-3, atol=1e-12) or min_eigenvalue < -tolerance:
        raise InputError("is not a covariance", where=f"{where}: {name}")
    return np.asarray(0.5 * (C + C.T), np.float64)


def _disagreement(row: dict[str, Any], names: list[str], where: str) -> Disagreement:
    if row.get("a") not in names or row.get("b") not in names:
        raise InputError("does not name two cameras", where=where)
    median = _number(row, "median_m", 1e6, where)
    return Disagreement(row["a"], row["b"], median, int(_number(row, "pixels", 1e15, where, 0.0)))


def _number(
    row: dict[str, Any], name: str, limit: float, where: str, default: float | None = None
) -> float:
    value = reading.number_in(row, name, where, default, _REMEDY)
    if not abs(value) <= limit:
        raise InputError(f"is {value:g}, not at most {limit:g}", where=f"{where}: {name}")
    return value
