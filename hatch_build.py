"""Compiled kernels in the package: a wheel for one system and version of Python.

Installation from source (`pip install .`) compiles what runs call; where that fails, the first
run compiles them. `make wheel`, which switches this hook on by name, compiles all listed ones, and
fails where it can't. With HATCH_BUILD_NO_HOOKS=true the wheel has none, and is for all systems.
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
import sys
from tofuse.engine.compute import ahead
from tofuse.engine.compute.kernel_cache import shipped_processor
ahead.compile_now(bool(int(sys.argv[1])), shipped_processor())
"""


class CompiledKernels(BuildHookInterface[Any]):
    """Compiles kernels and adds them to the wheel."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile into ``build/kernels``."""
        if version == "editable":  # has no files of its own
            return
        for_release = os.environ.get("HATCH_BUILD_HOOK_ENABLE_CUSTOM") == "true"
        folder = Path(self.root, "build", "kernels")
        shutil.rmtree(folder, ignore_errors=True)
        # pip names the packages of the build by PYTHONPATH as well.
        paths = [str(Path(self.root, "src")), *filter(None, [os.environ.get("PYTHONPATH")])]
        places = {"NUMBA_CACHE_DIR": str(folder), "PYTHONPATH": os.pathsep.join(paths)}
        self.app.display_info("compiling the numerical kernels, which takes a minute")
        subprocess.run(
            [sys.executable, "-c", _COMPILE, str(int(for_release))],
            env=os.environ | places,
            check=for_release,
        )
        kernels = sorted(folder.rglob("*.kernel"))
        if not kernels:
            problem = f"{folder}: no kernels were written; others can write to it?"
            if for_release:
                raise RuntimeError(problem)
            self.app.display_warning(f"{problem} The first run compiles them.")
            return
        for kernel in kernels:
            place = Path("tofuse/engine/compute/compiled", kernel.relative_to(folder))
            build_data["force_include"][str(kernel)] = place.as_posix()
        build_data["pure_python"] = False
        if not for_release:
            build_data["infer_tag"] = True
            return
        python = f"cp{sys.version_info.major}{sys.version_info.minor}"
        build_data["tag"] = f"{python}-{python}-{_PLATFORMS[sys.platform]}"
