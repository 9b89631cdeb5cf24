"""The output folder of a run: locked first, staged inside, moved into place at the end.

A folder is not modified before it is known to contain an earlier result. One process at a
time may write into it. A process that is stopped while it moves a result into place leaves a plan
by which the next one, reading or writing, finishes the moves (`files.moving`).
"""

from __future__ import annotations

import contextlib
import json
import os
import re
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Self

from tofuse.errors import InputError, OutputError
from tofuse.files.atomic import UNFINISHED
from tofuse.files.locking import Claim
from tofuse.files.reading import path_of, read_text
from tofuse.files.staging import (
    Names,
    check_interrupted,
    clear,
    is_interrupted,
    move_all,
    not_a_result_error,
    recover,
    result_locations,
)

STAGING = f"{UNFINISHED}unfinished"
LOCK = f"{UNFINISHED}lock"
TRACKED = f"{UNFINISHED}tracked.npz"  # tracked frames of an interrupted run
RECORDING = "recording"  # written by `tofuse demo` next to its result

# Files of a result, by `tofuse run` and `tofuse export`; all of them are removed with it.
FILES = (
    "trajectory.txt",
    "pose_graph.g2o",
    "cloud.ply",
    "mesh.ply",
    "mesh.glb",
    "changes.ply",
    "mesh.obj",
    "mesh.mtl",
    "mesh.png",
    "mesh.jpg",
    "mesh.usdz",
    "mesh.stl",
    "report.html",
    "view.npz",
    "run.json",
    "judge.json",
    "rig_trajectory.txt",
    "cloud.pcd",
    "cloud.las",
    "cloud.laz",
    "cloud.e57",
    "mesh.gltf",
    "trajectory.kitti.txt",
    "trajectory.log",
)
# Large surfaces are in tiles, in their own folder (`results.tiles`).
TILES, TILESET = "tiles", "tileset.json"
_TILES = Names(
    frozenset({TILESET}), file_pattern=re.compile(r"\d{1,4}(-\d{1,9}){3}\.glb", re.ASCII)
)
_WITH_TILES = (re.compile(re.escape(TILES)), _TILES)
# The model of a separate component is in its own folder, with the same files.
_COMPONENT = re.compile(r"component-[1-9]\d{0,5}", re.ASCII)


@dataclass(frozen=True)
class Contract:
    """The files of one kind of result.

    Attributes
    ----------
    names
        Names of the files and folders that it may contain.
    marker
        The file that is moved into place last: if it exists, the result is complete.
    is_ours
        Whether a folder contains a result of this kind, by its marker.
    """

    names: Names
    marker: str
    is_ours: Callable[[Path], bool]


class OutputFolder:
    """A folder that a run may write into, locked against other processes.

    The constructor checks everything that can be checked before hours of work: that the folder is
    empty or has an earlier result, that no other process writes into it, and that it is writable.

    Files and folders (`tiles`, `component-1` and so on) are moved into place as a whole. Links are
    moved as links, and never followed.

    The lock is released when the result is written; in a `with` statement, at its end.
    """

    def __init__(
        self, path: str | Path, *, overwrite: bool = False, contract: Contract | None = None
    ) -> None:
        """Check, create and lock the folder.

        Parameters
        ----------
        path
            The folder.
        overwrite
            Whether an earlier result may be replaced.
        contract
            What will be written; by default the files of a run.

        Raises
        ------
        OutputError
            If it contains anything but an earlier result, or a result and `overwrite` is not set,
            or another process writes into it, or it can't be written.
        """
        self.path = path_of(path, "folder", "pass the path of a folder")
        self._contract = contract or RESULT
        self._names = self._contract.names
        self._staging = self.path / STAGING
        self._created: list[Path] = []
        self._claim: Claim | None = None
        self._entered = False
        try:
            # Before any change, and again under the lock.
            _check_content(self.path, self._contract, overwrite)
            self._created = [p for p in (self.path, *self.path.parents) if not p.exists()]
            self.path.mkdir(parents=True, exist_ok=True)
            self._claim = Claim(self.path / LOCK, target=self.path)
            _recover(self.path, self._contract)
            _check_content(self.path, self._contract, overwrite)
            if not clear(self._staging, self._names):
                raise not_a_result_error(self._staging)
            self._staging.mkdir()
        except OSError as error:
            self.discard()
            raise _output_error(self.path, error) from error
        except BaseException:
            self.discard()
            raise

    def __enter__(self) -> Self:
        self._entered = True
        return self

    def __exit__(
        self, kind: type[BaseException] | None, value: object, trace: TracebackType | None
    ) -> None:
        self._entered = False
        self.discard()

    @contextmanager
    def staging(self) -> Iterator[Path]:
        """Yield a folder to write into; on success all of it is moved into place, else nothing.

        Files of an earlier result that were not written again are removed.
        """
        try:
            yield self._staging
            move_all(self._staging, self.path, self._names, self._contract.marker)
        except OutputError as error:
            # The path in its final place, not in the staging folder.
            where = self._final(error.where or "")
            raise OutputError(error.problem, where=where, remedy=error.remedy) from error
        except OSError as error:
            raise _output_error(self.path, error) from error
        finally:
            if self._entered:
                self._clear()
            else:
                self.discard()

    def _final(self, staged: str) -> Path:
        path = Path(staged)
        if path.is_relative_to(self._staging):
            return self.path / path.relative_to(self._staging)
        return path if path.is_relative_to(self.path) else self.path / path.name

    def _clear(self) -> None:
        if self._claim is not None and not is_interrupted(self._staging):
            clear(self._staging, self._names)

    def discard(self) -> None:
        """Remove unfinished files, and folders that were created for them if they are empty."""
        try:
            self._clear()
        finally:
            if self._claim is not None:
                self._claim.release()
                self._claim = None
        with contextlib.suppress(OSError):
            for folder in self._created:
                folder.rmdir()


def check_output(path: str | Path, *, overwrite: bool) -> None:
    """Check early whether `OutputFolder` will accept a folder, before long work.

    Parameters
    ----------
    path, overwrite
        As for `OutputFolder`.

    Raises
    ------
    OutputError
        If the folder can't be written into, or another process writes into it.
    """
    path = Path(path)
    lock = path / LOCK
    if os.path.lexists(lock):
        Claim(lock, target=path).release()
    try:
        _check_content(path, RESULT, overwrite)
    except OSError as error:
        raise _output_error(path, error) from error


def _check_content(path: Path, contract: Contract, overwrite: bool) -> None:
    """Reject a folder with anything but a result that may be replaced."""
    staging = path / STAGING
    if path.exists() and not path.is_dir():
        raise OutputError("is a file", where=path, remedy="pass a folder as --out")
    if is_interrupted(staging):
        check_interrupted(staging, contract.names, contract.marker)
        if any(contract.is_ours(place) for place in result_locations(staging, path)):
            return
    entries = {p.name for p in path.iterdir()} if path.exists() else set()
    entries -= {name for name in entries if name.startswith(UNFINISHED)}
    if not entries:
        return
    if not contract.is_ours(path) and entries - {RECORDING}:
        raise OutputError(
            "is not empty and contains no earlier result of this command",
            where=path,
            remedy="pass a new or empty folder as --out",
        )
    if not overwrite:
        raise OutputError(
            "contains an earlier result" if contract.marker in entries else "contains a recording",
            where=path,
            remedy="pass --overwrite to replace it, or another --out",
        )
    for name in sorted(entries):
        if contract.names.folder(name) and not contract.names.is_result_folder(path / name):
            raise not_a_result_error(path / name)


def lock_folder(folder: Path) -> Path:
    """Return the folder whose lock protects a folder: for a component's folder, its result's."""
    parent = folder.resolve().parent
    if component_number(folder.resolve()) is not None and is_result(parent):
        return parent
    return folder


@contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Hold the lock of a folder in the block, so that no run replaces its content.

    Raises
    ------
    OutputError
        If another process writes into it, or it can't be written.
    """
    locked = lock_folder(folder)
    claim = Claim(locked / LOCK, target=locked)
    try:
        yield
    finally:
        claim.release()


def _recover(folder: Path, contract: Contract) -> None:
    """Finish the moves of an interrupted process."""
    staging = folder / STAGING
    if not is_interrupted(staging):
        return
    check_interrupted(staging, contract.names, contract.marker)
    if not any(contract.is_ours(place) for place in result_locations(staging, folder)):
        raise not_a_result_error(folder)
    recover(staging, folder, contract.names, contract.marker)


def _output_error(path: Path, error: OSError) -> OutputError:
    if path.is_symlink() and not path.exists():
        return OutputError(
            f"is a link to {os.readlink(path)}, which doesn't exist",
            where=path,
            remedy="create its target, or pass another --out",
        )
    return OutputError(
        f"can't be written ({error.strerror or error})",
        where=path,
        remedy="check the permissions and the free space, or pass another --out",
    )


def finish_interrupted(folder: Path) -> None:
    """Finish moves that were interrupted, so that a result can be read.

    Raises
    ------
    InputError
        If another process is moving a result into place, or interrupted moves can't be finished.
    """
    staging = folder / STAGING
    if not is_interrupted(staging):
        return
    try:
        claim = Claim(folder / LOCK, target=folder)
        try:
            _recover(folder, RESULT)
            clear(staging, RESULT.names)
        finally:
            claim.release()
    except OutputError as error:
        raise InputError(
            f"a result is being moved into place: {error.problem}",
            where=error.where,
            remedy=error.remedy,
        ) from error
    except OSError as error:
        raise InputError(
            f"moving a result into place was interrupted, and can't be finished "
            f"({error.strerror or error})",
            where=folder,
            remedy="copy the folder, with hidden files, to a writable place, and try again",
        ) from error


def is_result(folder: Path) -> bool:
    """Whether a folder contains the result of a run."""
    data = read_json_object(folder / RESULT.marker)
    return data is not None and {"schema", "version", "verdict"} <= set(data)


def read_json_object(path: Path) -> dict[str, object] | None:
    """Return the object in a JSON file; None if it can't be read or is something else."""
    try:
        data = json.loads(read_text(path))
    except (InputError, ValueError, RecursionError):
        return None
    return data if isinstance(data, dict) else None


def component_name(number: int) -> str:
    """Return the name of the folder of a component with its own model."""
    return f"component-{number}"


def component_number(folder: Path) -> int | None:
    """Return the number of the component that a folder is named after; None for any other name."""
    return int(folder.name.split("-")[1]) if _COMPONENT.fullmatch(folder.name) else None


_MODEL = Names(frozenset(FILES), (_WITH_TILES,))
RESULT = Contract(
    Names(frozenset(FILES), (_WITH_TILES, (_COMPONENT, _MODEL))), "run.json", is_result
)
