"""The documents are correct: code runs, commands parse, tables are complete, links are valid."""

from __future__ import annotations

import dataclasses
import json
import re
import shlex
import shutil
import sys
import tomllib
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import tofuse
from paths import ROOT
from tofuse.apps.cli.parser import make_parser
from tofuse.apps.pairs.job import register_files
from tofuse.apps.pairs.result import pair_json
from tofuse.engine import parts
from tofuse.engine.mapping.config import ViewKind, changed
from tofuse.engine.mapping.methods import from_method
from tofuse.engine.results.verdicts import REASONS
from tofuse.formats.export.conversion import convert
from tofuse.lab import demo
from written_run_json import run_json

sys.path.insert(0, str(ROOT / "website"))
import reference

DOCUMENTS = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])
NAMES = [str(path.relative_to(ROOT)) for path in DOCUMENTS]


@cache
def text_of(name: str) -> str:
    return (ROOT / name).read_text(encoding="utf-8")


def blocks(name: str, language: str) -> list[str]:
    """Fenced code blocks of a document in one language."""
    return re.findall(rf"^```{language}\n(.*?)^```", text_of(name), re.MULTILINE | re.DOTALL)


def with_blocks(language: str) -> list[str]:
    return [name for name in NAMES if blocks(name, language)]


def sections(name: str) -> dict[str, str]:
    """Text below each heading, by heading, up to the next one of any level."""
    pieces = re.split(r"^#+ +(.+)$", text_of(name), flags=re.MULTILINE)
    return dict(zip(pieces[1::2], pieces[2::2], strict=True))


def codes(text: str) -> set[str]:
    prose = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    return set(re.findall(r"`([^`]+)`", prose))


# Examples.


@pytest.fixture(scope="module")
def short_recording(room_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first frames of the room."""
    out = tmp_path_factory.mktemp("short") / "recording"
    convert(tofuse.open(room_recording).select(0, 3), out)
    return out


def examples() -> list[Any]:
    """Documents with Python; those that reconstruct something take long."""
    slow = r"reconstruct\(|Mapper\(|register\(|inspect\("
    return [
        pytest.param(
            name,
            marks=[pytest.mark.nightly] if re.search(slow, "".join(blocks(name, "python"))) else [],
        )
        for name in with_blocks("python")
    ]


@pytest.mark.parametrize("name", examples())
def test_python_in_documents_runs(name, short_recording, tmp_path, monkeypatch) -> None:
    shutil.copytree(short_recording, tmp_path / "recording")
    monkeypatch.chdir(tmp_path)
    reference.kinds()  # imported now, so that only parts of the document are removed afterwards
    known = {kind: dict(known) for kind, known in parts._registry.items()}
    monkeypatch.setattr(parts, "_registry", known)
    # docs/formats.md assumes depth images of the camera that it shows.
    names: dict[str, Any] = {"depth_images": np.ones((2, 424, 512), np.float32)}
    for k, code in enumerate(blocks(name, "python")):
        exec(compile(code, f"{name}, python block {k}", "exec", dont_inherit=True), names)


@pytest.mark.parametrize("name", with_blocks("bash"))
def test_command_lines_in_documents_parse(name: str) -> None:
    lines = [line for block in blocks(name, "bash") for line in block.splitlines() if line.strip()]
    for line in lines:
        program, *arguments = shlex.split(line, comments=True)
        assert program == "tofuse", line
        make_parser().parse_args(arguments)


@pytest.mark.parametrize("name", with_blocks("toml"))
def test_configurations_in_documents_are_accepted(name: str) -> None:
    for block in blocks(name, "toml"):
        changes = tomllib.loads(block)
        config = changed(from_method(changes.get("method", "default")), changes, where=name)
        assert changes.keys() <= config.to_dict().keys()


@pytest.mark.parametrize("name", with_blocks("json"))
def test_json_in_documents_is_json(name: str) -> None:
    for block in blocks(name, "json"):
        json.loads(block)


# Links and names.


def anchors(name: str) -> set[str]:
    """Anchors that the headings of a document get on code hosting sites."""
    headings = re.findall(r"^#+ +(.+)$", text_of(name), re.MULTILINE)
    kept = [re.sub(r"[^\w\- ]", "", heading.lower()) for heading in headings]
    return {heading.replace(" ", "-") for heading in kept}


@pytest.mark.parametrize("name", [*NAMES, "benchmarks/README.md"])
def test_links_are_valid(name: str) -> None:
    for target in re.findall(r"\]\(([^)\s]+)\)", text_of(name)):
        if target.startswith(("http://", "https://")):
            continue
        path, _, anchor = target.partition("#")
        file = (ROOT / name).parent / path if path else ROOT / name
        assert file.exists(), f"{name} links to {target}"
        if anchor:
            linked = str(file.resolve().relative_to(ROOT))
            assert anchor in anchors(linked), f"{name} links to {target}"


@pytest.mark.parametrize("name", NAMES)
def test_files_named_in_documents_exist(name: str) -> None:
    """Paths in backticks that look like this project's own files, and names of Python files."""
    bases = [ROOT, ROOT / "src" / "tofuse"]
    rooms = {p.name for p in bases[1].iterdir() if p.is_dir()} | {"benchmarks", "tests", "docs"}
    for code in codes(text_of(name)):
        path = code.removeprefix("src/tofuse/")
        if path.split("/")[0] in rooms and re.fullmatch(r"[\w./]+\.(py|md)", path):
            assert any((base / path).exists() for base in bases), f"{name} names {code}"
        elif re.fullmatch(r"\w+\.py", code):
            folders = (ROOT / folder for folder in ("src", "benchmarks", "tests", "website"))
            found = (ROOT / code).exists() or any(any(f.rglob(code)) for f in folders)
            assert found, f"{name} names {code}"


def test_modules_named_in_sources_exist() -> None:
    """Names `room.module` in docstrings and comments: no module has moved since."""
    package = ROOT / "src" / "tofuse"
    rooms: dict[str, set[str]] = {}
    for path in package.rglob("*"):
        rooms.setdefault(path.stem, set()).add(path.parent.name)
    for path in package.rglob("*.py"):
        for room, module in re.findall(r"`([a-z_]+)\.(\w+)[.\w]*`", path.read_text("utf-8")):
            is_file = module in {"html", "js", "ply", "glb", "usdz"}
            if module in rooms and not is_file and room not in {"tofuse", "platform"}:
                assert room in rooms[module], f"{path} names {room}.{module}"


def test_every_benchmark_is_listed() -> None:
    listed = codes(text_of("benchmarks/README.md"))
    for path in (ROOT / "benchmarks").glob("*.py"):
        imported = any(
            re.search(rf"^(from|import) {path.stem}\b", other.read_text("utf-8"), re.MULTILINE)
            for other in (ROOT / "benchmarks").rglob("*.py")
        )
        assert imported or path.name in listed, path.name


def test_version_is_the_same_everywhere() -> None:
    assert f"version: {tofuse.__version__}\n" in text_of("CITATION.cff")
    assert f"## [{tofuse.__version__}]" in text_of("CHANGELOG.md")


def test_buildings_are_described_in_order_of_imports() -> None:
    contracts = tomllib.loads(text_of("pyproject.toml"))["tool"]["importlinter"]["contracts"]
    house = sections("ARCHITECTURE.md")["The house"]
    buildings = [layer for layer in contracts[0]["layers"] if not layer.startswith("_")]
    assert re.findall(r"^\| `(\w+)` \|", house, re.MULTILINE) == buildings[::-1]
    # The rooms of the engine, in prose; its single files are not named.
    engine = ROOT / "src" / "tofuse" / "engine"
    rooms = [layer for layer in contracts[1]["layers"] if (engine / layer).is_dir()]
    described = house[house.index("The rooms of the engine") :].split("\n\n")[0]
    assert [room for room in re.findall(r"\*(\w+)\*", described) if room in rooms] == rooms[::-1]


# Generated tables.


@pytest.mark.parametrize("name", sorted(reference.tables()))
def test_tables_can_be_made(name: str) -> None:
    """It also fails where a row of thesis.toml names a file or part that does not exist."""
    assert "|---" in reference.table(name) or name.startswith("parts ")


def test_every_table_is_on_a_page() -> None:
    shown = [name for page in NAMES for name in reference.PLACEHOLDER.findall(text_of(page))]
    assert len(shown) == len(set(shown))
    # Readers are the table of formats.
    assert set(shown) == reference.tables().keys() - {"parts reader"}
    with pytest.raises(ValueError, match="no table 'parts nothing'"):
        reference.filled("<!-- table: parts nothing -->")


PARTS = [cls for known in reference.kinds().values() for cls in known.values()]


@pytest.mark.parametrize("cls", PARTS, ids=lambda cls: f"{cls.part_kind} {cls.part_name}")
def test_every_part_is_listed_with_all_of_its_options(cls: Any) -> None:
    entry = reference.part_entry(cls)
    assert f"**`{cls.part_name}`** ({cls.part_label}" in entry
    assert reference.summary(cls).endswith((".", ":"))
    listed = {option.path.split(".")[0]: option for option in reference.options_of(cls)}
    assert listed.keys() == {field.name for field in dataclasses.fields(cls)}
    for option in reference.options_of(cls):
        assert option.text.endswith((".", '"')), f"{option.path} has no text in the docstring"
        assert f"| `{option.path}` | {option.default} |" in entry


@pytest.mark.parametrize("kind", ["range", "cloud"])
def test_default_configuration_has_few_options(kind: ViewKind) -> None:
    """What users have no reason to set should be a constant."""
    options = list(reference.options_of(from_method("default", kind)))
    assert 40 < len(options) <= 62
    assert all(option.text for option in options)


def test_options_of_default_configuration_are_paths_in_its_data() -> None:
    data, table = from_method("default", "range").to_dict(), reference.table("options range")
    for option in reference.options_of(from_method("default", "range")):
        here: Any = data
        for key in option.path.split("."):
            named = isinstance(here, list)
            here = next(p for p in here if p["part"] == key) if named else here[key]
        assert option.default == f"`{json.dumps(here)}`"
        assert f"| `{option.path}` |" in table
    assert "`odometry.references`" in reference.table("options cloud")
    assert "`memory_mb`" not in reference.table("options cloud")


def test_every_command_and_option_is_listed() -> None:
    assert reference.commands().keys() >= {"run", "rig check", "view"}
    for name, parser in reference.commands().items():
        table = reference.table(f"command {name}")
        for action in reference.arguments_of(parser):
            assert action.help
            options = "`, `".join(action.option_strings)
            assert f"| `{options}" in table, action
        assert f"## tofuse {name.split()[0]}\n" in text_of("docs/commands.md")
    table = reference.table("command run")
    assert "| `--memory SIZE` | approximate memory limit" in table
    assert "| `--overwrite` |" in table
    assert "| `--set NAME=VALUE` |" in reference.table("command record")
    assert "0.5 % of the model" in table


def test_every_format_is_listed_and_has_its_quirks() -> None:
    table, page = reference.table("formats"), text_of("docs/formats.md")
    for name in reference.kinds()["reader"]:
        assert f"| `{name}` |" in table
        assert re.search(rf"\*\*[^*]*`{name}`|^##.* {name}$|^## The {name} ", page, re.MULTILINE)


def test_reason_codes_are_listed_with_their_verdict() -> None:
    table = reference.table("reasons")
    for code, (verdict, text) in REASONS.items():
        assert f"| `{code}` | {verdict} | {text} |" in table


def test_troubleshooting_explains_every_reason_below_its_verdict() -> None:
    page = text_of("docs/troubleshooting.md")
    assert sorted(re.findall(r"^### (.+)$", page, re.MULTILINE)) == sorted(REASONS)
    below = dict(part.split("\n", 1) for part in re.split(r"^## ", page, flags=re.MULTILINE))
    headings = {"failed": "The result failed", "degraded": "The result is degraded"}
    for code, (verdict, _) in REASONS.items():
        assert f"### {code}\n" in below[headings.get(verdict, "Notes")]


@pytest.mark.nightly
def test_every_field_of_json_is_documented(short_recording: Path) -> None:
    data = run_json(tofuse.reconstruct(tofuse.open(short_recording)))
    page = codes(reference.filled(text_of("docs/commands.md") + text_of("docs/results.md")))
    found = {*data, *data["input"], *data["accuracy"], *data["frames"][0]}
    found |= {"code", "frames", "ranges", "text", "removed"}
    pair = pair_json(register_files(f"{short_recording}#1", f"{short_recording}#0"))
    assert found | pair.keys() <= page


# Notebooks.

NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))
JUDGING = ROOT / "docs" / "notebooks" / "judging_poses.ipynb"


def run_notebook(path: Path) -> dict[str, Any]:
    """Run the code cells of a notebook, one after the other."""
    names: dict[str, Any] = {}
    for k, cell in enumerate(json.loads(path.read_text(encoding="utf-8"))["cells"]):
        if cell["cell_type"] == "code":
            assert not cell["outputs"], "outputs of notebooks are not kept: they go stale"
            exec(compile("".join(cell["source"]), f"{path.name}, cell {k}", "exec"), names)
    return names


def simulate_less(monkeypatch: pytest.MonkeyPatch, *effects: str, frames: int) -> None:
    """Frames and camera effects take most of the time; the code does not need all of them."""
    simulate_to = demo.simulate_to

    def simulated(scene: str, out: Path, **options: Any) -> int:
        return simulate_to(scene, out, **options | {"frames": frames, "without": effects})

    monkeypatch.setattr(demo, "simulate_to", simulated)


@pytest.mark.nightly
@pytest.mark.parametrize("path", sorted({*NOTEBOOKS} - {JUDGING}), ids=lambda path: path.stem)
def test_notebooks_run(path: Path, short_recording: Path, tmp_path: Path, monkeypatch) -> None:
    shutil.copytree(short_recording, tmp_path / "scan")
    monkeypatch.chdir(tmp_path)
    simulate_less(monkeypatch, "all", frames=3)
    assert len(run_notebook(path)["recording"]) > 1


@pytest.mark.nightly
def test_phone_notebook_runs_on_phone_scan(tmp_path: Path, monkeypatch, shared_data: Path) -> None:
    scan = shared_data / "iphone_record3d"
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TOFUSE_SCAN", str(scan))
    opened = tofuse.open
    monkeypatch.setattr(tofuse, "open", lambda path: opened(path).select(0, 8))
    names = run_notebook(ROOT / "docs" / "notebooks" / "phone_scan.ipynb")
    assert (tmp_path / "scan.glb").stat().st_size > 10_000
    assert np.isfinite(names["result"].trajectory).all()


@pytest.mark.nightly
def test_judging_notebook_detects_drift(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    # Those that need many rays per pixel; noise remains.
    simulate_less(monkeypatch, "mixed_pixels", "multipath", "smear", frames=16)
    names = run_notebook(JUDGING)
    moved = {k: float(np.nanmax(j.displacement_m)) for k, j in names["judgements"].items()}
    assert moved["drifted"] > 0.03 > moved["true"]
