"""Checks that installed packages are as pinned, have a permitted licence and are in NOTICE.

    python requirements/check.py

Works offline: it compares the pins in this folder with the packages of the Python that runs it.
Prints a line for each fault, and exits with 1 if there is one.
"""

from __future__ import annotations

import re
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

from packaging.markers import Marker
from packaging.utils import canonicalize_name

HERE = Path(__file__).resolve().parent
NOTICE = HERE.parent / "NOTICE"
# All files of pins, and that of what users of tofuse install, which NOTICE names.
ALL = ("dev", "docs", "extras", "release", "runtime")
RUNTIME = "runtime"

_PIN = re.compile(r"([A-Za-z0-9][\w.-]*)(?:\[[\w,-]+\])?==([^\s;\\]+)\s*(?:;\s*([^\\]+))?")
_HASH = re.compile(r"--hash=sha256:([0-9a-f]{64})(?=\s|$)")
# GPL and LGPL impose conditions on programs that import the package.
_REFUSED = re.compile(r"\b(A|L)?GPL|SSPL|General Public License|Commons Clause|BUSL", re.I)


@dataclass(frozen=True)
class Pin:
    """A version of a package, its environment marker, and the SHA-256 sums of its files."""

    name: str
    version: str
    marker: str
    hashes: tuple[str, ...]

    @property
    def here(self) -> bool:
        """Whether it applies to this system and Python."""
        return not self.marker or Marker(self.marker).evaluate()


def pins(path: Path) -> list[Pin]:
    """Return the pins in a file.

    Raises
    ------
    ValueError
        For a line without an exact version.
    """
    found = []
    logical = re.sub(r"\\\n", " ", path.read_text(encoding="utf-8"))
    for line in logical.splitlines():
        text = line.split(" #")[0].strip()
        if not text or text.startswith("#"):
            continue
        match = _PIN.match(text)
        if match is None:
            raise ValueError(f"{path.name}: {text[:60]!r} is no exact version")
        marker = re.split(r"\s--hash", match[3] or "")[0].strip()
        hashes = tuple(_HASH.findall(text))
        found.append(Pin(canonicalize_name(match[1]), match[2], marker, hashes))
    return found


def unhashed(path: Path) -> Iterator[str]:
    """Pins without a hash."""
    for pin in pins(path):
        if not pin.hashes:
            yield f"{path.name}: {pin.name} {pin.version} has no hash"


def differing(path: Path) -> Iterator[str]:
    """Installed packages with another version than their pin."""
    for pin in pins(path):
        if pin.here and (installed := _version(pin.name)) not in (None, pin.version):
            yield f"{path.name}: {pin.name} is {installed} here, and pinned to {pin.version}"


def unlicensed(names: set[str]) -> Iterator[str]:
    """Installed packages whose licence is not permitted, or not stated."""
    for name in sorted(names):
        if _version(name) is None:
            continue
        stated = licence(name)
        if not stated:
            yield f"{name}: states no licence"
        # Of alternatives, one permitted licence is enough.
        elif all(map(_REFUSED.search, [stated] if " AND " in stated else stated.split(" OR "))):
            yield f"{name}: is under {stated}"


def unnamed(names: set[str], notice: str) -> Iterator[str]:
    """Packages that NOTICE does not name."""
    words = {canonicalize_name(word.strip(".")) for word in re.findall(r"[\w.-]+", notice)}
    for name in sorted(names - words):
        yield f"NOTICE: {name} is missing"


def licence(name: str) -> str:
    """Return the licence that an installed package states: an SPDX expression, or free text."""
    about = metadata.metadata(name)
    if expression := about.get("License-Expression"):
        return str(expression)
    classes = [c.split(" :: ")[-1] for c in about.get_all("Classifier", []) if "License ::" in c]
    if classes:
        return " OR ".join(classes)
    return (about.get("License") or "").strip().partition("\n")[0]


def _version(name: str) -> str | None:
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def main() -> int:
    """Print all faults."""
    paths = [HERE / f"{name}.txt" for name in ALL]
    shipped = {pin.name for pin in pins(HERE / f"{RUNTIME}.txt")}
    faults = [
        *(fault for path in paths for fault in unhashed(path)),
        *differing(HERE / "dev.txt"),
        *unlicensed(shipped),
        *unnamed(shipped, NOTICE.read_text(encoding="utf-8")),
    ]
    print("\n".join(faults) or f"{len(shipped)} packages are as pinned, licensed and named")
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main())
