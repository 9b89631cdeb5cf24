"""A store for objects made of arrays that spills the least recently used ones to disk.

A recording may be hours long, and its last frames may need views of its first. Items stay in memory
within a budget; the arrays of others are read back from a temporary file. The file is read instead
of mapped, so that the resident memory stays within the budget. Arrays are restored bit by bit: no
result depends on the budget.
"""

from __future__ import annotations

import ctypes
import dataclasses
import sys
import tempfile
import weakref
from collections import OrderedDict
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from threading import RLock
from typing import IO, Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from tofuse.engine.arrays import UInt8
from tofuse.engine.errors import OutputError, output_error


def trim_memory() -> None:
    """Return freed memory to the operating system, where the C library (glibc) retains it.

    The memory that a stage frees is fragmented, so that the next one would allocate more.
    """
    trim = _trim()
    if trim is not None:
        trim(0)


@cache
def _trim() -> Any:
    if sys.platform != "linux":
        return None
    try:
        return ctypes.CDLL(None).malloc_trim
    except (AttributeError, OSError):  # another C library
        return None


_TRIM_BYTES = 128 << 20  # evicted between two returns of free memory to the system


class SpillFile:
    """A temporary file that is only appended to, and is removed when the process ends in any way.

    Parameters
    ----------
    folder
        Its folder; None for the system's temporary folder. The file is created at the first write.

    Attributes
    ----------
    folder
        As given, as text.
    size
        In bytes.
    """

    def __init__(self, folder: str | Path | None = None) -> None:
        self.size = 0
        self.folder = None if folder is None else str(folder)
        self._file: IO[bytes] | None = None

    def append(self, data: UInt8) -> int:
        """Append bytes and return their offset; OutputError if the disk is full."""
        offset = self.size
        try:
            if self._file is None:
                # Unbuffered: errors are raised by the write that causes them, and memory is not
                # doubled.
                self._file = tempfile.TemporaryFile(  # noqa: SIM115 - closed by `close`
                    prefix="tofuse-", dir=self.folder, buffering=0
                )
                weakref.finalize(self, self._file.close)
            self._file.seek(offset)
            remaining = data.data
            while remaining:
                remaining = remaining[self._file.write(remaining) :]
        except OSError as error:
            raise _disk_error(error, self._where) from error
        self.size = offset + len(data)
        return offset

    def read(self, offset: int, out: UInt8) -> None:
        """Fill `out` with the bytes at an offset."""
        remaining = out.data
        try:
            assert self._file is not None
            self._file.seek(offset)
            while remaining:
                count = self._file.readinto(remaining)  # type: ignore[attr-defined]
                if not count:
                    raise OutputError(
                        "a temporary file of this run was truncated", where=self._where
                    )
                remaining = remaining[count:]
        except OSError as error:
            raise _disk_error(error, self._where) from error

    def close(self) -> None:
        """Remove the file."""
        if self._file is not None:
            self._file.close()
        self._file, self.size = None, 0

    @property
    def _where(self) -> Path:
        return Path(self.folder or tempfile.gettempdir())


T = TypeVar("T")


@dataclasses.dataclass(eq=False)
class _StoredItem:
    """The part of an item that always stays in memory.

    Attributes
    ----------
    shell
        The item with empty arrays in place of those that can be spilled.
    shapes
        Of these arrays, by field.
    nbytes
        Of these arrays together.
    offset
        Of these arrays in the file; None if they were never written.
    """

    shell: Any
    shapes: dict[str, tuple[int, ...]]
    nbytes: int
    offset: int | None = None


class Spill(Generic[T]):
    """Stores dataclass objects by number: within a budget in memory, the arrays of others on disk.

    Only arrays are spilled, except those that are identical (`is`) to those of the item before,
    such as the rays of a common camera. Fields that are not parameters of `__init__` are considered
    derived and may be lost. Thread-safe.

    Parameters
    ----------
    budget
        Bytes of arrays to keep in memory; the newest item is kept in any case.
    folder
        Of the temporary file; see `SpillFile`.

    Attributes
    ----------
    budget
        As given.
    """

    def __init__(self, budget: int, folder: Path | None = None) -> None:
        if budget < 0:
            raise ValueError(f"budget is {budget}, not 0 or more")
        self.budget = budget
        self._entries: dict[int, _StoredItem] = {}
        self._resident: OrderedDict[int, T] = OrderedDict()  # least recently used first
        self._resident_bytes = 0
        self._next = 0
        self._evicted_bytes = 0  # since free memory was returned to the system
        self._last: dict[str, NDArray[Any]] = {}
        self._shapes: dict[str, tuple[int, ...]] = {}  # of the last item
        self._empty: dict[tuple[tuple[int, ...], str], NDArray[Any]] = {}
        self._file = SpillFile(folder)
        self._lock = RLock()

    def put(self, item: T) -> int:
        """Store an item and return its number, one more than that of the item before.

        Raises
        ------
        OutputError
            If the disk has no room for the spilled arrays.
        """
        fields = {
            f.name: getattr(item, f.name)
            for f in dataclasses.fields(item)  # type: ignore[arg-type]
            if f.init
        }
        arrays = {name: value for name, value in fields.items() if _is_array(value)}
        with self._lock:
            unshared = {n: _compact(a) for n, a in arrays.items() if self._last.get(n) is not a}
            if any(unshared[name] is not arrays[name] for name in unshared):
                # The layout is lost on disk, and sums depend on it: it must be the same in memory.
                item = type(item)(**(fields | unshared))
            self._last = arrays
            number, self._next = self._next, self._next + 1
            placeholders = {name: self._empty_like(a) for name, a in unshared.items()}
            shapes = {name: a.shape for name, a in unshared.items()}
            if shapes == self._shapes:
                shapes = self._shapes  # share one object between many items
            self._shapes = shapes
            nbytes = sum(a.nbytes for a in unshared.values())
            self._entries[number] = _StoredItem(
                _shell(type(item), fields | placeholders), shapes, nbytes
            )
            self._make_resident(number, item)
        return number

    def get(self, number: int) -> T:
        """Return an item, the same object while it is in memory; KeyError if there is none."""
        with self._lock:
            if number in self._resident:
                self._resident.move_to_end(number)
                return self._resident[number]
            entry = self._entries[number]
            item: T = dataclasses.replace(entry.shell, **self._read(entry))
            self._make_resident(number, item)
            return item

    def drop(self, number: int) -> None:
        """Remove an item, if it exists. Its disk space is freed by `close`."""
        with self._lock:
            entry = self._entries.pop(number, None)
            if entry is not None and self._resident.pop(number, None) is not None:
                self._resident_bytes -= entry.nbytes

    def close(self) -> None:
        """Remove all items and the file."""
        with self._lock:
            self._entries, self._last = {}, {}
            self._resident, self._resident_bytes = OrderedDict(), 0
            self._file.close()

    def __len__(self) -> int:
        return len(self._entries)

    @property
    def nbytes(self) -> int:
        """Bytes of the arrays of all items, in memory or not."""
        with self._lock:
            return sum(entry.nbytes for entry in self._entries.values())

    @property
    def resident_bytes(self) -> int:
        """Bytes of the arrays that are in memory."""
        return self._resident_bytes

    @property
    def spilled_bytes(self) -> int:
        """Bytes written to disk so far."""
        return self._file.size

    def _empty_like(self, array: NDArray[Any]) -> NDArray[Any]:
        """Return the same empty array for all arrays of this type and shape beyond the first."""
        empty = np.empty((0, *array.shape[1:])[: array.ndim], array.dtype)
        return self._empty.setdefault((empty.shape, empty.dtype.str), empty)

    def _make_resident(self, number: int, item: T) -> None:
        self._resident[number] = item
        self._resident_bytes += self._entries[number].nbytes
        while self._resident_bytes > self.budget and len(self._resident) > 1:
            oldest = next(iter(self._resident))
            self._write(oldest)
            del self._resident[oldest]
            self._resident_bytes -= self._entries[oldest].nbytes
            self._evicted_bytes += self._entries[oldest].nbytes
        if self._evicted_bytes > _TRIM_BYTES:
            # Free memory is fragmented: without this, more than the budget stays resident.
            self._evicted_bytes = 0
            trim_memory()

    def _write(self, number: int) -> None:
        entry, item = self._entries[number], self._resident[number]
        if entry.offset is not None:
            return
        start = self._file.size
        for name in entry.shapes:
            self._file.append(_bytes_of(getattr(item, name)))
        entry.offset = start

    def _read(self, entry: _StoredItem) -> Mapping[str, NDArray[Any]]:
        assert entry.offset is not None
        offset, arrays = entry.offset, {}
        for name, shape in entry.shapes.items():
            arrays[name] = np.empty(shape, getattr(entry.shell, name).dtype)
            self._file.read(offset, _bytes_of(arrays[name]))
            offset += arrays[name].nbytes
        return arrays


@dataclasses.dataclass(frozen=True)
class Scratch:
    """Memory and disk for temporary data.

    Attributes
    ----------
    budget
        Bytes of arrays in memory; practically unlimited unless given.
    folder
        Of temporary files; see `SpillFile`.
    """

    budget: int = 1 << 62
    folder: Path | None = None

    def part(self, fraction: float) -> Spill[Any]:
        """Return a new store with a fraction of the budget."""
        return Spill(int(fraction * self.budget), self.folder)


def _shell(kind: type[T], fields: Mapping[str, Any]) -> T:
    """An item without the checks of its constructor, which empty arrays may not pass."""
    shell = object.__new__(kind)
    for field in dataclasses.fields(kind):  # type: ignore[arg-type]
        if field.name in fields:
            value = fields[field.name]
        elif field.default_factory is not dataclasses.MISSING:
            value = field.default_factory()
        else:
            value = field.default
        object.__setattr__(shell, field.name, value)
    return shell


def _is_array(value: Any) -> bool:
    return isinstance(value, np.ndarray) and not value.dtype.hasobject


def _compact(array: NDArray[Any]) -> NDArray[Any]:
    """The array in C order, copied if it is a view into a larger one."""
    base = array.base
    larger = isinstance(base, np.ndarray) and base.nbytes > array.nbytes
    if array.flags.c_contiguous and not larger:
        return array
    return array.copy(order="C")


def _bytes_of(array: NDArray[Any]) -> UInt8:
    """A writable view of the bytes of an array in C order."""
    return array.reshape(-1).view(np.uint8) if array.size else np.empty(0, np.uint8)


def _disk_error(error: OSError, where: Path) -> OutputError:
    cause = output_error(error, where)
    return OutputError(
        f"temporary data {cause.problem}",
        where=where,
        remedy="free some space there, name another folder in TMPDIR, or increase --memory",
    )
