"""A result as an MCAP file with the messages of Foxglove, in JSON.

https://docs.foxglove.dev/docs/visualization/message-schemas
"""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np

from tofuse._version import __version__
from tofuse.apps.export.image_folder import DEPTH_UNIT_M, counts
from tofuse.apps.export.posed_frames import PosedFrame
from tofuse.apps.export.scene import Scene
from tofuse.engine.arrays import Float64
from tofuse.engine.cameras import Pinhole
from tofuse.engine.fusion import GeometryRecord, drawing
from tofuse.engine.geometry import quaternion
from tofuse.formats.files import atomic, reading
from tofuse.formats.images import jpeg_bytes

MAP, WORLD, CAMERA = "map", "world", "camera"  # z up; as in the result; x right, y down, z forward
# Foxglove's numbers of the types of a point's fields.
_UINT8, _FLOAT32 = 1, 7
_SCHEMAS = {
    "/tf": "FrameTransform",
    "/pose": "PoseInFrame",
    "/trajectory": "PosesInFrame",
    "/cloud": "PointCloud",
    "/depth/calibration": "CameraCalibration",
    "/depth/image": "RawImage",
    "/color/calibration": "CameraCalibration",
    "/color/image": "CompressedImage",
}


def write_mcap(scene: Scene, path: Path) -> None:
    """Write the main model of a result.

    Raises
    ------
    InputError
        If the package is not installed; see `posed_frames`.
    """
    mcap = reading.required_package("mcap.writer", "mcap", "tofuse export mcap")
    with atomic.replacing(path) as temporary, temporary.open("wb") as file:
        writer = mcap.Writer(file)
        writer.start(library=f"tofuse {__version__}")
        messages = _Messages(writer, min(0.0, float(scene.times.min())))
        _write_model(messages, scene)
        for time, T in zip(scene.times, scene.poses, strict=True):
            messages.transform(float(time), WORLD, CAMERA, T)
            messages.write("/pose", float(time), frame_id=WORLD, pose=_pose(T))
        for posed in scene.images():
            _write_images(messages, posed)
        writer.finish()


class _Messages:
    """The messages of a file, of which none may be before 0 s."""

    def __init__(self, writer: Any, start: float) -> None:
        self._writer, self._start = writer, start
        self._channels: dict[str, int] = {}

    def write(self, topic: str, time: float, **fields: Any) -> None:
        """Write a message with these fields and its time."""
        nanoseconds = round((time - self._start) * 1e9)
        sec, nsec = divmod(nanoseconds, 1_000_000_000)
        message = {"timestamp": {"sec": sec, "nsec": nsec}, **fields}
        if topic not in self._channels:
            name = f"foxglove.{_SCHEMAS[topic]}"
            schema = json.dumps({"title": name, **_schema_of(message)}).encode()
            number = self._writer.register_schema(name, "jsonschema", schema)
            self._channels[topic] = self._writer.register_channel(topic, "json", number)
        data = json.dumps(
            message, allow_nan=False, default=lambda data: base64.b64encode(data).decode()
        ).encode()
        self._writer.add_message(self._channels[topic], nanoseconds, data, nanoseconds)

    def transform(self, time: float, parent: str, child: str, T: Float64) -> None:
        """Write a transform of frames."""
        pose = _pose(T)
        self.write(
            "/tf",
            time,
            parent_frame_id=parent,
            child_frame_id=child,
            translation=pose["position"],
            rotation=pose["orientation"],
        )


def _write_model(messages: _Messages, scene: Scene) -> None:
    start = float(scene.times.min())
    messages.transform(start, MAP, WORLD, scene.T_zup_world)
    messages.write("/trajectory", start, frame_id=WORLD, poses=[_pose(T) for T in scene.poses])
    points = _points(scene.cloud)
    fields = [
        {
            "name": name,
            "offset": int(points.dtype.fields[name][1]),
            "type": _UINT8 if points.dtype[name] == np.uint8 else _FLOAT32,
        }
        for name in points.dtype.names
    ]
    messages.write(
        "/cloud",
        start,
        frame_id=WORLD,
        pose=_pose(np.eye(4)),
        point_stride=points.dtype.itemsize,
        fields=fields,
        data=points.tobytes(),
    )


def _points(cloud: GeometryRecord) -> Any:
    """The points as records: coordinates, colour, and sigma where it is known."""
    columns = dict(zip("xyz", cloud.points.T, strict=True))
    types = [(axis, "<f4") for axis in "xyz"]
    if (sigma := cloud.scalars.get("sigma")) is not None:
        columns["sigma"] = sigma
        types.append(("sigma", "<f4"))
    if cloud.color is not None:
        rgb = drawing.display_colors(cloud.color)
        columns |= dict(zip(("red", "green", "blue"), rgb.T, strict=True))
        columns["alpha"] = np.full(len(cloud), 255, np.uint8)
        types += [(name, "u1") for name in ("red", "green", "blue", "alpha")]
    points = np.empty(len(cloud), types)
    for name, values in columns.items():
        points[name] = values
    return points


def _write_images(messages: _Messages, posed: PosedFrame) -> None:
    time, depth = posed.frame.timestamp, counts(posed.frame.depth, DEPTH_UNIT_M)
    height, width = depth.shape
    _write_camera(messages, "/depth/calibration", time, posed.camera)
    messages.write(
        "/depth/image",
        time,
        frame_id=CAMERA,
        width=width,
        height=height,
        encoding="16UC1",
        step=2 * width,
        data=depth.astype("<u2").tobytes(),
    )
    if posed.image is not None:
        _write_camera(messages, "/color/calibration", time, posed.image_camera)
        jpeg = jpeg_bytes(posed.image)
        messages.write("/color/image", time, frame_id=CAMERA, format="jpeg", data=jpeg)


def _write_camera(messages: _Messages, topic: str, time: float, camera: Pinhole) -> None:
    K = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
    messages.write(
        topic,
        time,
        frame_id=CAMERA,
        width=camera.width,
        height=camera.height,
        distortion_model="",
        D=[],
        K=K,
        R=np.eye(3).ravel().tolist(),
        P=np.column_stack([np.reshape(K, (3, 3)), np.zeros(3)]).ravel().tolist(),
    )


def _pose(T: Float64) -> dict[str, dict[str, float]]:
    rotation = quaternion.from_matrix(T[:3, :3]).tolist()
    return {
        "position": dict(zip("xyz", T[:3, 3].tolist(), strict=True)),
        "orientation": dict(zip("xyzw", rotation, strict=True)),
    }


def _schema_of(value: Any) -> dict[str, Any]:
    """The JSON schema of a message: the fields of Foxglove's that it has."""
    if isinstance(value, dict):
        properties = {name: _schema_of(each) for name, each in value.items()}
        return {"type": "object", "properties": properties}
    if isinstance(value, list):
        return {"type": "array", "items": _schema_of(value[0] if value else 0.0)}
    if isinstance(value, bytes):
        return {"type": "string", "contentEncoding": "base64"}
    return {"type": {str: "string", int: "integer", float: "number"}[type(value)]}
