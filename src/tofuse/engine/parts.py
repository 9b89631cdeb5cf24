"""Methods as small objects: named, configured by their fields, and discovered by import.

A *part* is a frozen dataclass that implements one method of the literature behind one small
interface (a filter, a matcher, an optimiser ...). Its fields are its options, so the object is
its own configuration, and a reconstruction is described completely by the parts in it.

A part is registered by the decorator::

    @part("filter", "median")
    @dataclass(frozen=True)
    class Median: ...

`discover` imports every module of a package, so adding a method touches one file."""

from __future__ import annotations

import dataclasses
import importlib
import math
import numbers
import pkgutil
import types
import typing
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from typing import Any, Literal, TypeVar

from tofuse.engine import quantities
from tofuse.engine.bounds import Bounds
from tofuse.engine.errors import InputError

T = TypeVar("T")
Label = Literal["validated", "experimental"]

_registry: dict[str, dict[str, type]] = {}
_TYPES = {float: "a number", int: "a whole number", bool: "true or false", str: "a text in quotes"}


def part(kind: str, name: str, *, label: Label = "experimental") -> Callable[[type[T]], type[T]]:
    """Register a dataclass as the part `name` of the given kind.

    `label` is "validated" where a test or benchmark reproduces a figure or the claimed property
    of the method's paper.
    """

    def register(cls: type[T]) -> type[T]:
        parts = _registry.setdefault(kind, {})
        if name in parts and parts[name].__qualname__ != cls.__qualname__:
            raise ValueError(f"two parts are called {kind} {name!r}")
        parts[name] = cls
        cls.part_kind = kind  # type: ignore[attr-defined]
        cls.part_name = name  # type: ignore[attr-defined]
        cls.part_label = label  # type: ignore[attr-defined]
        return cls

    return register


def discover(package: str) -> None:
    """Import every module directly inside `package`, which registers the parts in them."""
    module = importlib.import_module(package)
    for info in sorted(pkgutil.iter_modules(module.__path__), key=lambda m: m.name):
        importlib.import_module(f"{package}.{info.name}")


def load_installed() -> None:
    """Import the modules that installed packages name in the entry point group `tofuse.parts`.

    Raises
    ------
    InputError
        If one of them can't be imported.
    """
    from importlib.metadata import entry_points  # slow to import

    for entry in entry_points(group="tofuse.parts"):
        try:
            entry.load()
        except Exception as error:
            raise InputError(
                f"can't be imported ({type(error).__name__}: {error})",
                where=f"part {entry.name} = {entry.value}",
                remedy="update or uninstall the package that provides it",
            ) from error


def registered(kind: str) -> dict[str, type]:
    """Return the registered parts of a kind, by name."""
    return dict(sorted(_registry.get(kind, {}).items()))


def name_of(obj: object) -> str:
    """Return the name under which a part was registered."""
    return str(type(obj).part_name)  # type: ignore[attr-defined]


def check_number(value: Any, allowed: Bounds, name: str, *, whole: bool = False) -> Any:
    """Return an argument as an int or a float, or raise InputError if it is none in the bounds.

    Parameters
    ----------
    value
        The argument; NumPy's numbers are accepted.
    allowed
        Its bounds.
    name
        Its name.
    whole
        Whether it has to be a whole number.
    """
    kind = numbers.Integral if whole else numbers.Real
    number: float = math.nan
    is_number = isinstance(value, kind) and not isinstance(value, bool)
    if is_number:
        with suppress(OverflowError):
            number = int(value) if whole else float(value)
    if number not in allowed:
        remedy = f"pass a {'whole' if whole else 'finite'} number"
        bounds = "" if allowed == Bounds() else f", {allowed}"
        raise InputError(f"is {value!r}", where=name, remedy=remedy + bounds)
    return number


def to_dict(obj: Any) -> Any:
    """Turn a configuration (parts, dataclasses, tuples, plain values) into JSON-able data."""
    if dataclasses.is_dataclass(obj) and not isinstance(obj, type):
        data: dict[str, Any] = {}
        if hasattr(type(obj), "part_name"):
            data["part"] = name_of(obj)
        for field in dataclasses.fields(obj):
            data[field.name] = to_dict(getattr(obj, field.name))
        return data
    if isinstance(obj, list | tuple):
        return [to_dict(item) for item in obj]
    if isinstance(obj, Mapping):
        return {str(key): to_dict(value) for key, value in obj.items()}
    return obj


def from_dict(hint: Any, data: Any, *, where: str) -> Any:
    """Build a value of the annotated type `hint` from plain data.

    Parameters
    ----------
    hint
        A type annotation: a plain type, a dataclass, a union, a tuple, or an interface with a
        `part_kind` attribute, for which the data names the part.
    data
        What `to_dict` gives, or what a TOML or JSON file holds.
    where
        Names the file and field in errors, e.g. ``"my.toml: filters[0].minimum"``.

    Raises
    ------
    InputError
        For an unknown key or part, or a value of the wrong type.
    """
    origin = typing.get_origin(hint)
    args = typing.get_args(hint)
    if origin in (typing.Union, types.UnionType):
        return _from_union(args, data, where)
    if origin is Literal:
        if data not in args:
            raise InputError(f"is {data!r}", where=where, remedy=f"use one of {_listed(args)}")
        return data
    if origin in (tuple, list, Sequence):
        return _from_sequence(origin, args, data, where)
    if isinstance(hint, type) and getattr(hint, "part_kind", None):
        if not isinstance(data, Mapping):
            remedy = f"write a table with a part, one of {_listed(registered(hint.part_kind))}"  # type: ignore[attr-defined]
            raise InputError(f"is {data!r}", where=where, remedy=remedy)
        return _part_from_dict(hint, data, where)
    if dataclasses.is_dataclass(hint) and isinstance(hint, type):
        if not isinstance(data, Mapping):
            raise InputError(f"is {data!r}", where=where, remedy="write a table of options here")
        return _dataclass_from_dict(hint, data, where)
    return _plain(hint, data, where)


def _from_union(args: tuple[Any, ...], data: Any, where: str) -> Any:
    if data is None and type(None) in args:
        return None
    choices = [a for a in args if a is not type(None)]
    errors = []
    for choice in choices:
        try:
            return from_dict(choice, data, where=where)
        except InputError as error:
            errors.append(error)
    raise errors[0]


def _from_sequence(origin: Any, args: tuple[Any, ...], data: Any, where: str) -> Any:
    if not isinstance(data, list | tuple):
        raise InputError(f"is {data!r}", where=where, remedy="write a list here")
    if origin is tuple and not (len(args) == 2 and args[1] is Ellipsis):
        if len(data) != len(args):
            raise InputError(
                f"has {quantities.count(len(data), 'value')}",
                where=where,
                remedy=f"use {quantities.count(len(args), 'value')}",
            )
        hints = list(args)
    else:
        hints = [args[0]] * len(data)
    items = [
        from_dict(h, d, where=f"{where}[{k}]")
        for k, (h, d) in enumerate(zip(hints, data, strict=True))
    ]
    return tuple(items) if origin is tuple else items


def _part_from_dict(interface: type, data: Mapping[str, Any], where: str) -> Any:
    kind: str = interface.part_kind  # type: ignore[attr-defined]
    options = dict(data)
    name = options.pop("part", getattr(interface, "part_name", None))
    choices = registered(kind)
    if isinstance(name, str) and name not in choices:
        load_installed()
        choices = registered(kind)
    if not isinstance(name, str) or name not in choices:
        problem = "names no part" if name is None else f"there is no {kind} called {name!r}"
        raise InputError(problem, where=where, remedy=f"set part to one of {_listed(choices)}")
    return _dataclass_from_dict(choices[name], options, where)


def _dataclass_from_dict(cls: type, data: Mapping[str, Any], where: str) -> Any:
    hints = typing.get_type_hints(cls)
    fields = {f.name: f for f in dataclasses.fields(cls) if f.init}
    unknown = [key for key in data if key not in fields]
    if unknown:
        remedy = f"use one of {_listed(fields)}" if fields else "leave it out: there are none"
        raise InputError(f"unknown option {unknown[0]!r}", where=where, remedy=remedy)
    missing = [name for name, f in fields.items() if name not in data and not _has_default(f)]
    if missing:
        raise InputError(f"{missing[0]!r} is missing", where=where, remedy=f"add {missing[0]}")
    values = {
        key: from_dict(hints[key], value, where=_inside(where, key)) for key, value in data.items()
    }
    try:
        return cls(**values)
    except ValueError as error:
        raise InputError(str(error), where=where) from error


def _has_default(field: dataclasses.Field[Any]) -> bool:
    missing = dataclasses.MISSING
    return field.default is not missing or field.default_factory is not missing


def _inside(where: str, key: str) -> str:
    """Name a field: the file, a colon, and the path of fields in it."""
    return f"{where}.{key}" if ": " in where else f"{where}: {key}"


def _plain(hint: Any, data: Any, where: str) -> Any:
    if isinstance(data, numbers.Real) and hasattr(data, "item"):  # one of NumPy's
        data = data.item()
    if hint is Any:
        return data
    if hint is float and isinstance(data, int) and not isinstance(data, bool):
        return float(data)
    if (
        isinstance(hint, type)
        and isinstance(data, hint)
        and not (hint is not bool and isinstance(data, bool))
    ):
        return data
    words = _TYPES.get(hint, f"a value of type {getattr(hint, '__name__', hint)}")
    raise InputError(f"is {data!r}", where=where, remedy=f"use {words}")


def _listed(choices: Iterable[Any]) -> str:
    return ", ".join(map(str, choices))
