"""Files of compiled kernels, which can be damaged but never fatal, nor planted by somebody else.

One file holds one kernel compiled for one tuple of argument types, behind a digest of its bytes:
whatever can't be read is a miss, and is compiled and written again. Compiled code is only loaded
from a folder that no other user can have written to, or that is part of the installed package:
wheels contain kernels that run on any processor of the last ten years.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import pickle
import platform
import stat
import sys
import tempfile
import warnings
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from llvmlite import binding
from numba.core import serialize
from numba.core.caching import NullCache
from numba.core.compiler import CompileResult

from tofuse.engine.errors import KernelCacheWarning

_DIGEST_BYTES = hashlib.sha256().digest_size


class Processor(NamedTuple):
    """What compiled code is for: a processor and its features, in LLVM's names."""

    name: str
    features: str


# Processors that the kernels in wheels are for, by the family that `platform.machine` names. Those
# of arm64 need no features beyond the family's.
_SHIPPED = {
    "x86_64": Processor("x86-64-v3", "+avx,+avx2,+bmi,+bmi2,+f16c,+fma,+lzcnt,+movbe,+popcnt"),
    "aarch64": Processor("generic", ""),
    "arm64": Processor("apple-m1", ""),
}


def shipped_processor() -> Processor | None:
    """Return the processor that kernels in wheels for this system are for, if there are any."""
    return _SHIPPED.get(platform.machine().lower().replace("amd64", "x86_64"))


def runs_here(processor: Processor) -> bool:
    """Whether the processor of this machine has the features of another one."""
    if not processor.features:
        return True
    present = binding.get_host_cpu_features()
    return all(present.get(feature.lstrip("+")) for feature in processor.features.split(","))


class KernelCache(NullCache):
    """Compiled variants of one kernel in a folder, as Numba's dispatchers ask for them.

    Parameters
    ----------
    function
        The kernel.
    own_folder
        Returns where files are kept; None: nothing is kept.
    shipped
        A folder of the package with more files, and the processor that they are for.
    """

    def __init__(
        self,
        function: Callable[..., Any],
        own_folder: Callable[[], Path | None],
        shipped: tuple[Path, Processor] | None = None,
    ) -> None:
        self._name = f"{function.__module__}.{function.__qualname__}"
        self._own_folder = own_folder
        self._shipped = shipped

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """Return the kernel compiled for argument types; None if it must be compiled."""
        target_context.refresh()
        if self._shipped is not None:
            folder, processor = self._shipped
            compiled = _load(folder / self._file(sig, processor), target_context)
            if compiled is not None:
                return compiled
        own = self._own_folder()
        if own is None:
            return None
        return _load(own / self._file(sig, _target(target_context.codegen())), target_context)

    def save_overload(self, sig: Any, data: Any) -> None:
        """Keep the kernel compiled for argument types; if that fails, there is a warning."""
        folder = self._own_folder()
        if folder is None:
            return
        path = folder / self._file(sig, _target(data.codegen))
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
                _warn(f"{folder}: can't be written ({error.strerror or error})")

    def _file(self, sig: Any, processor: Processor) -> str:
        key = hashlib.sha256(f"{self._name} {sig} {sys.platform} {tuple(processor)}".encode())
        return f"{self._name.removeprefix('tofuse.')}-{key.hexdigest()[:16]}.kernel"


def _target(codegen: Any) -> Processor:
    """Return what this process compiles for: this processor, unless Numba was told otherwise."""
    _, name, features = codegen.magic_tuple()
    return Processor(name, features)


def _load(path: Path, target_context: Any) -> Any:
    """Return the kernel in a file; None if it can't be read."""
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
