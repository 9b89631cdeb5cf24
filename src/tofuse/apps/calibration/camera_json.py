"""Writing a calibrated lens to camera.json, preserving its other fields."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from tofuse.engine.cameras import Pinhole
from tofuse.engine.errors import InputError, OutputError
from tofuse.engine.frames import RangeFrame, Recording
from tofuse.formats.cameras import camera_file
from tofuse.formats.files import atomic, reading

_LENS = ("schema", "model", "width", "height", "fx", "fy", "cx", "cy", "distortion")
_METADATA = (
    "depth_unit_m",
    "depth_kind",
    "frame_rate_hz",
    "ambiguity_m",
    "confidence_max",
    "amplitude_kind",
)


def recording_fields(recording: Recording) -> dict[str, Any]:
    """Return the fields of camera.json that describe a recording's images, without the lens."""
    path = Path(recording.path) / "camera.json"
    if reading.is_folder(Path(recording.path)) and reading.is_file(path):
        return fields_without_lens(path)
    metadata = {key: recording.metadata.get(key) for key in _METADATA}
    present = {key: value for key, value in metadata.items() if value is not None}
    frame = next((f for f in recording.sample(3) if isinstance(f, RangeFrame)), None)
    if frame is not None:
        present.setdefault("depth_kind", frame.depth_kind)
    return present


def fields_without_lens(path: Path) -> dict[str, Any]:
    """Return the fields of a camera.json that are not of the lens."""
    return {key: value for key, value in reading.read_json(path).items() if key not in _LENS}


def write_camera_json(path: Path, camera: Pinhole, about: dict[str, Any]) -> None:
    """Write a camera.json, for `--camera` or the folder of a native recording.

    Parameters
    ----------
    path
        The file.
    camera
        The lens.
    about
        Other fields; by default `depth_unit_m` is 0.001 and `depth_kind` is "z".

    Raises
    ------
    OutputError
        If a rays.npy in the same folder would override the lens.
    """
    table = path.with_name("rays.npy")
    if table.exists():
        raise OutputError(
            "would override the lens that is written to the same folder",
            where=table,
            remedy="move it away, or choose an --out in another folder",
        )
    fields = {"schema": camera_file.SCHEMA} | camera_file.camera_fields(camera)
    content = fields | {"depth_unit_m": 0.001, "depth_kind": "z"} | about
    atomic.make_folder(path.parent)
    atomic.write_text(path, json.dumps(content, indent=2) + "\n")


def check_new(path: Path, *, overwrite: bool) -> None:
    """Refuse an existing file before anything is computed.

    Raises
    ------
    OutputError
        If it exists and may not be replaced.
    InputError
        If it is a folder.
    """
    if reading.is_folder(path):
        raise InputError("is a folder", where="--out", remedy="pass a file, such as camera.json")
    if path.exists() and not overwrite:
        raise OutputError("exists already", where=path, remedy="use --overwrite to replace it")
