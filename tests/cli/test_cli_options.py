"""From the words of a command line to options and a configuration, without running anything."""

from __future__ import annotations

import json
from argparse import ArgumentTypeError
from pathlib import Path
from typing import Any

import pytest

from cli_calls import refuses
from tofuse import __version__
from tofuse.apps.cli.commands import run_options
from tofuse.apps.cli.parser import make_parser
from tofuse.apps.cli.values import _size
from tofuse.apps.jobs.run_options import Options, resolve, seed_of
from tofuse.engine.errors import InputError, on_command_line
from tofuse.engine.mapping.methods import from_method
from tofuse.engine.parts import name_of


def options_of(*words: object) -> Options:
    return run_options(make_parser().parse_args(["run", "rec", "--out", "out", *map(str, words)]))


def config_of(*words: object) -> dict[str, Any]:
    return resolve(options_of(*words)).to_dict()


def test_defaults() -> None:
    options = options_of()
    assert options == Options(out=Path("out"))
    assert seed_of(options) == 0
    assert resolve(options) == from_method("default")


@pytest.mark.parametrize(
    ("words", "changed"),
    [
        ("--start 1 --end 7 --every 2", {"start": 1, "end": 7, "every": 2}),
        ("--seed 5 --threads 2", {"seed": 5, "threads": 2}),
        ("--min-depth 1 --max-depth 2.5", {"min_depth": 1.0, "max_depth": 2.5}),
        ("--tolerance 5mm --voxel 10cm --faces 5000",
         {"tolerance": 0.005, "voxel": 0.1, "faces": 5000}),
        ("--camera c.json --loops l.txt --config r.toml",
         {"camera": Path("c.json"), "loops": Path("l.txt"), "config": Path("r.toml")}),
        ("--guess odometry --method thesis", {"guess": "odometry", "method": "thesis"}),
        ("--memory 2GB", {"memory": 2 * 10**9}),
        ("--object --unwrap --overwrite --no-report --texture",
         dict.fromkeys(("object", "unwrap", "overwrite", "no_report", "texture"), True)),
        ("--format tum", {"format": "tum"}),
    ],
)  # fmt: skip
def test_words_become_options(words: str, changed: dict[str, Any]) -> None:
    assert options_of(*words.split()) == Options(out=Path("out"), **changed)


def test_home_folder_after_an_equals_sign(monkeypatch) -> None:
    """Shells expand `--out ~/result`, and leave `--out=~/result`."""
    monkeypatch.setenv("HOME", str(Path("/home/me")))
    monkeypatch.setenv("USERPROFILE", str(Path("/home/me")))
    assert options_of("--config=~/my.toml").config == Path("/home/me/my.toml")


def test_options_become_configuration() -> None:
    assert config_of("--guess", "identity")["odometry"]["guess"] == "identity"
    assert config_of("--moving", "ignore")["odometry"]["moving"] == "ignore"
    assert config_of("--tolerance", "5mm")["tolerance_m"] == 0.005
    fusion = config_of("--voxel", "10cm", "--faces", 5000)["fusion"]
    assert (fusion["voxel_m"], fusion["faces"]) == (0.1, 5000)
    assert config_of("--memory", "2GB")["memory_mb"] == 2000
    assert config_of("--unwrap")["corrections"][0]["part"] == "unwrap"


def test_filters_from_options_come_first() -> None:
    own = [name_of(f) for f in from_method("thesis").filters]
    for words, first in (
        (("--min-depth", 1), "distance"),
        (("--object", "--max-depth", 2.5), "distance"),
        (("--object",), "background"),
    ):
        filters = config_of("--method", "thesis", *words)["filters"]
        assert [f["part"] for f in filters] == [first, *own]
    corrections = [c["part"] for c in config_of("--object")["corrections"]]
    assert corrections[-2:] == ["scattering", "multipath"]
    assert config_of("--object")["priors"] == []


def test_options_override_those_of_file(tmp_path: Path) -> None:
    file = tmp_path / "my.toml"
    file.write_text('method = "thesis"\nfilters = []\n[fusion]\nvoxel_m = 0.1\n')
    config = config_of("--config", file, "--guess", "identity")
    assert (config["method"], config["filters"]) == ("thesis", [])
    assert (config["fusion"]["voxel_m"], config["odometry"]["guess"]) == (0.1, "identity")
    assert config_of("--config", file, "--voxel", "5cm")["fusion"]["voxel_m"] == 0.05


@pytest.mark.parametrize(
    "words",
    [
        "--faces 0",
        "--faces x",
        "--voxel 0mm",
        "--voxel 3 miles",
        "--tolerance -1mm",
        "--tolerance 5",  # millimetres are meant
    ],
)
def test_invalid_numbers_name_their_option(words: str, capfd) -> None:
    option, value = words.split(maxsplit=1)
    words = ("run", "rec", "--out", "out", option, value)
    refuses(capfd, *words, says=option, prefix="tofuse run: ")


@pytest.mark.parametrize(
    "words", [("run", "", "--out", "out"), ("run", "rec", "--out", ""), ("view", "")]
)
def test_empty_path_is_not_the_current_folder(words: tuple[str, ...], capfd) -> None:
    """That of a shell variable that is not set."""
    refuses(capfd, *words, says=("not a path",), prefix="tofuse")


@pytest.mark.parametrize(
    ("text", "size"), [("4GB", 4_000_000_000), ("1.5 mb", 1_500_000), ("2GiB", 2 << 30), ("7", 7)]
)
def test_memory_sizes_are_parsed(text: str, size: int) -> None:
    assert _size(text) == size


@pytest.mark.parametrize("text", ["", "0", "-1GB", "4 PB", "4ib", "nan", "1e3", "9" * 400 + "GB"])
def test_invalid_memory_sizes_are_rejected(text: str) -> None:
    with pytest.raises(ArgumentTypeError, match="not an amount of memory"):
        _size(text)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--mirrors",), "--mirrors: needs depth images"),
        (("--unwrap",), "--unwrap: needs depth images"),
        (("--object",), "--object: needs depth images.*--max-depth as well"),
    ],
)
def test_options_for_images_are_refused_with_clouds(words: tuple[str, ...], says: str) -> None:
    with on_command_line(), pytest.raises(InputError, match=says):
        resolve(options_of(*words), "cloud")
    resolve(options_of("--object", "--max-depth", "1"), "cloud")


def test_another_method_is_refused_with_a_run_json(tmp_path: Path) -> None:
    """Its options are all stated, so that the run would be of it, and be called by the other."""
    path = tmp_path / "run.json"
    config = from_method("default").to_dict()
    path.write_text(json.dumps({"schema": 1, "version": __version__, "config": config}))
    words = ("--config", str(path), "--method")
    assert resolve(options_of(*words, "default")) == from_method("default")
    with pytest.raises(InputError, match=r"is thesis, and .*run\.json states all options of def"):
        resolve(options_of(*words, "thesis"))
