"""Wheels, and installations from source, contain compiled kernels: a first run compiles nothing."""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
import venv
import zipfile
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hatchling.bridge.app import Application

from paths import ROOT

# As on a processor without AVX2.
_OLD_PROCESSOR = """
from llvmlite import binding
binding.get_host_cpu_features = binding.targets.FeatureMap
from tofuse.engine.compute import jit
assert jit.shipped_kernels() is None
from tofuse.engine.geometry import rigid_motion_kernels
import numpy as np
assert rigid_motion_kernels.distance_and_angle(np.eye(4), np.eye(4)) == (0, 0)
"""


@pytest.fixture
def build(tmp_path, monkeypatch) -> Any:
    """Call the hook in an empty folder, with a compiler that writes no or one kernel."""
    spec = spec_from_file_location("hatch_build", ROOT / "hatch_build.py")
    assert spec is not None
    assert spec.loader is not None
    module = module_from_spec(spec)
    spec.loader.exec_module(module)

    def call(version: str = "standard", *, compiles: bool = True) -> dict[str, Any]:
        def run(words: list[str], env: dict[str, str], check: bool) -> None:
            if compiles:
                folder = Path(env["NUMBA_CACHE_DIR"], "kernels-1")
                folder.mkdir(parents=True)
                (folder / f"all-{words[-1]}.kernel").touch()
            elif check:
                raise subprocess.CalledProcessError(1, words)

        monkeypatch.setattr(module, "subprocess", SimpleNamespace(run=run))
        hook = module.CompiledKernels(str(tmp_path), {}, None, None, "", "wheel", Application())
        data: dict[str, Any] = {"force_include": {}, "pure_python": True}
        hook.initialize(version, data)
        return data

    return call


def test_installation_from_source_compiles_what_runs_call(build) -> None:
    data = build()
    assert list(data["force_include"].values()) == [
        "tofuse/engine/compute/compiled/kernels-1/all-0.kernel"
    ]
    assert (data["pure_python"], data["infer_tag"]) == (False, True)


def test_installation_from_source_needs_no_compiled_kernels(build) -> None:
    untouched = {"force_include": {}, "pure_python": True}
    assert build(compiles=False) == untouched
    assert build("editable") == untouched


def test_wheel_of_release_has_all_kernels(build, monkeypatch) -> None:
    monkeypatch.setenv("HATCH_BUILD_HOOK_ENABLE_CUSTOM", "true")
    data = build()
    assert [Path(name).name for name in data["force_include"]] == ["all-1.kernel"]
    assert data["tag"].startswith(f"cp{sys.version_info.major}{sys.version_info.minor}-")
    with pytest.raises(subprocess.CalledProcessError):
        build(compiles=False)


@pytest.fixture(scope="module")
def python(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Python of an environment with the wheel, and this one's packages."""
    folder = tmp_path_factory.mktemp("wheel")
    words = [sys.executable, "-m", "hatchling", "build", "--target", "wheel", "--directory", folder]
    switch = {"HATCH_BUILD_HOOK_ENABLE_CUSTOM": "true"}
    subprocess.run(words, cwd=ROOT, env=os.environ | switch, check=True, capture_output=True)
    (wheel,) = folder.glob("*.whl")
    version = f"cp{sys.version_info.major}{sys.version_info.minor}"
    assert f"-{version}-{version}-" in wheel.name
    venv.create(folder / "env")
    scheme = {"base": str(folder / "env"), "platbase": str(folder / "env")}
    packages = Path(sysconfig.get_path("purelib", "venv", scheme))
    zipfile.ZipFile(wheel).extractall(packages)
    (packages / "others.pth").write_text(sysconfig.get_path("purelib"))
    name = "python.exe" if os.name == "nt" else "python"
    return Path(sysconfig.get_path("scripts", "venv", scheme), name)


def kept(python: Path, cache: Path, *words: object) -> list[str]:
    """Names of the kernels that a process has compiled."""
    clean = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    env = clean | {"NUMBA_CACHE_DIR": str(cache)}
    subprocess.run([python, *words], env=env, cwd=python.parent, check=True, capture_output=True)
    return sorted(path.name for path in cache.rglob("*.kernel"))


@pytest.mark.nightly
def test_first_run_compiles_nothing(python, tmp_path, room_recording, room_result) -> None:
    """And its result is that of kernels compiled for the processor of this machine."""
    run = ("-m", "tofuse", "run", room_recording, "--out", tmp_path / "result")
    assert kept(python, tmp_path / "cache", *run) == []
    for name in ("trajectory.txt", "pose_graph.g2o", "cloud.ply", "mesh.ply"):
        assert (tmp_path / "result" / name).read_bytes() == (room_result / name).read_bytes()


@pytest.mark.nightly
def test_other_processors_compile(python, tmp_path) -> None:
    assert len(kept(python, tmp_path / "cache", "-c", _OLD_PROCESSOR)) >= 1
