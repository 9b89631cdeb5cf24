"""Replacing a folder as a whole: after a power cut or a kill it has its old content or the new one.

The new content is written into a folder beside it. In the end the old folder is renamed, then the
new one gets its place, and the old one is removed. So an old one that is still beside an empty or
missing folder shows that this was interrupted, and `finish_replacing` completes it. The folders
beside it, and the lock, have names that begin with `UNFINISHED`: whatever has such a name is
removed.
"""

from __future__ import annotations

import errno
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Self

from tofuse.engine.errors import OutputError, output_error
from tofuse.formats.files.atomic import UNFINISHED, sync, sync_tree
from tofuse.formats.files.locking import Claim


def beside(folder: Path, kind: str) -> Path:
    """Return the path beside a folder of its lock ("lock"), or its "new" or "old" content."""
    return folder.with_name(f"{UNFINISHED}{kind}-{folder.name}")


class StagedFolder:
    """New content of a folder, written beside it and then moved into its place.

    The folder is locked against other processes until `discard`. It is created at once, so that
    everything which can fail early does.

    Attributes
    ----------
    folder
        The folder, without symbolic links in its path.
    new
        Where to write the new content.
    """

    def __init__(
        self, path: str | Path, check: Callable[[Path], object], *, kept: str | None = None
    ) -> None:
        """Lock the folder, and finish an interrupted replacement of it.

        Parameters
        ----------
        path
            The folder; it may be a link to one.
        check
            Raises an error if the content of the folder may not be replaced.
        kept
            Name of a folder in it that is moved into the new content.

        Raises
        ------
        OutputError
            If another process writes into it, or it can't be replaced.
        """
        self.folder = Path(os.path.realpath(path))
        self._check, self._kept = check, kept
        self._claim: Claim | None = None
        self._complete = False
        self._created = [p for p in self.folder.parents if not p.exists()]
        try:
            _check_place(self.folder, path)
            self.new = beside(self.folder, "new")
            self.folder.parent.mkdir(parents=True, exist_ok=True)
            self._claim = Claim(beside(self.folder, "lock"), target=path)
            finish_replacing(self.folder, kept)
            check(self.folder)
            if not self.folder.exists():  # known only now: the holder of the lock creates it
                self._created.insert(0, self.folder)
            self.folder.mkdir(exist_ok=True)
            _remove(self.new)
            _check_replaceable(self.folder, path)
            self.new.mkdir()
            shutil.copymode(self.folder, self.new)
        except OSError as error:
            self.discard()
            raise output_error(error, error.filename or path) from error
        except BaseException:
            self.discard()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_error: object) -> None:
        self.discard()

    @contextmanager
    def staging(self) -> Iterator[Path]:
        """Yield the folder to write into; on success it is moved into place, else removed.

        The block should only write: its OSErrors become OutputErrors.

        Raises
        ------
        OutputError
            If something can't be written. If the new content is complete but can't be moved into
            place, it is kept, and the error says where.
        """
        try:
            yield self.new
            sync_tree(self.new)
            self._complete = True
            self._check(self.folder)
            replace_folder(self.new, self.folder, self._kept)
        except (OSError, OutputError) as error:
            reason = error if isinstance(error, OutputError) else output_error(error, self.folder)
            remedy = reason.remedy
            if self._complete:
                remedy = f"move the new result, which is complete, from {self.new}"
            raise OutputError(reason.problem, where=self._final(reason), remedy=remedy) from error
        finally:
            self.discard()

    def discard(self) -> None:
        """Remove new content that is not complete, and empty new folders; release the lock."""
        claim, self._claim = self._claim, None
        if claim is not None:
            try:
                if not self._complete:
                    shutil.rmtree(self.new, ignore_errors=True)
            finally:
                claim.release()
        for folder in self._created:
            with suppress(OSError):
                folder.rmdir()

    def _final(self, error: OutputError) -> Path:
        """The final place of the file that an error names."""
        path = Path(error.where or self.folder)
        return self.folder / path.relative_to(self.new) if path.is_relative_to(self.new) else path


@contextmanager
def replacing_folder(
    path: str | Path, check: Callable[[Path], object] = lambda _folder: None
) -> Iterator[Path]:
    """Yield a temporary folder that replaces `path` if the block succeeds; see `StagedFolder`."""
    with StagedFolder(path, check) as staged, staged.staging() as folder:
        yield folder


@contextmanager
def new_folder(path: str | Path) -> Iterator[Path]:
    """Yield a temporary folder that becomes `path` if the block succeeds; see `replacing_folder`.

    Raises
    ------
    OutputError
        If `path` exists and is not an empty folder, or can't be written.
    """
    with replacing_folder(path, lambda _folder: check_new(path)) as folder:
        yield folder


def check_new(path: str | Path) -> None:
    """Raise OutputError if `path` exists and is not an empty folder."""
    folder = Path(path)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise OutputError("isn't empty", where=path, remedy="choose a new folder")


def replace_folder(new: Path, path: Path, kept: str | None = None) -> None:
    """Move a folder into the place of another one on the same disk, with its folder `kept`.

    Raises
    ------
    OSError
        If that fails; both are as before.
    """
    old = beside(path, "old")
    os.replace(path, old)
    try:
        _move_into_place(new, path, old, kept)
    except OSError:
        if kept and (new / kept).exists():
            os.replace(new / kept, old / kept)
        os.replace(old, path)
        raise
    except BaseException:  # a signal: the new content is complete
        finish_replacing(path, kept)
        raise
    with suppress(OSError):  # the next replacement removes it
        _remove(old)


def finish_replacing(path: Path, kept: str | None = None) -> None:
    """Complete a replacement of a folder that was interrupted, if any.

    Raises
    ------
    OSError
        If that fails; calling again is safe.
    """
    new, old = beside(path, "new"), beside(path, "old")
    if not old.exists():
        return
    if not path.exists() or not any(path.iterdir()):
        if path.exists():
            path.rmdir()
        if new.exists():
            _move_into_place(new, path, old, kept)
        else:
            os.replace(old, path)
            sync(path.parent)
    _remove(old)


def is_interrupted(path: Path) -> bool:
    """Whether the replacement of a folder was interrupted, so that it is missing."""
    return not path.exists() and beside(path, "old").exists()


def _move_into_place(new: Path, path: Path, old: Path, kept: str | None) -> None:
    if kept and (old / kept).exists():
        os.replace(old / kept, new / kept)
    os.replace(new, path)
    sync(path.parent)


def _remove(folder: Path) -> None:
    if os.path.lexists(folder):
        shutil.rmtree(folder)


def _check_place(folder: Path, path: str | Path) -> None:
    if folder.exists() and not folder.is_dir():
        raise OutputError("is a file", where=path, remedy="choose a folder")
    if folder == folder.parent or Path.cwd().is_relative_to(folder):
        raise OutputError(
            "is or contains the current folder, and can't be replaced",
            where=path,
            remedy="choose another folder, or run the command in another one",
        )


def _check_replaceable(folder: Path, path: str | Path) -> None:
    """Find out now, not after hours, if a folder is read-only, in use or a mount point."""
    if not os.access(folder, os.W_OK):
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
    old = beside(folder, "old")
    try:
        os.replace(folder, old)
    except OSError as error:
        raise OutputError(
            f"can't be renamed ({error.strerror or error}), as results are replaced as a whole",
            where=path,
            remedy="choose another folder, such as one inside it",
        ) from error
    os.replace(old, folder)
