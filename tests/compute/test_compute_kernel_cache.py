"""Files of compiled kernels that are damaged, can't be written, or could be another user's."""

from __future__ import annotations

import errno
import os
import platform
import warnings
from pathlib import Path

import numba
import pytest
from numba.core import registry

from tofuse.engine.compute import kernel_cache
from tofuse.engine.compute.kernel_cache import KernelCache, trusted_folder
from tofuse.engine.errors import KernelCacheWarning


def twice(x):
    return 2 * x


def dispatcher(folder: Path | None):
    compiled = numba.njit(twice)
    compiled._cache = KernelCache(twice, lambda: folder)
    return compiled


def was_loaded(compiled) -> bool:
    return sum(compiled.stats.cache_hits.values()) == 1


@pytest.fixture(autouse=True)
def _forgotten():
    trusted_folder.cache_clear()
    kernel_cache._warn.cache_clear()
    yield
    trusted_folder.cache_clear()


def test_kernel_is_loaded_by_argument_types(tmp_path) -> None:
    first, second = dispatcher(tmp_path), dispatcher(tmp_path)
    assert first(2.0) == 4.0
    assert not was_loaded(first)
    assert second(3.0) == 6.0
    assert was_loaded(second)
    assert second(3) == 6
    assert len(list(tmp_path.iterdir())) == 2


@pytest.mark.parametrize("damage", ["empty", "cut", "head", "changed", "foreign"])
def test_damaged_file_is_compiled_and_written_again(tmp_path, damage) -> None:
    assert dispatcher(tmp_path)(2.0) == 4.0
    (file,) = tmp_path.iterdir()
    whole = file.read_bytes()
    middle = len(whole) // 2
    file.write_bytes(
        {
            "empty": b"",
            "cut": whole[:middle],
            "head": whole[:20],
            "changed": whole[:middle] + bytes(64) + whole[middle + 64 :],
            "foreign": b"cos\nsystem\n(S'exit 1'\ntR.",
        }[damage]
    )
    mending = dispatcher(tmp_path)
    assert mending(2.0) == 4.0
    assert not was_loaded(mending)
    assert [p.name for p in tmp_path.iterdir()] == [file.name]
    mended = dispatcher(tmp_path)
    assert mended(2.0) == 4.0
    assert was_loaded(mended)


def test_intact_file_of_another_version_is_compiled_again(tmp_path) -> None:
    assert dispatcher(tmp_path)(2.0) == 4.0
    (file,) = tmp_path.iterdir()
    content = kernel_cache.serialize.dumps(("not", "a", "kernel"))
    file.write_bytes(kernel_cache.hashlib.sha256(content).digest() + content)
    assert dispatcher(tmp_path)(2.0) == 4.0
    mended = dispatcher(tmp_path)
    assert mended(2.0) == 4.0
    assert was_loaded(mended)


def test_full_disk_is_a_warning_that_names_folder(tmp_path, monkeypatch) -> None:
    def full(path: Path, _: bytes) -> int:
        path.touch()
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(Path, "write_bytes", full)
    with pytest.warns(KernelCacheWarning, match=f"{tmp_path}: can't be written .No space left"):
        assert dispatcher(tmp_path)(2.0) == 4.0
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # said once
        assert dispatcher(tmp_path)(2.0) == 4.0
    assert not list(tmp_path.iterdir())


def test_without_folder_nothing_is_kept() -> None:
    compiled = dispatcher(None)
    assert compiled(2.0) == 4.0
    assert not was_loaded(compiled)


def test_shipped_kernel_is_loaded_though_own_can_be_kept(tmp_path) -> None:
    shipped, own = tmp_path / "shipped", tmp_path / "own"
    shipped.mkdir()
    own.mkdir()
    assert dispatcher(shipped)(2.0) == 4.0
    here = kernel_cache._target(registry.cpu_target.target_context.codegen())
    compiled = numba.njit(twice)
    compiled._cache = KernelCache(twice, lambda: own, (shipped, here))
    assert compiled(3.0) == 6.0
    assert was_loaded(compiled)
    assert compiled(3) == 6  # not shipped
    assert len(list(own.iterdir())) == len(list(shipped.iterdir())) == 1


@pytest.mark.parametrize("machine", ["x86_64", "AMD64", "aarch64", "arm64"])
def test_shipped_kernels_are_for_each_family(monkeypatch, machine) -> None:
    monkeypatch.setattr(platform, "machine", lambda: machine)
    processor = kernel_cache.shipped_processor()
    assert processor is not None
    present = dict.fromkeys(processor.features.replace("+", "").split(","), True)
    monkeypatch.setattr(kernel_cache.binding, "get_host_cpu_features", lambda: present)
    assert kernel_cache.runs_here(processor)
    present["avx2"] = False
    assert kernel_cache.runs_here(processor) == (processor.features == "")


def test_own_folder_is_private(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    folder = trusted_folder("kernels")
    assert folder == tmp_path / "cache" / "kernels"
    if os.name == "posix":
        assert folder.stat().st_mode & 0o777 == 0o700


@pytest.mark.skipif(os.name != "posix", reason="owners and modes of POSIX")
@pytest.mark.parametrize(
    ("place", "mode", "trusted"),
    [
        ("cache/kernels", 0o770, False),
        ("cache/kernels", 0o702, False),
        ("cache", 0o777, False),
        ("cache", 0o1777, True),  # sticky: nobody can replace what others own
        ("cache", 0o775, True),  # the user's own group
        ("cache/kernels", 0o755, True),
    ],
)
def test_folder_that_others_can_write_to_is_not_used(
    tmp_path, monkeypatch, place, mode, trusted
) -> None:
    (tmp_path / "cache" / "kernels").mkdir(parents=True)
    (tmp_path / "cache" / "kernels").chmod(0o700)
    (tmp_path / place).chmod(mode)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    if trusted:
        assert trusted_folder("kernels") is not None
        return
    with pytest.warns(KernelCacheWarning, match=f"{tmp_path / place}: other users can write to it"):
        assert trusted_folder("kernels") is None


@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="needs root")
@pytest.mark.parametrize("place", ["cache", "cache/kernels"])
def test_folder_of_another_user_is_not_used(tmp_path, monkeypatch, place) -> None:
    (tmp_path / "cache" / "kernels").mkdir(parents=True, mode=0o700)
    os.chown(tmp_path / place, 65534, 65534)
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "cache"))
    with pytest.warns(KernelCacheWarning, match=r"belongs to another user \(65534\)"):
        assert trusted_folder("kernels") is None


def test_folder_that_cannot_be_made_is_a_warning(tmp_path, monkeypatch) -> None:
    (tmp_path / "file").touch()
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file"))
    with pytest.warns(KernelCacheWarning, match="file"):
        assert trusted_folder("kernels") is None
