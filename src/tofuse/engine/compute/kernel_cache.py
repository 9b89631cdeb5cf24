"""Files of compiled kernels, which can be damaged but never fatal, nor planted by somebody else.

One file holds one kernel compiled for one tuple of argument types, behind a digest of its bytes:
whatever can't be read is a miss, and is compiled and written again. Compiled code is only loaded
from a folder that no other user can have written to.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import pickle
import stat
import sys
import tempfile
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from numba.core import serialize
from numba.core.caching import NullCache
from numba.core.compiler import CompileResult

from tofuse.engine.errors import KernelCacheWarning

_DIGEST_BYTES = hashlib.sha256().digest_size


class KernelCache(NullCache):
    """Compiled variants of one kernel in a folder, as Numba's dispatchers ask for them.

    Parameters
    ----------
    function
        The kernel.
    folder
        Where its files are; None: nothing is kept.
    """

    def __init__(self, function: Callable[..., Any], folder: Path | None) -> None:
        self._name = f"{function.__module__}.{function.__qualname__}"
        self._folder = folder

    @property
    def cache_path(self) -> str | None:
        """The folder, if there is one."""
        return None if self._folder is None else str(self._folder)

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the kernel compiled for argument types; None if it must be compiled."""
        if self._folder is None:
            return None
        target_context.refresh()
        path = self._path(sig, target_context.codegen())
        try:
            content = path.read_bytes()
        except OSError:
            return None
        digest, compiled = content[:_DIGEST_BYTES], content[_DIGEST_BYTES:]
        if digest != hashlib.sha256(compiled).digest():
            return None  # saving replaces the file
        try:
            rebuild: Any = CompileResult._rebuild
            return rebuild(target_context, *pickle.loads(compiled))
        except Exception:  # whatever a file of another version may raise
            return None

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep the kernel compiled for argument types; if that fails, there is a warning."""
        if self._folder is None:
            return
        path = self._path(sig, data.codegen)
        dump: Any = serialize.dumps
        compiled = dump(data._reduce())
        temporary = path.with_suffix(f".{os.getpid()}")
        try:
            temporary.write_bytes(hashlib.sha256(compiled).digest() + compiled)
            temporary.replace(path)
        except OSError as error:
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)
            if not path.exists():  # on Windows a file that another process reads can't be replaced
                _warn(f"{self._folder}: can't be written ({error.strerror or error})")

    def _path(self, sig: Any, codegen: Any) -> Path:
        assert self._folder is not None
        key = hashlib.sha256(f"{self._name} {sig} {codegen.magic_tuple()}".encode())
        return self._folder / f"{self._name.removeprefix('tofuse.')}-{key.hexdigest()[:16]}.kernel"


@cache
def trusted_folder(name: str) -> Path | None:
    """Return the folder `name` among the caches of this user; None, with a warning, without one.

    It and its parents belong to this user or to the system, and no other user can write to them.
    """
    try:
        folder = _cache_root() / name
        folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        if problem := _problem(folder):
            _warn(problem)
            return None
    except (OSError, RuntimeError) as error:  # no home folder is a RuntimeError
        _warn(str(error))
        return None
    return folder


def _cache_root() -> Path:
    if os.environ.get("NUMBA_CACHE_DIR"):
        return Path(os.environ["NUMBA_CACHE_DIR"])
    if sys.platform == "win32":
        return Path(os.environ.get("LOCALAPPDATA", tempfile.gettempdir())) / "tofuse"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "tofuse"


def _problem(folder: Path) -> str | None:
    """Say who else could write to a folder or replace it; None if nobody can."""
    if not hasattr(os, "geteuid"):
        return None  # on Windows the folder is in the user's profile
    user = os.geteuid()
    folder = folder.resolve()
    for place in (folder, *folder.parents):
        status = place.stat()
        shared = status.st_mode & (stat.S_IWGRP | stat.S_IWOTH)
        if place != folder:
            # Nobody can replace what others own in a sticky folder such as /tmp. The group of one's
            # own folders is often one's own as well, and can't give away a folder in this name.
            if status.st_mode & stat.S_ISVTX:
                shared = 0
            elif status.st_uid == user:
                shared &= stat.S_IWOTH
        if status.st_uid not in (user, 0):
            return f"{place}: belongs to another user ({status.st_uid})"
        if shared:
            return f"{place}: other users can write to it"
    return None


@cache  # once for each problem
def _warn(problem: str) -> None:
    warnings.warn(
        f"compiled kernels are not kept, so each run compiles them anew: {problem}; "
        "NUMBA_CACHE_DIR names another folder for them",
        KernelCacheWarning,
        stacklevel=2,
    )
