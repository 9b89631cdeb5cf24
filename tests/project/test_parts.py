"""Parts: found by name, described by their fields, refused with the field's name."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal, Protocol

import pytest

from refused import refused
from tofuse.engine import parts
from tofuse.engine.bounds import Bounded, Bounds, NotEmpty
from tofuse.engine.errors import InputError
from tofuse.engine.mapping.config import Config, changed
from tofuse.engine.mapping.methods import from_method, methods


class Shape(Protocol):
    part_kind: ClassVar[str] = "test-shape"


@parts.part("test-shape", "round", label="validated")
@dataclass(frozen=True)
class Round(Bounded, Shape):
    radius: Annotated[float, Bounds(0, exclusive=True)] = 1.0
    kind: Literal["disc", "ball"] = "disc"


@parts.part("test-shape", "square")
@dataclass(frozen=True)
class Square(Shape):
    corner: tuple[float, float]
    holes: tuple[Shape, ...] = ()
    count: int | None = None
    solid: bool = True


def read(data):
    return parts.from_dict(Shape, data, where="my.toml")


@pytest.mark.parametrize("method", methods())
def test_methods_survive_json_round_trip(method) -> None:
    config = from_method(method)
    text = json.dumps(config.to_dict(), allow_nan=False)
    back = parts.from_dict(Config, json.loads(text), where="run.json")
    assert back == config
    assert json.dumps(back.to_dict()) == text


def test_nested_parts_survive_round_trip() -> None:
    shape = Square((1.0, 2.0), (Round(0.5, "ball"), Square((0.0, 0.0))), count=3)
    data = parts.to_dict(shape)
    assert data["part"] == "square"
    assert data["holes"][0] == {"part": "round", "radius": 0.5, "kind": "ball"}
    assert read(data) == shape


def test_duplicate_part_names_are_refused() -> None:
    with pytest.raises(ValueError, match="two parts are called test-shape 'round'"):

        @parts.part("test-shape", "round")
        @dataclass(frozen=True)
        class Other:
            pass

    assert parts.registered("test-shape")["round"] is Round


@pytest.mark.parametrize(
    ("data", "message"),
    [
        ({"part": "round", "radius": "a"}, r"my\.toml: radius: is 'a'; use a number"),
        ({"part": "round", "radius": True}, r"my\.toml: radius: is True; use a number"),
        ({"part": "round", "radius": -1}, r"my\.toml: radius must be above 0, not -1\.0"),
        ({"part": "round", "radius": float("nan")}, r"radius must be above 0, not nan"),
        ({"part": "round", "radios": 1}, r"my\.toml: unknown option 'radios'; .*radius, kind"),
        ({"part": "round", "kind": "cube"}, r"my\.toml: kind: is 'cube'; .*disc, ball"),
        ({"part": "oval"}, r"my\.toml: there is no test-shape called 'oval'; .*round, square"),
        ({"part": ["round"]}, r"no test-shape called \['round'\]; .*round, square"),
        ({}, r"names no part; .*round, square"),
        (3, r"my\.toml: is 3; write a table with a part, one of round, square"),
        (None, r"my\.toml: is None"),
        ({"part": "square"}, r"my\.toml: .corner. is missing; add corner"),
        ({"part": "square", "corner": 3}, r"my\.toml: corner: is 3; write a list"),
        ({"part": "square", "corner": [1]}, r"my\.toml: corner: has 1 value; use 2"),
        ({"part": "square", "corner": [1, "b"]}, r"my\.toml: corner\[1\]: is 'b'"),
        ({"part": "square", "corner": [1, 2], "count": 1.5}, r"count: is 1\.5; use a whole number"),
        ({"part": "square", "corner": [1, 2], "solid": 1}, r"solid: is 1; use true or false"),
        (
            {"part": "square", "corner": [1, 2], "holes": [{"part": "round", "radius": []}]},
            r"my\.toml: holes\[0\]\.radius: is \[\]",
        ),
    ],
)
def test_errors_name_the_field(data, message) -> None:
    with pytest.raises(InputError, match=message) as caught:
        read(data)
    assert "\n" not in str(caught.value)


def test_integers_are_accepted_as_floats() -> None:
    assert read({"part": "round", "radius": 2}) == Round(2.0)
    assert isinstance(read({"part": "round", "radius": 2}).radius, float)
    assert read({"part": "square", "corner": [1, 2], "count": None}).count is None


def test_changes_are_merged_into_configuration() -> None:
    config = from_method("thesis")
    new = changed(config, {"odometry": {"registration": {"resolution": 0.07}}}, where="c.toml")
    assert new.odometry.registration.resolution == 0.07
    assert new.odometry.registration.source == config.odometry.registration.source
    assert new.filters == config.filters


def test_other_part_has_own_defaults_and_lists_are_replaced() -> None:
    config = from_method("thesis")
    every = {"odometry": {"registration": {"source": {"part": "all"}}}, "filters": []}
    new = changed(config, every, where="c.toml")
    assert parts.name_of(new.odometry.registration.source) == "all"
    assert new.filters == ()
    two = changed(config, {"filters": [{"part": "median"}, {"part": "distance"}]}, where="c.toml")
    assert [parts.name_of(f) for f in two.filters] == ["median", "distance"]


@dataclass(frozen=True)
class _Limits(Bounded):
    count: Annotated[int, Bounds(1)] = 1
    fraction: Annotated[float, Bounds(0, 1)] = 0.5
    length_m: Annotated[float | None, Bounds(0, exclusive=True)] = None
    probability: Annotated[float, Bounds(0, 1, exclusive=True)] = 0.5
    kind: Literal["disc", "ball"] = "disc"
    channels: Annotated[tuple[str, ...], NotEmpty()] = ("depth",)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"count": 0}, "count must be 1 or more, not 0"),
        ({"fraction": 1.5}, "fraction must be 0 to 1, not 1.5"),
        ({"fraction": math.nan}, "fraction must be 0 to 1, not nan"),
        ({"length_m": 0.0}, "length_m must be above 0, not 0.0"),
        ({"length_m": math.inf}, "length_m must be above 0, not inf"),
        ({"probability": 1.0}, "probability must be between 0 and 1, not 1.0"),
        ({"channels": ()}, r"channels must be non-empty, not \(\)"),
    ],
)
def test_values_outside_declared_bounds_are_refused(wrong, message) -> None:
    with pytest.raises(ValueError, match=f"^{message}$"):
        _Limits(**wrong)
    refused(message, _Limits, wrong, by=parts.from_dict, where="test.toml")


def installed(folder, module: str, text: str) -> None:
    """An installed package with one module, an entry point of `tofuse.parts`."""
    (folder / f"{module}.py").write_text(text)
    info = folder / f"{module}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {module}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[tofuse.parts]\nmine = {module}\n")


PART = """
from dataclasses import dataclass
from tofuse.engine.filters import Filter
from tofuse.engine.parts import part

@part("filter", "of-another-package")
@dataclass(frozen=True)
class Mine(Filter):
    takes = frozenset({"range", "cloud"})
    amount: int = 3

    def mask(self, frame, history):
        return frame.valid
"""


def test_config_finds_parts_of_installed_packages(tmp_path, monkeypatch):
    installed(tmp_path, "package_with_a_part", PART)
    monkeypatch.syspath_prepend(tmp_path)
    filters = {"filters": [{"part": "of-another-package", "amount": 5}]}
    try:
        assert changed(from_method("default"), filters, where="test").filters[0].amount == 5
    finally:
        parts._registry["filter"].pop("of-another-package", None)


def test_broken_package_is_named(tmp_path, monkeypatch):
    installed(tmp_path, "broken_package", "import a_module_that_is_missing")
    monkeypatch.syspath_prepend(tmp_path)
    filters = {"filters": [{"part": "of-a-broken-package"}]}
    with pytest.raises(InputError, match=r"mine = broken_package: can't be imported"):
        changed(from_method("default"), filters, where="test")
