"""The parser of the command line, made from the classes of `options`."""

from __future__ import annotations

import argparse
import inspect
import os
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from importlib import import_module
from types import NoneType
from typing import Annotated, Any, Literal, NoReturn, get_args, get_origin

from tofuse._version import __version__
from tofuse.apps.cli.options import COMMANDS, REQUIRED, Command
from tofuse.apps.cli.values import reader

_SECTION = re.compile(r"^(\w[\w ]*)\n-{3,}\n", re.MULTILINE)
_OPTION = re.compile(r"^(\w+)(?: : (\S+))?\n((?:    .*\n?)+)", re.MULTILINE)
_MAIN, _STATUS = "Attributes", "Exit status"


class Parser(argparse.ArgumentParser):
    """An argument parser whose errors are one line.

    Parameters
    ----------
    command
        The command whose options it gets when it is used, as it takes long to add those of all.
    """

    def __init__(self, *args: Any, command: type[Command] | None = None, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._without_options = command
        self._words: list[str] = []

    def add_options(self) -> None:
        """Add the options of the command, once."""
        if self._without_options is not None:
            _add_options(self, self._without_options)
            self._without_options = None

    def parse_known_args(self, args: Any = None, namespace: Any = None) -> Any:
        """Parse what belongs to this command."""
        self.add_options()
        self._words = list(args or ())
        return super().parse_known_args(args, namespace)

    def error(self, message: str) -> NoReturn:
        """Print one line and exit with 2; what is missing may be written as an unknown option."""
        options = (w for w in self._words if re.match("--?[a-z]", w) and " " not in w)
        known = self._option_string_actions
        unknown = next((w for w in options if w.partition("=")[0] not in known), None)
        if unknown is not None and "are required" in message:
            message = self._unknown(unknown)
        sys.stderr.write(f"{self.prog}: {message}; see `{self.prog} --help`\n")
        sys.exit(2)

    def parse_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> argparse.Namespace:
        """Parse; each command reports its own unknown options. No command at all is ``--help``."""
        arguments, unknown = self.parse_known_args(args, namespace)
        if not hasattr(arguments, "command") and not unknown:
            arguments.parser.print_help()
            sys.exit(0)
        if unknown:
            command: Parser = getattr(arguments, "parser", self)
            command.error(command._unknown(unknown[0]))
        return arguments

    def _unknown(self, word: str) -> str:
        option = word.partition("=")[0]
        return f"unknown option {option}{_suggestion(option, self._option_string_actions)}"

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        if action.choices is not None and value not in action.choices:
            choices = [str(choice) for choice in action.choices]
            name = action.metavar or "/".join(action.option_strings) or action.dest
            kind = "unknown command" if name == "COMMAND" else f"{name}: unknown value"
            hint = _suggestion(str(value), choices) or f" (one of {', '.join(choices)})"
            if name == "COMMAND" and os.path.exists(value):
                hint = f", but a path: `tofuse inspect {value}`, `tofuse run {value} --out result`"
            raise argparse.ArgumentError(None, f"{kind} {value!r}{hint}")


def _suggestion(word: str, candidates: Iterable[str]) -> str:
    suggestions = get_close_matches(word, list(candidates), 1)
    return f" (did you mean {suggestions[0]}?)" if suggestions else ""


class _Help(argparse.HelpFormatter):
    """Prints each command and its summary on one line."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog)
        # argparse does not count the extra indentation of commands.
        self._action_max_length = 15


def make_parser(kind: type[Parser] = Parser) -> Parser:
    """Return the parser of the command line.

    Parameters
    ----------
    kind
        Its class, which handles errors.
    """
    parser = kind(
        prog="tofuse",
        description="Reconstruct a 3D model and the camera trajectory from recordings of "
        "Time-of-Flight cameras, and state how accurate they are.",
        epilog="Start with `tofuse demo`. `tofuse COMMAND --help` describes each command.",
        formatter_class=_Help,
    )
    parser.add_argument("--version", action="version", version=f"tofuse {__version__}")
    _add_commands(parser, COMMANDS)
    return parser


def _add_commands(parser: argparse.ArgumentParser, commands: Iterable[type[Command]]) -> None:
    parser.set_defaults(parser=parser)
    subparsers = parser.add_subparsers(title="commands", metavar="COMMAND")
    for cls in commands:
        words = [word.lower() for word in re.findall("[A-Z][a-z]+", cls.__name__)]
        texts = _Texts.of(cls)
        p = subparsers.add_parser(
            words[-1],
            help=texts.summary[:1].lower() + texts.summary[1:].rstrip("."),
            description=texts.summary,
            epilog=texts.epilog or None,
            formatter_class=_Help if cls.subcommands else argparse.RawDescriptionHelpFormatter,
            command=None if cls.subcommands else cls,
        )
        if cls.subcommands:
            _add_commands(p, cls.subcommands)
        else:
            p.set_defaults(command=_function(cls, "_".join(words)), parser=p)


def _function(cls: type[Command], name: str) -> Callable[[argparse.Namespace], int]:
    """Return what runs a command with parsed arguments."""

    def call(arguments: argparse.Namespace) -> int:
        function: Callable[[Command], int] = getattr(import_module(cls.home), name)
        options = cls(**vars(arguments))
        if not cls.reconstructs:
            return function(options)
        from tofuse.engine.compute import ahead

        with ahead.compiling_in_background() as is_first_run:
            if is_first_run and sys.stderr.isatty():
                sys.stderr.write(
                    "tofuse: the first run compiles the numerical kernels, each when it is needed: "
                    "half a minute longer on two cores\n"
                )
            return function(options)

    return call


@dataclass
class _Texts:
    """The help texts in the docstring of a command.

    Attributes
    ----------
    summary, epilog
        The first line, and what is printed below the options.
    options
        By name: the title of the group, the placeholder of the value, and the help.
    """

    summary: str = ""
    epilog: str = ""
    options: dict[str, tuple[str, str | None, str]] = field(default_factory=dict)

    @classmethod
    def of(cls, command: type[Command]) -> _Texts:
        """Read the docstrings of a command and of its bases; there are none in ``python -OO``."""
        texts = cls()
        for base in _with_bases(command):
            text, *sections = _SECTION.split(inspect.cleandoc(base.__doc__ or "") + "\n")
            for title, body in zip(sections[::2], sections[1::2], strict=True):
                for name, metavar, words in _OPTION.findall(body):
                    help_text = " ".join(words.split()).replace("%", "%%")
                    texts.options.setdefault(name, (title, metavar or None, help_text))
                if title == _STATUS:
                    texts.epilog = "exit status:\n" + re.sub("^(?=.)", "  ", body, flags=re.M)
            if base is command:
                texts.summary, _, remarks = text.strip().partition("\n\n")
                texts.epilog = "\n\n".join(filter(None, (remarks, texts.epilog)))
        return texts


def _with_bases(command: type[Command]) -> Iterator[type[Command]]:
    """Yield a command and the classes from which it has options."""
    for base in command.__mro__:
        if base is Command:
            return
        yield base


def _add_options(parser: argparse.ArgumentParser, command: type[Command]) -> None:
    """Add the fields of a command and of its bases as arguments and options, in their groups."""
    texts = _Texts.of(command).options
    containers: dict[object, Any] = {_MAIN: parser}
    for base in _with_bases(command):
        for name, hint in base.__annotations__.items():
            title, metavar, help_text = texts.get(name, (_MAIN, None, ""))
            if title not in containers:
                containers[title] = parser.add_argument_group(title[0].lower() + title[1:])
            container = containers[title]
            if name in command.exclusive:
                if command not in containers:
                    containers[command] = container.add_mutually_exclusive_group()
                container = containers[command]
            option, settings = _settings(name, hint, vars(base))
            if settings.get("action", "append") == "append":
                settings["metavar"] = metavar
            container.add_argument(option, help=help_text, **settings)


def _settings(name: str, hint: Any, defaults: Mapping[str, Any]) -> tuple[str, dict[str, Any]]:
    """Return the name and the settings of an argument or option, from its field."""
    option = f"--{name.replace('_', '-')}" if name in defaults else name
    default = defaults.get(name)
    if hint is bool:
        return option, {"action": "store_true"}
    if hint == bool | None:
        return option, {"action": argparse.BooleanOptionalAction, "default": default}
    settings: dict[str, Any] = {"default": default}
    if default is REQUIRED:
        settings = {"required": True}
    alternatives = get_args(hint) if NoneType in get_args(hint) else (hint,)
    hint = alternatives[0]
    if len(alternatives) > 1 and name not in defaults:
        settings["nargs"] = "?"
    if get_origin(hint) is list:
        settings |= {"action": "append"} if name in defaults else {"nargs": "+"}
        (hint,) = get_args(hint)
    if get_origin(hint) is Literal:
        return option, settings | {"choices": get_args(hint)}
    kind, extra = get_args(hint) if get_origin(hint) is Annotated else (hint, None)
    return option, settings | {"type": reader(kind, extra)}
