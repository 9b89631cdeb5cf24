"""Checkpoints: the state after each stage of a run, from which an interrupted run is resumed.

A state is an .npz file: arrays, and JSON that describes how the package's own types consist of
them (`states`). Nothing else is loaded, so a folder from an untrusted source executes no code.
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
from itertools import chain
from pathlib import Path
from time import perf_counter
from typing import Any, Protocol

from numpy.typing import NDArray

from tofuse.errors import Ended, InputError, OutputError
from tofuse.files.memory import give_back
from tofuse.files.npz import Arrays, read_npz, write_npz
from tofuse.files.stamps import Stamp, stamp, stamps_in
from tofuse.pipeline.states import PIECE, StateError, decode, encode, from_json, to_json
from tofuse.results.folder import CHECKPOINT

# The state of tracking, which is large, is saved at this interval, and at most at this fraction of
# the time.
_INTERVAL_S, _TIME_FRACTION = 30.0, 0.03
# Disk space to leave for the result: a multiple of the state's size, and bytes.
_FREE_STATES, _FREE_BYTES = 2, 50_000_000
# After a failure, states are kept for another attempt if the run took at least this time.
_MIN_KEPT_RUN_S = 60.0
# Names of states, and of temporary files of these.
_STATE = re.compile(r"[a-z]+\.(state|part)")
_VERSION = 3  # of the format
_MAX_BYTES, _MAX_HEADER_BYTES = 16 << 30, 4096
_HEADER = "header"


class Stages(Protocol):
    """Stores the state of a job after each stage, and provides those of an interrupted job."""

    def load(self, stage: str) -> Any:
        """Return the stored state of a stage, or None."""
        ...

    def save(self, stage: str, state: Any) -> None:
        """Store the state after a stage; None is not stored."""
        ...

    def due(self) -> bool:
        """Whether a large state, such as an intermediate one of a stage, should be saved now."""
        ...


class NoCheckpoints(Stages):
    """Stores nothing."""

    def load(self, stage: str) -> Any:
        """See `Stages`."""
        return None

    def save(self, stage: str, state: Any) -> None:
        """See `Stages`."""

    def due(self) -> bool:
        """See `Stages`."""
        return False


class Checkpoints(Stages):
    """Stores the stages of one run in its output folder until it is finished.

    Attributes
    ----------
    folder
        The folder of the checkpoints.
    used
        Whether the run was resumed from a checkpoint.
    fresh
        Whether the run began without an earlier result in the folder: then it may write there again
        without --overwrite. None without checkpoints of this run.
    """

    def __init__(self, out: Path, key: str, note: Callable[[str], None]) -> None:
        """Look for checkpoints of an earlier run.

        Parameters
        ----------
        out
            The output folder.
        key
            Digest of everything that determines the result. Checkpoints with another digest are
            ignored.
        note
            Shows a message to the user.
        """
        self.folder = out / CHECKPOINT
        self.fresh: bool | None = None
        self.used = False
        self._key = key
        self._note = note
        self._enabled = True
        self._finished = False
        self._start_s = self._last_save_s = perf_counter()
        self._save_duration_s = 0.0
        self._foreign: list[Path] = []
        linked = self.folder.is_symlink()
        for file in () if linked else sorted(self.folder.glob("*.state")):
            header = _header(file)
            if header.get("key") == key:
                self.fresh = bool(header.get("fresh"))
            else:
                self._foreign.append(file)

    def begin(self, fresh: bool) -> None:
        """Begin or resume the run.

        Parameters
        ----------
        fresh
            Whether the folder contains no earlier result, unless a checkpoint states it.
        """
        self.fresh = fresh if self.fresh is None else self.fresh
        if self._foreign:
            self._note(
                "the checkpoint of an interrupted run is of another input, other options or "
                "another version: it is not used"
            )
        for file in self._foreign:
            _unlink(file)

    def load(self, stage: str) -> Any:
        """See `Stages`. A damaged state is not used, with a note."""
        path = self._path(stage)
        if not path.exists():
            return None
        try:
            state = _read(path, self._key)
        except (InputError, StateError) as error:
            reason = error.problem if isinstance(error, InputError) else str(error)
            self._note(f"the checkpoint of stage {stage} is damaged, and not used ({reason})")
            _unlink(path)
            return None
        self.used = True
        return state

    def save(self, stage: str, state: Any) -> None:
        """See `Stages`. If it can't be written, the run continues without checkpoints."""
        if not self._enabled or state is None:
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
            if shutil.disk_usage(self.folder).free < _FREE_STATES * size + _FREE_BYTES:
                raise OSError("hardly any space left")
        # A part from elsewhere may have attributes that can't be stored.
        except (OSError, StateError) as error:
            self._enabled = False
            reason = error.strerror if isinstance(error, OSError) and error.strerror else str(error)
            self._note(
                f"can't save a checkpoint after {stage} ({reason.lower()}): if this run is "
                "interrupted, the next one starts from the beginning"
            )
            self.discard()
        self._last_save_s = perf_counter()
        self._save_duration_s = self._last_save_s - start

    def due(self) -> bool:
        """See `Stages`."""
        elapsed = perf_counter() - self._last_save_s
        return self._enabled and elapsed >= max(_INTERVAL_S, self._save_duration_s / _TIME_FRACTION)

    def discard(self) -> None:
        """Remove all checkpoints."""
        remove_states(self.folder)

    def finish(self) -> None:
        """Remove all checkpoints, as there is a result."""
        self._finished = True
        self.discard()

    def give_up(self, error: BaseException) -> None:
        """Remove all checkpoints, unless they save much work and a retry may succeed."""
        retry_may_succeed = isinstance(
            error, OutputError | OSError | MemoryError | Ended | KeyboardInterrupt
        )
        if self._finished or not (
            retry_may_succeed and perf_counter() - self._start_s >= _MIN_KEPT_RUN_S
        ):
            self.discard()

    def unusable(self, error: Exception) -> InputError:
        """Return the error for checkpoints, now removed, from which the run can't be resumed."""
        return InputError(
            f"can't resume from the checkpoint ({type(error).__name__}: {error})",
            where=self.folder,
            remedy="it has been removed: run the same command again",
        )

    def _path(self, stage: str) -> Path:
        return self.folder / f"{stage}.state"


def remove_states(folder: Path) -> None:
    """Remove the checkpoints in a folder, no other files, and the folder if it is then empty."""
    if folder.is_symlink() or not folder.is_dir():
        return
    for file in folder.iterdir():
        if _STATE.fullmatch(file.name) and not file.is_dir():
            _unlink(file)
    with suppress(OSError):
        folder.rmdir()


def digest(facts: Mapping[str, Any], files: Iterable[Path], *, excluded: Path) -> str:
    """Return a digest of plain data, of files, and of this program.

    Parameters
    ----------
    facts
        Plain data.
    files
        Files and folders, by path, size and modification time; for a single file, all files in its
        folder are included.
    excluded
        A folder that is excluded.
    """
    stats = []
    for path in files:
        stats += _stamps(path.absolute(), excluded.absolute())
    text = json.dumps({"facts": facts, "files": stats, "program": _program()}, sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()


def _stamps(path: Path, excluded: Path) -> list[Stamp]:
    if path.is_dir():
        return stamps_in(path, excluded)
    return [stamp(each) for each in sorted(path.parent.iterdir()) if each.is_file()]


@cache
def _program() -> str:
    """Return a digest of the package's sources and of the numerical libraries."""
    import cv2
    import numba
    import numpy
    import scipy

    versions = (cv2.__version__, numba.__version__, numpy.__version__, scipy.__version__)
    text = repr((sys.version, platform.machine(), *versions))
    hasher = hashlib.sha256(text.encode())
    root = Path(__file__).parents[1]
    for file in sorted(root.rglob("*.py")):
        hasher.update(str(file.relative_to(root)).encode() + b"\0" + file.read_bytes())
    return hasher.hexdigest()


def _unlink(path: Path) -> None:
    try:
        path.unlink()
    except OSError:
        return


def _header(path: Path) -> dict[str, Any]:
    """Return the header of a checkpoint; empty for other files."""
    try:
        return _header_in(read_npz(path, limit=_MAX_HEADER_BYTES, names=frozenset({_HEADER})))
    except (InputError, StateError):
        return {}


def _header_in(arrays: Arrays) -> dict[str, Any]:
    header = from_json(arrays.pop(_HEADER, None))
    if not isinstance(header, dict) or header.get("version") != _VERSION:
        raise StateError("it is not a checkpoint of this version")
    return header


def _write(path: Path, header: dict[str, Any], state: Any) -> None:
    # Not synchronised with the disk: after a power failure, checksums show damage.
    with path.open("wb") as file:
        write_npz(file, chain([(_HEADER, to_json(header))], encode(state)))
    give_back()


def _read(path: Path, key: str) -> Any:
    arrays = read_npz(path, limit=_MAX_BYTES, exclude_prefix=PIECE)
    if _header_in(arrays).get("key") != key:
        raise StateError("it is of another run")

    def piece(name: str) -> NDArray[Any]:
        return read_npz(path, names=frozenset({name}))[name]

    return decode(arrays, piece)
