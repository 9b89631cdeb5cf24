"""A contract of import-linter: rooms are entered by their faces; no circles of files.

A room is a folder of modules. Modules of other rooms import from its `__init__` alone, whose names,
listed under ``if TYPE_CHECKING``, are at most 15. Single files directly in a building have no face.
"""

from __future__ import annotations

import ast
import importlib.util
from functools import cache
from pathlib import Path

from grimp import ImportGraph
from importlinter import Contract, ContractCheck, output

MAX_NAMES = 15
# Packages of rooms, without a face of their own.
BUILDINGS = frozenset({"tofuse", "tofuse.engine", "tofuse.formats", "tofuse.apps", "tofuse.lab"})


class DoorsContract(Contract):
    """No imports past a face, no face with too many names, no circle of files."""

    type_name = "doors"

    def check(self, graph: ImportGraph, verbose: bool) -> ContractCheck:
        """See `Contract.check`."""
        packages = {m for m in graph.modules if graph.find_children(m)}
        problems = []
        for module in sorted(graph.modules - packages):
            for imported in sorted(graph.find_modules_directly_imported_by(module)):
                room, name = imported.rsplit(".", 1)
                if imported in packages or room in BUILDINGS or module.startswith(f"{room}."):
                    continue
                # A face may offer a whole module as one name.
                details = graph.get_import_details(importer=module, imported=imported)
                by_name = all(d["line_contents"].startswith(f"from {room} import") for d in details)
                if not (by_name and name in names_of(room)):
                    problems.append(f"{module} imports {imported}, past the face of {room}")
        for room in sorted(packages - BUILDINGS):
            count = len(names_of(room))
            if count > MAX_NAMES:
                problems.append(f"the face of {room} has {count} names, more than {MAX_NAMES}")
        problems += [f"imported in a circle: {', '.join(circle)}" for circle in circles(graph)]
        return ContractCheck(kept=not problems, metadata={"problems": problems})

    def render_broken_contract(self, check: ContractCheck) -> None:
        """See `Contract.render_broken_contract`."""
        for problem in check.metadata["problems"]:
            output.print_error(problem)


@cache
def names_of(room: str) -> tuple[str, ...]:
    """Return the names in the face of a room, as its modules are called where they are modules."""
    spec = importlib.util.find_spec(room)
    assert spec is not None
    assert spec.origin is not None
    tree = ast.parse(Path(spec.origin).read_text(encoding="utf-8"))
    return tuple(
        alias.name
        for block in tree.body
        if isinstance(block, ast.If)
        for statement in block.body
        if isinstance(statement, ast.ImportFrom)
        for alias in statement.names
    )


def circles(graph: ImportGraph) -> list[list[str]]:
    """Return the sets of files that import each other, by Tarjan's algorithm."""
    order: dict[str, int] = {}
    lowest: dict[str, int] = {}
    stack: list[str] = []
    found: list[list[str]] = []

    def visit(module: str) -> None:
        order[module] = lowest[module] = len(order)
        stack.append(module)
        for imported in sorted(graph.find_modules_directly_imported_by(module)):
            if imported not in order:
                visit(imported)
                lowest[module] = min(lowest[module], lowest[imported])
            elif imported in stack:
                lowest[module] = min(lowest[module], order[imported])
        if lowest[module] == order[module]:
            circle = stack[stack.index(module) :]
            del stack[stack.index(module) :]
            if len(circle) > 1:
                found.append(sorted(circle))

    for module in sorted(graph.modules):
        if module not in order:
            visit(module)
    return found
