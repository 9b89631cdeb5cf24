"""Bags of camera makers' viewers: ROS containers with proprietary messages."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from tofuse.errors import InputError
from tofuse.files.reading import files_with, is_file, is_folder, read_head
from tofuse.geometry.cameras import Camera
from tofuse.recordings.bags import ROS1_MAGIC, BagSource, Track, open_bag, open_container
from tofuse.recordings.camera_file import ColorCamera, load_camera
from tofuse.recordings.reader import ReaderOptions


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


class MakerBagSource(BagSource):
    """A source over a bag whose topics and messages are those of a maker."""

    def find_streams(self, options: ReaderOptions) -> None:
        """See `BagSource.find_streams`."""
        if options.topic is not None:
            raise InputError(
                "does not apply to this maker's bags",
                where="--topic",
                remedy="omit it, or use --format ros",
            )
        self.find_tracks()
        if options.camera is None:
            self.camera = self.lens()
        else:
            description, self.camera = load_camera(options.camera)
            self.unit, self.kind = description.depth_unit_m, description.depth_kind
            self.color_camera = description.color
        self._find_color()
        self.set_timestamps()
        self.metadata |= {"depth_unit_m": self.unit, "depth_kind": self.kind}

    def find_tracks(self) -> None:
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
