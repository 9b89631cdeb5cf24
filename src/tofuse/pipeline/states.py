"""Serialisation of the package's own types to plain data and arrays, for checkpoints.

Such data can't execute code or name other types. A class is looked up by its name among those that
the modules below define, and is filled, not called; then the checks of its constructor are repeated
(`state_checks`). Shared objects stay shared.

The data is a list of nodes. A value is a plain number, text or None; or the number of a node, in a
list of one element. A node is its kind and its content. The nodes are stored as JSON, in parts, so
that the state of a long recording is written with little memory.
"""

from __future__ import annotations

import importlib
import json
import math
import pkgutil
from collections import OrderedDict, deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofuse.arrays import UInt8
from tofuse.errors import InputError
from tofuse.files.spill import SpillFile
from tofuse.pipeline.state_checks import check_objects

Arrays = dict[str, NDArray[Any]]

# Packages and modules whose classes can be serialised.
_MODULES = (
    "corrections",
    "evaluation",
    "files.spill",
    "filters",
    "fusion",
    "geometry",
    "lab.methods",
    "odometry",
    "pipeline.background_queue",
    "pipeline.config",
    "pipeline.frame_log",
    "pipeline.intake",
    "pipeline.live_poses",
    "pipeline.mapper",
    "pipeline.observations",
    "pipeline.preparation",
    "pipeline.progress",
    "pipeline.reconstruct",
    "pipeline.stage_results",
    "posegraph",
    "recordings.background",
    "recordings.frames",
    "registration",
    "results.samples",
    "results.types",
    "sensor",
)
_DTYPE_KINDS = "biufcSU"  # of arrays
# Prefix of arrays that are pieces of a temporary file, which may be larger than the memory.
PIECE = "piece-"
_SMALL_BYTES = 1 << 14  # smaller arrays of one type are stored together
# Prefix of arrays that are JSON of the nodes, and the number of nodes in each.
_NODES, _NODES_PER_PART = "nodes-", 1 << 14
_MAX_NODES_BYTES = 1 << 30
_POOL_BYTES = 1 << 24  # of small arrays that are stored together


class StateError(Exception):
    """A state that can't be serialised, or is invalid."""


def encode(state: Any) -> Iterator[tuple[str, NDArray[Any]]]:
    """Yield arrays that describe a state, by name.

    Raises
    ------
    StateError
        If it contains an object of a type that can't be serialised.
    """
    return _Encoder().run(state)


def decode(
    arrays: Mapping[str, NDArray[Any]], piece: Callable[[str], NDArray[Any]] | None = None
) -> Any:
    """Return the state that arrays describe.

    Parameters
    ----------
    arrays
        As yielded by `encode`.
    piece
        Reads arrays whose names begin with `PIECE`, which are needed one at a time; None if they
        are among the others.

    Raises
    ------
    StateError
        If they are not a valid state.
    """
    others = {name: array for name, array in arrays.items() if not name.startswith(_NODES)}
    return _Decoder(_nodes_in(arrays), others, piece or arrays.__getitem__).run()


def _nodes_in(arrays: Mapping[str, NDArray[Any]]) -> list[Any]:
    parts = [array for name, array in arrays.items() if name.startswith(_NODES)]
    if sum(part.nbytes for part in parts) > _MAX_NODES_BYTES:
        raise StateError("it is too large")
    nodes: list[Any] = []
    for k in range(len(parts)):
        part = from_json(arrays.get(f"{_NODES}{k}"))
        if not isinstance(part, list):
            raise StateError("the list of nodes is invalid")
        nodes += part
    return nodes


def to_json(data: Any) -> UInt8:
    """Return plain data as JSON, in an array."""
    return np.frombuffer(json.dumps(data, separators=(",", ":")).encode(), np.uint8)


def from_json(array: NDArray[Any] | None) -> Any:
    """Return the data in an array of `to_json`; StateError if it is none."""
    if array is None or array.dtype != np.uint8:
        raise StateError("it is not a checkpoint")
    try:
        return json.loads(array.tobytes())
    except (ValueError, RecursionError):
        raise StateError("it is not a checkpoint") from None


@cache
def serialisable_types() -> dict[str, type]:
    """Return the classes that can be serialised, by their names."""
    types: dict[str, type] = {}
    for module in _modules():
        for item in vars(module).values():
            if isinstance(item, type) and item.__module__ == module.__name__ and _is_plain(item):
                types[_name(item)] = item
    return types


def _modules() -> Iterator[ModuleType]:
    for name in _MODULES:
        module = importlib.import_module(f"tofuse.{name}")
        yield module
        for info in pkgutil.iter_modules(getattr(module, "__path__", ())):
            yield importlib.import_module(f"{module.__name__}.{info.name}")


def _is_plain(cls: type) -> bool:
    """Whether the state of an instance is its attributes, and creating one calls nothing."""
    has_allowed_bases = all(base.__module__.split(".")[0] in _ALLOWED_BASES for base in cls.__mro__)
    has_default_new = _member(cls, "__new__") is object.__new__ and not hasattr(cls, "__del__")
    return (
        has_allowed_bases
        and has_default_new
        and hasattr(cls, "__dict__")
        and not getattr(cls, "_is_protocol", False)
    )


_ALLOWED_BASES = ("tofuse", "abc", "typing", "builtins")


def _name(cls: type) -> str:
    return f"{cls.__module__}.{cls.__qualname__}"


class _Encoder:
    def __init__(self) -> None:
        self._numbers: dict[int, int] = {}
        self._referenced: list[Any] = []  # so that no id of an object is used twice
        self._n_arrays = 0
        self._complete: Arrays = {}
        self._pools: dict[str, _Pool] = {}

    def run(self, state: Any) -> Iterator[tuple[str, NDArray[Any]]]:
        self._value([state])
        nodes: list[Any] = []
        parts = 0
        for item in self._referenced:  # grows during the iteration
            nodes.append(self._node(item))
            if len(nodes) == _NODES_PER_PART:
                yield f"{_NODES}{parts}", to_json(nodes)
                nodes, parts = [], parts + 1
            yield from self._complete.items()
            self._complete = {}
        yield f"{_NODES}{parts}", to_json(nodes)
        for pool in self._pools.values():
            yield pool.name, pool.array()

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
            return ["bytes", *self._array_reference(np.frombuffer(item, np.uint8))]
        if kind is np.ndarray:
            transposed = item.flags.f_contiguous and not item.flags.c_contiguous
            contiguous = item.T if transposed else item
            flat = np.ascontiguousarray(contiguous).reshape(-1)
            return ["array", *self._array_reference(flat), transposed, *contiguous.shape]
        if isinstance(item, np.generic):
            return ["number", *self._array_reference(np.asarray(item).reshape(-1))]
        if kind is SpillFile:
            return ["file", item.folder, *self._pieces(item)]
        if serialisable_types().get(_name(kind)) is kind:
            state = _attributes(item)
            return ["object", _name(kind), *(v for k in state for v in (k, value(state[k])))]
        raise StateError(f"objects of type {_name(kind)} can't be stored")

    def _pieces(self, file: SpillFile) -> list[str]:
        """Return names of the pieces of a temporary file: arrays read when they are written."""
        return [self._stored(PIECE, piece) for piece in file.pieces()]

    def _stored(self, prefix: str, array: Any) -> str:
        name = f"{prefix}{self._n_arrays}"
        self._n_arrays += 1
        self._complete[name] = array
        return name

    def _array_reference(self, flat: NDArray[Any]) -> list[Any]:
        """Return the name of the array that contains the values, their start, and their number."""
        if flat.dtype.kind not in _DTYPE_KINDS:
            raise StateError(f"arrays of {flat.dtype} can't be stored")
        if flat.nbytes > _SMALL_BYTES:
            return [self._stored("array-", flat), 0, len(flat)]
        pool = self._pools.get(flat.dtype.str)
        if pool is not None and pool.nbytes >= _POOL_BYTES:
            self._complete[pool.name] = pool.array()
            pool = None
        if pool is None:
            pool = self._pools[flat.dtype.str] = _Pool(f"small-{self._n_arrays}")
            self._n_arrays += 1
        return [pool.name, pool.add(flat), len(flat)]


class _Pool:
    """Small arrays of one type that are stored as one."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.nbytes = 0
        self._parts: list[NDArray[Any]] = []
        self._size = 0

    def add(self, flat: NDArray[Any]) -> int:
        """Add an array and return its start."""
        start = self._size
        self._parts.append(flat)
        self._size += len(flat)
        self.nbytes += flat.nbytes
        return start

    def array(self) -> NDArray[Any]:
        """Return all as one array."""
        return np.concatenate(self._parts)


def _attributes(item: Any) -> dict[str, Any]:
    """Return the state of an object of the package.

    For a frozen dataclass its fields, without derived values. (In Python 3.11, access to `__dict__`
    would create one permanently.)
    """
    cls = type(item)
    if _is_frozen(cls) and _member(cls, "__getstate__") is vars(object)["__getstate__"]:
        return {field.name: getattr(item, field.name) for field in fields(cls)}
    state: dict[str, Any] = item.__getstate__() or {}
    return state


def _is_frozen(cls: Any) -> bool:
    options = getattr(cls, "__dataclass_params__", None)
    return options is not None and bool(options.frozen)


_SEQUENCES: dict[type, str] = {list: "list", tuple: "tuple", set: "set", frozenset: "frozenset"}
_TABLES: dict[type, str] = {dict: "dict", OrderedDict: "ordered"}


class _Decoder:
    def __init__(
        self,
        nodes: list[Any],
        arrays: Mapping[str, NDArray[Any]],
        piece: Callable[[str], NDArray[Any]],
    ) -> None:
        self._piece = piece
        if not nodes:
            raise StateError("the list of nodes is missing")
        self._nodes = nodes
        self._arrays = arrays
        self._remaining_bytes = sum(array.nbytes for array in arrays.values())  # each is read once
        self._built: dict[int, Any] = {}
        self._visited: set[int] = set()

    def run(self) -> Any:
        try:
            (state,) = self._item(0)
            own_types = frozenset(serialisable_types().values())
            check_objects(item for item in self._built.values() if type(item) in own_types)
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
        if number in self._built:
            return self._built[number]
        if type(number) is not int or not 0 <= number < len(self._nodes) or number in self._visited:
            raise StateError("a reference between nodes is invalid")
        kind, *content = self._nodes[number]
        self._visited.add(number)
        if kind in ("tuple", "frozenset"):
            values = map(self._value, content)
            self._built[number] = tuple(values) if kind == "tuple" else frozenset(values)
        elif kind == "object":
            self._object(number, *content)
        elif kind in _FILLED:
            self._container(number, kind, content)
        else:
            self._built[number] = self._plain(kind, content)
        return self._built[number]

    def _container(self, number: int, kind: str, content: list[Any]) -> None:
        """Fill a container after creating it, as it may contain itself."""
        container: Any = deque(maxlen=content[0]) if kind == "deque" else _FILLED[kind]()
        self._built[number] = container
        if kind in ("dict", "ordered"):
            for key, value in zip(content[::2], content[1::2], strict=True):
                container[self._value(key)] = self._value(value)
            return
        add = container.add if kind == "set" else container.append
        for value in content[1:] if kind == "deque" else content:
            add(self._value(value))

    def _object(self, number: int, name: str, *attributes: Any) -> None:
        cls = serialisable_types().get(name)
        if cls is None:
            raise StateError(f"the type {name!r:.80} is unknown")
        instance: Any = object.__new__(cls)
        self._built[number] = instance
        state = {
            key: self._value(value)
            for key, value in zip(attributes[::2], attributes[1::2], strict=True)
        }
        if not all(type(key) is str for key in state):
            raise StateError("names of attributes are invalid")
        if is_dataclass(cls):
            names = {field.name for field in fields(cls)}
            missing = [n for n in names - set(state) if _member(cls, n) is None]
            if missing or (_is_frozen(cls) and set(state) - names):
                raise StateError(f"the fields do not match those of {name}")
        if hasattr(instance, "__setstate__"):
            instance.__setstate__(state)
        else:
            instance.__dict__.update(state)

    def _file(self, folder: str | None, *names: str) -> SpillFile:
        if folder is not None and not isinstance(folder, str):
            raise StateError("the folder of a temporary file is invalid")
        file = SpillFile(folder)
        for name in names:
            data = self._piece(name) if name.startswith(PIECE) else None
            if data is None or data.dtype != np.uint8:
                raise StateError("a temporary file is incomplete")
            file.append(data)
        return file

    def _plain(self, kind: str, content: list[Any]) -> Any:
        if kind == "float":
            return float(content[0])
        if kind == "file":
            return self._file(*content)
        if kind in ("bytes", "number", "array"):
            name, start, count, *shape = content
            stored = self._arrays[name]
            self._remaining_bytes -= count * stored.itemsize
            if min(start, count) < 0 or start + count > len(stored) or self._remaining_bytes < 0:
                raise StateError("an array is too short")
            flat = stored if len(stored) == count else stored[start : start + count].copy()
            if kind == "bytes":
                return flat.tobytes()
            if kind == "number":
                return flat[0]
            transposed, *sizes = shape
            if any(type(size) is not int or size < 0 for size in sizes):
                raise StateError("the shape of an array is invalid")
            array = flat.reshape(sizes)
            return array.T if transposed else array
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
