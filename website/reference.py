"""The tables of the reference pages, from docstrings, the parser and the lists in the code.

    python website/reference.py                    list the tables
    python website/reference.py "parts filter"     print one

A page asks for a table by a line `<!-- table: parts filter -->`; the site's hook replaces it.
"""

from __future__ import annotations

import argparse
import dataclasses
import functools
import inspect
import json
import re
import sys
import typing
from collections.abc import Callable, Iterator
from typing import Any

import thesis
from tofuse.apps.cli.parser import Parser, make_parser
from tofuse.engine import parts
from tofuse.engine.bounds import Bounds, NotEmpty
from tofuse.engine.graph.graph import LoopRecord
from tofuse.engine.mapping.config import PACKAGES, Config
from tofuse.engine.mapping.methods import from_method
from tofuse.engine.quality.pose_accuracy import Accuracy
from tofuse.engine.results.types import Component, FrameRecord
from tofuse.engine.results.verdicts import REASONS

PART_PACKAGES = (*PACKAGES, "tofuse.formats.readers", "tofuse.apps.live.devices")
RECORDS = {"frame": FrameRecord, "component": Component, "loop": LoopRecord, "accuracy": Accuracy}
CONFIGURATIONS = {
    "`default`, images": ("default", "range"),
    "`default`, clouds": ("default", "cloud"),
    "`thesis`": ("thesis", "range"),
}
PLACEHOLDER = re.compile(r"^<!-- table: ([\w -]+) -->$", re.MULTILINE)
_SECTION = re.compile(r"^(\w+)\n-{3,}\n", re.MULTILINE)
_ENTRY = re.compile(r"^(\w+(?:, \w+)*)[^\n]*\n((?:    [^\n]*\n|\n)+)", re.MULTILINE)


def filled(markdown: str) -> str:
    """Return a page with its tables; ValueError for one that does not exist."""
    return PLACEHOLDER.sub(lambda found: table(found[1]), markdown)


def table(name: str) -> str:
    """Return a table by the name that pages use."""
    if name not in tables():
        raise ValueError(f"there is no table {name!r}")
    return tables()[name]()


@functools.cache
def tables() -> dict[str, Callable[[], str]]:
    """Return the functions that make the tables, by name."""
    made: dict[str, Callable[[], str]] = {
        "configurations": configurations,
        "options range": lambda: default_options("range"),
        "options cloud": lambda: default_options("cloud"),
        "formats": formats,
        "reasons": reasons,
    }
    made |= {f"parts {kind}": functools.partial(part_list, kind) for kind in kinds()}
    made |= {f"command {name}": functools.partial(command, name) for name in commands()}
    made |= {f"record {name}": functools.partial(record, name) for name in RECORDS}
    made |= {f"thesis {name}": functools.partial(thesis.table, name) for name in thesis.NAMES}
    return made


@functools.cache
def kinds() -> dict[str, dict[str, type]]:
    """Return the parts of the package by kind and name."""
    for package in PART_PACKAGES:
        parts.discover(package)
    found = {kind: parts.registered(kind) for kind in parts._registry}
    ours = {
        kind: {name: cls for name, cls in known.items() if cls.__module__.startswith("tofuse.")}
        for kind, known in found.items()
    }
    return {kind: known for kind, known in ours.items() if known}


def rows(head: str, lines: Iterator[tuple[str, ...]]) -> str:
    """Return a Markdown table; `head` has the titles, separated by bars."""
    titles = head.split("|")
    text = [f"| {' | '.join(titles)} |", "|---" * len(titles) + "|"]
    text += [f"| {' | '.join(map(cell, line))} |" for line in lines]
    return "\n".join(text) + "\n"


def cell(text: str) -> str:
    """Return text on one line, with what Markdown takes for markup escaped outside of code."""
    pieces = re.split(r"(``.*?``|`[^`]*`)", " ".join(text.split()))
    return "".join(piece if k % 2 else _escaped(piece) for k, piece in enumerate(pieces))


def _escaped(text: str) -> str:
    return re.sub(r"([|*])", r"\\\1", text).replace("<", "&lt;")


# Docstrings.


def description(cls: type) -> str:
    """Return the docstring of a class up to its sections, as Markdown."""
    text = re.split(_SECTION, inspect.cleandoc(cls.__doc__ or ""), maxsplit=1)[0]
    return re.sub(r",? ?::\n", ":\n", text).strip()


def summary(cls: type) -> str:
    """Return the first paragraph of a docstring."""
    return description(cls).split("\n\n")[0]


def attributes(cls: type) -> dict[str, str]:
    """Return the texts of a class's attributes by name, those of its bases included."""
    found: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        pieces = re.split(_SECTION, inspect.cleandoc(base.__dict__.get("__doc__") or ""))
        for title, body in zip(pieces[1::2], pieces[2::2], strict=True):
            if title in ("Attributes", "Parameters"):
                for names, text in re.findall(_ENTRY, body + "\n"):
                    found |= dict.fromkeys(names.split(", "), " ".join(text.split()))
    return found


# Options.


@dataclasses.dataclass(frozen=True)
class Option:
    """An option of a part: its dotted path, default, allowed values and text."""

    path: str
    default: str
    allowed: str
    text: str


def options_of(obj: Any, path: str = "") -> Iterator[Option]:
    """Options of a dataclass (or of an object of one), those of nested dataclasses included."""
    cls = obj if isinstance(obj, type) else type(obj)
    texts, hints = attributes(cls), typing.get_type_hints(cls, include_extras=True)
    for field in dataclasses.fields(cls):
        value = default_of(field) if isinstance(obj, type) else getattr(obj, field.name)
        name, text = f"{path}{field.name}", texts.get(field.name, "")
        several = isinstance(value, tuple) and value and dataclasses.is_dataclass(value[0])
        if obj is not cls and several:
            for item in value:
                yield from options_of(item, f"{name}.{item.part_name}.")
        elif nested(value, given=obj is not cls):
            yield from options_of(value, f"{name}.")
        else:
            yield Option(name, shown(value), allowed(hints[field.name]), text)


def nested(value: Any, *, given: bool) -> bool:
    """Whether the options of a value are listed: of those given all, else of plain tables."""
    table = dataclasses.is_dataclass(value) and not isinstance(value, type)
    return table and (given or not hasattr(value, "part_name"))


def default_of(field: dataclasses.Field[Any]) -> Any:
    """Return the default of a field; MISSING if it has none."""
    made = field.default_factory
    return field.default if made is dataclasses.MISSING else made()


def shown(value: Any) -> str:
    """Return a default as it is written in TOML or JSON."""
    if value is dataclasses.MISSING:
        return "required"
    if hasattr(value, "part_name"):
        return f"`{value.part_name}`"
    if isinstance(value, tuple) and value and hasattr(value[0], "part_name"):
        return ", ".join(map(shown, value))
    return f"`{json.dumps(parts.to_dict(value))}`"


def allowed(hint: Any) -> str:
    """Return the values that an annotation declares, in words; empty if all of its type."""
    if typing.get_origin(hint) is typing.Literal:
        return ", ".join(f"`{choice}`" for choice in typing.get_args(hint))
    limits = [x for x in getattr(hint, "__metadata__", ()) if isinstance(x, Bounds | NotEmpty)]
    return ", ".join(map(str, limits))


def option_table(found: Iterator[Option]) -> str:
    """Return the table of options."""
    lines = ((f"`{o.path}`", o.default, o.allowed, o.text) for o in found)
    return rows("Option|Default|Allowed|Meaning", lines)


def part_list(kind: str) -> str:
    """Return the parts of a kind, each with its description and its options."""
    return "\n".join(part_entry(cls) for cls in kinds()[kind].values())


def part_entry(cls: type) -> str:
    takes = getattr(cls, "takes", None)
    kept = ", ".join(sorted(takes)) if isinstance(takes, frozenset) else ""
    label = cls.part_label  # type: ignore[attr-defined]
    text = f"**`{cls.part_name}`** ({label}{f'; {kept}' if kept else ''}). {description(cls)}\n"  # type: ignore[attr-defined]
    if dataclasses.fields(cls):  # type: ignore[arg-type]
        text += f"\n{option_table(options_of(cls))}"
    return text


def default_options(kind: str) -> str:
    """Return the options of the default configuration; for clouds those that images lack."""
    found = options_of(from_method("default", kind))  # type: ignore[arg-type]
    known = () if kind == "range" else set(options_of(from_method("default", "range")))
    return option_table(option for option in found if option not in known)


def configurations() -> str:
    """Return the fields of a configuration, and what the named ones choose."""
    made = [from_method(*which) for which in CONFIGURATIONS.values()]  # type: ignore[arg-type]
    texts = attributes(Config)

    def lines() -> Iterator[tuple[str, ...]]:
        for field in dataclasses.fields(Config):
            chosen = [getattr(config, field.name) for config in made]
            yield (f"`{field.name}`", texts[field.name], *map(_chosen, chosen))

    return rows("|".join(("Field", "What it controls", *CONFIGURATIONS)), lines())


def _chosen(value: Any) -> str:
    if dataclasses.is_dataclass(value) and not hasattr(value, "part_name"):
        return "a table"
    return "none" if value == () else shown(value)


# Formats, reasons, records.


def formats() -> str:
    """Return the formats of recordings."""
    lines = (
        (f"`{name}`", summary(cls), str(cls.part_label))  # type: ignore[attr-defined]
        for name, cls in kinds()["reader"].items()
    )
    return rows("`--format`|What it reads|Label", lines)


def reasons() -> str:
    """Return the closed list of reason codes."""
    lines = ((f"`{code}`", verdict, text) for code, (verdict, text) in REASONS.items())
    return rows("Code|Verdict|Meaning", lines)


def record(name: str) -> str:
    """Return the fields of a record in `run.json`."""
    cls = RECORDS[name]
    texts = attributes(cls)
    names = [f.name for f in dataclasses.fields(cls) if f.name != "result"]
    return rows("Field|Meaning", ((f"`{n}`", texts[n]) for n in names))


# Commands.


@functools.cache
def commands() -> dict[str, argparse.ArgumentParser]:
    """Return the parsers of the commands by name; those of subcommands too, `rig check`."""

    def below(parser: Parser, path: str) -> Iterator[tuple[str, Parser]]:
        parser.add_options()
        for action in parser._actions:
            if isinstance(action, argparse._SubParsersAction):
                for name, command_parser in action.choices.items():
                    yield f"{path}{name}", command_parser
                    yield from below(command_parser, f"{path}{name} ")

    found = dict(below(make_parser(), ""))
    return {name: parser for name, parser in found.items() if arguments_of(parser)}


def arguments_of(parser: argparse.ArgumentParser) -> list[argparse.Action]:
    """Return the arguments and options of a command; none of one with subcommands."""
    skipped = (argparse._HelpAction, argparse._SubParsersAction)
    if any(isinstance(action, argparse._SubParsersAction) for action in parser._actions):
        return []
    return [action for action in parser._actions if not isinstance(action, skipped)]


def command(name: str) -> str:
    """Return the arguments and options of a command."""
    parser = commands()[name]
    formatter = parser._get_formatter()

    def lines() -> Iterator[tuple[str, ...]]:
        for action in arguments_of(parser):
            metavar = action.metavar if isinstance(action.metavar, str) else None
            choices = "|".join(map(str, action.choices or ())) or None
            value = "" if action.nargs == 0 else metavar or choices or action.dest.upper()
            flags = [f"`{f'{name} {value}'.strip()}`" for name in action.option_strings or ("",)]
            yield ", ".join(flags), formatter._expand_help(action)

    return rows("Argument|Meaning", lines())


def main() -> int:
    """Print a table, or the names of all."""
    names = sys.argv[1:]
    print("\n".join(map(table, names) if names else tables()))
    return 0


if __name__ == "__main__":
    sys.exit(main())
