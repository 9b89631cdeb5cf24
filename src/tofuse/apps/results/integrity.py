"""Whether a result is what a run wrote: digests of its files, and values that fit each other.

`run.json` ends with `sha256`: the digests of the other files of the folder, and its own up to that
key. A result that somebody edited is refused by name, unless edits are accepted; values that no run
can write are refused in any case.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Any, get_args

import numpy as np

from tofuse._version import __version__
from tofuse.engine.errors import InputError
from tofuse.engine.geometry import se3
from tofuse.engine.loops import JoinKind
from tofuse.engine.results import Reason, Verdict, verdicts
from tofuse.engine.tracking import Status

_KEY, _SELF = "sha256", "run.json"
_START = f',\n "{_KEY}": {{'
# Asymmetry and negative eigenvalues of covariances, relative to their size, that rounding explains.
_ROUNDING = 1e-6

_edits_accepted: ContextVar[bool] = ContextVar("edits_accepted", default=False)


@contextmanager
def accepting_edits() -> Iterator[None]:
    """Read results inside the block although their files were edited."""
    token = _edits_accepted.set(True)
    try:
        yield
    finally:
        _edits_accepted.reset(token)


def seal(path: Path) -> None:
    """Complete a `run.json` with digests, and the closing brace.

    Parameters
    ----------
    path
        The file up to there. All other files of its folder are complete; components have a
        `run.json` of their own.
    """
    names = sorted(file.name for file in path.parent.iterdir() if file.is_file())
    digests = {name: _digest(path.parent / name) for name in names}
    entries = ",\n".join(f"  {json.dumps(name)}: {json.dumps(d)}" for name, d in digests.items())
    with path.open("a", encoding="utf-8", newline="") as file:
        file.write(f"{_START}\n{entries}\n }}\n}}\n")


def check(folder: Path, run: Mapping[str, Any]) -> None:
    """Check the files of a result, and the values of its `run.json`.

    Raises
    ------
    InputError
        If a file was edited and that is not accepted, or if values contradict each other.
    """
    if not _edits_accepted.get() and (edited := _edited(folder, run)):
        raise InputError(
            f"{edited} was changed after the run",
            where=folder,
            remedy="run again, or pass --edited to use it nevertheless",
        )
    for problem in _problems(run):
        raise InputError(problem, where=folder / _SELF, remedy="run again")
    se3.check_pose(run["T_up_world"], where=f"{folder / _SELF}: T_up_world")


def _edited(folder: Path, run: Mapping[str, Any]) -> str | None:
    """Return the name of the first file that is not what its digest says; None if all are."""
    digests = run.get(_KEY)
    if not isinstance(digests, dict):
        return _SELF
    content = (folder / _SELF).read_bytes()
    written = content[: content.rfind(_START.encode())]
    if hashlib.sha256(written).hexdigest() != digests.get(_SELF):
        return _SELF
    for name, digest in digests.items():
        # A file that was deleted is missed by whoever needs it.
        file = folder / Path(name).name
        if name != _SELF and file.is_file() and _digest(file) != digest:
            return str(name)
    return None


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _problems(run: Mapping[str, Any]) -> Iterator[str]:
    """Say what no run of this version can have written."""
    if not re.fullmatch(r"\d+\.\d+\.\d+.*", str(run["version"])):
        yield f"version is {run['version']!r}"
    elif _release(run["version"]) > _release(__version__):
        yield f"is of the newer version {run['version']}: update tofuse"
    yield from _unlisted("verdict", [run["verdict"]], get_args(Verdict))
    yield from _unlisted("reasons: code", [r["code"] for r in run["reasons"]], verdicts.REASONS)
    yield from _unlisted("frames: status", [f["status"] for f in run["frames"]], get_args(Status))
    kinds = [c["joined"] for c in run["components"] if c["joined"] is not None]
    yield from _unlisted("components: joined", kinds, get_args(JoinKind))
    reasons = [Reason(r["code"], (), r["text"]) for r in run["reasons"]]
    if run["verdict"] != verdicts.verdict_of(reasons):
        yield f"verdict is {run['verdict']!r}, and the reasons say otherwise"
    if not isinstance(run["seed"], int) or run["seed"] < 0:
        yield f"seed is {run['seed']!r}"
    bounds = [run["accuracy"][key] for key in ("position_m", "rotation_rad", "relative")]
    if not all(bound is None or bound >= 0 for bound in bounds):
        yield "accuracy has a negative bound"
    yield from _wrong_covariances(run["frames"])
    numbers = {f["component"] for f in run["frames"] if f["component"] is not None}
    if run["components"] and not numbers <= set(range(len(run["components"]))):
        yield "frames are in components that are not listed"


def _release(version: str) -> tuple[int, ...]:
    return tuple(int(number) for number in re.findall(r"\d+", version)[:3])


def _unlisted(
    name: str, values: Sequence[Any], allowed: Sequence[str] | Mapping[str, Any]
) -> Iterator[str]:
    for value in values:
        if value not in allowed:
            yield f"{name} is {value!r}, not one of {', '.join(allowed)}"


def _wrong_covariances(frames: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    known = [f for f in frames if f["covariance"] is not None]
    if not known:
        return
    C = np.array([f["covariance"] for f in known], float).reshape(-1, 6, 6)
    C = np.where(np.isfinite(C).all((1, 2), keepdims=True), C, 0)
    size = np.abs(C).max((1, 2))
    lowest = np.linalg.eigvalsh((C + np.swapaxes(C, 1, 2)) / 2)[:, 0]
    wrong = (np.abs(C - np.swapaxes(C, 1, 2)).max((1, 2)) > _ROUNDING * size) | (
        lowest < -_ROUNDING * size
    )
    for k in np.flatnonzero(wrong)[:1]:
        yield f"the covariance of frame {known[k]['index']} is not symmetric and non-negative"
