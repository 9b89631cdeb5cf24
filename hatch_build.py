"""Wheels that contain compiled kernels, one for each system and version of Python: `make wheel`.

Without this hook, which is off by default, a wheel is for all systems, and each machine compiles.
"""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

# The oldest systems that Numba's own wheels are for.
_PLATFORMS = {
    "linux": f"manylinux_2_28_{platform.machine()}",
    "darwin": f"macosx_11_0_{platform.machine()}",
    "win32": "win_amd64",
}
_COMPILE = """
from numba import config
from tofuse.engine.compute.kernel_cache import shipped_processor
config.CPU_NAME, config.CPU_FEATURES = shipped_processor()
from tofuse.engine.compute import ahead
with ahead.rare_garbage_collection():
    ahead.compile_all(ahead.signatures(all_commands=True))
"""


class CompiledKernels(BuildHookInterface[Any]):
    """Compiles all listed kernels and adds them to the wheel."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile into ``build/kernels``."""
        folder = Path(self.root, "build", "kernels")
        shutil.rmtree(folder, ignore_errors=True)
        places = {"NUMBA_CACHE_DIR": str(folder), "PYTHONPATH": str(Path(self.root, "src"))}
        subprocess.run([sys.executable, "-c", _COMPILE], env=os.environ | places, check=True)
        kernels = sorted(folder.rglob("*.kernel"))
        if not kernels:
            raise RuntimeError(f"{folder}: no kernels were written; others can write to it?")
        for kernel in kernels:
            place = Path("tofuse/engine/compute/compiled", kernel.relative_to(folder))
            build_data["force_include"][str(kernel)] = place.as_posix()
        python = f"cp{sys.version_info.major}{sys.version_info.minor}"
        build_data["pure_python"] = False
        build_data["tag"] = f"{python}-{python}-{_PLATFORMS[sys.platform]}"
