"""Faces of rooms: what other rooms may import of one, loaded on first use.

A room is a folder of modules. Its `__init__` states the room's idea and lists, under
``if TYPE_CHECKING``, the names that others may use:

    if TYPE_CHECKING:
        from tofuse.engine.graph.graph import PoseGraph

    __getattr__, __dir__, __all__ = face(__name__, __file__)

Type checkers read the imports; `face` reads the same lines and imports each name on first use, so
that loading a room does not load all of it.
"""

from __future__ import annotations

import ast
import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any


def face(room: str, file: str) -> tuple[Callable[[str], Any], Callable[[], list[str]], list[str]]:
    """Return `__getattr__`, `__dir__` and `__all__` of a room.

    Parameters
    ----------
    room, file
        `__name__` and `__file__` of its `__init__`.
    """
    tree = ast.parse(Path(file).read_text(encoding="utf-8"))
    homes = {
        alias.asname or alias.name: (statement.module or "", alias.name)
        for block in tree.body
        if isinstance(block, ast.If)
        for statement in block.body
        if isinstance(statement, ast.ImportFrom)
        for alias in statement.names
    }

    def load(name: str) -> Any:
        if name not in homes:
            raise AttributeError(f"module {room!r} has no attribute {name!r}")
        home, attribute = homes[name]
        if home == room:  # a module of the room
            return importlib.import_module(f"{room}.{attribute}")
        value = getattr(importlib.import_module(home), attribute)
        setattr(sys.modules[room], name, value)
        return value

    return load, lambda: sorted(homes), sorted(homes)
