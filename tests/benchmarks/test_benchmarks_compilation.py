"""The list of kernels, written by a benchmark, read by tofuse."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType

import numba
import numpy as np
import pytest

from paths import BENCHMARKS
from tofuse.engine.compute import ahead
from tofuse.engine.tracking.moving_object_kernels import Cells, Limits


@pytest.fixture
def compilation(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    import compilation

    return compilation


def test_listed_signatures_round_trip(compilation: ModuleType) -> None:
    lines = [compilation.signature_line(name, types) for name, types in ahead.signatures()]
    assert lines == Path(ahead.__file__).with_name("signatures.txt").read_text().splitlines()


def test_named_tuples_are_listed_with_fields(
    compilation: ModuleType, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    limits, image = Limits(0.005, 0.04, 2, 3.0, 1.2, 0.3), np.zeros((2, 3), np.float32)
    images = Cells(image, image, image, image)
    types = tuple(numba.typeof(each) for each in (limits, 1, images, (images, images)))
    line = compilation.signature_line("moving_objects.compare", types)
    cells = "moving_objects.Cells(f4:2C,f4:2C,f4:2C,f4:2C)"
    mixed = "moving_objects.Limits(f8,f8,i8,f8,f8,f8)"
    assert line == f"moving_objects.compare {mixed} i8 {cells} 2x{cells}"
    listed = tmp_path / "signatures.txt"
    listed.write_text(line)
    monkeypatch.setattr(ahead, "_LIST", listed)
    assert ahead.signatures() == [("moving_objects.compare", types)]
