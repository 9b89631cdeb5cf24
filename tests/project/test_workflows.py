"""The GitHub workflows are valid, and what they refer to exists."""

from __future__ import annotations

import re
import tomllib
from typing import Any

import pytest

from paths import ROOT

WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
MAKEFILE = (ROOT / "Makefile").read_text(encoding="utf-8")
# Paths in commands that are in the repository; built files are in dist, build and .venv.
PATH = re.compile(r"(?<![\w./-])((?:benchmarks|docs|requirements|src|tests|website)/[\w./-]+)")


def jobs() -> list[tuple[str, dict[str, Any]]]:
    yaml = pytest.importorskip("ruamel.yaml", reason="the package ruamel.yaml is not installed")
    found = []
    for path in WORKFLOWS:
        workflow = yaml.YAML(typ="safe", pure=True).load(path.read_text(encoding="utf-8"))
        assert set(workflow) <= {"name", "on", "permissions", "concurrency", "jobs"}
        assert {"name", "on", "permissions", "jobs"} <= set(workflow)
        # Least privilege by default; a job that publishes asks for more.
        assert workflow["permissions"] == {"contents": "read"}
        found += [(f"{path.name}: {name}", job) for name, job in workflow["jobs"].items()]
    return found


def commands() -> list[str]:
    return [step["run"] for _, job in jobs() for step in job["steps"] if "run" in step]


def python_versions() -> list[str]:
    """All versions that the workflows install."""
    found = []
    for _, job in jobs():
        matrix = job.get("strategy", {}).get("matrix", {})
        for step in job["steps"]:
            version = step.get("with", {}).get("python-version")
            if version == "${{ matrix.python }}":
                found += matrix["python"]
            elif version is not None:
                found.append(version)
    return found


def test_make_targets_exist() -> None:
    rules = set(re.findall(r"^([\w./-]+):(?!=)", MAKEFILE, re.MULTILINE))
    targets = [
        target
        for command in commands()
        for line in re.findall(r"^make (.+)$", command, re.MULTILINE)
        for target in line.split()
    ]
    assert len(targets) >= 4
    assert set(targets) <= rules
    declared = re.search(r"^\.PHONY: (.+)$", MAKEFILE, re.MULTILINE)
    assert declared is not None
    assert set(declared[1].split()) <= rules


def test_files_in_commands_exist() -> None:
    recipes = [line for line in MAKEFILE.splitlines() if line.startswith("\t")]
    with_ = [step.get("with", {}) for _, job in jobs() for step in job["steps"]]
    named = [text for step in with_ for text in step.values() if isinstance(text, str)]
    paths = {path for text in (*commands(), *recipes, *named) for path in PATH.findall(text)}
    assert {"requirements/dev.txt", "benchmarks/attack.py"} <= paths
    made = set(re.findall(r"^(docs/[\w./-]+):", MAKEFILE, re.MULTILINE))
    assert [path for path in sorted(paths - made) if not (ROOT / path).exists()] == []


def test_python_versions_agree() -> None:
    """With requires-python, the classifiers, the Makefile, ruff and the pins."""
    stated = [
        line.rpartition(" ")[2]
        for line in PROJECT["project"]["classifiers"]
        if re.fullmatch(r"Programming Language :: Python :: 3\.\d+", line)
    ]
    oldest, newest = stated[0], stated[-1]
    assert stated == [f"3.{k}" for k in range(int(oldest[2:]), int(newest[2:]) + 1)]
    assert PROJECT["project"]["requires-python"] == f">={oldest}"
    assert {oldest, newest} <= set(python_versions()) <= set(stated)
    assert PROJECT["tool"]["ruff"]["target-version"] == f"py{oldest.replace('.', '')}"
    assert f"sys.version_info < (3, {oldest[2:]})" in MAKEFILE
    assert f"--python-version {oldest} " in MAKEFILE
