"""Availability of wheels of all dependencies, for each system and version of Python.

    python benchmarks/wheels.py [--only dask scan ...]

Resolves the dependencies in `pyproject.toml`, without and with each extra, from wheels only, as
`pip` would on that system, and prints which are available and what is missing. Nothing is
installed. Needs uv (`pip install uv`) and a package index.
"""

from __future__ import annotations

import argparse
import re
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
PYTHONS = ("3.11", "3.12", "3.13", "3.14")
# Names of platforms in uv, and common names.
SYSTEMS = {
    "x86_64-pc-windows-msvc": "Windows",
    "aarch64-apple-darwin": "macOS arm64",
    "x86_64-manylinux_2_28": "Linux x86-64",
    "aarch64-manylinux_2_28": "Linux arm64",
}
_LACKING = re.compile(
    r"\b([a-z0-9][a-z0-9._-]*)(?:[<>=!~,]=?[\w.,<>=]*)? has no (?:usable )?wheels"
)


def main() -> int:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = list(project["optional-dependencies"])
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--only", nargs="+", choices=extras, default=extras, metavar="EXTRA")
    arguments = parser.parse_args()
    uv = shutil.which("uv") or shutil.which("uv", path=str(Path(sys.executable).parent))
    if uv is None:
        raise SystemExit("uv is missing: pip install uv")
    print("| | " + " | ".join(SYSTEMS.values()) + " |")
    print("|---" * (1 + len(SYSTEMS)) + "|")
    whole = True
    for extra in (None, *arguments.only):
        cells = []
        for system in SYSTEMS:
            lacking = {python: missing(uv, system, python, extra) for python in PYTHONS}
            whole &= extra is not None or not any(lacking.values())
            cells.append(cell(lacking))
        name = "required" if extra is None else f"`{extra}`"
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)
    return 0 if whole else 1


def missing(uv: str, system: str, python: str, extra: str | None) -> str:
    """Return the packages without a wheel on a platform; empty if none."""
    command = [uv, "pip", "compile", "--quiet", "--no-header", "--only-binary", ":all:"]
    command += ["--python-platform", system, "--python-version", python, "pyproject.toml"]
    command += [] if extra is None else ["--extra", extra]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    return "" if done.returncode == 0 else reason(done.stderr)


def reason(message: str) -> str:
    """Return the packages without a wheel from uv's message, or else its beginning."""
    text = " ".join(message.split())
    found = sorted(set(_LACKING.findall(text)))
    return ", ".join(found) if found else text[:200] or "not resolved"


def cell(lacking: dict[str, str]) -> str:
    """Format a cell: versions with all wheels, and what the others lack."""
    if not any(lacking.values()):
        return f"{PYTHONS[0]} to {PYTHONS[-1]}"
    if all(lacking.values()) and len(set(lacking.values())) == 1:
        return f"no {lacking[PYTHONS[0]]}"
    have = [python for python in PYTHONS if not lacking[python]]
    parts = [f"{have[0]} to {have[-1]}"] if have else []
    parts += [f"{python}: no {what}" for python, what in lacking.items() if what]
    return "; ".join(parts)


if __name__ == "__main__":
    sys.exit(main())
