"""Where a run that was killed goes on: what it had after each stage, kept beside its result.

A state is an .npz file: arrays, and JSON that says how our own types are made of them (`states`).
Nothing else is ever loaded, so that a folder from somebody else runs no code of theirs.
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import re
import shutil
import sys
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from functools import cache
from pathlib import Path
from time import perf_counter
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from tofuse.arrays import UInt8
from tofuse.errors import Ended, InputError, OutputError
from tofuse.files.arrays import Arrays, read_npz, write_npz
from tofuse.files.stamps import Stamp, stamp, stamps_in
from tofuse.pipeline.states import PIECE, StateError, decode, encode
from tofuse.results.folder import CHECKPOINT

# While frames are tracked a state is kept this often, and so seldom that it costs little.
_EVERY_S, _SHARE = 10.0, 0.03
# What must be left for the result: so many times the state, and so many bytes.
_TIMES_LEFT, _BYTES_LEFT = 2, 50_000_000
# A failure after so much work leaves the states, for when there is space or memory again.
_WORTH_KEEPING_S = 60.0
# Names of states, and of parts of them that were being written.
_STATE = re.compile(r"[a-z]+\.(state|part)")
_VERSION = 2  # of the format; 1 were pickles
_MAX_BYTES, _MAX_NODES_BYTES, _MAX_HEADER_BYTES = 16 << 30, 1 << 30, 4096
_HEADER, _NODES = "header", "nodes"


class Stages(Protocol):
    """Keeps what a job has after each stage, and knows what an earlier, stopped job had."""

    def load(self, stage: str) -> Any:
        """Return what was kept of a stage, or None."""
        ...

    def save(self, stage: str, state: Any) -> None:
        """Keep what there is after a stage; None is not kept."""
        ...

    def due(self) -> bool:
        """Whether it is worth while to keep something in the middle of a stage."""
        ...


class NotKept(Stages):
    """Keeps nothing."""

    def load(self, stage: str) -> Any:
        """See `Stages`."""
        return None

    def save(self, stage: str, state: Any) -> None:
        """See `Stages`."""

    def due(self) -> bool:
        """See `Stages`."""
        return False


class Checkpoints(Stages):
    """Keeps the stages of one run in its output folder until it is finished.

    Attributes
    ----------
    folder
        Where they are.
    used
        Whether the run goes on from something that was kept.
    fresh
        Whether the run began without an earlier result in the folder; None where there is nothing
        of this run. Then it may write there once more without being told to.
    """

    def __init__(self, out: Path, key: str, note: Callable[[str], None]) -> None:
        """Look at what an earlier run left.

        Parameters
        ----------
        key
            Digest of all that decides the result. What was kept under another one is not used.
        note
            Hears what a person should know.
        """
        self.folder = out / CHECKPOINT
        self.fresh: bool | None = None
        self.used = False
        self._key = key
        self._note = note
        self._works = True
        self._finished = False
        self._begun = self._last = perf_counter()
        self._cost_s = 0.0
        self._strange: list[Path] = []
        linked = self.folder.is_symlink()
        for file in () if linked else sorted(self.folder.glob("*.state")):
            header = _header(file)
            if header.get("key") == key:
                self.fresh = bool(header.get("fresh"))
            else:
                self._strange.append(file)

    def begin(self, fresh: bool) -> None:
        """Begin the run, or go on with it.

        Parameters
        ----------
        fresh
            Whether the folder holds no earlier result; a stopped run knows better.
        """
        self.fresh = fresh if self.fresh is None else self.fresh
        if self._strange:
            self._note(
                "a run that was stopped left a state for another input, other options or another "
                "version: it is not used"
            )
        for file in self._strange:
            _unlink(file)

    def load(self, stage: str) -> Any:
        """See `Stages`. What is damaged is left out, with a note."""
        path = self._path(stage)
        if not path.exists():
            return None
        try:
            state = _read(path, self._key)
        except (InputError, StateError) as error:
            why = error.problem if isinstance(error, InputError) else str(error)
            self._note(f"what a stopped run left of its {stage} is damaged, and not used ({why})")
            _unlink(path)
            return None
        self.used = True
        return state

    def save(self, stage: str, state: Any) -> None:
        """See `Stages`. Where it can't be written the run goes on without."""
        if not self._works or state is None:
            return
        start = perf_counter()
        path = self._path(stage)
        part = path.with_suffix(".part")
        header = {"version": _VERSION, "key": self._key, "fresh": bool(self.fresh)}
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            _write(part, header, state)
            os.replace(part, path)
            size = path.stat().st_size
            if shutil.disk_usage(self.folder).free < _TIMES_LEFT * size + _BYTES_LEFT:
                raise OSError("hardly any space left")
        # A part that somebody added may hold what can't be kept.
        except (OSError, StateError) as error:
            self._works = False
            why = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
            self._note(
                f"can't keep what it has after {stage} ({why.lower()}): if this run is stopped, "
                "the next one begins anew"
            )
            self.discard()
        self._last = perf_counter()
        self._cost_s = self._last - start

    def due(self) -> bool:
        """See `Stages`."""
        waited = perf_counter() - self._last
        return self._works and waited >= max(_EVERY_S, self._cost_s / _SHARE)

    def discard(self) -> None:
        """Remove all that was kept."""
        _clear(self.folder)

    def finish(self) -> None:
        """Remove all that was kept: there is a result."""
        self._finished = True
        self.discard()

    def give_up(self, error: BaseException) -> None:
        """Remove what was kept, unless it was much work and trying again may help."""
        can_help = isinstance(error, OutputError | OSError | MemoryError | Ended)
        if self._finished or not (can_help and perf_counter() - self._begun >= _WORTH_KEEPING_S):
            self.discard()

    def unusable(self, error: Exception) -> InputError:
        """Say that what was kept, and is removed now, led to an error."""
        return InputError(
            f"what a stopped run left can't be gone on from ({type(error).__name__}: {error})",
            where=self.folder,
            remedy="it has been removed: run the same command again",
        )

    def _path(self, stage: str) -> Path:
        return self.folder / f"{stage}.state"


def discard_states(out: Path) -> None:
    """Remove what a stopped run left in its output folder to go on from."""
    _clear(out / CHECKPOINT)


def _clear(folder: Path) -> None:
    """Remove states, and nothing that only lies beside them."""
    if folder.is_symlink() or not folder.is_dir():
        return
    for file in folder.iterdir():
        if _STATE.fullmatch(file.name) and not file.is_dir():
            _unlink(file)
    with suppress(OSError):
        folder.rmdir()


def digest(facts: Mapping[str, Any], files: Iterable[Path], *, without: Path) -> str:
    """Return a digest of plain facts, of what files are, and of this program.

    Files and all that is in folders count by path, size and time of change; beside a single file,
    so do its neighbours. `without` is a folder that does not count.
    """
    stats = []
    for path in files:
        stats += _stamps(path.absolute(), without.absolute())
    text = json.dumps({"facts": facts, "files": stats, "program": _program()}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def _stamps(path: Path, without: Path) -> list[Stamp]:
    if path.is_dir():
        return stamps_in(path, without)
    return [stamp(each) for each in sorted(path.parent.iterdir()) if each.is_file()]


@cache
def _program() -> str:
    """Digest of our sources, and of what computes for us."""
    import cv2
    import numba
    import numpy
    import scipy

    made_with = (cv2.__version__, numba.__version__, numpy.__version__, scipy.__version__)
    text = repr((sys.version, platform.machine(), *made_with))
    found = hashlib.sha256(text.encode())
    root = Path(__file__).parents[1]
    for file in sorted(root.rglob("*.py")):
        found.update(str(file.relative_to(root)).encode() + b"\0" + file.read_bytes())
    return found.hexdigest()


def _unlink(path: Path) -> None:
    try:
        path.unlink()
    except OSError:
        return


def _header(path: Path) -> dict[str, Any]:
    """What a file of ours says of itself; nothing where it is none."""
    try:
        return _header_in(read_npz(path, limit=_MAX_HEADER_BYTES, only=frozenset({_HEADER})))
    except (InputError, StateError):
        return {}


def _header_in(arrays: Arrays) -> dict[str, Any]:
    header = _json(arrays.pop(_HEADER, None))
    if not isinstance(header, dict) or header.get("version") != _VERSION:
        raise StateError("it is no checkpoint of this version")
    return header


def _json(data: NDArray[Any] | None) -> Any:
    if data is None or data.dtype != np.uint8:
        raise StateError("it is no checkpoint")
    try:
        return json.loads(data.tobytes())
    except (ValueError, RecursionError):
        raise StateError("it is no checkpoint") from None


def _text(data: Any) -> UInt8:
    return np.frombuffer(json.dumps(data, separators=(",", ":")).encode(), np.uint8)


def _write(path: Path, header: dict[str, Any], state: Any) -> None:
    nodes, arrays = encode(state)
    # Not forced to the disk: should the power fail, the sums tell.
    with path.open("wb") as file:
        write_npz(file, {_HEADER: _text(header), _NODES: _text(nodes), **arrays})


def _read(path: Path, key: str) -> Any:
    arrays = read_npz(path, limit=_MAX_BYTES, without=PIECE)
    if _header_in(arrays).get("key") != key:
        raise StateError("it is of another run")
    nodes = arrays.pop(_NODES, None)
    if nodes is not None and nodes.nbytes > _MAX_NODES_BYTES:
        raise StateError("it is too large")

    def piece(name: str) -> NDArray[Any]:
        return read_npz(path, only=frozenset({name}))[name]

    return decode(_json(nodes), arrays, piece)
