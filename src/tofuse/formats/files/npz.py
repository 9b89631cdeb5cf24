"""Reading .npz files, safe against pickles and decompression bombs."""

from __future__ import annotations

import math
import zipfile
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy
from numpy.typing import NDArray

from tofuse.engine.errors import InputError
from tofuse.formats.files.reading import input_error, is_file

Arrays = dict[str, NDArray[Any]]

_MAX_BYTES = 4 << 30
_MAX_MEMBERS = 100_000
_MAX_COMPRESSION = 1100  # just above the largest ratio that deflate reaches
_KINDS = "biufcSU"


def read_npz(
    path: str | Path, *, limit: int = _MAX_BYTES, names: frozenset[str] | None = None
) -> Arrays:
    """Return the arrays of a file, by name.

    Parameters
    ----------
    limit
        Largest total size in bytes.
    names
        Names of the arrays to read; all unless given.

    Raises
    ------
    InputError
        If it can't be read, is damaged (each array has a checksum), contains objects, or is too
        large.
    """
    try:
        if not is_file(Path(path)):
            Path(path).stat()
            raise InputError("is not a regular file", where=path, remedy="pass a file")
        with zipfile.ZipFile(path) as archive:
            return _read(archive, limit, names)
    except OSError as error:
        raise input_error(error, path) from error
    except InputError:
        raise
    except Exception as error:  # NumPy evaluates headers as Python, which can raise anything
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        raise InputError(
            f"can't be read as an .npz file ({reason})",
            where=path,
            remedy="check that it is the file you meant, and complete",
        ) from error


def read_npy(path: str | Path) -> NDArray[Any]:
    """Return the array of an .npy file, mapped, so that a damaged header can't cause an allocation.

    Raises
    ------
    InputError
        If it can't be read, or is anything else.
    """
    try:
        array = np.load(path, mmap_mode="r", allow_pickle=False)
    except OSError as error:
        raise input_error(error, path) from error
    except Exception as error:  # NumPy evaluates the header as Python, which can raise anything
        raise InputError("is not an array", where=path, remedy="write it by numpy.save") from error
    if not isinstance(array, np.ndarray):
        raise InputError("is not an array", where=path, remedy="write it by numpy.save")
    return array


def _read(archive: zipfile.ZipFile, limit: int, names: frozenset[str] | None) -> Arrays:
    members = archive.infolist()
    if len(members) > _MAX_MEMBERS:
        raise ValueError(f"it contains {len(members)} arrays")
    selected = [m for m in members if names is None or m.filename.removesuffix(".npy") in names]
    if sum(m.file_size for m in selected) > limit:
        raise ValueError(f"its arrays have more than {limit >> 20} MiB")
    arrays: Arrays = {}
    for member in selected:
        if not member.filename.endswith(".npy"):
            raise ValueError(f"{member.filename!r} is not an array")
        if member.file_size > _MAX_COMPRESSION * member.compress_size + 1000:
            raise ValueError(f"{member.filename!r} declares more than it can contain")
        with archive.open(member) as stream:
            _check_header(stream, member)
        with archive.open(member) as stream:
            array = npy.read_array(stream, allow_pickle=False)
            if stream.read(1):  # reading to the end also verifies the checksum
                raise ValueError(f"{member.filename!r} contains more than its array")
        arrays[member.filename.removesuffix(".npy")] = array
    return arrays


def _check_header(stream: IO[bytes], member: zipfile.ZipInfo) -> None:
    """Raise ValueError, before allocation, if a header declares another size than the data has."""
    version = npy.read_magic(stream)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"{member.filename!r} has the version {version}")
    read = npy.read_array_header_1_0 if version == (1, 0) else npy.read_array_header_2_0
    shape, _fortran, dtype = read(stream)
    if dtype.kind not in _KINDS:
        raise ValueError(f"{member.filename!r} contains {dtype}")
    if math.prod(shape) * dtype.itemsize != member.file_size - stream.tell():
        raise ValueError(f"{member.filename!r} has another size than it declares")
