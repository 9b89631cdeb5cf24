"""Damaged files of compiled kernels, full disks, and folders of another user.

Whatever the folder holds, a kernel must compute its value, and nothing foreign may be executed.
Where the folder can be used, the next process must find a kernel in it again.
"""

from __future__ import annotations

import errno
import os
import pickle
import warnings
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path
from typing import Any
from unittest import mock

import numba
import numpy as np

from tofuse.engine.compute import kernel_cache
from tofuse.engine.errors import KernelCacheWarning

_FOREIGN_USER = 65534


def _twice(x: float) -> float:
    return 2 * x


def _compiled(folder: Path | None) -> Any:
    compiled: Any = numba.njit(_twice)
    compiled._cache = kernel_cache.KernelCache(_twice, lambda: folder)
    return compiled


class _Planted:
    """A pickle that makes a file when it is loaded."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def __reduce__(self) -> tuple[Callable[..., Any], tuple[Any, ...]]:
        return Path.touch, (self._path,)


def _changed(data: bytes, rng: np.random.Generator) -> bytes:
    changed = bytearray(data)
    for _ in range(1 + int(rng.integers(64))):
        changed[int(rng.integers(len(data)))] ^= 1 + int(rng.integers(255))
    return bytes(changed)


def _put(change: Callable[[bytes, np.random.Generator], bytes]) -> Callable[..., None]:
    def damage(file: Path, rng: np.random.Generator, _planted: Path) -> None:
        file.write_bytes(change(file.read_bytes(), rng))

    return damage


def _plant(file: Path, _rng: np.random.Generator, planted: Path) -> None:
    file.write_bytes(pickle.dumps(_Planted(planted)))


def _plant_after_digest(file: Path, _rng: np.random.Generator, planted: Path) -> None:
    """Keep the digest of the kernel before a foreign pickle."""
    file.write_bytes(file.read_bytes()[:32] + pickle.dumps(_Planted(planted)))


def _link(file: Path, _rng: np.random.Generator, _planted: Path) -> None:
    file.unlink()
    file.symlink_to("nowhere")


def _folder(file: Path, _rng: np.random.Generator, _planted: Path) -> None:
    file.unlink()
    file.mkdir()


def _removed(file: Path, _rng: np.random.Generator, _planted: Path) -> None:
    file.unlink()


def _half_written(file: Path, _rng: np.random.Generator, _planted: Path) -> None:
    """Leave the temporary file of a process that was killed."""
    file.rename(file.with_suffix(".4711"))


DAMAGES: dict[str, Callable[[Path, np.random.Generator, Path], None]] = {
    "empty": _put(lambda data, rng: b""),
    "cut": _put(lambda data, rng: data[: rng.integers(len(data))]),
    "changed": _put(_changed),
    "zeros": _put(lambda data, rng: bytes(len(data))),
    "longer": _put(lambda data, rng: data + rng.bytes(100)),
    "noise": _put(lambda data, rng: rng.bytes(int(rng.integers(5000)))),
    "foreign pickle": _plant,
    "foreign pickle after the digest": _plant_after_digest,
    "dangling link": _link,
    "folder": _folder,
    "removed": _removed,
    "half written": _half_written,
}
HOSTILE = ("full disk", "full disk from the start", "of another user", "writable by others")
KINDS = (*DAMAGES, *HOSTILE)


def attack(kind: str, seed: int, base: Path) -> str:
    """Damage the cache in a new folder below `base`; return the fault, or nothing."""
    rng = np.random.default_rng([seed, *kind.encode()])
    home = base / f"{kind.replace(' ', '-')}-{seed}"
    home.mkdir(mode=0o755)
    kernel_cache.trusted_folder.cache_clear()
    kernel_cache._warn.cache_clear()
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", KernelCacheWarning)
            with mock.patch.dict(os.environ, {"NUMBA_CACHE_DIR": str(home)}):
                return _attack(kind, rng, home)
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    finally:
        kernel_cache.trusted_folder.cache_clear()


def _attack(kind: str, rng: np.random.Generator, home: Path) -> str:
    planted = home / "planted"
    folder = kernel_cache.trusted_folder("kernels")
    if folder is None:
        return "a private folder was not used"
    if kind != "full disk from the start" and _compiled(folder)(2.0) != 4.0:
        return "wrong value"
    for file in sorted(folder.iterdir()):
        if kind in DAMAGES:
            DAMAGES[kind](file, rng, planted)
        else:
            _plant(file, rng, planted)
    if kind in ("of another user", "writable by others"):
        return _from_untrusted(kind, folder, planted)
    full = kind.startswith("full disk")
    with mock.patch.object(Path, "write_bytes", _no_space) if full else nullcontext():
        if _compiled(folder)(2.0) != 4.0:
            return "wrong value"
    if planted.exists():
        return "a foreign pickle was executed"
    if full or kind == "folder":
        return ""
    mended = _compiled(folder)
    if mended(2.0) != 4.0:
        return "wrong value afterwards"
    return "" if sum(mended.stats.cache_hits.values()) == 1 else "not mended"


def _from_untrusted(kind: str, folder: Path, planted: Path) -> str:
    """Compile beside a folder in which another user may have planted files."""
    if kind == "writable by others":
        folder.chmod(0o777)
    elif os.geteuid() == 0:
        os.chown(folder, _FOREIGN_USER, _FOREIGN_USER)
    else:
        return ""  # only root can give a folder away
    kernel_cache.trusted_folder.cache_clear()
    used = kernel_cache.trusted_folder("kernels")
    if used is not None:
        return "was used"
    if _compiled(used)(2.0) != 4.0:
        return "wrong value"
    return "a foreign pickle was executed" if planted.exists() else ""


def _no_space(path: Path, _data: bytes) -> int:
    path.touch()
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
