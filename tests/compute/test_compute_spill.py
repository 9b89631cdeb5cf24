from __future__ import annotations

import errno
import os
import tempfile
from dataclasses import dataclass, field
from pathlib import Path
from threading import Thread
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from tofuse.engine.compute.spill import Spill
from tofuse.engine.errors import OutputError


@dataclass(frozen=True, eq=False)
class Item:
    index: int
    rays: NDArray[Any]
    image: NDArray[Any]
    mask: NDArray[Any] | None = None
    derived: dict[int, int] = field(default_factory=dict, init=False)


_RAYS = np.arange(100.0)


def made(k: int) -> Item:
    rng = np.random.default_rng(k)
    mask = rng.random((3, 0 if k % 5 == 0 else 4)) > 0.5 if k % 3 else None
    return Item(k, _RAYS, rng.random((20, 10)).astype(np.float32), mask)


def same(a: Item, b: Item) -> bool:
    if (a.mask is None) != (b.mask is None):
        return False
    masks = a.mask is None or b.mask is None or np.array_equal(a.mask, b.mask)
    return a.index == b.index and np.array_equal(a.image, b.image) and masks


@pytest.mark.parametrize("budget", [0, 3000, 10**9])
def test_items_round_trip_for_any_budget(tmp_path: Path, budget: int) -> None:
    spill: Spill[Item] = Spill(budget, tmp_path)
    assert [spill.put(made(k)) for k in range(30)] == list(range(30))
    order = np.random.default_rng(0).permutation(30)
    for k in [*order, *order[::-1]]:
        got = spill.get(int(k))
        assert same(got, made(int(k)))
        assert got.image.flags.writeable  # kernels are compiled for writable arrays
        assert spill.resident_bytes <= max(budget, 2000)  # the newest item stays resident
    assert (spill.spilled_bytes > 0) == (budget < 10**9)
    assert spill.nbytes > 30 * 800
    assert len(spill) == 30


def test_shared_arrays_stay_shared(tmp_path: Path) -> None:
    spill: Spill[Item] = Spill(0, tmp_path)
    for k in range(4):
        spill.put(made(k))
    assert all(spill.get(k).rays is _RAYS for k in range(1, 4))
    assert spill.nbytes < 4 * 900 + _RAYS.nbytes  # counted once


def test_least_recently_used_item_is_spilled_first(tmp_path: Path) -> None:
    size = made(0).image.nbytes
    spill: Spill[Item] = Spill(2 * size + 1000, tmp_path)
    items = [Item(k, _RAYS, np.full((20, 10), k, np.float32)) for k in range(3)]
    for item in items[:2]:
        spill.put(item)
    spill.get(0)
    spill.put(items[2])
    assert spill.get(0) is items[0]
    assert spill.get(1) is not items[1]


def test_arrays_are_made_contiguous_on_put() -> None:
    spill: Spill[Item] = Spill(10**9)
    whole = np.arange(600.0).reshape(20, 30)
    got = spill.get(spill.put(Item(0, _RAYS, whole[:, ::3], whole.T)))
    assert got.image.flags.c_contiguous
    assert got.mask is not None
    assert got.mask.flags.c_contiguous
    assert np.array_equal(got.image, whole[:, ::3])


def test_no_file_remains_or_is_visible(tmp_path: Path) -> None:
    spill: Spill[Item] = Spill(0, tmp_path)
    for k in range(3):
        spill.put(made(k))
    spill.close()
    assert len(spill) == 0
    assert os.listdir(tmp_path) == []
    with pytest.raises(KeyError):
        spill.get(0)


def test_dropped_items_are_removed(tmp_path: Path) -> None:
    spill: Spill[Item] = Spill(1000, tmp_path)
    for k in range(5):
        spill.put(made(k))
    for k in (0, 4):
        spill.drop(k)
        with pytest.raises(KeyError):
            spill.get(k)
    assert same(spill.get(2), made(2))
    assert spill.put(made(5)) == 5


def test_concurrent_reads(tmp_path: Path) -> None:
    spill: Spill[Item] = Spill(3000, tmp_path)
    for k in range(20):
        spill.put(made(k))
    wrong: list[int] = []

    def ask(seed: int) -> None:
        some = np.random.default_rng(seed).integers(0, 20, 200).tolist()
        wrong.extend(k for k in some if not same(spill.get(k), made(k)))

    asking = [Thread(target=ask, args=(seed,)) for seed in range(4)]
    for thread in asking:
        thread.start()
    for thread in asking:
        thread.join()
    assert wrong == []


def test_full_disk_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Full:
        def seek(self, offset: int) -> None: ...

        def write(self, data: Any) -> int:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

        def close(self) -> None: ...

    monkeypatch.setattr(tempfile, "TemporaryFile", lambda **_: Full())
    spill: Spill[Item] = Spill(0, tmp_path)
    spill.put(made(0))
    with pytest.raises(
        OutputError, match=r"no space left on device.*or increase memory$"
    ) as caught:
        spill.put(made(1))
    assert "\n" not in str(caught.value)


def test_missing_folder_is_reported(tmp_path: Path) -> None:
    spill: Spill[Item] = Spill(0, tmp_path / "missing")
    spill.put(made(0))
    with pytest.raises(OutputError, match="missing"):
        spill.put(made(1))
