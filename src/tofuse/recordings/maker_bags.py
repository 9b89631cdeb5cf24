"""Bags of camera makers' viewers: ROS containers with proprietary messages."""

from __future__ import annotations

import weakref
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from tofuse.arrays import Float64
from tofuse.errors import InputError
from tofuse.files.reading import files_with, is_file, is_folder, read_head
from tofuse.geometry.cameras import Camera
from tofuse.recordings.bags import (
    MAX_GAP_S,
    ROS1_MAGIC,
    Track,
    amplitude_at,
    damaged,
    open_bag,
    open_container,
)
from tofuse.recordings.camera_file import ColorCamera, check_size, load_camera
from tofuse.recordings.color import sampled_color
from tofuse.recordings.depth_counts import depth_from_counts
from tofuse.recordings.frames import DepthKind, RangeFrame
from tofuse.recordings.reader import ReaderOptions
from tofuse.recordings.ros_messages import ENCODINGS, color_image, image
from tofuse.recordings.sources import FileSource


def topics(path: Path) -> frozenset[str]:
    """Return the topics of a bag, none if it can't be opened."""
    try:
        status = path.stat()
    except OSError:
        return frozenset()
    return _topics_of(path, status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=4)
def _topics_of(path: Path, changed_ns: int, size: int) -> frozenset[str]:
    """See `topics`; cached, as several readers call it and opening a large bag is slow."""
    try:
        if is_folder(path):
            is_bag = is_file(path / "metadata.yaml") and bool(
                files_with(path, ".db3", ".mcap", ".zstd")
            )
            is_ros1 = False
        else:
            head = read_head(path, 16)
            is_ros1 = head.startswith(ROS1_MAGIC)
            is_bag = is_ros1 or (path.suffix == ".db3" and head.startswith(b"SQLite format 3"))
        if not is_bag:
            return frozenset()
        bag = open_container(path) if is_ros1 else open_bag(path)
    except InputError:
        return frozenset()
    try:
        return frozenset(c.topic for c in bag.connections)
    finally:
        bag.close()


class BagSource(FileSource):
    """A source over depth images of a bag, with amplitude and colour of other topics."""

    camera: Camera
    unit: float
    kind: DepthKind = "z"
    depth: Track
    amplitude: Track | None = None
    color: Track | None = None
    color_camera: ColorCamera | None = None

    def __init__(self, path: Path, options: ReaderOptions) -> None:
        self.path = path
        if options.topic is not None:
            raise InputError(
                "does not apply to this maker's bags",
                where="--topic",
                remedy="omit it, or use --format ros",
            )
        self.bag = self.open_bag(path)
        weakref.finalize(self, self.bag.close)
        super().__init__(np.zeros(0))
        try:
            self.find_streams()
            if options.camera is None:
                self.camera = self.lens()
            else:
                description, self.camera = load_camera(options.camera)
                self.unit, self.kind = description.depth_unit_m, description.depth_kind
                self.color_camera = description.color
            self._find_color()
        except InputError:
            raise
        except Exception as error:
            raise damaged(error, path) from error
        self.timestamps = self.depth.times
        if (np.diff(self.timestamps) <= 0).any():
            self.warnings.append("time decreases or repeats; frames stay in the order of the bag")
        self.metadata |= {"depth_unit_m": self.unit, "depth_kind": self.kind}

    @staticmethod
    def open_bag(path: Path) -> Any:
        """Open the bag, so that its messages can be decoded."""
        return open_bag(path)

    def find_streams(self) -> None:
        """Set `unit` and `depth`, and `amplitude` and `color` if the bag has them."""
        raise NotImplementedError

    def lens(self) -> Camera:
        """Return the camera of the depth images."""
        raise NotImplementedError

    def color_lens(self) -> ColorCamera:
        """Return the camera of the colour images; raise InputError if it is unknown."""
        raise NotImplementedError

    def _find_color(self) -> None:
        if self.color is None or self.color_camera is not None:
            return
        try:
            self.color_camera = self.color_lens()
        except InputError as error:
            self.warnings.append(f"colour is ignored: {error}")
            self.color = None

    @property
    def T_color_depth(self) -> Float64 | None:
        """(4, 4) maps points from the depth to the colour camera's frame; None if unknown."""
        return None if self.color_camera is None else self.color_camera.T_color_depth

    def message(self, track: Track, index: int) -> Any:
        """Return an image message of a track."""
        return track.message(index)

    def load(self, index: int) -> RangeFrame:
        """See `FileSource.load`."""
        where = f"{self.path}: frame {index}"
        time = float(self.timestamps[index])
        try:
            counts = image(self.message(self.depth, index), where, ENCODINGS)
            check_size(counts, self.camera, where)
            frame = RangeFrame(
                index,
                time,
                self.camera,
                depth_from_counts(counts.astype(np.uint16), self.unit),
                self.kind,
                amplitude_at(self.amplitude, time, self.camera, where, self.message),
                amplitude_kind="ir",
            )
            return self._colored(frame, where)
        except InputError:
            raise
        except Exception as error:
            raise damaged(error, where) from error

    def _colored(self, frame: RangeFrame, where: str) -> RangeFrame:
        """The frame with the colour image nearest in time, if there is one."""
        k = None if self.color is None else self.color.nearest(frame.timestamp, MAX_GAP_S)
        if k is None or self.color is None or self.color_camera is None:
            return frame
        where = f"{where}, colour"
        image = color_image(self.message(self.color, k), where)
        return replace(frame, color_image=sampled_color(frame, image, self.color_camera, where))

    def track(self, topic: str) -> Track | None:
        """Return the messages of a topic; None if there are none."""
        for connection in self.bag.connections:
            if connection.topic == topic:
                track = Track(self.bag, connection)
                return track if len(track) else None
        return None

    def required_track(self, topic: str, noun: str) -> Track:
        """Return the messages of a topic, called `noun` in the error if there are none."""
        track = self.track(topic)
        if track is None:
            raise InputError(
                f"has no {noun} ({topic})", where=self.path, remedy="record the depth stream"
            )
        return track
