"""Where a run that was killed goes on: what it had after each stage, kept beside its result.

A state is a pickle of our own types and of arrays; nothing else is ever loaded, so that a folder
from somebody else runs no code of theirs.
"""

from __future__ import annotations

import hashlib
import importlib
import json
import os
import pickle
import platform
import re
import shutil
import sys
import zlib
from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from functools import cache
from pathlib import Path
from time import perf_counter
from typing import Any, BinaryIO, Protocol

from tofuse.errors import OutputError
from tofuse.files.stamps import Stamp, stamp, stamps_in
from tofuse.results.folder import CHECKPOINT

# While frames are tracked a state is kept this often, and so seldom that it costs little.
_EVERY_S, _SHARE = 10.0, 0.03
# What must be left for the result: so many times the state, and so many bytes.
_TIMES_LEFT, _BYTES_LEFT = 2, 50_000_000
# A failure after so much work leaves the states, for when there is space or memory again.
_WORTH_KEEPING_S = 60.0
# Names of states, and of parts of them that were being written.
_STATE = re.compile(r"[a-z]+\.(state|part)")
_MAGIC = b"tofuse checkpoint\n"
_LONGEST_HEADER = 4096
_ROOMS = (
    "evaluation",
    "filters",
    "fusion",
    "geometry",
    "maps",
    "odometry",
    "pipeline.backend",
    "pipeline.behind",
    "pipeline.components",
    "pipeline.config",
    "pipeline.frame_log",
    "pipeline.intake",
    "pipeline.live",
    "pipeline.mapper",
    "pipeline.observations",
    "pipeline.preparation",
    "pipeline.progress",
    "pipeline.reconstruct",
    "posegraph",
    "recordings.frames",
    "registration",
    "results.samples",
    "results.types",
    "sensor",
)
_FOREIGN = {
    ("collections", "OrderedDict"),
    ("collections", "deque"),
    ("numpy", "dtype"),
    ("numpy", "ndarray"),
    ("numpy._core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "scalar"),
    ("numpy._core.numeric", "_frombuffer"),
}


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
        self._key = key
        self._note = note
        self._works = True
        self._begun = self._last = perf_counter()
        self._cost_s = 0.0
        self._strange: list[Path] = []
        for file in sorted(self.folder.glob("*.state")):
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
            with path.open("rb") as file:
                return _read(file, self._key)
        # Damaged data can make anything of a pickle.
        except Exception as error:
            self._note(f"what a stopped run left of its {stage} is damaged, and not used ({error})")
            _unlink(path)
            return None

    def save(self, stage: str, state: Any) -> None:
        """See `Stages`. Where it can't be written the run goes on without."""
        if not self._works or state is None:
            return
        start = perf_counter()
        path = self._path(stage)
        part = path.with_suffix(".part")
        header = {"key": self._key, "fresh": bool(self.fresh)}
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            with part.open("wb") as file:
                _write(file, header, state)
            os.replace(part, path)
            size = path.stat().st_size
            if shutil.disk_usage(self.folder).free < _TIMES_LEFT * size + _BYTES_LEFT:
                raise OSError("hardly any space left")
        # A part that somebody added may hold what can't be pickled.
        except (OSError, pickle.PicklingError, AttributeError, TypeError) as error:
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

    def give_up(self, error: BaseException) -> None:
        """Remove what was kept, unless it was much work and trying again may help."""
        can_help = isinstance(error, OutputError | OSError | MemoryError)
        if not (can_help and perf_counter() - self._begun >= _WORTH_KEEPING_S):
            self.discard()

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
        with path.open("rb") as file:
            return _read_header(file)
    except (OSError, ValueError):
        return {}


def _read_header(file: BinaryIO) -> dict[str, Any]:
    if file.read(len(_MAGIC)) != _MAGIC:
        raise ValueError("it is no checkpoint")
    header = json.loads(file.readline(_LONGEST_HEADER))
    if not isinstance(header, dict):
        raise ValueError("its header is damaged")
    return header


class _Summed:
    """A file that sums up what is written to it."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self.sum = 0

    def write(self, data: Any) -> int:
        self.sum = zlib.crc32(data, self.sum)
        return self._file.write(data)


def _write(file: BinaryIO, header: dict[str, Any], state: Any) -> None:
    file.write(_MAGIC + json.dumps(header).encode() + b"\n")
    summed = _Summed(file)
    pickle.Pickler(summed, protocol=5).dump(state)
    # Not forced to the disk: should the power fail, the sum tells.
    file.write(summed.sum.to_bytes(4, "little"))


def _read(file: BinaryIO, key: str) -> Any:
    if _read_header(file).get("key") != key:
        raise ValueError("it is of another run")
    start = file.tell()
    end = file.seek(-4, os.SEEK_END)
    wanted = int.from_bytes(file.read(4), "little")
    file.seek(start)
    found, left = 0, end - start
    while left > 0:
        data = file.read(min(left, 1 << 20))
        found, left = zlib.crc32(data, found), left - len(data)
    if found != wanted:
        raise ValueError("its sum is wrong")
    file.seek(start)
    return _OwnTypes(file).load()


class _OwnTypes(pickle.Unpickler):
    """Loads arrays, and classes of the rooms whose state is kept."""

    def find_class(self, module: str, name: str) -> Any:
        """Return a class that may take part."""
        if (module, name) in _FOREIGN:
            return super().find_class(module, name)
        room = module.removeprefix("tofuse.")
        if room != module and any(room == r or room.startswith(f"{r}.") for r in _ROOMS):
            found = getattr(importlib.import_module(module), name, None)
            if isinstance(found, type):
                return found
        raise pickle.UnpicklingError(f"{module}.{name} is no part of a state")
