"""cameraconfig.json of cwipc: the cameras of a rig, and the recording of each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tofuse.arrays import Float64
from tofuse.errors import InputError
from tofuse.geometry.se3 import check_pose, inverse, orthonormalise
from tofuse.recordings.camera_file import numbers_in, read_json
from tofuse.recordings.recording import Recording
from tofuse.recordings.rig import Rig, RigCamera, is_plain_name

FILE_NAME = "cameraconfig.json"
VERSIONS = (3, 4, 5)
# The recorder's file type, by the first word of the type of a camera, such as kinect_playback.
_SUFFIXES = {"kinect": ".mkv", "realsense": ".bag", "orbbec": ".bag"}
_REMEDY = "correct it, or register the cameras again by cwipc_register"
_CALIBRATE = "estimate the poses by `tofuse rig calibrate` with the recordings"


@dataclass(frozen=True, eq=False)
class CwipcCamera:
    """One enabled camera of a cameraconfig.json.

    Attributes
    ----------
    name
        Its serial number, else the name of its file without suffix.
    recording
        Its recording.
    trafo
        (4, 4) maps points in m into the world frame.
    in_color_frame
        Whether these points are in the colour camera's frame; otherwise in the depth camera's.
    """

    name: str
    recording: Path
    trafo: Float64
    in_color_frame: bool


def is_camera_config(path: Path) -> bool:
    """Whether a file has the layout of a cameraconfig.json. Never raises."""
    try:
        data = read_json(path)
    except InputError:
        return False
    return isinstance(data.get("camera"), list) and isinstance(data.get("type"), str)


def read_cameras(path: Path) -> list[CwipcCamera]:
    """Read a cameraconfig.json; cameras that are disabled in it are left out.

    Raises
    ------
    InputError
        Naming the invalid field, if the version is not one of `VERSIONS`, or if two cameras have
        the same pose, as before registration.
    """
    data = read_json(path)
    version = data.get("version")
    if version not in VERSIONS or isinstance(version, bool):
        raise InputError(
            f"version is {version!r:.40}, not {', '.join(map(str, VERSIONS))}",
            where=path,
            remedy=_CALIBRATE,
        )
    rows = data.get("camera")
    if not isinstance(rows, list):
        raise InputError("camera is not a list of cameras", where=path, remedy=_REMEDY)
    cameras = [_camera(row, k, data, path) for k, row in enumerate(rows) if not _disabled(row)]
    if not cameras:
        raise InputError("has no enabled camera", where=path, remedy="enable its cameras")
    for k, camera in enumerate(cameras):
        for other in cameras[:k]:
            if camera.name == other.name:
                raise InputError(
                    f"has two cameras called {camera.name!r}", where=path, remedy=_REMEDY
                )
            if np.allclose(camera.trafo, other.trafo, atol=1e-9):
                raise InputError(
                    f"{other.name} and {camera.name} have the same trafo: they aren't registered",
                    where=path,
                    remedy=_CALIBRATE,
                )
    return cameras


def rig_of(cameras: Sequence[CwipcCamera], recordings: Sequence[Recording]) -> Rig:
    """Return the rig of depth cameras; the frame of the first camera is that of the rig.

    Raises
    ------
    InputError
        If a recording lacks the transform between its depth and colour camera, where it is needed.
    """
    T_world = [
        camera.trafo @ _T_color_depth(recording) if camera.in_color_frame else camera.trafo
        for camera, recording in zip(cameras, recordings, strict=True)
    ]
    T_rig_world = inverse(T_world[0])
    return Rig(
        tuple(
            RigCamera(
                camera.name,
                str(camera.recording),
                orthonormalise(T_rig_world @ T) if k else np.eye(4),
                np.zeros((6, 6)),
            )
            for k, (camera, T) in enumerate(zip(cameras, T_world, strict=True))
        )
    )


def _T_color_depth(recording: Recording) -> Float64:
    T: Float64 | None = getattr(recording.source, "T_color_depth", None)
    if T is None:
        raise InputError(
            "doesn't contain the pose of its colour camera relative to depth, which trafo needs",
            where=recording.path,
            remedy=_CALIBRATE,
        )
    return T


def _disabled(row: object) -> bool:
    return isinstance(row, dict) and row.get("disabled") is True


def _camera(row: object, k: int, data: dict[str, Any], path: Path) -> CwipcCamera:
    location = f"camera[{k}]"
    if not isinstance(row, dict):
        raise InputError(f"{location} is not an object", where=path, remedy=_REMEDY)
    kind = str(row.get("type", data.get("type"))).partition("_")[0]
    if kind not in _SUFFIXES:
        raise InputError(
            f"{location}.type is {row.get('type')!s:.40}, of which no recordings are read",
            where=path,
            remedy=f"use cameras of the types {', '.join(_SUFFIXES)}",
        )
    serial = row.get("serial") or ""
    file = row.get("filename") or row.get("playback_filename") or f"{serial}{_SUFFIXES[kind]}"
    name = serial or Path(str(file)).stem
    for text, field in ((name, "serial"), (file, "filename")):
        if not isinstance(text, str) or not text.strip() or not is_plain_name(text):
            raise InputError(
                f"{location}.{field} is {text!r:.80}, not the name of a file in the same folder",
                where=path,
                remedy="put the recordings next to the file, and set their names",
            )
    return CwipcCamera(
        name, path.parent / file, _trafo(row, location, path), _in_color_frame(kind, data)
    )


def _trafo(row: dict[str, Any], location: str, path: Path) -> Float64:
    where = f"{path}: {location}"
    T = numbers_in(row, "trafo", where, (4, 4), _REMEDY)
    return orthonormalise(check_pose(T, where=f"{where}.trafo"))


def _in_color_frame(kind: str, data: dict[str, Any]) -> bool:
    """Whether cwipc computes points in the colour camera's frame.

    It always does for Kinect and Orbbec; for RealSense only if depth is mapped to colour.
    """
    if kind != "realsense":
        return True
    filtering = data.get("filtering")
    mapping = filtering.get("map_color_to_depth", 1) if isinstance(filtering, dict) else 1
    return bool(mapping == 0)
