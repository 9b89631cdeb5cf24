"""Reader of PLY clouds."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tofuse.parts import part
from tofuse.recordings.cloud_files import CloudFileSource, required_files, sniff_clouds
from tofuse.recordings.reader import Reader, ReaderOptions, Sniff, refuse_camera
from tofuse.recordings.sources import ply_frame


@part("reader", "ply", label="validated")
@dataclass(frozen=True)
class PlyClouds(Reader):
    """A .ply file, or a folder of them; metres."""

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        return sniff_clouds(path, ".ply")

    def open(self, path: Path, options: ReaderOptions) -> CloudFileSource:
        """See `Reader.open`."""
        refuse_camera(options, "ply")
        return CloudFileSource(path, required_files(path, ".ply"), ply_frame, ply_frame)
