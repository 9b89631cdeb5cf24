"""Recordings in .zip files, as phones share them, unpacked into a temporary folder."""

from __future__ import annotations

import atexit
import shutil
import stat
import tempfile
import warnings
import zipfile
import zlib
from pathlib import Path, PurePosixPath

from tofuse.engine.errors import SHOWN_AS, InputError, InputWarning
from tofuse.formats.files import reading

_REMEDY = "unpack it yourself, and pass the folder"
_MAX_FILES = 1_000_000
# Measured images hardly shrink; deflate can shrink zeros a thousandfold.
_MAX_RATIO, _SMALL_BYTES = 100, 100_000_000
_OF_SYSTEMS = ("__MACOSX", ".DS_Store", "Thumbs.db", "desktop.ini")
# Folders by path, time and size of their archives: of this process, which removes them at its end.
_unpacked: dict[tuple[str, int, int], Path] = {}


def unzipped(path: str | Path, *, nested: bool = False) -> Path:
    """Return the folder or file that an archive contains, unpacked; other paths as they are.

    A folder that is alone in an archive or in another such folder stands for its content, and so
    does an archive in an archive, as mail programs make them.

    Raises
    ------
    InputError
        If it is damaged, encrypted, or has more or larger files or other names than a recording.
    OutputError
        If there is no room for its content.
    """
    path = Path(path)
    if path.suffix.lower() != ".zip" or not reading.is_file(path):
        return path
    facts = path.stat()
    key = str(path.absolute()), facts.st_mtime_ns, facts.st_size
    if key not in _unpacked:
        _unpacked[key] = _unpack(path)
    inside = _unpacked[key]
    while reading.is_folder(inside) and len(children := reading.list_folder(inside)) == 1:
        inside = children[0]
    return inside if nested else unzipped(inside, nested=True)


def _unpack(path: Path) -> Path:
    """Unpack an archive into a new folder, for which messages name the archive."""
    with reading.library_errors(path), zipfile.ZipFile(path) as archive:
        _check_whole(archive, path)
        members = _checked(archive.infolist(), path)
        folder = Path(tempfile.mkdtemp(prefix="tofuse-"))
        atexit.register(shutil.rmtree, folder, ignore_errors=True)
        size = sum(member.file_size for member in members)
        if size > shutil.disk_usage(folder).free:
            raise InputError(
                f"needs {size / 1e6:.0f} MB in {folder.parent}, which are not free",
                where=path,
                remedy=_REMEDY,
            )
        SHOWN_AS[str(folder / path.name)] = str(path)
        damaged = [m.filename for m in members if not _extracted(archive, m, folder / path.name)]
    if len(damaged) == len(members):
        raise InputError("is damaged", where=path, remedy="copy the file again")
    if damaged:
        more = f" and {len(damaged) - 1} more" if damaged[1:] else ""
        warnings.warn(
            f"{path}: {damaged[0]}{more} can't be unpacked and will be empty; copy it again",
            InputWarning,
            stacklevel=3,
        )
    return folder / path.name


def _extracted(archive: zipfile.ZipFile, member: zipfile.ZipInfo, folder: Path) -> bool:
    """Unpack one file of an archive; a damaged one becomes empty, which its reader reports."""
    try:
        archive.extract(member, folder)
    except (zipfile.BadZipFile, zlib.error, EOFError):
        (folder / member.filename).write_bytes(b"")
        return False
    return True


def _check_whole(archive: zipfile.ZipFile, path: Path) -> None:
    """Reject a part of an archive, where the directory is that of another archive in it (.npz)."""
    first = min((member.header_offset for member in archive.infolist()), default=0)
    with path.open("rb") as file:
        if first > 0 and file.read(4) == b"PK\3\4":
            raise InputError("is cut off before its end", where=path, remedy="copy the file again")


def _checked(members: list[zipfile.ZipInfo], path: Path) -> list[zipfile.ZipInfo]:
    """Return the files of a recording in an archive; InputError for what none contains."""

    def refuse(problem: str, remedy: str = _REMEDY) -> InputError:
        return InputError(problem, where=path, remedy=remedy)

    members = [m for m in members if not m.is_dir()]
    for member in members:  # of programs on Windows
        member.filename = member.filename.replace("\\", "/")
    members = [m for m in members if not set(PurePosixPath(m.filename).parts) & set(_OF_SYSTEMS)]
    if not members:
        raise refuse("is an empty archive", "pass a recording")
    if len(members) > _MAX_FILES:
        raise refuse(f"contains {len(members):,} files")
    for member in members:
        name = member.filename
        parts = PurePosixPath(name).parts
        if member.flag_bits & 1:
            raise refuse("is encrypted", "unpack it with its password, and pass the folder")
        if name.startswith("/") or ".." in parts or ":" in parts[0]:
            raise refuse(f"contains a file outside of itself ({name!r})", "check where it is from")
        if stat.S_ISLNK(member.external_attr >> 16):
            raise refuse(f"contains a link ({name!r})")
    size = sum(member.file_size for member in members)
    if size > _SMALL_BYTES and size > _MAX_RATIO * max(path.stat().st_size, 1):
        raise refuse(f"unpacks to {size / 1e9:.1f} GB, far more than measurements would")
    return members
