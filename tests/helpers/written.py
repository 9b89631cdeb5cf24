"""Recordings of the native format, and descriptions of cameras, as tests write them."""

from __future__ import annotations

import json
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.frames.frames import Frame
from tofuse.formats.recordings.native import RecordingWriter


def record(folder: Path, frames: Iterable[Frame], **options: Any) -> Path:
    """Write a native recording of the camera of the first frame."""
    first, *rest = frames
    writer = RecordingWriter(folder, getattr(first, "camera", None), **options)
    for frame in (first, *rest):
        writer.add(frame)
    return writer.finish()


def camera_json(path: Path, lens: Pinhole, **fields: Any) -> Path:
    """Write a camera.json of depth in mm along the optical axis, but for other `fields`."""
    about = {"schema": 1, "model": "pinhole", "depth_unit_m": 0.001, "depth_kind": "z"}
    about |= {name: getattr(lens, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    path.write_text(json.dumps(about | fields))
    return path


def change_camera(folder: Path, **changes: Any) -> None:
    """Change fields of the camera.json of a recording; None removes one."""
    path = folder / "camera.json"
    fields = json.loads(path.read_text()) | changes
    path.write_text(json.dumps({k: v for k, v in fields.items() if v is not None}))
