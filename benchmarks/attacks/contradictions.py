"""Results, cameras and rigs that were edited, or whose values contradict each other.

`tofuse export`, `merge` and `evaluate` must refuse each in one line that names the file, with
status 2. Some edits of `run.json` come with digests as a run would write them: they must be refused
by their values.
"""

from __future__ import annotations

import contextlib
import io
import json
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from attacks import mutation
from tofuse.apps.cli.program import main
from tofuse.apps.results import integrity

Document = dict[str, Any]


@dataclass(frozen=True)
class Edit:
    """A change of one file, below the folder of `made`, and the commands that must refuse it.

    `named` is the file that they name: another one, if the digests were edited.
    """

    name: str
    file: str
    change: Callable[[Path], object]
    commands: tuple[str, ...] = ("export", "merge", "evaluate")
    named: str = ""


def made(folder: Path) -> None:
    """Make two results, with their recordings, a reference, and a rig of these recordings."""
    mutation.subjects()  # adds tests/helpers to the import path
    import made_sessions

    made_sessions.made_result(folder / "a", made_sessions.HERE[:4], number=1)
    made_sessions.made_result(folder / "b", made_sessions.HERE[4:8], number=2)
    shutil.copy(folder / "a" / "trajectory.txt", folder / "reference.txt")
    for name in ("a", "b"):
        shutil.copytree(folder / f"{name}-recording", folder / "rig" / name)
    (folder / "rig" / "rig.json").write_text(json.dumps({
        "schema": 1,
        "cameras": [
            {"name": name, "T_rig_camera": np.eye(4).tolist(),
             "covariance": (1e-6 * np.eye(6)).ravel().tolist()}
            for name in ("a", "b")
        ],
        "disagreement": [{"a": "a", "b": "b", "median_m": 0.01, "pixels": 100}],
    }))  # fmt: skip


def _words(command: str, folder: Path, recording: str) -> list[object]:
    out = folder / "out"
    return {
        "export": ["export", folder / "a", "pcd", "nerfstudio", "--out", out],
        "merge": ["merge", folder / "a", folder / "b", "--out", out],
        "evaluate": ["evaluate", folder / "a", folder / "reference.txt"],
        "evaluate images": [
            "evaluate", folder / "a", folder / "reference.txt", "--recording", folder / recording],
    }[command]  # fmt: skip


def attack(edit: Edit, original: Path, folder: Path) -> list[str]:
    """Apply an edit to a copy, which is `folder`, and return the faults of the commands."""
    faults = []
    for command in edit.commands:
        shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(original, folder)
        _moved(folder, original)
        edit.change(folder / edit.file)
        status, out, err = called(_words(command, folder, edit.file.split("/", 1)[0]))
        problem = _problem(status, out, err, edit.named or Path(edit.file).name)
        if problem:
            faults.append(f"{edit.name}: {command}: {problem}")
    return faults


def _moved(folder: Path, original: Path) -> None:
    """Let the results refer to the recordings beside them."""
    for name in ("a", "b"):
        path = folder / name / "run.json"
        _resealed(path, lambda run, n=name: _refer(run, folder / f"{n}-recording"))


def _refer(run: Document, recording: Path) -> None:
    run["input"]["path"] = str(recording)
    run["input"]["opening"]["paths"] = [str(recording)]


def called(words: list[object]) -> tuple[int, str, str]:
    """Call the command line in this process: status, standard output and error."""
    with (
        contextlib.redirect_stdout(io.StringIO()) as out,
        contextlib.redirect_stderr(io.StringIO()) as err,
    ):
        try:
            status = main([str(word) for word in words])
        except SystemExit as stop:
            status = int(stop.code or 0)
    return status, out.getvalue(), err.getvalue()


def _problem(status: int, out: str, err: str, file: str) -> str:
    lines = err.splitlines()
    if status != 2:
        return f"status {status}"
    if "Traceback" in err or len(lines) != 1 or not lines[0].startswith("tofuse: "):
        return f"{len(lines)} lines: {err[:200]!r}"
    if file not in err:
        return f"does not name {file}: {err.strip()}"
    return "printed to stdout" if out else ""


# ---- Edits ---------------------------------------------------------------------------------------


def _text(change: Callable[[list[str]], list[str]]) -> Callable[[Path], object]:
    """An edit of the lines of a file."""
    return lambda path: path.write_text("\n".join(change(path.read_text().splitlines())) + "\n")


def _replaced(old: str, new: str) -> Callable[[Path], object]:
    def change(path: Path) -> None:
        text = path.read_text()
        assert old in text, old
        path.write_text(text.replace(old, new, 1))

    return change


def _cut(path: Path) -> None:
    data = path.read_bytes()
    path.write_bytes(data[: len(data) // 2])


def _flipped(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[-5] ^= 4
    path.write_bytes(data)


def _emptied(path: Path) -> None:
    path.write_bytes(b"")


def _of_b(path: Path) -> None:
    """The file of another result."""
    shutil.copy(path.parents[1] / "b" / path.name, path)


def _resealed(path: Path, change: Callable[[Document], object]) -> None:
    """Change a `run.json`, with digests as a run would write them."""
    run = json.loads(path.read_text())
    run.pop("sha256", None)
    change(run)
    path.write_text(json.dumps(run, indent=1).removesuffix("}").rstrip())
    integrity.seal(path)


def _sealed(change: Callable[[Document], object]) -> Callable[[Path], object]:
    return lambda path: _resealed(path, change)


def _json(change: Callable[[Document], object]) -> Callable[[Path], object]:
    def edit(path: Path) -> None:
        document = json.loads(path.read_text())
        change(document)
        path.write_text(json.dumps(document))

    return edit


def _columns(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], object]:
    """An edit of the numbers of a trajectory (N, 8)."""
    return lambda path: np.savetxt(path, change(np.loadtxt(path, ndmin=2)), fmt="%.12g")


def _scaled(column: slice, factor: float, offset: float = 0.0) -> Callable[[Path], object]:
    def change(rows: np.ndarray) -> np.ndarray:
        rows[:, column] = rows[:, column] * factor + offset
        return rows

    return _columns(change)


def _covariance(change: Callable[[np.ndarray], np.ndarray]) -> Callable[[Path], object]:
    def edit(run: Document) -> None:
        frame = run["frames"][-1]
        frame["covariance"] = change(np.reshape(frame["covariance"], (6, 6))).ravel().tolist()

    return _sealed(edit)


def _frame(**values: object) -> Callable[[Path], object]:
    return _sealed(lambda run: run["frames"][1].update(values))


def _run(**values: object) -> Callable[[Path], object]:
    return _sealed(lambda run: run.update(values))


def _up(row: int, factor: float) -> Callable[[Path], object]:
    def edit(run: Document) -> None:
        run["T_up_world"][row] = [factor * x for x in run["T_up_world"][row]]

    return _sealed(edit)


def edits() -> Iterator[Edit]:
    """Yield all edits."""
    for name, change in {
        "reversed": _text(lambda lines: lines[::-1]),
        "times shifted by 1 s": _scaled(slice(0, 1), 1, 1.0),
        "poses x 10": _scaled(slice(1, 4), 10),
        "poses moved by 1 m": _scaled(slice(1, 4), 1, 1.0),
        "quaternions negated": _scaled(slice(4, 8), -1),
        "a line removed": _text(lambda lines: lines[:-1]),
        "a line repeated": _text(lambda lines: [*lines, lines[-1]]),
        "a comment added": _text(lambda lines: ["# edited", *lines]),
        "empty": _emptied,
        "of another result": _of_b,
    }.items():
        yield Edit(f"trajectory {name}", "a/trajectory.txt", change)
    for name, change in {
        "cut": _cut,
        "empty": _emptied,
        "with a bit changed": _flipped,
        "of another result": _of_b,
    }.items():
        yield Edit(f"graph {name}", "a/pose_graph.g2o", change)
        yield Edit(f"cloud {name}", "a/cloud.ply", change)
    yield Edit("mesh with a bit changed", "a/mesh.ply", _flipped)
    yield from _edits_of_run()
    for name, change in {
        "width": _json(lambda c: c.update(width=64)),
        "focal length 0": _json(lambda c: c.update(fx=0)),
        "focal length negative": _json(lambda c: c.update(fy=-92.0)),
        "focal length of a word": _json(lambda c: c.update(fx="x")),
        "model": _json(lambda c: c.update(model="unknown")),
        "depth_unit_m negative": _json(lambda c: c.update(depth_unit_m=-1)),
        "depth_kind": _json(lambda c: c.update(depth_kind="height")),
        "schema": _json(lambda c: c.update(schema=9)),
        "empty": _emptied,
        "cut": _cut,
    }.items():
        commands = ("export", "merge", "evaluate images")
        yield Edit(f"camera.json: {name}", "a-recording/camera.json", change, commands)
    for name, change in {
        "mirrored": _json(lambda r: r["cameras"][1]["T_rig_camera"].__setitem__(0, [-1, 0, 0, 0])),
        "scaled": _json(lambda r: r["cameras"][1]["T_rig_camera"].__setitem__(0, [2, 0, 0, 0])),
        "two of one name": _json(lambda r: r["cameras"][1].update(name="a")),
        "no cameras": _json(lambda r: r.update(cameras=[])),
        "negative covariance": _json(
            lambda r: r["cameras"][1].update(covariance=(-np.eye(6)).ravel().tolist())
        ),
        "first camera moved": _json(
            lambda r: r["cameras"][0]["T_rig_camera"].__setitem__(0, [1, 0, 0, 1])
        ),
        "disagreement of a stranger": _json(lambda r: r["disagreement"][0].update(a="c")),
        "depth offset": _json(lambda r: r["cameras"][1].update(depth_offset_m=1e3)),
        "cut": _cut,
    }.items():
        yield Edit(f"rig.json: {name}", "rig/rig.json", change, ("evaluate images",))


def _edits_of_run() -> Iterator[Edit]:
    changes = {
        "a status edited": _replaced('"tracked"', '"predicted"'),
        "a verdict edited": _replaced('"verdict": "', '"verdict": "x'),
        "a bound edited": _replaced('"position_m": ', '"position_m": 1'),
        "a blank added": _replaced('"seed":', '"seed": '),
        "no digests": _json(lambda run: run.pop("sha256")),
        "cut": _cut,
        "empty": _emptied,
        "sealed: verdict excellent": _run(verdict="excellent"),
        "sealed: verdict failed": _run(verdict="failed"),
        "sealed: version 99": _run(version="99.0.0"),
        "sealed: version new": _run(version="new"),
        "sealed: schema 2": _run(schema=2),
        "sealed: seed -1": _run(seed=-1),
        "sealed: seed of a word": _run(seed="x"),
        "sealed: shift of two numbers": _run(shift_m=[0, 0]),
        "sealed: no frames": _run(frames=[]),
        "sealed: negative bound": _sealed(lambda run: run["accuracy"].update(position_m=-0.1)),
        "sealed: unknown status": _frame(status="fine"),
        "sealed: unknown component": _frame(component=7),
        "sealed: other time": _frame(timestamp=7e9),
        "sealed: lost": _frame(status="lost"),
        "sealed: unknown reason": _sealed(
            lambda run: run["reasons"].append({"code": "x", "ranges": [], "text": ""})
        ),
        "sealed: negative covariance": _covariance(lambda C: -C),
        "sealed: asymmetric covariance": _covariance(lambda C: C + np.eye(6, k=1)),
        "sealed: mirrored T_up_world": _up(0, -1),
        "sealed: scaled T_up_world": _up(0, 2),
    }
    for name, change in changes.items():
        yield Edit(f"run.json {name}", "a/run.json", change)
    edited = _replaced('"trajectory.txt": "', '"trajectory.txt": "0')
    yield Edit("run.json a digest edited", "a/run.json", edited, named="trajectory.txt")
    yield Edit("run.json of another result", "a/run.json", _of_b, named="cloud.ply")
