"""ROS bags and the messages of their topics, read by the package rosbags."""

from __future__ import annotations

import errno
import tempfile
import weakref
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from tofuse.arrays import Float32, Float64, UInt8
from tofuse.errors import InputError
from tofuse.files.reading import is_file, is_folder, list_folder, required_package
from tofuse.geometry.cameras import Camera
from tofuse.recordings.camera_file import ColorCamera, check_size
from tofuse.recordings.color import sampled_color
from tofuse.recordings.depth_counts import depth_from_counts
from tofuse.recordings.frames import DepthKind, Frame, RangeFrame
from tofuse.recordings.reader import ReaderOptions
from tofuse.recordings.ros_messages import ENCODINGS, GREY, color_image, header_time, image
from tofuse.recordings.sources import FileSource

MAX_GAP_S = 0.02  # between the images of one frame
ROS1_MAGIC = b"#ROSBAG V2"
MAGIC = (ROS1_MAGIC, b"\x89MCAP0\r\n")


def open_bag(path: Path) -> Any:
    """Open a bag; the caller has to ``close`` it.

    Raises
    ------
    InputError
        If rosbags is missing, or can't open it.
    """
    highlevel = required_package("rosbags.highlevel", "ros", path)
    typesys = required_package("rosbags.typesys", "ros", path)
    if is_folder(path):
        for entry in list_folder(path):
            if not is_file(entry) and not is_folder(entry):  # rosbags would wait for a pipe
                raise InputError(
                    "is not a regular file", where=entry, remedy="remove it from the bag"
                )
    types = typesys.get_typestore(typesys.Stores.LATEST)
    return _opened(path, lambda: highlevel.AnyReader([path], default_typestore=types))


def open_container(path: Path) -> Any:
    """Open a ROS 1 bag without decoding its messages; else as `open_bag`.

    The message definitions in the bags of some makers are incomplete.
    """
    rosbag1 = required_package("rosbags.rosbag1", "ros", path)
    return _opened(path, lambda: rosbag1.Reader(path))


def _opened(path: Path, reader: Callable[[], Any]) -> Any:
    try:
        bag = reader()
        bag.open()
        return bag
    except Exception as error:
        if isinstance(error, OSError) and error.errno == errno.ENOSPC:
            raise InputError(
                "has no space for the decompressed files of a bag",
                where=tempfile.gettempdir(),
                remedy="free some space, or set TMPDIR to another folder",
            ) from error
        raise damaged(error, path) from error


def damaged(error: Exception, where: str | Path) -> InputError:
    """Return an InputError for any exception that rosbags raises for a damaged bag."""
    return InputError(
        f"can't be read ({type(error).__name__}: {str(error)[:200]})",
        where=where,
        remedy="check the bag, or reindex it",
    )


class Track:
    """The messages of one topic, with sequential and random access.

    Attributes
    ----------
    connection
        The connection of rosbags, with ``topic`` and ``msgtype``.
    times
        (N,) s, from the message headers, or else of their arrival.
    """

    def __init__(self, bag: Any, connection: Any) -> None:
        self.bag, self.connection = bag, connection
        times_of_messages = [
            (t, header_time(raw, getattr(bag, "is2", False))) for _, t, raw in self._messages()
        ]
        self._arrival_times = [arrival for arrival, _ in times_of_messages]
        self.times: Float64 = np.array([stamp or t / 1e9 for t, stamp in times_of_messages])
        self._iterator: Iterator[tuple[Any, int, Any]] | None = None
        self._next = 0

    def __len__(self) -> int:
        return len(self._arrival_times)

    def raw(self, index: int) -> Any:
        """Return the bytes of a message; reading in order needs no search."""
        if self._iterator is None or index != self._next:
            # Skip earlier messages with the same arrival time.
            time = self._arrival_times[index]
            self._iterator = self._messages(time)
            for _ in range(index - self._arrival_times.index(time)):
                next(self._iterator)
        self._next = index + 1
        try:
            return next(self._iterator)[2]
        except BaseException:
            self._iterator = None
            raise

    def message(self, index: int) -> Any:
        """Return a message, decoded by rosbags."""
        raw = self.raw(index)
        try:
            return self.bag.deserialize(raw, self.connection.msgtype)
        except BaseException:
            self._iterator = None
            raise

    def nearest(self, time: float, limit: float) -> int | None:
        """Return the index of the message nearest to `time`, or None beyond `limit`, both in s."""
        if not len(self.times):
            return None
        k = int(np.argmin(np.abs(self.times - time)))
        return k if abs(self.times[k] - time) <= limit else None

    def _messages(self, start: int | None = None) -> Iterator[tuple[Any, int, Any]]:
        messages: Iterator[tuple[Any, int, Any]] = self.bag.messages(
            connections=[self.connection], start=start
        )
        return messages


class BagSource(FileSource):
    """A source over depth images of a bag, with amplitude and colour of other topics.

    Attributes
    ----------
    camera, unit, kind
        Of the depth images: metres per count, and "z" or "range".
    depth, amplitude, color
        The messages of each topic; None where the bag has none.
    color_camera
        None if colour is registered to depth.
    """

    camera: Camera
    unit: float
    kind: DepthKind = "z"
    depth: Track
    amplitude: Track | None = None
    color: Track | None = None
    color_camera: ColorCamera | None = None

    def __init__(self, path: Path, options: ReaderOptions) -> None:
        self.path = path
        self.bag = self.open_bag(path)
        weakref.finalize(self, self.bag.close)
        super().__init__(np.zeros(0))
        try:
            self.find_streams(options)
        except InputError:
            raise
        except Exception as error:
            raise damaged(error, path) from error

    @staticmethod
    def open_bag(path: Path) -> Any:
        """Open the bag, so that its messages can be decoded."""
        return open_bag(path)

    def find_streams(self, options: ReaderOptions) -> None:
        """Set the attributes of the streams, and those of `FileSource`."""
        raise NotImplementedError

    def set_timestamps(self) -> None:
        """Take the timestamps of `depth`."""
        self.timestamps = self.depth.times
        if (np.diff(self.timestamps) <= 0).any():
            self.warnings.append("time decreases or repeats; frames stay in the order of the bag")

    def load(self, index: int) -> Frame:
        """See `FileSource.load`."""
        where = self.where(index)
        try:
            return self.read_frame(index, where)
        except InputError:
            raise
        except Exception as error:
            raise damaged(error, where) from error

    def where(self, index: int) -> str:
        """Return the name of a frame for errors."""
        return f"{self.path}: frame {index}"

    def read_frame(self, index: int, where: str) -> Frame:
        """Read a frame, which `where` names in errors."""
        time = float(self.timestamps[index])
        frame = RangeFrame(
            index,
            time,
            self.camera,
            self.read_depth(index, where),
            self.kind,
            amplitude_at(self.amplitude, time, self.camera, where, self.message),
            amplitude_kind="ir",
        )
        k = None if self.color is None else self.color.nearest(time, MAX_GAP_S)
        if self.color is None or k is None:
            return frame
        where = f"{where}, colour"
        color = self.read_color(self.color, k, where)
        return replace(frame, color_image=sampled_color(frame, color, self.color_camera, where))

    def read_depth(self, index: int, where: str) -> Float32:
        """Return the depth (H, W) of a frame in m."""
        counts = image(self.message(self.depth, index), where, ENCODINGS)
        check_size(counts, self.camera, where)
        return depth_from_counts(counts.astype(np.uint16), self.unit)

    def read_color(self, track: Track, index: int, where: str) -> UInt8:
        """Return an image (H, W, 3) of a track."""
        return color_image(self.message(track, index), where)

    def message(self, track: Track, index: int) -> Any:
        """Return a message of a track."""
        return track.message(index)


def amplitude_at(
    track: Track | None,
    time: float,
    camera: Camera,
    where: str,
    read: Callable[[Track, int], Any],
) -> Float32 | None:
    """Return the amplitude (H, W) at the time of a depth image; zeros if there is none.

    Parameters
    ----------
    track
        Amplitude images; None if the bag has none.
    time
        Of the depth image, s.
    camera
        Of the depth image.
    where
        For errors.
    read
        Returns a message of a track by its index.

    Raises
    ------
    InputError
        If the image is of another size or encoding, or cut off.
    """
    if track is None:
        return None
    k = track.nearest(time, MAX_GAP_S)
    if k is None:
        return np.zeros((camera.height, camera.width), np.float32)
    counts = image(read(track, k), f"{where}, amplitude", GREY)
    check_size(counts, camera, f"{where}, amplitude")
    with np.errstate(all="ignore"):
        return np.nan_to_num(counts.astype(np.float32), posinf=0, neginf=0)


def first_message(bag: Any, topic: str) -> Any:
    """Return the first message of a topic, or None if there is none."""
    connections = [c for c in bag.connections if c.topic == topic]
    if connections:
        for connection, _, raw in bag.messages(connections=connections):
            return bag.deserialize(raw, connection.msgtype)
    return None
