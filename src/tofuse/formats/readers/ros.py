"""Reader of ROS 1 bags, ROS 2 bags and MCAP files, by the package rosbags."""

from __future__ import annotations

import re
from contextlib import suppress
from os.path import commonprefix
from pathlib import Path
from typing import Any

import numpy as np

from tofuse.engine.arrays import Float32, Float64, UInt8
from tofuse.engine.cameras import Camera, Pinhole
from tofuse.engine.errors import InputError
from tofuse.engine.frames import Frame, depth_counts
from tofuse.engine.parts import part
from tofuse.formats.cameras import camera_file
from tofuse.formats.files import reading
from tofuse.formats.sources import (
    ACCELERATION,
    Reader,
    ReaderOptions,
    Sniff,
    bags,
    cloud_files,
    gravity_at,
    organised,
)

IMAGE, COMPRESSED = "sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage"
INFO, CLOUD = "sensor_msgs/msg/CameraInfo", "sensor_msgs/msg/PointCloud2"
_AMPLITUDE_KEYWORDS = ("/ir/", "/infra", "amplitude", "intensity", "reflec")
_COMPRESSED_DEPTH = "compresseddepth"  # ends topics of the transport that is for depth alone
_COLOR_KEYWORDS = ("color", "colour", "rgb")
# Topics of rectified images, of which CameraInfo's P is the lens, without distortion.
_RECTIFIED = re.compile(r"(?<![a-z])rect(?![a-z])|rectified")
# Prefix of drifting odometry frames; frames above them are corrected.
_ODOMETRY = "odom"


@part("reader", "ros")
class Ros(Reader):
    """ROS 1 and 2: a .bag, .db3 or .mcap, or a bag's folder; depth or clouds (extra `ros`)."""

    has_topics = True

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        kind = bags.bag_kind(path)
        if kind is None:
            return None
        return Sniff(0.95, "metadata.yaml and a bag" if kind == "folder" else "a bag")

    def open(self, path: Path, options: ReaderOptions) -> RosSource:
        """See `Reader.open`."""
        return RosSource(path, options)


class RosSource(bags.BagSource):
    """Messages of the chosen topic, or of the one most likely to contain depth.

    Attributes
    ----------
    raster
        The camera of clouds that are images of one; else None.
    imu
        Columns of the native imu.csv, in the axes of the depth camera; or None.
    """

    unit = 0.001  # integer depth is in mm by convention (REP 118)
    raster: Camera | None = None
    imu: dict[str, Float64] | None = None

    def find_streams(self, options: ReaderOptions) -> None:
        """See `BagSource.find_streams`."""
        self.connection = self._choose(options.topic)
        self.depth = bags.Track(self.bag, self.connection)
        if not len(self.depth):
            raise InputError(f"has no message of {self.connection.topic}", where=self.path)
        self.set_timestamps()
        transforms = self._transforms()
        if self.connection.msgtype != CLOUD:
            self._read_camera(options)
            self.amplitude = self._find_amplitude()
            self._find_color(transforms)
            self.metadata["depth_kind"] = self.kind
            if self.connection.msgtype == IMAGE:
                kind = np.dtype(bags.ENCODINGS[self._encoding(self.connection)]).kind
                self.metadata["depth_unit_m"] = self._unit(kind)
        else:
            if options.camera is not None:
                raise InputError(
                    "does not apply to clouds", where="--camera", remedy="leave it out"
                )
            self.raster = self._organised()
        self._read_poses(transforms)
        self._read_gravity(transforms)
        self.metadata |= {"topic": self.connection.topic}
        others = sorted({c.topic for c in self._candidates()} - {self.connection.topic})
        if others and options.topic is None:
            self.warnings.append(
                f"the topic {self.connection.topic} is read; others are {', '.join(others)}:"
                " choose with --topic"
            )

    def where(self, index: int) -> str:
        """See `FileSource.where`."""
        return f"{self.path}: {self.connection.topic}, message {index}"

    def read_frame(self, index: int, where: str) -> Frame:
        """See `BagSource.read_frame`."""
        if self.connection.msgtype != CLOUD:
            return super().read_frame(index, where)
        time, message = float(self.timestamps[index]), self.depth.message(index)
        cloud = bags.cloud(message, where)
        if self.raster is None:
            return cloud_files.cloud_frame(index, time, cloud)
        points = cloud_files.to_float32(cloud.points).reshape(message.height, message.width, 3)
        return organised.organised_frame(points, cloud, self.raster, index, time)

    def read_depth(self, index: int, where: str) -> Float32:
        """See `BagSource.read_depth`."""
        decode = bags.decompressed if self.connection.msgtype == COMPRESSED else bags.image
        counts = decode(self.depth.message(index), where)
        camera_file.check_size(counts, self.camera, where)
        return depth_counts.depth_from_numbers(counts, self._unit(counts.dtype.kind))

    def read_color(self, track: bags.Track, index: int, where: str) -> UInt8:
        """See `BagSource.read_color`."""
        decode = (
            bags.decompressed_color if track.connection.msgtype == COMPRESSED else bags.color_image
        )
        return decode(track.message(index), where)

    def _candidates(self) -> list[Any]:
        """The connections that may contain depth, most likely first."""
        return sorted(
            (c for c in self.bag.connections if _rank(c) is not None and self._may_be_depth(c)),
            key=lambda c: (_rank(c), c.topic),
        )

    def _choose(self, topic: str | None) -> Any:
        topics = ", ".join(sorted({c.topic for c in self.bag.connections}))
        if topic is not None:
            for connection in self.bag.connections:
                if connection.topic == topic and connection.msgtype in (IMAGE, COMPRESSED, CLOUD):
                    return connection
            raise InputError(
                f"has no images or clouds at {topic} (there are: {topics[:300] or 'none'})",
                where=self.path,
                remedy="choose one of these with --topic",
            )
        for connection in self._candidates():
            if connection.msgtype != IMAGE or self._encoding(connection) in bags.ENCODINGS:
                return connection
        raise InputError(
            f"has no topic of depth images or clouds (there are: {topics[:300] or 'none'})",
            where=self.path,
            remedy="record 16UC1 or 32FC1 images with camera_info, or PointCloud2; if depth has "
            "another name, choose it with --topic",
        )

    def _may_be_depth(self, connection: Any) -> bool:
        """Whether a compressed image is not one of colour, by what it was compressed from."""
        if connection.msgtype != COMPRESSED or connection.topic.lower().endswith(_COMPRESSED_DEPTH):
            return True
        return self._encoding(connection).split(";")[0] in bags.ENCODINGS

    def _encoding(self, connection: Any) -> str:
        name = "format" if connection.msgtype == COMPRESSED else "encoding"
        for _, _, raw in self.bag.messages(connections=[connection]):
            return str(getattr(self.bag.deserialize(raw, connection.msgtype), name))
        return ""

    def _read_camera(self, options: ReaderOptions) -> None:
        if options.camera is not None:
            self.use_camera(options.camera)
            self.color_camera = None  # the bag's own is found below
            return
        infos = [c for c in self.bag.connections if c.msgtype == INFO]
        infos = _alike_first(infos, self.connection)
        adjacent = self._camera_infos(self.connection)
        candidates = (
            adjacent
            or [c for c in infos if "depth" in c.topic]
            or infos[: len(infos) == 1]
            or [c for c in infos if self._is_of_depth(c)]
        )
        if not candidates:
            others = f", but for others ({', '.join(c.topic for c in infos)})" if infos else ""
            raise InputError(
                f"has no CameraInfo for {self.connection.topic}{others}",
                where=self.path,
                remedy="pass the depth camera with --camera camera.json",
            )
        self.camera = self._lens_of(candidates[0], self.connection, self._depth_size())

    def _is_of_depth(self, info: Any) -> bool:
        """Whether a CameraInfo states the frame and the size of the depth images."""
        for _, _, raw in self.bag.messages(connections=[info]):
            message = self.bag.deserialize(raw, info.msgtype)
            frame = bags.frame_name(message.header.frame_id)
            size = message.width, message.height
            return frame == self._frame_of(self.depth) and size == self._depth_size()
        return False

    def _camera_infos(self, connection: Any) -> list[Any]:
        """The CameraInfo connections in the namespace of an image connection, of like names first.

        As in /camera/depth and /camera, or /depth_image, /color_camera_info, /depth_camera_info.
        """
        folder = connection.topic.rsplit("/", 1)[0]
        found = [
            c
            for c in self.bag.connections
            if c.msgtype == INFO and c.topic.rsplit("/", 1)[0] in (folder, folder.rsplit("/", 1)[0])
        ]
        return _alike_first(found, connection)

    def _transforms(self) -> bags.Transforms:
        try:
            with reading.library_errors(self.path, bags.REMEDY):
                transforms = bags.Transforms.read(self.bag)
        except InputError as error:
            self.warnings.append(f"tf is ignored: {error}")
            transforms = bags.Transforms({})
        try:
            with reading.library_errors(self.path, bags.REMEDY):
                transforms.add_odometry(self.bag)
        except InputError as error:
            self.warnings.append(f"odometry is ignored: {error}")
        return transforms

    def _frame_of(self, track: bags.Track) -> str:
        """Name of the tf frame of the messages."""
        return bags.frame_name(track.message(0).header.frame_id)

    def _read_poses(self, transforms: bags.Transforms) -> None:
        """Read the poses of the depth camera from tf, and from messages of odometry."""
        if not transforms:
            return
        try:
            with reading.library_errors(self.where(0), bags.REMEDY):
                frame = self._frame_of(self.depth)
        except InputError as error:  # affects only this frame
            self.warnings.append(f"tf is ignored: {error}")
            return
        ancestors = transforms.ancestors(frame)
        if transforms.any_moves and not transforms.moves(ancestors[-1], frame):
            self.warnings.append(
                f"tf or odometry has frames that move, but the frame of depth, {frame!r}, is "
                "attached to none of them: if it should be, /tf_static was not recorded"
            )
            return
        topics = transforms.odometry_topics
        odometry = next((n for n in ancestors if n in topics or _ODOMETRY in n.lower()), None)
        if odometry is not None and transforms.moves(odometry, frame):
            poses = transforms.poses(odometry, frame, self.timestamps)
            if np.isfinite(poses).any():
                self.odometry = poses
                if odometry in topics:
                    self.metadata["odometry_topic"] = topics[odometry]
        if ancestors[-1] != odometry and transforms.moves(ancestors[-1], frame):
            poses = transforms.poses(ancestors[-1], frame, self.timestamps)
            if np.isfinite(poses).any():
                self.reference = poses
        moves = transforms.moves(ancestors[-1], frame)
        if moves and self.reference is None and self.odometry is None:
            self.warnings.append(
                f"tf or odometry states how the frame of depth, {frame!r}, moves, but at no time "
                "of an image: is their clock another one?"
            )

    def _read_gravity(self, transforms: bags.Transforms) -> None:
        """Read the direction of gravity from an accelerometer that is fixed to the camera."""
        apart = None
        for topic in sorted({c.topic for c in self.bag.connections if c.msgtype == bags.IMU_TYPE}):
            try:
                with reading.library_errors(self.path, bags.REMEDY):
                    camera = self._frame_of(self.depth)
                    measured = bags.accelerations(self.bag, topic)
            except InputError as error:
                self.warnings.append(f"{topic} is ignored: {error}")
                continue
            if measured is None:
                continue
            frame, columns = measured
            T = transforms.static_transform(camera, frame)
            if T is None:
                apart = apart or (
                    f"gravity in {topic} is ignored: the relation of its frame, {frame!r}, to that "
                    f"of depth, {camera!r}, is not in the bag (/tf_static)"
                )
                continue
            turned = T[:3, :3] @ np.array([columns[name] for name in ACCELERATION])
            self.imu = columns | dict(zip(ACCELERATION, turned, strict=True))
            self.gravity = gravity_at(self.timestamps, self.imu)
            self.metadata["imu_topic"] = topic
            return
        if apart is not None:
            self.warnings.append(apart)

    def _find_color(self, transforms: bags.Transforms) -> None:
        """Find a colour camera with known intrinsics and pose relative to depth."""
        missing: list[str] = []
        connections = sorted(self.bag.connections, key=lambda c: (c.msgtype, c.topic))
        for connection in _alike_first(connections, self.connection):
            if not self._is_color(connection) or not len(track := bags.Track(self.bag, connection)):
                continue
            try:
                with reading.library_errors(self.path, bags.REMEDY):
                    found = self._relate_color(track, transforms)
            except InputError as error:
                missing.append(f"{connection.topic} ({error.problem})")
                continue
            if found:
                self.metadata["color_topic"] = connection.topic
                return
            missing.append(connection.topic)
        if missing:
            self.warnings.append(
                f"colour is ignored: the relation of {missing[0]} to depth is not in the bag "
                "(its camera_info, and tf_static between the two cameras)"
            )

    def _relate_color(self, track: bags.Track, transforms: bags.Transforms) -> bool:
        """Use a colour camera, if its intrinsics and pose relative to depth are known."""
        first = self.read_color(track, 0, f"{self.path}: {track.connection.topic}")
        depth_frame, color_frame = self._frame_of(self.depth), self._frame_of(track)
        registered = _rank(self.connection) == 1  # depth is registered to colour
        same_size = first.shape[:2] == (self.camera.height, self.camera.width)
        T = transforms.static_transform(color_frame, depth_frame)
        infos = self._camera_infos(track.connection)
        if not (same_size and (registered or depth_frame == color_frame)):
            if T is None or not infos:
                return False
            self.color_camera = camera_file.ColorCamera(
                self._lens_of(infos[0], track.connection, (first.shape[1], first.shape[0])), T
            )
        self.color = track
        return True

    def _is_color(self, connection: Any) -> bool:
        topic = connection.topic.lower().replace("to_depth", "")  # registered to it
        if "depth" in topic or not any(keyword in topic for keyword in _COLOR_KEYWORDS):
            return False
        if connection.msgtype == COMPRESSED:
            return True
        return connection.msgtype == IMAGE and self._encoding(connection).lower() in bags.COLORS

    def _depth_size(self) -> tuple[int, int] | None:
        """Width and height of the middle image, as a mode may change soon; None if unreadable."""
        middle = (len(self.depth) - 1) // 2
        where = self.where(middle)
        with suppress(InputError), reading.library_errors(where, bags.REMEDY):
            message = self.depth.message(middle)
            if self.connection.msgtype == IMAGE:
                return int(message.width), int(message.height)
            height, width = bags.decompressed(message, where).shape
            return width, height
        return None

    def _lens_of(self, info: Any, images: Any, size: tuple[int, int] | None) -> Pinhole:
        """The lens of a CameraInfo for a topic of images of a size (width, height).

        That of the first message of this size, or else of the first that states a lens: drivers
        write zeros until they know it.
        """
        where = f"{self.path}: {info.topic}"
        rectified = _RECTIFIED.search(images.topic.lower()) is not None
        best, best_rank = None, -1
        for _, _, raw in self.bag.messages(connections=[info]):
            message = self.bag.deserialize(raw, info.msgtype)
            rank = bags.info_rank(message, where, size)
            if rank > best_rank:
                best, best_rank = message, rank
            if rank == bags.FITS:
                break
        if best is None:
            raise InputError("has no message", where=where, remedy="use --camera camera.json")
        lens = bags.lens(best, where, rectified=rectified)
        return lens if size is None else bags.shown_part(lens, best, size)

    def _find_amplitude(self) -> bags.Track | None:
        """The amplitude track of the same sensor: its images match the depth's size and times."""
        connections = sorted(self.bag.connections, key=lambda c: c.topic)
        for connection in _alike_first(connections, self.connection):
            is_named = any(keyword in connection.topic.lower() for keyword in _AMPLITUDE_KEYWORDS)
            if connection.msgtype != IMAGE or connection.topic == self.connection.topic:
                continue
            if not is_named or self._encoding(connection) not in bags.GREY:
                continue
            track = bags.Track(self.bag, connection)
            middle = track.message((len(track) - 1) // 2)
            if (middle.height, middle.width) != (self.camera.height, self.camera.width):
                continue
            has_match = [track.nearest(t, bags.MAX_GAP_S) is not None for t in self.timestamps]
            if sum(has_match) > 0.5 * len(has_match):
                self.metadata["amplitude_topic"] = connection.topic
                return track
        return None

    def _unit(self, kind: str) -> float:
        """Metres per count; floats are always in metres."""
        return self.unit if kind == "u" else 1.0

    def _organised(self) -> Camera | None:
        """The camera of organised clouds, if they are in x right, y down, z forward; else None."""
        images = []
        for k, message in organised.samples(len(self.depth), lambda k: (k, self.depth.message(k))):
            with suppress(InputError):
                points = cloud_files.to_float32(bags.cloud(message, self.where(k)).points)
                if min(message.width, message.height) < 2:
                    return None
                images.append(points.reshape(message.height, message.width, 3))
        return organised.common_camera(images)


def _alike_first(connections: list[Any], other: Any) -> list[Any]:
    """Connections sorted by how much of its name their topic begins with: those of one camera."""
    return sorted(connections, key=lambda c: -len(commonprefix((c.topic, other.topic))))  # noqa: RUF071


def _rank(connection: Any) -> int | None:
    """The rank of a topic as a source of depth, 0 is best; None if it can't be one."""
    topic, kind = connection.topic.lower(), connection.msgtype
    if kind == IMAGE and "depth" in topic:
        # Depth in its own frame is preferred to depth registered to another camera.
        registered = any(
            keyword in topic for keyword in ("align", "regist", "_to_", "color", "rgb")
        )
        return 1 if registered else 0
    if kind == COMPRESSED and "depth" in topic:
        return 2
    # DepthAI's driver calls its depth /oak/stereo/image_raw.
    if kind == IMAGE and any(word in topic for word in ("distance", "range", "/stereo/image")):
        return 3
    return 4 if kind == CLOUD else None
