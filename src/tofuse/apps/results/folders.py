"""The output folder of a run: locked first, written beside it, moved into place at the end.

A folder is not modified before it is known to contain an earlier result and nothing else.
"""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager, nullcontext
from dataclasses import dataclass
from pathlib import Path

from tofuse.engine.errors import InputError, OutputError, output_error
from tofuse.formats.files import Claim, atomic, reading, staging

TRACKED = f"{atomic.UNFINISHED}tracked.npz"  # tracked frames of an interrupted run
RECORDING = "recording"  # written by `tofuse demo` next to its result, and kept with it

# Files of a result, by `tofuse run` and `tofuse export`; all of them are removed with it.
_FILE = (
    r"trajectory\.(txt|kitti\.txt|log)|rig_trajectory\.txt|pose_graph\.g2o|changes\.ply|mirrors\.ply|"
    r"cloud\.(ply|pcd|las|laz|e57)|mesh\.(ply|glb|gltf|obj|mtl|png|jpg|stl|usdz)|"
    r"result\.(rrd|mcap)|(occupancy|esdf)\.npz|octomap\.bt|"
    r"report\.html|share\.(html|usdz)|(run|judge)\.json|"
    # Of version 0.2 only.
    r"view\.npz|tiles/(tileset\.json|\d{1,4}(-\d{1,9}){3}\.glb)"
)
# The model of a separate component is in its own folder, with the same files.
_COMPONENT = re.compile(r"component-[1-9]\d{0,5}", re.ASCII)
_IMAGES = r"(images|depth|sigma|masks|sparse)/.+"  # exported, with their poses
_OF_SYSTEMS = re.compile(r"(.*/)?(\.DS_Store|Thumbs\.db|desktop\.ini)")


@dataclass(frozen=True)
class Contract:
    """What one kind of result consists of.

    Attributes
    ----------
    files
        Pattern of the paths of its files, relative to its folder.
    marker
        The file by which it is recognised.
    keys
        What the JSON object in that file has, apart from `schema` and `version`.
    """

    files: re.Pattern[str]
    marker: str
    keys: frozenset[str]

    @classmethod
    def of_files(cls, marker: str, *others: str, keys: Iterable[str]) -> Contract:
        """Return the contract of a result that consists of these files alone."""
        names = "|".join(map(re.escape, (marker, *others)))
        return cls(re.compile(names), marker, frozenset(keys))

    def is_ours(self, folder: Path) -> bool:
        """Whether a folder contains a result of this kind."""
        data = read_json_object(folder / self.marker)
        return data is not None and {"schema", "version", *self.keys} <= set(data)

    def foreign(self, folder: Path, prefix: str = "") -> str | None:
        """Return the path of a file or link in a folder that no such result has, relative to it.

        Parameters
        ----------
        folder
            The folder; its recording and files of an interrupted run are ignored.
        prefix
            Its path in the result, with a slash at the end.
        """
        for parent, folders, names in os.walk(folder):
            relative = Path(parent).relative_to(folder)
            if parent == str(folder):
                folders[:] = [f for f in folders if f != RECORDING or prefix]
            folders[:] = sorted(f for f in folders if not f.startswith(atomic.UNFINISHED))
            links = [f for f in folders if (Path(parent) / f).is_symlink()]
            for name in (*links, *sorted(n for n in names if not n.startswith(atomic.UNFINISHED))):
                path = (relative / name).as_posix()
                known = self.files.fullmatch(prefix + path) or _OF_SYSTEMS.fullmatch(path)
                if not known or (Path(parent) / name).is_symlink():
                    return path
        return None


class OutputFolder(staging.StagedFolder):
    """A folder that a run may write into, locked against other processes.

    The constructor checks everything that can be checked before hours of work: that the folder is
    empty or has an earlier result, that no other process writes into it, and that it can be
    replaced.

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
        self.path = reading.path_of(path, "folder", "pass the path of a folder")
        self._contract, self._overwrite = contract or RESULT, overwrite
        super().__init__(self.path, self._check_content, kept=RECORDING)
        self._overwrite = True  # of a recording that is simulated meanwhile

    def _check_content(self, folder: Path) -> None:
        """Reject a folder with anything but a result that may be replaced."""
        if not folder.exists():
            if self.path.is_symlink():
                raise OutputError(
                    f"is a link to {os.readlink(self.path)}, which doesn't exist",
                    where=self.path,
                    remedy="create its target, or pass another folder",
                )
            return
        entries = {p.name for p in folder.iterdir() if not p.name.startswith(atomic.UNFINISHED)}
        if not entries:
            return
        if not self._contract.is_ours(folder) and entries - {RECORDING}:
            raise OutputError(
                f"contains {min(entries)}, but no earlier result of this command",
                where=self.path,
                remedy="pass a new or empty folder",
            )
        if not self._overwrite:
            recording = entries == {RECORDING}
            raise OutputError(
                "contains a recording" if recording else "contains an earlier result",
                where=self.path,
                remedy="pass --overwrite to replace it, or another folder",
            )
        if foreign := self._contract.foreign(folder):
            raise OutputError(
                "is not a file of an earlier result",
                where=self.path / foreign,
                remedy="move it away, or choose another folder",
            )


@dataclass(frozen=True)
class OutputOptions:
    """Options of a command that writes its result if there is a folder for it.

    Attributes
    ----------
    out
        Folder for the result; None writes none.
    overwrite
        Whether an earlier result there is replaced.
    """

    out: Path | None = None
    overwrite: bool = False

    def folder(
        self, contract: Contract | None = None
    ) -> AbstractContextManager[OutputFolder | None]:
        """Return the folder, None in a context if there is none; see `OutputFolder` for errors."""
        if self.out is None:
            return nullcontext()
        return OutputFolder(self.out, overwrite=self.overwrite, contract=contract)


def check_output(path: Path, *, overwrite: bool) -> None:
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
    OutputFolder(path, overwrite=overwrite).discard()


@contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Hold the lock of a result, or that of a component, in the block: no run replaces it then.

    Other folders are not locked.

    Raises
    ------
    OutputError
        If another process writes into it, or it can't be written.
    """
    result = result_folder(folder)
    with ExitStack() as stack:
        if is_result(result):
            stack.callback(Claim(staging.beside(result, "lock"), target=result).release)
        yield


def result_folder(folder: Path) -> Path:
    """Return the result that the folder of a component belongs to; any other folder itself."""
    folder = Path(os.path.realpath(folder))
    is_component = component_number(folder) is not None and is_result(folder.parent)
    return folder.parent if is_component else folder


def finish_interrupted(folder: Path) -> None:
    """Finish the replacement of a result that was interrupted, so that it can be read.

    Raises
    ------
    InputError
        If another process is replacing it, or that can't be finished.
    """
    place = Path(os.path.realpath(folder))
    if not staging.is_interrupted(place):
        return
    try:
        with ExitStack() as stack:
            stack.callback(Claim(staging.beside(place, "lock"), target=folder).release)
            staging.finish_replacing(place, RECORDING)
    except (OutputError, OSError) as error:
        reason = error if isinstance(error, OutputError) else output_error(error, folder)
        raise InputError(
            f"is being replaced, or that was interrupted: {reason.problem}",
            where=folder,
            remedy="wait until it is done, or make the folder that it is in writable",
        ) from error


def check_result(folder: Path) -> None:
    """Check that a folder contains a result, after finishing its interrupted replacement.

    Raises
    ------
    InputError
        If there is none, or another process is replacing it.
    """
    finish_interrupted(result_folder(folder))
    if not is_result(folder):
        marker = folder / RESULT.marker
        if marker.exists():
            raise InputError(
                "is damaged, or not a run.json of tofuse",
                where=marker,
                remedy="copy the whole folder again, or run again",
            )
        raise InputError(
            "is not a result (no run.json)" if folder.exists() else "doesn't exist",
            where=folder,
            remedy="pass the folder of a result",
        )


def is_result(folder: Path) -> bool:
    """Whether a folder contains the result of a run."""
    return RESULT.is_ours(folder)


def result_of_poses(path: Path) -> Path | None:
    """Return the result whose poses a path names: itself, or by its trajectory.txt; else None."""
    if path.name == "trajectory.txt":
        return path.parent if is_result(path.parent) else None
    return path if named_result(path) else None


def named_result(path: Path) -> bool:
    """Whether a path names the folder of a result, which is checked.

    Raises
    ------
    InputError
        If its run.json is damaged: nothing else that is read has one.
    """
    if not (path / RESULT.marker).is_file():
        return False
    check_result(path)
    return True


def read_json_object(path: Path) -> dict[str, object] | None:
    """Return the object in a JSON file; None if it can't be read or is something else."""
    try:
        data = json.loads(reading.read_text(path))
    except (InputError, ValueError, RecursionError):
        return None
    return data if isinstance(data, dict) else None


def component_name(number: int) -> str:
    """Return the name of the folder of a component with its own model."""
    return f"component-{number}"


def component_number(folder: Path) -> int | None:
    """Return the number of the component that a folder is named after; None for any other name."""
    return int(folder.name.split("-")[1]) if _COMPONENT.fullmatch(folder.name) else None


_EXPORTED = rf"nerfstudio/(transforms\.json|points\.ply|{_IMAGES})|colmap/{_IMAGES}"
RESULT = Contract(
    re.compile(rf"({_COMPONENT.pattern}/)?({_FILE})|{_EXPORTED}", re.ASCII),
    "run.json",
    frozenset({"verdict"}),
)
