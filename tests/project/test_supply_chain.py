"""Installed packages are pinned by hash, have permitted licences, and are named in NOTICE."""

from __future__ import annotations

import re
import sys
import tomllib
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from packaging.version import Version

from paths import ROOT

FOLDER = ROOT / "requirements"


@pytest.fixture
def check(monkeypatch):
    monkeypatch.syspath_prepend(str(FOLDER))
    sys.modules.pop("check", None)
    import check

    return check


def test_pins_of_runtime_and_development_agree(check) -> None:
    """One version of each package, which satisfies the requirements of tofuse and its extras."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = {k: v for k, v in project["optional-dependencies"].items() if k != "bench"}
    wanted = [*project["dependencies"], *(line for lines in extras.values() for line in lines)]
    shipped = check.pins(FOLDER / "runtime.txt")
    for line in wanted:
        requirement = Requirement(line)
        name = canonicalize_name(requirement.name)
        versions = [Version(pin.version) for pin in shipped if pin.name == name]
        assert versions, line
        assert all(version in requirement.specifier for version in versions), line
    developed = check.pins(FOLDER / "dev.txt")
    for pin in shipped:
        same = {other.version for other in developed if other.name == pin.name}
        assert not same or pin.version in same, pin


def test_notice_names_all_runtime_packages(check) -> None:
    names = {pin.name for pin in check.pins(FOLDER / "runtime.txt")}
    assert list(check.unnamed(names, check.NOTICE.read_text(encoding="utf-8"))) == []
    assert list(check.unnamed({"numpy", "left-pad"}, "NumPy.")) == ["NOTICE: left-pad is missing"]


def test_licences_of_runtime_packages(check, monkeypatch) -> None:
    names = {pin.name for pin in check.pins(FOLDER / "runtime.txt")}
    assert list(check.unlicensed(names)) == []
    stated = {
        "numpy": "MIT OR GPL-2.0-only",
        "scipy": "MIT AND LGPL-2.1-or-later",
        "rich": "",
        "numba": "GNU General Public License v3 (GPLv3)",
    }
    monkeypatch.setattr(check, "licence", stated.__getitem__)
    assert list(check.unlicensed(set(stated))) == [
        "numba: is under GNU General Public License v3 (GPLv3)",
        "rich: states no licence",
        "scipy: is under MIT AND LGPL-2.1-or-later",
    ]


def test_pins_are_read(check, tmp_path: Path) -> None:
    path = tmp_path / "some.txt"
    path.write_text(
        f"a-b==1.2 \\\n    --hash=sha256:{64 * 'a'} \\\n    --hash=sha256:{64 * 'b'}\n    # via x\n"
        f"numpy==0.0.1 ; python_full_version >= '3.0' \\\n    --hash=sha256:{64 * 'c'}\n"
        f"numpy==0.0.2 ; python_full_version < '3.0' \\\n    --hash=sha256:{64 * 'c'}\n"
        "c==1\n"
    )
    first, numpy, old, last = check.pins(path)
    assert (first.name, first.version, first.here) == ("a-b", "1.2", True)
    assert first.hashes == (64 * "a", 64 * "b")
    assert (numpy.here, old.here, last.hashes) == (True, False, ())
    assert list(check.unhashed(path)) == ["some.txt: c 1 has no hash"]
    (differs,) = check.differing(path)
    assert re.fullmatch(r"some.txt: numpy is \S+ here, and pinned to 0.0.1", differs)
    path.write_text("a>=1\n")
    with pytest.raises(ValueError, match="is no exact version"):
        check.pins(path)
