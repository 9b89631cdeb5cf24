"""Serialisation of our own types to plain data and arrays, for checkpoints.

Such data can't execute code or name other types. A class is looked up by its name among those that
the rooms below define, and is filled, not called; then the checks of its constructor are repeated
(`state_checks`). Shared objects stay shared.

The data is a list of nodes. A value is a plain number, text or None; or the number of a node, in a
list of one element. A node is its kind and its content.
"""

from __future__ import annotations

import importlib
import math
import pkgutil
from collections import OrderedDict, deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from functools import cache, cached_property
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofuse.errors import InputError
from tofuse.files.spill import SpillFile
from tofuse.pipeline.state_checks import check_objects

Arrays = dict[str, NDArray[Any]]

# Packages and modules whose classes can be serialised.
_ROOMS = (
    "corrections",
    "evaluation",
    "files.spill",
    "filters",
    "fusion",
    "geometry",
    "lab.methods",
    "odometry",
    "pipeline.backend",
    "pipeline.background_queue",
    "pipeline.components",
    "pipeline.config",
    "pipeline.frame_log",
    "pipeline.intake",
    "pipeline.live_poses",
    "pipeline.mapper",
    "pipeline.observations",
    "pipeline.preparation",
    "pipeline.progress",
    "pipeline.reconstruct",
    "posegraph",
    "recordings.background",
    "recordings.frames",
    "registration",
    "results.samples",
    "results.types",
    "sensor",
)
_KINDS = "biufcSU"  # of arrays
# Prefix of arrays that are pieces of a temporary file, which may exceed the memory.
PIECE = "piece-"
_SMALL = 1 << 14  # bytes; smaller arrays of one type are stored together


class StateError(Exception):
    """A state that can't be serialised, or is invalid."""


def encode(state: Any) -> tuple[list[Any], Arrays]:
    """Return the nodes of a state, the first being its root, and its arrays by name.

    Raises
    ------
    StateError
        If it contains an object of a type that can't be serialised.
    """
    return _Encoder().run(state)


def decode(
    nodes: Any,
    arrays: Mapping[str, NDArray[Any]],
    piece: Callable[[str], NDArray[Any]] | None = None,
) -> Any:
    """Return the state from its nodes and arrays.

    Parameters
    ----------
    nodes, arrays
        As returned by `encode`.
    piece
        Reads arrays whose names begin with `PIECE`, which are needed one at a time; None if they
        are among the others.

    Raises
    ------
    StateError
        If they are not a valid state.
    """
    return _Decoder(nodes, arrays, piece or arrays.__getitem__).run()


@cache
def known_types() -> dict[str, type]:
    """Return the classes that can be serialised, by their names."""
    found: dict[str, type] = {}
    for module in _modules():
        for item in vars(module).values():
            if isinstance(item, type) and item.__module__ == module.__name__ and _is_plain(item):
                found[_name(item)] = item
    return found


def _modules() -> Iterator[ModuleType]:
    for room in _ROOMS:
        module = importlib.import_module(f"tofuse.{room}")
        yield module
        for info in pkgutil.iter_modules(getattr(module, "__path__", ())):
            yield importlib.import_module(f"{module.__name__}.{info.name}")


def _is_plain(cls: type) -> bool:
    """Whether the state of an instance is its attributes, and creating one calls nothing."""
    ours = all(base.__module__.split(".")[0] in _BASES for base in cls.__mro__)
    made = _member(cls, "__new__") is object.__new__ and not hasattr(cls, "__del__")
    return ours and made and hasattr(cls, "__dict__") and not getattr(cls, "_is_protocol", False)


_BASES = ("tofuse", "abc", "typing", "builtins")


def _name(cls: type) -> str:
    return f"{cls.__module__}.{cls.__qualname__}"


class _Encoder:
    def __init__(self) -> None:
        self._numbers: dict[int, int] = {}
        self._referenced: list[Any] = []  # so that no id of an object is used twice
        self._nodes: list[Any] = []
        self._arrays: Arrays = {}
        self._small: dict[str, list[NDArray[Any]]] = {}
        self._sizes: dict[str, int] = {}

    def run(self, state: Any) -> tuple[list[Any], Arrays]:
        self._value([state])
        for number, item in enumerate(self._referenced):  # which grows meanwhile
            self._nodes.append(self._node(item))
            assert len(self._nodes) == number + 1
        pools = {name: np.concatenate(parts) for name, parts in self._small.items()}
        return self._nodes, self._arrays | pools

    def _value(self, item: Any) -> Any:
        kind = type(item)
        if item is None or kind in (bool, int, str) or (kind is float and math.isfinite(item)):
            return item
        number = self._numbers.get(id(item))
        if number is None:
            number = self._numbers[id(item)] = len(self._referenced)
            self._referenced.append(item)
        return [number]

    def _node(self, item: Any) -> list[Any]:
        kind: type = type(item)
        value = self._value
        if kind in _SEQUENCES:
            return [_SEQUENCES[kind], *map(value, item)]
        if kind in _TABLES:
            return [_TABLES[kind], *(value(each) for pair in item.items() for each in pair)]
        if kind is deque:
            return ["deque", item.maxlen, *map(value, item)]
        if kind is float:
            return ["float", repr(item)]
        if kind is bytes:
            return ["bytes", *self._placed(np.frombuffer(item, np.uint8))]
        if kind is np.ndarray:
            turned = item.flags.f_contiguous and not item.flags.c_contiguous
            whole = item.T if turned else item
            flat = np.ascontiguousarray(whole).reshape(-1)
            return ["array", *self._placed(flat), turned, *whole.shape]
        if isinstance(item, np.generic):
            return ["number", *self._placed(np.asarray(item).reshape(-1))]
        if kind is SpillFile:
            return ["file", item.folder, *self._pieces(item)]
        if known_types().get(_name(kind)) is kind:
            state = item.__getstate__() or {}
            return ["object", _name(kind), *(v for k in state for v in (k, value(state[k])))]
        raise StateError(f"objects of type {_name(kind)} can't be stored")

    def _pieces(self, file: SpillFile) -> list[str]:
        """Return names of the pieces of a temporary file: arrays read when they are written."""
        names = []
        for piece in file.pieces():
            names.append(f"{PIECE}{len(self._arrays)}")
            made: Any = piece
            self._arrays[names[-1]] = made
        return names

    def _placed(self, flat: NDArray[Any]) -> list[Any]:
        """Return the written array that contains the values, their start, and their number."""
        if flat.dtype.kind not in _KINDS:
            raise StateError(f"arrays of {flat.dtype} can't be stored")
        if flat.nbytes > _SMALL:
            name = f"array-{len(self._arrays)}"
            self._arrays[name] = flat
            return [name, 0, len(flat)]
        name = f"small-{flat.dtype.str[1:]}-{'big' if flat.dtype.byteorder == '>' else 'little'}"
        start = self._sizes.get(name, 0)
        self._small.setdefault(name, []).append(flat)
        self._sizes[name] = start + len(flat)
        return [name, start, len(flat)]


_SEQUENCES: dict[type, str] = {list: "list", tuple: "tuple", set: "set", frozenset: "frozenset"}
_TABLES: dict[type, str] = {dict: "dict", OrderedDict: "ordered"}


class _Decoder:
    def __init__(
        self,
        nodes: Any,
        arrays: Mapping[str, NDArray[Any]],
        piece: Callable[[str], NDArray[Any]],
    ) -> None:
        self._piece = piece
        if not isinstance(nodes, list) or not nodes:
            raise StateError("the list of nodes is missing")
        self._nodes = nodes
        self._arrays = arrays
        self._left = sum(array.nbytes for array in arrays.values())  # each is taken once
        self._made: dict[int, Any] = {}
        self._begun: set[int] = set()

    def run(self) -> Any:
        try:
            (state,) = self._item(0)
            ours = frozenset(known_types().values())
            check_objects(item for item in self._made.values() if type(item) in ours)
        except StateError:
            raise
        except RecursionError:
            raise StateError("the data is nested too deeply") from None
        except InputError as error:
            raise StateError(str(error)) from error
        except (ArithmeticError, AttributeError, LookupError, TypeError, ValueError) as error:
            raise StateError(f"the data is invalid ({type(error).__name__}: {error})") from error
        return state

    def _value(self, value: Any) -> Any:
        if type(value) is list:
            (number,) = value
            return self._item(number)
        if value is None or type(value) in (bool, int, float, str):
            return value
        raise StateError("a value is of an unexpected type")

    def _item(self, number: int) -> Any:
        if number in self._made:
            return self._made[number]
        if type(number) is not int or not 0 <= number < len(self._nodes) or number in self._begun:
            raise StateError("a reference between nodes is invalid")
        kind, *rest = self._nodes[number]
        self._begun.add(number)
        if kind in ("tuple", "frozenset"):
            values = map(self._value, rest)
            self._made[number] = tuple(values) if kind == "tuple" else frozenset(values)
        elif kind == "object":
            self._object(number, *rest)
        elif kind in _FILLED:
            self._container(number, kind, rest)
        else:
            self._made[number] = self._plain(kind, rest)
        return self._made[number]

    def _container(self, number: int, kind: str, rest: list[Any]) -> None:
        """Fill a container after creating it, as it may contain itself."""
        made: Any = deque(maxlen=rest[0]) if kind == "deque" else _FILLED[kind]()
        self._made[number] = made
        if kind in ("dict", "ordered"):
            for key, value in zip(rest[::2], rest[1::2], strict=True):
                made[self._value(key)] = self._value(value)
            return
        add = made.add if kind == "set" else made.append
        for value in rest[1:] if kind == "deque" else rest:
            add(self._value(value))

    def _object(self, number: int, name: str, *rest: Any) -> None:
        cls = known_types().get(name)
        if cls is None:
            raise StateError(f"the type {name!r:.80} is unknown")
        made: Any = object.__new__(cls)
        self._made[number] = made
        state = {key: self._value(value) for key, value in zip(rest[::2], rest[1::2], strict=True)}
        if not all(type(key) is str for key in state):
            raise StateError("names of attributes are invalid")
        if is_dataclass(cls):
            names = {field.name for field in fields(cls)}
            more = {key for key in state if not isinstance(_member(cls, key), cached_property)}
            frozen: bool = cls.__dataclass_params__.frozen  # type: ignore[attr-defined]
            lacking = [n for n in names - set(state) if _member(cls, n) is None]
            if lacking or (frozen and more - names):
                raise StateError(f"the fields do not match those of {name}")
        if hasattr(made, "__setstate__"):
            made.__setstate__(state)
        else:
            made.__dict__.update(state)

    def _file(self, folder: str | None, *names: str) -> SpillFile:
        if folder is not None and not isinstance(folder, str):
            raise StateError("the folder of a temporary file is invalid")
        made = SpillFile(folder)
        for name in names:
            data = self._piece(name) if name.startswith(PIECE) else None
            if data is None or data.dtype != np.uint8:
                raise StateError("a temporary file is incomplete")
            made.append(data)
        return made

    def _plain(self, kind: str, rest: list[Any]) -> Any:
        if kind == "float":
            return float(rest[0])
        if kind == "file":
            return self._file(*rest)
        if kind in ("bytes", "number", "array"):
            name, start, count, *shape = rest
            whole = self._arrays[name]
            self._left -= count * whole.itemsize
            if min(start, count) < 0 or start + count > len(whole) or self._left < 0:
                raise StateError("an array is too short")
            flat = whole if len(whole) == count else whole[start : start + count].copy()
            if kind == "bytes":
                return flat.tobytes()
            if kind == "number":
                return flat[0]
            turned, *sizes = shape
            if any(type(size) is not int or size < 0 for size in sizes):
                raise StateError("the shape of an array is invalid")
            array = flat.reshape(sizes)
            return array.T if turned else array
        raise StateError(f"the kind of node {kind!r:.80} is unknown")


_FILLED: dict[str, type] = {
    "list": list,
    "dict": dict,
    "ordered": OrderedDict,
    "set": set,
    "deque": deque,
}


def _member(cls: type, name: str) -> Any:
    return next((vars(base)[name] for base in cls.__mro__ if name in vars(base)), None)
