"""Every public name documents all of its parameters."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterator
from typing import Any

import pytest

import tofuse

NAMES = [name for name in tofuse.__all__ if name != "__version__"]


def methods(kind: type) -> Iterator[tuple[str, Any]]:
    """Public methods and properties that a class of tofuse defines, inherited ones included."""
    for name in dir(kind):
        if name.startswith("_"):
            continue
        owner = next((c for c in kind.__mro__ if name in vars(c)), None)
        if owner is None or not owner.__module__.startswith("tofuse."):
            continue
        member = inspect.getattr_static(kind, name)
        if isinstance(member, staticmethod | classmethod):
            member = member.__func__
        if inspect.isfunction(member):
            yield name, member
        elif isinstance(member, property) or hasattr(member, "func"):  # or a cached property
            yield name, member.fget if isinstance(member, property) else member.func


def undocumented(function: Any, text: str) -> list[str]:
    """Parameters that a docstring does not name."""
    parameters = [p for p in inspect.signature(function).parameters if p not in ("self", "cls")]
    return [p for p in parameters if not re.search(rf"\b{re.escape(p)}\b", text)]


def faults(name: str) -> list[str]:
    """Gaps in the docstrings of a public name and of its methods."""
    public = getattr(tofuse, name)
    text = inspect.getdoc(public) or ""
    if not text.strip():
        return [f"{name} has no docstring"]
    if not inspect.isclass(public):
        return [f"{name}: {p}" for p in undocumented(public, text)]
    # Fields are described by the class that declares them, arguments by `__init__` as well.
    bases = [kind for kind in public.__mro__ if kind.__module__.startswith("tofuse.")]
    text = " ".join(kind.__doc__ or "" for kind in bases)
    text += " ".join(
        vars(kind)["__init__"].__doc__ or "" for kind in bases if "__init__" in vars(kind)
    )
    found = []
    if public.__init__ is not object.__init__ and not issubclass(public, BaseException):
        found = [f"{name}: {p}" for p in undocumented(public.__init__, text)]
    for method, function in methods(public):
        words = inspect.getdoc(function) or ""
        if not words.strip():
            found.append(f"{name}.{method} has no docstring")
        found += [f"{name}.{method}: {p}" for p in undocumented(function, words)]
    return found


@pytest.mark.parametrize("name", NAMES)
def test_docstrings_name_every_parameter(name: str) -> None:
    assert faults(name) == []


def test_undocumented_parameter_is_detected() -> None:
    def scaled(value: float, factor: float) -> float:
        """Multiply a value."""
        return value * factor

    assert undocumented(scaled, scaled.__doc__ or "") == ["factor"]
