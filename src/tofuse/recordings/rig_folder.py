"""Folders with the recordings of a rig's cameras: of a rig.json, or of cwipc."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from tofuse.files.reading import is_file, is_folder
from tofuse.recordings import cwipc, rig
from tofuse.recordings.recording import Recording
from tofuse.recordings.rig import Rig, read_rig


def rig_file_in(folder: str | Path) -> Path | None:
    """Return the file in a folder that describes a rig; None if there is none."""
    folder = Path(folder)
    if not is_folder(folder):
        return None
    if is_file(folder / rig.FILE_NAME):
        return folder / rig.FILE_NAME
    config = folder / cwipc.FILE_NAME
    return config if is_file(config) and cwipc.is_camera_config(config) else None


def recordings_of(rig_file: Path) -> dict[str, Path]:
    """Return the recordings in the folder of a rig's file, by the names of its cameras.

    Raises
    ------
    InputError
        If the file is invalid.
    """
    if rig_file.name == cwipc.FILE_NAME:
        return {camera.name: camera.recording for camera in cwipc.read_cameras(rig_file)}
    return {c.name: rig_file.parent / c.name for c in read_rig(rig_file).cameras}


def rig_from(rig_file: Path, recordings: Sequence[Recording]) -> Rig:
    """Read the rig of these recordings, given in the order of its cameras.

    Raises
    ------
    InputError
        If the file is invalid, or doesn't determine the poses of the depth cameras.
    """
    if rig_file.name == cwipc.FILE_NAME:
        return cwipc.rig_of(cwipc.read_cameras(rig_file), recordings)
    return read_rig(rig_file)
