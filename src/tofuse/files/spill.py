"""What does not fit into memory: objects made of arrays, kept on disk until they are asked for.

A recording may be hours long, and its end asks for views of its beginning. Items are held in memory
as long as a budget allows; of those that were asked for longest ago the arrays are then read back
from a temporary file. It is read and not mapped, so that what is resident is what was budgeted.
What comes back is equal to what went in, to the bit: no result depends on the budget.
"""

from __future__ import annotations

import dataclasses
import tempfile
import weakref
from collections import OrderedDict
from collections.abc import Mapping
from pathlib import Path
from threading import RLock
from typing import IO, Any, Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from tofuse.arrays import UInt8
from tofuse.errors import OutputError
from tofuse.files.atomic import output_error
from tofuse.files.memory import give_back

_PIECE = 16 << 20  # bytes that are copied at a time
_OFTEN = 128 << 20  # bytes that leave memory before it is given back to the system


class SpillFile:
    """A temporary file that only grows, and is gone with the process, however that ends.

    Parameters
    ----------
    folder
        Where it is; None for the system's folder of temporary files. It is made when something is
        written.

    Attributes
    ----------
    folder
        As it was given, as text.
    size
        Bytes in it.
    """

    def __init__(self, folder: str | Path | None = None) -> None:
        self.size = 0
        self.folder = None if folder is None else str(folder)
        self._file: IO[bytes] | None = None

    def append(self, data: UInt8) -> int:
        """Write at the end; returns where that is. OutputError where the disk is full."""
        offset = self.size
        try:
            if self._file is None:
                # Unbuffered: an error comes with what caused it, and nothing is held twice.
                self._file = tempfile.TemporaryFile(  # noqa: SIM115 - closed by `close`
                    prefix="tofuse-", dir=self.folder, buffering=0
                )
                weakref.finalize(self, self._file.close)
            self._file.seek(offset)
            left = data.data
            while left:
                left = left[self._file.write(left) :]
        except OSError as error:
            raise _no_room(error, self._where) from error
        self.size = offset + len(data)
        return offset

    def read(self, offset: int, out: UInt8) -> None:
        """Fill `out` with what was written there."""
        left = out.data
        try:
            assert self._file is not None
            self._file.seek(offset)
            while left:
                count = self._file.readinto(left)  # type: ignore[attr-defined]
                if not count:
                    raise OutputError(
                        "a temporary file of this run has lost its end", where=self._where
                    )
                left = left[count:]
        except OSError as error:
            raise _no_room(error, self._where) from error

    def pieces(self) -> list[Piece]:
        """All of it, piece by piece, each read when it is asked for."""
        return [Piece(self, k, min(_PIECE, self.size - k)) for k in range(0, self.size, _PIECE)]

    def close(self) -> None:
        """Remove it."""
        if self._file is not None:
            self._file.close()
        self._file, self.size = None, 0

    @property
    def _where(self) -> Path:
        return Path(self.folder or tempfile.gettempdir())

    def __getstate__(self) -> dict[str, Any]:
        """All of it. Who has much of it to keep takes its `pieces` instead."""
        return {"folder": self.folder, "data": [piece.copy() for piece in self.pieces()]}

    def __setstate__(self, state: dict[str, Any]) -> None:
        SpillFile.__init__(self, state["folder"])
        for data in state["data"]:
            self.append(data)


@dataclasses.dataclass(frozen=True)
class Piece:
    """Some of a temporary file: an array once NumPy asks for it."""

    file: SpillFile
    offset: int
    size: int

    def copy(self) -> UInt8:
        """Return the bytes."""
        data = np.empty(self.size, np.uint8)
        self.file.read(self.offset, data)
        return data

    def __array__(self, dtype: Any = None, copy: bool | None = None) -> UInt8:
        """See `copy`."""
        return self.copy()


T = TypeVar("T")


@dataclasses.dataclass(eq=False)
class _Entry:
    """What is known of an item that is not in memory.

    Attributes
    ----------
    shell
        The item with empty arrays in place of those that are its own.
    shapes
        Of these arrays, by field.
    offset
        Where they are in the file; None where they were never written.
    """

    shell: Any
    shapes: dict[str, tuple[int, ...]]
    nbytes: int
    offset: int | None = None


class Spill(Generic[T]):
    """Keeps dataclass objects, by number: few of them in memory, the arrays of all others on disk.

    Fields that are arrays may go to disk. What is no array stays in memory, and so does an array
    that is the very same as in the item before (the rays of all views of one camera, say). Fields
    that take no part in `__init__` are taken for derived, and may be lost. Any thread may call.

    Parameters
    ----------
    budget
        Bytes of arrays that may stay in memory; the newest item does in any case.
    folder
        Where the temporary file is to be; see `SpillFile`.
    """

    def __init__(self, budget: int, folder: Path | None = None) -> None:
        if budget < 0:
            raise ValueError(f"budget is {budget}, not 0 or more")
        self._budget = budget
        self._entries: dict[int, _Entry] = {}
        self._held: OrderedDict[int, T] = OrderedDict()  # the longest unused first
        self._held_bytes = 0
        self._next = 0
        self._let_go = 0  # bytes since memory was given back
        self._last: dict[str, NDArray[Any]] = {}
        self._file = SpillFile(folder)
        self._lock = RLock()

    def put(self, item: T) -> int:
        """Keep an item; returns its number, one more than that of the item before.

        Raises
        ------
        OutputError
            If there is no room on the disk for what memory can't hold.
        """
        fields = {
            f.name: getattr(item, f.name)
            for f in dataclasses.fields(item)  # type: ignore[arg-type]
            if f.init
        }
        arrays = {name: value for name, value in fields.items() if _is_array(value)}
        with self._lock:
            own = {n: _compact(a) for n, a in arrays.items() if self._last.get(n) is not a}
            if any(own[name] is not arrays[name] for name in own):
                # Sums may differ with the layout, which is lost on disk: it must not matter.
                item = type(item)(**(fields | own))
            self._last = arrays
            number, self._next = self._next, self._next + 1
            # Of as many columns: items may look at that when they are made.
            empty = {n: np.empty((0, *a.shape[1:])[: a.ndim], a.dtype) for n, a in own.items()}
            self._entries[number] = _Entry(
                type(item)(**(fields | empty)),
                {name: a.shape for name, a in own.items()},
                sum(a.nbytes for a in own.values()),
            )
            self._hold(number, item)
        return number

    def get(self, number: int) -> T:
        """Return an item, the same object as long as it is in memory; KeyError if there is none."""
        with self._lock:
            if number in self._held:
                self._held.move_to_end(number)
                return self._held[number]
            entry = self._entries[number]
            item: T = dataclasses.replace(entry.shell, **self._read(entry))
            self._hold(number, item)
            return item

    def drop(self, number: int) -> None:
        """Forget an item, if it is there. What it takes on the disk is free when all is."""
        with self._lock:
            entry = self._entries.pop(number, None)
            if entry is not None and self._held.pop(number, None) is not None:
                self._held_bytes -= entry.nbytes

    def close(self) -> None:
        """Forget all items, and remove the file."""
        with self._lock:
            self._entries, self._last = {}, {}
            self._held, self._held_bytes = OrderedDict(), 0
            self._file.close()

    def __len__(self) -> int:
        return len(self._entries)

    @property
    def nbytes(self) -> int:
        """Of the arrays of all items, in memory or not."""
        with self._lock:
            return sum(entry.nbytes for entry in self._entries.values())

    @property
    def held_bytes(self) -> int:
        """Of the arrays that are in memory."""
        return self._held_bytes

    @property
    def spilled_bytes(self) -> int:
        """Written to disk so far."""
        return self._file.size

    def _hold(self, number: int, item: T) -> None:
        self._held[number] = item
        self._held_bytes += self._entries[number].nbytes
        while self._held_bytes > self._budget and len(self._held) > 1:
            oldest = next(iter(self._held))
            self._write(oldest)
            del self._held[oldest]
            self._held_bytes -= self._entries[oldest].nbytes
            self._let_go += self._entries[oldest].nbytes
        if self._let_go > _OFTEN:
            # Else what is free lies in pieces between what stays, and more than the budget is held.
            self._let_go = 0
            give_back()

    def _write(self, number: int) -> None:
        entry, item = self._entries[number], self._held[number]
        if entry.offset is not None:
            return
        start = self._file.size
        for name in entry.shapes:
            self._file.append(_bytes_of(getattr(item, name)))
        entry.offset = start

    def _read(self, entry: _Entry) -> Mapping[str, NDArray[Any]]:
        assert entry.offset is not None
        offset, found = entry.offset, {}
        for name, shape in entry.shapes.items():
            found[name] = np.empty(shape, getattr(entry.shell, name).dtype)
            self._file.read(offset, _bytes_of(found[name]))
            offset += found[name].nbytes
        return found

    def __getstate__(self) -> dict[str, Any]:
        """Items as they are, if all are in memory; else all of them as they are on disk."""
        with self._lock:
            held = self._held
            if self._file.size:
                for number in held:
                    self._write(number)
                held = OrderedDict()
            return self.__dict__ | {
                "_held": held,
                "_held_bytes": self._held_bytes if held else 0,
                "_last": {},
                "_lock": None,
            }

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, _lock=RLock())


@dataclasses.dataclass(frozen=True)
class Scratch:
    """What may be kept for later, and where.

    Attributes
    ----------
    budget
        Bytes of arrays in memory; as good as unlimited unless given.
    folder
        Of temporary files; see `SpillFile`.
    """

    budget: int = 1 << 62
    folder: Path | None = None

    def part(self, share: float) -> Spill[Any]:
        """Return a new store with a share of the budget."""
        return Spill(int(share * self.budget), self.folder)


def _is_array(value: Any) -> bool:
    return isinstance(value, np.ndarray) and not value.dtype.hasobject


def _compact(array: NDArray[Any]) -> NDArray[Any]:
    """The array in C order, holding on to no larger one."""
    base = array.base
    larger = isinstance(base, np.ndarray) and base.nbytes > array.nbytes
    if array.flags.c_contiguous and not larger:
        return array
    return array.copy(order="C")


def _bytes_of(array: NDArray[Any]) -> UInt8:
    """Of an array in C order; what is written there is written to the array."""
    return array.reshape(-1).view(np.uint8) if array.size else np.empty(0, np.uint8)


def _no_room(error: OSError, where: Path) -> OutputError:
    told = output_error(error, where)
    return OutputError(
        f"what memory can't hold {told.problem}",
        where=where,
        remedy="free some space there, name another folder in TMPDIR, or give more --memory",
    )
