"""Completes a software bill of materials, and checks it against the pins.

    python requirements/sbom.py build/sbom.json

The bill is in CycloneDX's JSON format, of an environment in which runtime.txt is installed. Each
component gets the SHA-256 sums of the files that are permitted for it, and a licence if the program
that wrote the bill found none. Prints a line for each fault, and exits with 1 if there is one.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from check import HERE, RUNTIME, Pin, pins
from packaging.utils import canonicalize_name

# Of packages that state their licence as free text, which cyclonedx-py omits.
LICENCES = {"partd": "BSD-3-Clause", "xatlas": "MIT"}


def complete(bill: dict[str, Any], pinned: Sequence[Pin]) -> None:
    """Add licences, and the hashes of the pins as references to the files on PyPI."""
    for component in bill["components"]:
        if not component.get("licenses") and component["name"] in LICENCES:
            component["licenses"] = [{"license": {"id": LICENCES[component["name"]]}}]
    hashes = {(pin.name, pin.version): pin.hashes for pin in pinned if pin.here}
    for component in bill["components"]:
        key = canonicalize_name(component["name"]), component.get("version", "")
        if key in hashes:
            reference = {
                "type": "distribution",
                "url": f"https://pypi.org/project/{key[0]}/{key[1]}/#files",
                "hashes": [{"alg": "SHA-256", "content": each} for each in hashes[key]],
            }
            references = component.setdefault("externalReferences", [])
            references[:] = [r for r in references if r["type"] != "distribution"] + [reference]


def faults(bill: dict[str, Any], pinned: Sequence[Pin]) -> Iterator[str]:
    """Yield the differences between a bill of materials and the pins, and what it lacks."""
    required = {pin.name: pin.version for pin in pinned if pin.here}
    listed = {canonicalize_name(c["name"]): c for c in bill["components"]}
    for name in sorted(required.keys() - listed.keys()):
        yield f"{name}: is pinned, and not listed"
    for name, component in sorted(listed.items()):
        version = component.get("version")
        if name not in required:
            yield f"{name}: is listed, and not pinned"
        elif version != required[name]:
            yield f"{name}: is listed as {version}, and pinned to {required[name]}"
        elif not any(r.get("hashes") for r in component.get("externalReferences", [])):
            yield f"{name}: has no hash"
        kind, _, package = component.get("purl", "").partition("?")[0].rpartition("/")
        if (kind, canonicalize_name(package)) != (
            "pkg:pypi",
            canonicalize_name(f"{name}@{version}"),
        ):
            yield f"{name}: has the package URL {component.get('purl')}"
        if not component.get("licenses"):
            yield f"{name}: states no licence"


def main() -> int:
    """Complete and check the given file."""
    path = Path(sys.argv[1])
    bill = json.loads(path.read_text(encoding="utf-8"))
    pinned = pins(HERE / f"{RUNTIME}.txt")
    complete(bill, pinned)
    found = list(faults(bill, pinned))
    path.write_text(json.dumps(bill, indent=2) + "\n", encoding="utf-8")
    print("\n".join(found) or f"{path}: {len(bill['components'])} components as pinned")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
