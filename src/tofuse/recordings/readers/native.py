"""Reader of the native folder."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from tofuse.errors import InputError
from tofuse.files.reading import is_file, is_folder, read_text
from tofuse.parts import part
from tofuse.recordings.native import NativeSource
from tofuse.recordings.reader import SURE, UNSURE, ReaderOptions, Sniff


@part("reader", "native", label="validated")
@dataclass(frozen=True)
class Native:
    """Folders with a camera.json and depth/ (PNG) or cloud/ (PLY)."""

    joinable: ClassVar[bool] = True

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        if not is_folder(path):
            return None
        images = next((n for n in ("depth", "cloud") if is_folder(path / n)), None)
        if is_file(path / "camera.json"):
            try:
                text = read_text(path / "camera.json")
            except InputError:
                text = ""
            if "intrinsic_matrix" in text and '"schema"' not in text:
                return None
            if images is None:
                return Sniff(SURE, "a camera.json but neither depth/ nor cloud/")
            return Sniff(1.0, f"camera.json and {images}/")
        if images == "depth":
            return Sniff(
                UNSURE,
                "depth/ but no camera.json",
                "write one (docs/formats.md), or use --format native --camera camera.json",
            )
        return Sniff(SURE, "cloud/") if images == "cloud" else None

    def open(self, path: Path, options: ReaderOptions) -> NativeSource:
        """See `Reader.open`."""
        if not is_folder(path):
            raise InputError("is not a folder", where=path, remedy="pass the recording's folder")
        if not is_folder(path / "depth") and not is_folder(path / "cloud"):
            raise InputError(
                "has neither depth/ nor cloud/",
                where=path,
                remedy="check that the recording is complete",
            )
        return NativeSource(path, options.camera)
