"""Compilation time of the first run on a machine, alone and with a second compiling process.

    python benchmarks/compilation.py [RECORDING]
    python benchmarks/compilation.py --list RECORDING [RECORDING ...] [--others COMMAND ...]

Each row is a `tofuse run` in its own process: with all kernels cached, with an empty cache, and
with an empty cache and the second process (`tofuse.engine.compute.ahead`). `--list` writes the list
of kernels that this process compiles, from those that runs of the recordings call, and below them
those that `--others` call as well, which only wheels contain compiled: commands such as
"register a.ply b.ply --out OUT".
"""

from __future__ import annotations

import argparse
import os
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numba

from tofuse.engine.compute.ahead import DTYPES

ROOT = Path(__file__).resolve().parents[1]
LIST = ROOT / "src" / "tofuse" / "engine" / "compute" / "signatures.txt"
ALONE = (
    "import sys; from tofuse.engine.compute import ahead; ahead.usable_cores = lambda: 1; "
    "from tofuse.apps.cli.program import main; sys.exit(main())"
)
BOTH = "import sys; from tofuse.apps.cli.program import main; sys.exit(main())"
_NAMES = {name: short for short, name in DTYPES.items()} | {"bool": "b1"}


def seconds(program: str, recording: Path, cache: str) -> float:
    """Wall time of a run."""
    with tempfile.TemporaryDirectory() as out:
        args = ["run", str(recording), "--out", f"{out}/result", "--threads", "2"]
        start = time.perf_counter()
        subprocess.run(
            [sys.executable, "-c", program, *args],
            env=os.environ | {"NUMBA_CACHE_DIR": cache},
            check=True,
            capture_output=True,
        )
        return time.perf_counter() - start


def print_table(recording: Path) -> None:
    """Print the seconds of each case."""
    print("| kernels | s |\n|---|---|")
    with tempfile.TemporaryDirectory() as cache:
        cold = seconds(ALONE, recording, cache)
        warm = seconds(ALONE, recording, cache)
    with tempfile.TemporaryDirectory() as cache:
        helped = seconds(BOTH, recording, cache)
    print(f"| cached | {warm:.1f} |")
    print(f"| compiled by the run alone | {cold:.1f} |")
    print(f"| compiled with a second process | {helped:.1f} |")


def signature_line(name: str, types: tuple[Any, ...]) -> str:
    """Line of the list for a kernel, "module.function", and types of its arguments."""
    return " ".join([name, *(_text_of(kind) for kind in types)])


def _text_of(kind: Any) -> str:
    kinds = numba.types
    if isinstance(kind, kinds.BaseNamedTuple):
        named = kind.instance_class
        fields = ",".join(_text_of(field) for field in kind.types)
        return f"{named.__module__.removeprefix('tofuse.')}.{named.__name__}({fields})"
    if isinstance(kind, kinds.UniTuple):
        return f"{kind.count}x{_text_of(kind.dtype)}"
    if isinstance(kind, kinds.Array):
        mark = "" if kind.mutable else "!"
        return f"{mark}{_NAMES[str(kind.dtype)]}:{kind.ndim}{kind.layout}"
    return _NAMES[str(kind)]


def called(commands: list[list[str]]) -> list[str]:
    """Lines of the list, in the order in which commands call the kernels."""
    from numba.core.dispatcher import Dispatcher

    from tofuse.apps.cli.program import main

    lines: dict[str, None] = {}
    thread = threading.local()  # whose kernel calls others
    compile_or_load = Dispatcher.compile

    def recorded(dispatcher: Any, types: Any) -> Any:
        kernel, caller = dispatcher.py_func, getattr(thread, "kernel", None)
        if caller is None and kernel.__module__.startswith("tofuse."):
            name = f"{kernel.__module__.removeprefix('tofuse.')}.{kernel.__name__}"
            lines.setdefault(signature_line(name, types))
        thread.kernel = caller or kernel
        try:
            return compile_or_load(dispatcher, types)
        finally:
            thread.kernel = caller

    with patch.object(Dispatcher, "compile", recorded), tempfile.TemporaryDirectory() as folder:
        for number, command in enumerate(commands):
            main([word.replace("OUT", f"{folder}/{number}") for word in command])
    return list(lines)


def main() -> None:
    """Print the table, or write the list."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n", 1)[0])
    parser.add_argument("recordings", nargs="*", type=Path)
    parser.add_argument("--list", action="store_true")
    parser.add_argument("--others", nargs="*", default=[], metavar="COMMAND")
    given = parser.parse_args()
    if given.list:
        runs = [["run", str(path), "--every", "4", "--out", "OUT"] for path in given.recordings]
        usual = called(runs)
        others = [line for line in called(list(map(str.split, given.others))) if line not in usual]
        LIST.write_text("\n".join([*usual, "", *others]) + "\n", encoding="ascii")
        return
    print_table(given.recordings[0])


if __name__ == "__main__":
    main()
