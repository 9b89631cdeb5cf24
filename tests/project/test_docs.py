"""The documents are correct: code runs, commands parse, lists are complete, links are valid."""

from __future__ import annotations

import argparse
import dataclasses
import json
import re
import runpy
import shlex
import shutil
import subprocess
import tomllib
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import tofuse
from paths import ROOT
from tofuse.apps.cli.parser import DEMO_SCENES, make_parser
from tofuse.apps.jobs.pair import register_files
from tofuse.apps.results.pair import FILES as PAIR_FILES
from tofuse.apps.results.pair import pair_json
from tofuse.engine import parts
from tofuse.engine.alignment.projective import ProjectiveOptions
from tofuse.engine.alignment.uncertainty import UncertaintyOptions
from tofuse.engine.geometry import se3
from tofuse.engine.graph.graph import LoopRecord
from tofuse.engine.mapping.config import PACKAGES, Config, ViewKind, changed, from_method, methods
from tofuse.engine.quality.types import Component
from tofuse.engine.quality.verdict import REASONS
from tofuse.engine.views.surface_options import SurfaceOptions
from tofuse.formats.export.conversion import convert
from tofuse.formats.files.trajectory import read_tum
from tofuse.lab import demo
from tofuse.lab.simulation.models import CAMERAS
from written_run_json import run_json

DOCUMENTS = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])
NAMES = [str(path.relative_to(ROOT)) for path in DOCUMENTS]
CITED = (
    *("Arun et al. 1987", "Besl and McKay 1992", "Chen and Medioni 1992", "Godin et al. 1994"),
    *("Rusinkiewicz and Levoy 2001", "Sharp et al. 2002", "Chetverikov et al. 2005"),
    *("Almhdie et al. 2007", "Bergevin et al. 1996", "Lu and Milios 1997", "Pulli 1999"),
    *("Williams and Bennamoun 2001", "Castellani et al. 2002", "Fusiello et al. 2002"),
    *("Thrun and Montemerlo 2005", "Borrmann et al. 2008", "Sprickerhof et al. 2009"),
    *("Olson 2008", "Nüchter et al. 2007", "May et al. 2009", "Prusak et al. 2008", "Artner 2009"),
    *("Mure-Dubois and Hügli 2008", "Fuchs and Hirzinger 2008", "Gruen and Akca 2005"),
    *("Akca 2007", "Akca and Gruen 2007", "Pottmann et al. 2004", "Magnusson 2006"),
    *("Smith et al. 2008", "Barnea and Filin 2008", "Bae and Lichti 2008"),
    *("Fischler and Bolles 1981", "Lowe 1999, 2004", "Wheeler and Ikeuchi 1995"),
    *("Söderkvist and Wedin 1994", "Moore 1991", "Hartley and Zisserman 2003"),
)
PART_PACKAGES = (*PACKAGES, "tofuse.formats.readers", "tofuse.apps.live.devices")


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


def rows(text: str) -> list[list[str]]:
    """Cells of the tables in a text, without their heads."""
    lines = re.findall(r"^\|(.*)\|\s*$", text, re.MULTILINE)
    cells = [[cell.strip() for cell in line.split("|")] for line in lines]
    rules = [k for k, row in enumerate(cells) if all(set(cell) <= set("-: ") for cell in row)]
    heads = {k - 1 for k in rules}
    return [row for k, row in enumerate(cells) if k not in rules and k not in heads]


def codes(text: str) -> set[str]:
    prose = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    return set(re.findall(r"`([^`]+)`", prose))


@pytest.fixture(scope="module")
def short_recording(room_recording: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The first frames of the room."""
    out = tmp_path_factory.mktemp("short") / "recording"
    convert(tofuse.open(room_recording).select(0, 3), out)
    return out


@pytest.mark.slow
@pytest.mark.parametrize("name", with_blocks("python"))
def test_python_in_documents_runs(
    name: str, short_recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(short_recording, tmp_path / "recording")
    monkeypatch.chdir(tmp_path)
    registered_parts()  # imported now, so that only parts of the document are removed afterwards
    known = {kind: dict(known) for kind, known in parts._registry.items()}
    monkeypatch.setattr(parts, "_registry", known)
    # docs/formats.md assumes depth images of the camera that it shows.
    names: dict[str, Any] = {"depth_images": np.ones((2, 424, 512), np.float32)}
    for k, code in enumerate(blocks(name, "python")):
        exec(compile(code, f"{name}, python block {k}", "exec", dont_inherit=True), names)


def test_worked_pose_matches_document(tmp_path: Path) -> None:
    (line,) = re.findall(r"^12\.5 .*$", text_of("docs/conventions.md"), re.MULTILINE)
    (tmp_path / "trajectory.txt").write_text(line + "\n")
    times, (T,) = read_tum(tmp_path / "trajectory.txt")
    assert times.tolist() == [12.5]
    # 30 degrees about y, by the definition of a rotation matrix.
    c, s = np.sqrt(3) / 2, 0.5
    np.testing.assert_allclose(
        T, [[c, 0, s, 0.5], [0, 1, 0, 0], [-s, 0, c, 0.2], [0, 0, 0, 1]], atol=1e-8
    )
    np.testing.assert_allclose(se3.transform(T, [[0, 0, 2]]), [[1.5, 0, 0.2 + np.sqrt(3)]])


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
        for key in changes:
            assert key in config.to_dict()


@pytest.mark.parametrize("name", with_blocks("json"))
def test_json_in_documents_is_json(name: str) -> None:
    for block in blocks(name, "json"):
        json.loads(block)


def anchors(name: str) -> set[str]:
    """Anchors that the headings of a document get on code hosting sites."""
    headings = re.findall(r"^#+ +(.+)$", text_of(name), re.MULTILINE)
    kept = [re.sub(r"[^\w\- ]", "", heading.lower()) for heading in headings]
    return {heading.replace(" ", "-") for heading in kept}


@pytest.mark.parametrize("name", NAMES)
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
    """Paths in backticks that look like this project's own files."""
    bases = [ROOT, ROOT / "src" / "tofuse"]
    rooms = {p.name for p in bases[1].iterdir() if p.is_dir()} | {"benchmarks", "tests", "docs"}
    for code in codes(text_of(name)):
        path = code.removeprefix("src/tofuse/")
        if path.split("/")[0] in rooms and re.fullmatch(r"[\w./]+\.(py|md)", path):
            assert any((base / path).exists() for base in bases), f"{name} names {code}"


@pytest.mark.parametrize("name", NAMES)
def test_every_document_is_reached_from_the_readme(name: str) -> None:
    reached, todo = set(), ["README.md"]
    while todo:
        here = todo.pop()
        if here in reached:
            continue
        reached.add(here)
        for target in re.findall(r"\]\(([^)#\s]+\.md)", text_of(here)):
            if not target.startswith("http"):
                linked = ((ROOT / here).parent / target).resolve().relative_to(ROOT)
                todo.append(str(linked))
    assert name in reached or name == "CHANGELOG.md"


def commands() -> dict[str, argparse.ArgumentParser]:
    (action,) = (a for a in make_parser()._actions if isinstance(a, argparse._SubParsersAction))
    return dict(action.choices)


def options(parser: argparse.ArgumentParser) -> set[str]:
    nested = [a for a in parser._actions if isinstance(a, argparse._SubParsersAction)]
    own = {option for a in parser._actions for option in a.option_strings} - {"-h", "--help"}
    return own.union(*(options(p) for a in nested for p in a.choices.values()))


@pytest.mark.parametrize("command", sorted(commands()))
def test_every_option_of_a_command_is_documented(command: str) -> None:
    section = sections("docs/commands.md")[f"tofuse {command}"]
    documented = {
        word
        for row in rows(section)
        for code in codes(row[0])
        for word in code.split()
        if word.startswith("--")
    }
    assert documented == options(commands()[command])


def test_every_documented_command_exists() -> None:
    documented = {
        heading.removeprefix("tofuse ")
        for heading in sections("docs/commands.md")
        if heading.startswith("tofuse ")
    }
    assert documented == set(commands())


def test_choices_are_documented() -> None:
    found = sections("docs/commands.md")
    assert set(DEMO_SCENES) <= codes(found["tofuse demo"])
    assert set(CAMERAS) <= codes(found["tofuse simulate"])
    named = {row[0].strip("`") for row in rows(sections("docs/methods.md")["Configurations"])}
    assert set(methods()) <= named
    for action in commands()["run"]._actions:
        if action.choices:
            assert set(action.choices) <= codes(found["tofuse run"])


def test_reason_codes_are_the_closed_list() -> None:
    table = rows(sections("docs/commands.md")["The verdict"])
    assert {row[0].strip("`"): (row[1], row[2]) for row in table} == REASONS


@pytest.mark.slow
def test_every_field_of_run_json_is_documented(short_recording: Path) -> None:
    result = tofuse.reconstruct(tofuse.open(short_recording))
    data = run_json(result)
    section = sections("docs/commands.md")["run.json"]
    top, accuracy, frames, components, loops = re.split(
        r"^Fields of an? \w+(?:, .*)?:$", section, flags=re.MULTILINE
    )
    assert {c for row in rows(top) for c in codes(row[0])} == set(data)
    assert {c for row in rows(accuracy) for c in codes(row[0])} == set(data["accuracy"])
    assert set(data["accuracy"]["worst"]) <= codes(accuracy)
    assert {row[0].strip("`") for row in rows(frames)} == set(data["frames"][0])
    fields = {f.name for f in dataclasses.fields(Component)} - {"result"}
    assert {row[0].strip("`") for row in rows(components)} == fields
    record = {f.name for f in dataclasses.fields(LoopRecord)}
    assert {c for row in rows(loops) for c in codes(row[0])} == record
    meaning = {c: row[1] for row in rows(top) for c in codes(row[0])}
    assert set(data["input"]) <= codes(meaning["input"])
    assert {"code", "frames", "ranges", "text"} <= codes(meaning["reasons"])
    assert all(set(entry) <= codes(meaning["filters"]) for entry in data["filters"].values())


def test_every_field_of_registration_json_is_documented(room_recording: Path) -> None:
    result = register_files(f"{room_recording}#1", f"{room_recording}#0")
    files, fields = re.split(
        r"^`registration.json` is .*$",
        sections("docs/commands.md")["tofuse register"],
        flags=re.MULTILINE,
    )
    assert {c for row in rows(fields) for c in codes(row[0])} == set(pair_json(result))
    written = {row[0].strip("`") for row in rows(files) if not row[0].startswith("`--")}
    assert written == set(PAIR_FILES)


def documented_parts() -> dict[str, dict[str, list[str]]]:
    """Rows of docs/methods.md by kind and name; the kind is in the heading."""
    out: dict[str, dict[str, list[str]]] = {}
    for heading, text in sections("docs/methods.md").items():
        kind = re.search(r"\(`([\w-]+)`\)$", heading)
        if kind:
            listed = [row for row in rows(text) if row[1] in ("validated", "experimental")]
            out[kind[1]] = {row[0].strip("`"): row for row in listed}
    return out


def registered_parts() -> dict[str, dict[str, type]]:
    for package in PART_PACKAGES:
        parts.discover(package)
    found = {kind: parts.registered(kind) for kind in parts._registry}
    # Parts that other tests define do not belong to the package.
    ours = {
        kind: {n: c for n, c in known.items() if c.__module__.startswith("tofuse.")}
        for kind, known in found.items()
    }
    return {kind: known for kind, known in ours.items() if known}


def test_every_part_is_listed_with_its_label() -> None:
    """A new part gets a row in docs/methods.md, below the heading with its kind."""
    listed = {
        (kind, name, row[1])
        for kind, known in documented_parts().items()
        for name, row in known.items()
    }
    registered = {
        (kind, name, cls.part_label)  # type: ignore[attr-defined]
        for kind, known in registered_parts().items()
        for name, cls in known.items()
    }
    assert registered - listed == set(), "not in docs/methods.md"
    assert listed - registered == set(), "only in docs/methods.md"


def test_tables_of_thesis_match_script() -> None:
    """It also fails where a row names a module, a part or a test that does not exist."""
    script = runpy.run_path(str(ROOT / "website" / "thesis.py"))
    page = text_of("docs/thesis.md")
    assert script["written"](page) == page, "run python website/thesis.py"


def test_every_work_cited_by_thesis_is_listed() -> None:
    text = sections("docs/thesis.md")["Works that it cites"]
    missing = [name for name in CITED if name not in text]
    assert not missing
    assert "not there" not in text_of("docs/thesis.md")


def test_every_option_of_a_part_is_listed() -> None:
    registered = registered_parts()
    for kind, known in documented_parts().items():
        for name, row in known.items():
            fields = {f.name for f in dataclasses.fields(registered[kind][name])}
            missing = fields - codes(" ".join(row[2:]))
            assert not missing, f"{kind} {name}"


def test_options_of_nested_dataclasses_are_listed() -> None:
    """Options that are plain dataclasses have options themselves, as those of keyframes."""
    text = codes(text_of("docs/methods.md"))
    for kind, known in registered_parts().items():
        for name, cls in known.items():
            defaults = [
                f.default if f.default is not dataclasses.MISSING else f.default_factory()
                for f in dataclasses.fields(cls)
                if (f.default, f.default_factory) != (dataclasses.MISSING, dataclasses.MISSING)
            ]
            for value in defaults:
                if dataclasses.is_dataclass(value) and not hasattr(value, "part_label"):
                    missing = {f.name for f in dataclasses.fields(value)} - text
                    assert not missing, f"{kind} {name}: {type(value).__name__}"


def stated_defaults(text: str) -> Iterator[tuple[str, float]]:
    """Options with a number in brackets behind them: `points` (1000)."""
    for name, number, unit in re.findall(r"`(\w+)` \(([\d.]+(?:e-?\d+)?)(\s+degrees)?", text):
        yield name, np.radians(float(number)) if unit else float(number)


def numbers_of(options: Any) -> dict[str, float]:
    """Defaults of a dataclass that are numbers."""
    values = {f.name: f.default for f in dataclasses.fields(options)}
    return {n: v for n, v in values.items() if isinstance(v, int | float)}


def test_stated_defaults_match_parts() -> None:
    checked = 0
    for kind, known in documented_parts().items():
        for name, row in known.items():
            numbers = numbers_of(registered_parts()[kind][name])
            for option, value in stated_defaults(" ".join(row[2:])):
                if option in numbers:
                    assert np.isclose(numbers[option], value), f"{kind} {name}: {option}"
                    checked += 1
    assert checked > 40


def test_stated_defaults_match_keyframes() -> None:
    numbers: dict[str, float] = {}
    for constants in (UncertaintyOptions, ProjectiveOptions, SurfaceOptions):
        numbers |= numbers_of(constants)
    stated = dict(stated_defaults(sections("docs/methods.md")["How `keyframes` works"]))
    checked = numbers.keys() & stated.keys()
    assert {option: stated[option] for option in checked} == pytest.approx(
        {option: numbers[option] for option in checked}
    )
    assert len(checked) > 15


def test_constants_of_covariance_match_tracker() -> None:
    numbers = numbers_of(UncertaintyOptions)
    table = [row for row in rows(text_of("docs/uncertainty.md")) if codes(row[0]) & set(numbers)]
    stated = {option: float(row[1]) for row in table for option in codes(row[0])}
    assert stated == pytest.approx({option: numbers[option] for option in stated})
    assert len(stated) == 7


def options_of(data: Any, path: str = "") -> dict[str, str]:
    """Options of a configuration's data by path, parts of a list by their names, as JSON."""
    found: dict[str, str] = {}
    if isinstance(data, dict):
        for key, value in data.items():
            if key != "part":
                found |= options_of(value, f"{path}.{key}" if path else key)
    elif isinstance(data, list) and data and isinstance(data[0], dict):
        for item in data:
            found |= options_of(item, f"{path}.{item['part']}")
    else:
        found[path] = json.dumps(data)
    return found


@pytest.mark.parametrize("kind", ["range", "cloud"])
def test_default_configuration_has_few_options(kind: ViewKind) -> None:
    """What users have no reason to set should be a constant."""
    assert len(options_of(from_method("default", kind).to_dict())) <= 60


def test_options_of_default_configuration_are_listed_with_defaults() -> None:
    tables = {
        name: {row[0].strip("`"): row[1].strip("`") for row in rows(text)}
        for name, text in sections("docs/options.md").items()
        if rows(text)
    }
    images, clouds = tables["Range images"], tables["Clouds"]
    assert images == options_of(from_method("default", "range").to_dict())
    assert images | clouds == images | options_of(from_method("default", "cloud").to_dict())
    assert not clouds.items() & images.items()


def test_every_field_of_configuration_is_described() -> None:
    table = rows(sections("docs/methods.md")["Configurations"])
    described = {row[0].strip("`") for row in table} - set(methods())
    fields = {f.name for f in dataclasses.fields(Config)} - {"method"}
    assert described == fields


def parts_named(data: Any) -> set[str]:
    """Names of the parts of a configuration's data that are not inside another part."""
    if isinstance(data, dict):
        return {data["part"]} if "part" in data else set()
    return set().union(*(parts_named(item) for item in data)) if isinstance(data, list) else set()


@pytest.mark.parametrize(
    ("column", "method", "kind"),
    [(2, "default", "range"), (3, "default", "cloud"), (4, "thesis", "range")],
)
def test_table_of_configurations_names_their_parts(
    column: int, method: str, kind: ViewKind
) -> None:
    config = from_method(method, kind).to_dict()
    for row in rows(sections("docs/methods.md")["Configurations"]):
        field = row[0].strip("`")
        if field in config and field not in ("loops", "fusion", "method"):
            names = {code for code in codes(row[column]) if code != "lamp"}
            assert names == parts_named(config[field]), f"{method}, {kind}: {field}"


def test_packages_are_described_in_order_of_imports() -> None:
    project = tomllib.loads(text_of("pyproject.toml"))
    layers = project["tool"]["importlinter"]["contracts"][0]["layers"]
    ranks = {room.strip(): rank for rank, layer in enumerate(layers) for room in layer.split("|")}
    table = rows(sections("ARCHITECTURE.md")["Packages"])
    described = [row[0].strip("`") for row in table if not row[0].strip("`").endswith(("/", "."))]
    assert set(described) == set(ranks) - {"_version"}
    order = [ranks[room] for room in described]
    assert order == sorted(order, reverse=True)


def test_version_is_the_same_everywhere() -> None:
    assert f"version: {tofuse.__version__}\n" in text_of("CITATION.cff")
    assert f"## [{tofuse.__version__}]" in text_of("CHANGELOG.md")


def test_documents_are_small_enough_to_clone() -> None:
    tracked = subprocess.run(
        ["git", "ls-files", "docs"], cwd=ROOT, capture_output=True, text=True, check=False
    ).stdout.split()
    for name in tracked:
        assert (ROOT / name).stat().st_size < 200_000, name


def test_troubleshooting_explains_every_reason() -> None:
    explained = re.findall(r"^### (.+)$", text_of("docs/troubleshooting.md"), re.MULTILINE)
    assert sorted(explained) == sorted(REASONS)


def test_troubleshooting_sorts_reasons_by_their_verdict() -> None:
    parts_of = re.split(r"^## +", text_of("docs/troubleshooting.md"), flags=re.MULTILINE)
    below = {part.split("\n", 1)[0]: part for part in parts_of}
    headings = {
        "failed": "The result failed",
        "degraded": "The result is degraded",
        "note": "Notes",
    }
    for code, (verdict, _) in REASONS.items():
        assert f"### {code}\n" in below[headings[verdict]]


NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))


def run_notebook(path: Path) -> dict[str, Any]:
    """Run the code cells of a notebook, one after the other; the last line of a cell is shown."""
    names: dict[str, Any] = {}
    for k, cell in enumerate(json.loads(path.read_text(encoding="utf-8"))["cells"]):
        if cell["cell_type"] == "code":
            assert not cell["outputs"], "outputs of notebooks are not kept: they go stale"
            code = compile("".join(cell["source"]), f"{path.name}, cell {k}", "exec")
            exec(code, names)
    return names


JUDGING = ROOT / "docs" / "notebooks" / "judging_poses.ipynb"


def simulate_less(monkeypatch: pytest.MonkeyPatch, *effects: str, frames: int) -> None:
    """Frames and camera effects take most of the time; the code does not need all of them."""
    simulate_to = demo.simulate_to

    def simulated(scene: str, out: Path, **options: Any) -> int:
        return simulate_to(scene, out, **options | {"frames": frames, "without": effects})

    monkeypatch.setattr(demo, "simulate_to", simulated)


@pytest.mark.slow
@pytest.mark.parametrize("path", sorted({*NOTEBOOKS} - {JUDGING}), ids=lambda path: path.stem)
def test_notebooks_run(
    path: Path, short_recording: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shutil.copytree(short_recording, tmp_path / "scan")
    monkeypatch.chdir(tmp_path)
    simulate_less(monkeypatch, "all", frames=3)
    names = run_notebook(path)
    assert len(names["recording"]) > 1


@pytest.mark.slow
def test_phone_notebook_runs_on_phone_scan(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, shared_data: Path
) -> None:
    scan = shared_data / "iphone_record3d"
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("TOFUSE_SCAN", str(scan))
    opened = tofuse.open
    monkeypatch.setattr(tofuse, "open", lambda path: opened(path).select(0, 8))
    names = run_notebook(ROOT / "docs" / "notebooks" / "phone_scan.ipynb")
    assert (tmp_path / "scan.glb").stat().st_size > 10_000
    assert np.isfinite(names["result"].trajectory).all()


@pytest.mark.slow
def test_judging_notebook_detects_drift(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    # Those that need many rays per pixel; noise remains.
    simulate_less(monkeypatch, "mixed_pixels", "multipath", "smear", frames=16)
    names = run_notebook(JUDGING)
    moved = {k: float(np.nanmax(j.displacement_m)) for k, j in names["judgements"].items()}
    assert moved["drifted"] > 0.03 > moved["true"]
