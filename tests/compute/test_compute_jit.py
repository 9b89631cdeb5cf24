"""Compiled kernels without a writable cache, and a cache that can't become stale."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tofuse.engine.compute import jit

_COMPILE = """
import numpy as np
from tofuse.engine.compute import jit
from tofuse.formats.geometry.lzf_kernels import lzf_decompress
out = np.zeros(3, np.uint8)
assert lzf_decompress(np.frombuffer(bytes([2]) + b"abc", np.uint8), out) == 3
print(out.tobytes().decode())
print(jit.cache_folder())
"""


def _run(env: dict[str, str], code: str = _COMPILE) -> tuple[list[str], str]:
    clean = {k: v for k, v in os.environ.items() if k not in ("NUMBA_CACHE_DIR", "XDG_CACHE_HOME")}
    done = subprocess.run(
        [sys.executable, "-c", code], env=clean | env, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines(), done.stderr


@pytest.mark.nightly_part
@pytest.mark.skipif(sys.platform == "win32", reason="the home folder is used on POSIX systems only")
@pytest.mark.parametrize("place", ["file", "missing"])
def test_unwritable_home_is_a_warning(tmp_path, place) -> None:
    # Even root can't write below a file, nor into /proc.
    if place == "file":
        home = tmp_path / "home"
        home.write_text("not a folder")
    else:
        home = Path("/proc/no-such-home")
    env = {"HOME": str(home), "XDG_CACHE_HOME": str(home / "cache"), "TMPDIR": str(tmp_path)}
    (text, folder), messages = _run(env)
    assert text == "abc"
    assert folder == "None"
    assert "compiled kernels are not kept" in messages
    assert str(home) in messages
    assert [p.name for p in tmp_path.iterdir()] == (["home"] if place == "file" else [])


@pytest.mark.nightly_part
def test_writable_cache_is_kept_and_reused(tmp_path) -> None:
    env = {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    (text, folder), messages = _run(env)
    assert text == "abc"
    assert not messages
    assert Path(folder) == tmp_path / "cache" / f"kernels-{jit.source_hash()}"
    stamps = {p: p.stat().st_mtime_ns for p in Path(folder).rglob("*")}
    assert len(stamps) > 0
    assert _run(env)[0][0] == "abc"
    assert {p: p.stat().st_mtime_ns for p in Path(folder).rglob("*")} == stamps  # reused


def test_cache_key_changes_with_any_kernel(tmp_path: Path) -> None:
    """Also with one in another folder, which may be a callee."""
    package = Path(jit.__file__).parents[2]
    files = jit.kernel_files()
    assert {f.parent.parent.name for f in files} >= {"engine", "lab"}

    def hash_of_copy(name: str, *, changed: str = "", renamed: str = "") -> str:
        copy = tmp_path / name
        for file in files:
            relative = file.relative_to(package)
            target = copy / (
                relative.with_name("x_kernels.py") if file.name == renamed else relative
            )
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(file.read_bytes() + (b"# changed" if file.name == changed else b""))
        return jit.source_hash(copy)

    same = hash_of_copy("same")
    assert same == jit.source_hash()
    changed = hash_of_copy("changed", changed="tukey_kernels.py")
    renamed = hash_of_copy("renamed", renamed="tukey_kernels.py")
    assert len({same, changed, renamed}) == 3


def test_kernels_are_in_files_that_the_cache_key_covers() -> None:
    package = Path(jit.__file__).parents[2]
    for file in package.rglob("*.py"):
        if "\n@kernel\n" in file.read_text("utf-8"):
            assert file in jit.kernel_files()
