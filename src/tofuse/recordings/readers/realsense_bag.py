"""Reader of bags written by RealSense's viewer and SDK."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tofuse.arrays import Float64
from tofuse.errors import InputError
from tofuse.geometry.cameras import DISTORTION_ORDER, BrownConrady, Camera, Pinhole, RayTable
from tofuse.geometry.quaternion import to_pose
from tofuse.geometry.se3 import check_pose, inverse, orthonormalise
from tofuse.parts import part
from tofuse.recordings.bags import first_message
from tofuse.recordings.camera_file import ColorCamera, checked_lens
from tofuse.recordings.lenses import forward_brown, inverse_brown
from tofuse.recordings.maker_bags import MakerBagSource, topics
from tofuse.recordings.reader import Reader, ReaderOptions, Sniff
from tofuse.recordings.ros_messages import Info, camera_info


@part("reader", "realsense-bag")
@dataclass(frozen=True)
class RealSenseBag(Reader):
    """A .bag or .db3 of RealSense's SDK: depth, colour, infrared of the L515 (extra `ros`)."""

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        if any(re.fullmatch(_REALSENSE_DEPTH, topic) for topic in topics(path)):
            return Sniff(1.0, "a bag of RealSense's SDK")
        return None

    def open(self, path: Path, options: ReaderOptions) -> RealSenseSource:
        """See `Reader.open`."""
        return RealSenseSource(path, options)


_REALSENSE_DEPTH = r"/device_\d+/sensor_\d+/Depth_\d+/image/data"


class RealSenseSource(MakerBagSource):
    """See `RealSenseBag`."""

    def find_tracks(self) -> None:
        """See `MakerBagSource.find_tracks`."""
        matches = sorted(
            c.topic for c in self.bag.connections if re.fullmatch(_REALSENSE_DEPTH, c.topic)
        )
        if not matches:
            raise InputError("has no depth of a RealSense", where=self.path, remedy="record it")
        stream = matches[0].removesuffix("/image/data")
        sensor = stream.rsplit("/", 1)[0]
        self.depth = self.required_track(matches[0], "depth")
        self.stream = stream
        self.unit = self._unit(sensor)
        name = self._name(sensor.rsplit("/", 1)[0])
        self.metadata["sensor"] = name
        if "L5" in name:  # a stereo camera's infrared is another view
            matches = [
                c.topic
                for c in self.bag.connections
                if re.fullmatch(re.escape(sensor) + r"/Infrared_\d+/image/data", c.topic)
            ]
            if matches:
                self.amplitude = self.track(sorted(matches)[0])
        device = sensor.rsplit("/", 1)[0]
        pattern = re.escape(device) + r"/sensor_\d+/Color_\d+/image/data"
        matches = [c.topic for c in self.bag.connections if re.fullmatch(pattern, c.topic)]
        if matches:
            self.color = self.track(sorted(matches)[0])

    def lens(self) -> Camera:
        """See `MakerBagSource.lens`."""
        return self._lens(self.stream)

    def color_lens(self) -> ColorCamera:
        """See `MakerBagSource.color_lens`."""
        assert self.color is not None
        stream = self.color.connection.topic.removesuffix("/image/data")
        lens = self._lens(stream)
        if isinstance(lens, RayTable):
            lens = forward_brown(lens, self._brown(stream))
        assert isinstance(lens, Pinhole)
        depth, color = self._extrinsics(self.stream), self._extrinsics(stream)
        common = sorted(depth.keys() & color.keys())
        if not common:
            raise InputError("has no pose relative to depth", where=f"{self.path}: {stream}")
        return ColorCamera(lens, color[common[0]] @ inverse(depth[common[0]]))

    def _extrinsics(self, stream: str) -> dict[str, Float64]:
        """Return transforms (4, 4) into a stream's frame, by the number of their reference.

        ROS 1 bags store transforms; later versions text: a column-major rotation and a translation.
        """
        out = {}
        for connection in self.bag.connections:
            if not re.fullmatch(re.escape(stream) + r"/tf/\d+", connection.topic):
                continue
            message = first_message(self.bag, connection.topic)
            where = f"{self.path}: {connection.topic}"
            T = np.eye(4)
            try:
                if hasattr(message, "data"):
                    text = dict(p.partition("=")[::2] for p in str(message.data).split(";"))
                    T[:3, :3] = _numbers(text["rotation"]).reshape(3, 3).T
                    T[:3, 3] = _numbers(text["translation"])
                elif message is not None:
                    q, t = message.rotation, message.translation
                    T = to_pose([q.x, q.y, q.z, q.w], [t.x, t.y, t.z])
            except (AttributeError, KeyError, ValueError) as error:
                raise InputError(f"can't be read ({error})", where=where) from error
            out[connection.topic.rsplit("/", 1)[1]] = orthonormalise(check_pose(T, where=where))
        return out

    def _lens(self, stream: str) -> Camera:
        info, where = self._info(stream), f"{self.path}: {stream}"
        if not any(info.coefficients):
            return checked_lens(Pinhole, info.size, info.values, where)
        brown = self._brown(stream)
        model = info.model.lower().replace("_", " ")
        if model.startswith("inverse brown"):
            return inverse_brown(brown)
        if model.startswith("brown"):
            return brown
        raise InputError(
            f"has the distortion model {info.model!r:.40}", where=where, remedy="use --camera"
        )

    def _brown(self, stream: str) -> BrownConrady:
        info = self._info(stream)
        k = dict(zip(DISTORTION_ORDER["brown"], info.coefficients, strict=False))
        lens = checked_lens(BrownConrady, info.size, info.values | k, f"{self.path}: {stream}")
        assert isinstance(lens, BrownConrady)
        return lens

    def _info(self, stream: str) -> Info:
        where = f"{self.path}: {stream}"
        message = first_message(self.bag, f"{stream}/info/camera_info")
        # Newer versions write text.
        return (
            self._info_from_text(stream, where) if message is None else camera_info(message, where)
        )

    def _info_from_text(self, stream: str, where: str) -> Info:
        text = first_message(self.bag, f"{stream}/camera_info")
        if text is None:
            raise InputError("has no camera_info", where=where, remedy="use --camera")
        fields = dict(p.partition("=")[::2] for p in str(text.data).split(";"))
        keys = {"fx": "fx", "fy": "fy", "cx": "ppx", "cy": "ppy"}
        try:
            return Info(
                (int(fields["width"]), int(fields["height"])),
                {name: float(fields[key]) for name, key in keys.items()},
                fields.get("model", ""),
                [float(d) for d in fields.get("coeffs", "").split(",") if d],
            )
        except (KeyError, ValueError) as error:
            raise InputError(
                f"has a camera_info that can't be read ({error})", where=where
            ) from error

    def _unit(self, sensor: str) -> float:
        message = first_message(self.bag, f"{sensor}/option/Depth_Units/value")
        try:
            unit = float(message.data) if message is not None else 0.0
        except ValueError:
            unit = 0.0
        if not 1e-6 < unit < 0.1:
            self.warnings.append(f"{self.path}: no depth unit is given; 1 mm is assumed")
            return 0.001
        return float(np.float32(unit))

    def _name(self, device: str) -> str:
        """Return the camera's name, from the (key, value) messages."""
        for connection in self.bag.connections:
            if connection.topic != f"{device}/info":
                continue
            for _, _, raw in self.bag.messages(connections=[connection]):
                message = self.bag.deserialize(raw, connection.msgtype)
                if getattr(message, "key", "") == "Name":
                    return str(message.value)[:200]
        return "RealSense"


def _numbers(text: str) -> Float64:
    return np.array([float(cell) for cell in text.split(",")])
