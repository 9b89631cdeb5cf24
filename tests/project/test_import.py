"""``import tofuse`` and ``tofuse --help`` are fast."""

from __future__ import annotations

import ast
import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

import tofuse
from paths import DOCS

HEAVY = {"numba", "scipy", "cv2", "matplotlib", "jinja2", "rich"}


def _python(code: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)


def test_import_loads_no_heavy_packages() -> None:
    done = _python("import json, sys, tofuse; print(json.dumps(sorted(sys.modules)))")
    assert done.stderr == ""
    loaded = set(json.loads(done.stdout))
    assert not loaded & (HEAVY | {"numpy"})
    assert {m for m in loaded if m.startswith("tofuse")} == {"tofuse", "tofuse._faces"}


@pytest.mark.parametrize("words", [["--help"], ["run", "--help"], ["--version"], ["run"], []])
def test_help_loads_no_heavy_packages(words) -> None:
    done = _python(
        "import json, sys\n"
        "from tofuse.apps.cli.program import main\n"
        "try:\n"
        f"    main({words!r})\n"
        "except SystemExit:\n"
        "    pass\n"
        "print('MODULES' + json.dumps(sorted(sys.modules)))"
    )
    loaded = set(json.loads(done.stdout.rsplit("MODULES", 1)[1]))
    assert not loaded & (HEAVY | {"numpy"})


def test_run_with_report_does_not_load_matplotlib(room_recording, tmp_path) -> None:
    words = ["run", str(room_recording), "--out", str(tmp_path / "result")]
    done = _python(
        "import sys\n"
        "from tofuse.apps.cli.program import main\n"
        f"status = main({words!r})\n"
        "print('STATUS', status, 'matplotlib' in sys.modules)"
    )
    assert "STATUS 0 False" in done.stdout, done.stderr
    assert "data-chart=" in (tmp_path / "result" / "report.html").read_text(encoding="utf-8")


def test_public_names_are_written_out() -> None:
    """Type checkers of other packages take imports for private unless a literal lists them."""
    listed = []
    for line in ast.parse(Path(tofuse.__file__).read_text(encoding="utf-8")).body:
        target = getattr(line, "target", None) or getattr(line, "targets", [None])[0]
        if isinstance(target, ast.Name) and target.id == "__all__":
            listed += ast.literal_eval(line.value)
    assert listed == tofuse.__all__


def test_public_names_exist() -> None:
    for name in tofuse.__all__:
        assert getattr(tofuse, name) is not None, name
    assert dir(tofuse) == sorted(tofuse.__all__)
    assert tofuse.open.__name__ == "open_recording"
    with pytest.raises(AttributeError, match="no attribute 'nonsense'"):
        tofuse.nonsense  # noqa: B018


def test_errors_state_place_problem_and_remedy_on_one_line() -> None:
    error = tofuse.InputError("is\n broken", where="a.txt", remedy="mend\tit")
    assert str(error) == "a.txt: is broken; mend it"
    assert (error.where, error.problem, error.remedy) == ("a.txt", "is\n broken", "mend\tit")
    assert str(tofuse.OutputError("can't be written")) == "can't be written"
    for kind in (tofuse.InputError, tofuse.OutputError, tofuse.RegistrationError):
        assert issubclass(kind, tofuse.TofuseError)


def test_reference_shows_every_public_name() -> None:
    page = (DOCS / "api.md").read_text(encoding="utf-8")
    shown = re.findall(r"^::: tofuse\.(\S+)$", page, re.MULTILINE)
    assert sorted(shown) == sorted(set(tofuse.__all__) - {"__version__"})
