"""`run.json`: its content, writing, and reading by other commands."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, TextIO, overload

import numpy as np

from tofuse._version import __version__
from tofuse.apps.results import integrity
from tofuse.engine import quantities
from tofuse.engine.arrays import Float64, Intp
from tofuse.engine.errors import InputError
from tofuse.engine.geometry import se3
from tofuse.engine.quality import pose_accuracy
from tofuse.engine.refinement import Refinement, calibration_check
from tofuse.engine.results import FrameRecord, Mirror, Reason, Reconstruction, SelfCalibration
from tofuse.formats.files import atomic, reading
from tofuse.formats.poses import read_tum

_OF_SENSOR = ("sensor", "measured", "used", "scale", "lengths", "text")


def write_run_json(path: Path, result: Reconstruction) -> None:
    """Write `run.json`, schema 1: SI units and radians, null instead of NaN.

    All other files of the folder are complete: it has their digests.
    It is written frame by frame, as all frames of a long recording would need much memory.

    Parameters
    ----------
    path
        The new file.
    result
        The result.
    """
    with path.open("w", encoding="utf-8") as file:
        file.write("{")
        separator = ""
        for key, value in _content(result).items():
            file.write(f'{separator}\n "{key}": ')
            separator = ","
            if isinstance(value, Iterator):
                _write_rows(file, value)
            else:
                file.write(_indented(value, 1))
    integrity.seal(path)


def _write_rows(file: TextIO, rows: Iterator[Any]) -> None:
    """Write a JSON list at the first level, item by item."""
    separator = "["
    for row in rows:
        file.write(f"{separator}\n  {_indented(row, 2)}")
        separator = ","
    file.write("[]" if separator == "[" else "\n ]")


def _indented(value: Any, level: int) -> str:
    """Return the JSON of a value at a level of indentation: null instead of NaN."""
    text = json.dumps(plain(value), indent=1, allow_nan=False)
    return text.replace("\n", "\n" + level * " ")


def _content(result: Reconstruction) -> dict[str, Any]:
    """Return the content; that of `frames` is an iterator."""
    d = result.diagnostics
    return {
        "schema": 1,
        "version": __version__,
        "input": {
            **{key: result.recording[key] for key in ("path", "format", "frames")},
            "opening": result.recording.get("opening"),
        },
        "warnings": result.recording.get("warnings", []),
        "findings": result.recording.get("findings", []),
        "seed": result.seed,
        "threads": result.threads,
        "config": result.config,
        "seconds": {k: round(v, 4) for k, v in d.seconds.items()},
        "cpu_seconds": {k: round(v, 4) for k, v in d.cpu_seconds.items()},
        "verdict": d.verdict,
        "accuracy": accuracy_json(d.accuracy),
        "self_calibration": _calibration(d.calibrated),
        "reasons": reasons_json(d.reasons),
        "frames": (_frame(f, result) for f in d.frames),
        "T_up_world": result.T_up_world,
        "shift_m": result.shift,
        "rig": result.recording.get("rig"),
        "components": [
            _fields(c, "frames", "T_main_component", "joined", "reached") for c in result.components
        ],
        "sessions": [vars(session) for session in result.sessions],
        "session_pairs": [vars(pair) for pair in result.session_pairs],
        "changes": [
            {
                **_fields(c, "a", "b"),
                "kind": c.change.kind,
                "centre_m": c.change.centre,
                "size_m": c.change.size,
                "volume_m3": c.change.volume_m3,
            }
            for c in result.changes
        ],
        **({"mirrors": [_mirror(m) for m in result.mirrors]} if result.mirrors else {}),
        "loops": [vars(loop) for loop in d.loops],
        "optimiser": [
            _fields(p, "first", "vertices", "edges", "before", "after", "improved", "converged")
            for p in d.parts
        ],
        "certificate": d.certified and d.certified.to_dict(),
        "priors": [_fields(s, *_OF_SENSOR) for s in d.priors],
        "refinement": _refinement(d.refinement),
        "filters": {name: {"removed": fraction} for name, fraction in d.removed.items()},
    }


def _fields(record: Any, *names: str) -> dict[str, Any]:
    """Some fields of a record, in this order."""
    return {name: getattr(record, name) for name in names}


def _mirror(m: Mirror) -> dict[str, Any]:
    names = ("normal", "offset_m", "corners", "area_m2", "agreement", "log_ratio")
    return {**_fields(m, *names), "points": len(m.points)}


def _frame(f: FrameRecord, result: Reconstruction) -> dict[str, Any]:
    covariance = None if f.covariance is None else f.covariance.ravel()
    session = next((k for k, session in enumerate(result.sessions) if session.has(f.index)), None)
    return {**vars(f), "covariance": covariance, "session": session}


def frame_clock(run: Mapping[str, Any]) -> tuple[Float64, Intp]:
    """Return (N,) timestamps in s and (N,) indices of the frames of a `run.json`."""
    times = np.array([frame["timestamp"] for frame in run["frames"]], float)
    return times, np.array([frame["index"] for frame in run["frames"]], np.intp)


def accuracy_json(a: pose_accuracy.Accuracy) -> dict[str, Any]:
    """Return the accuracy as in `run.json`, except that infinite bounds are not yet null."""
    return asdict(a)


def reasons_json(reasons: Sequence[Reason]) -> list[dict[str, Any]]:
    """Return the reasons as `run.json` has them."""
    return [_fields(reason, "code", "frames", "ranges", "text", "remedy") for reason in reasons]


def _refinement(r: Refinement | None) -> dict[str, Any] | None:
    """Outcome of the global refinement; None where no view took part."""
    if r is None or not r.views:
        return None
    return {
        **_fields(r, "kept", "views", "pairs", "moved_m", "moved_rad"),
        "support_before": r.support[0],
        "support_after": r.support[1],
        "camera": r.errors,
        "suspicion": _suspicion(r.calibration_check),
    }


def _calibration(calibration: SelfCalibration | None) -> dict[str, Any] | None:
    """The self-calibration; None where there was none."""
    if calibration is None:
        return None
    return {
        **_fields(calibration, "focal", "offset_m", "center_x", "center_y", "distortion"),
        "sigma": dict(calibration.sigmas),
        "stated_bound_m": calibration.bound_m[0],
        "corrected_bound_m": calibration.bound_m[1],
    }


def _suspicion(check: calibration_check.CalibrationCheck | None) -> dict[str, Any] | None:
    """The check of the camera's calibration; None where it was not made."""
    if check is None:
        return None
    gap = check.gap and {
        "i": check.gap.i,
        "j": check.gap.j,
        "gap_m": check.gap.before[0],
        "gap_rad": check.gap.before[1],
        "calibrated_gap_m": check.gap.after[0],
        "calibrated_gap_rad": check.gap.after[1],
    }
    return {
        "alarm": check.alarm,
        "camera": check.errors,
        "sigma": {name: check.sigma(name) for name in check.errors},
        "estimates": check.estimates,
        "focal_motion_m": 0.01 * check.motion["focal"][0] if check.motion else None,
        "support": check.support,
        "loop": gap,
    }


@overload
def plain(value: dict[str, Any]) -> dict[str, Any]: ...
@overload
def plain(value: Any) -> Any: ...
def plain(value: Any) -> Any:
    """Convert arrays and NumPy numbers to JSON values; NaN and infinity become null."""
    if isinstance(value, dict):
        return {k: plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [plain(v) for v in value]
    if isinstance(value, np.ndarray):
        has_gaps = value.dtype.kind == "f" and not np.isfinite(value).all()
        return plain(value.tolist()) if has_gaps else value.tolist()
    if isinstance(value, np.generic):
        return plain(value.item())
    return None if isinstance(value, float) and not np.isfinite(value) else value


def write_object(path: Path, data: dict[str, Any]) -> None:
    """Write an object of plain data and arrays as JSON, what is not finite as null.

    Raises
    ------
    OutputError
        If the file can't be written; an existing one is then unchanged.
    """
    atomic.write_text(path, json.dumps(plain(data), indent=1, allow_nan=False) + "\n")


def read_run_json(path: str | Path) -> dict[str, Any]:
    """Read a `run.json`.

    Raises
    ------
    InputError
        If it can't be read, or is not a `run.json` of schema 1.
    """
    path = Path(path)
    data = reading.parsed(json.loads, reading.read_text(path), where=path, format_name="JSON")
    if not isinstance(data, dict) or data.get("schema") != 1:
        raise InputError("is not a run.json of schema 1", where=path)
    return data


@contextmanager
def opened(folder: Path) -> Iterator[dict[str, Any]]:
    """Yield the checked `run.json` of a result; a block that reads its fields raises InputError."""
    path = folder / "run.json"
    run = read_run_json(path)
    with reading.damage_reported(path, "a run.json"):
        integrity.check(folder, run)
        yield run


def rotation_up_world(data: Mapping[str, Any], path: Path) -> Float64:
    """Return the rotation (3, 3) of `T_up_world` in data from a file.

    Raises
    ------
    InputError
        If it is missing, or not a pose.
    """
    with reading.damage_reported(path, f"a {path.name}"):
        return se3.check_pose(data["T_up_world"], where=f"{path}: T_up_world")[:3, :3]


def frame_covariance(frame: Mapping[str, Any]) -> Float64 | None:
    """Return the (6, 6) covariance of the pose of an entry of `frames`; None if it is unknown."""
    values = frame["covariance"]
    C = None if values is None else np.array(values, float).reshape(6, 6)
    return None if C is None or not np.isfinite(C).all() else C


def main_poses(folder: Path, run: dict[str, Any]) -> tuple[list[int], Float64]:
    """Return the frame indices and poses (N, 4, 4) T_world_camera of the main model of a result.

    Relative to its `shift_of`.

    Parameters
    ----------
    folder
        The result.
    run
        Its `run.json`.

    Raises
    ------
    InputError
        If `run.json` is damaged, or `trajectory.txt` is of another run.
    """
    with reading.damage_reported(folder / "run.json", "a run.json"):
        indices = [int(frame["index"]) for frame in frames_in_main_model(run)]
        stated = np.array([frame["timestamp"] for frame in frames_in_main_model(run)], float)
    times, poses = read_tum(folder / "trajectory.txt")
    problem = None
    if len(indices) != len(poses):
        posed = quantities.count(len(indices), "frame")
        problem = f"lists {posed} with a pose, but trajectory.txt has {len(poses)}"
    elif not np.array_equal(times, stated):
        problem = "has other timestamps than trajectory.txt"
    if problem is not None:
        raise InputError(
            problem, where=folder / "run.json", remedy="copy the whole folder, or run again"
        )
    return indices, se3.about(-shift_of(run, folder / "run.json"), poses)


def shift_of(run: dict[str, Any], where: Path) -> Float64:
    """Return the shift (3,) in m of a result's clouds; see `Reconstruction.shift`."""
    shift = np.asarray(run.get("shift_m", (0, 0, 0)))
    if shift.shape != (3,) or shift.dtype.kind not in "fi" or not np.isfinite(shift).all():
        raise InputError("shift_m is not three numbers", where=where, remedy="run again")
    return shift.astype(np.float64)


def frames_in_main_model(run: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the entries of `run.json` for the frames with a line in `trajectory.txt`, in order.

    See `types.in_main_model`.
    """
    connected = [c["T_main_component"] is not None for c in run["components"]]
    return [
        frame
        for frame in run["frames"]
        if frame["status"] in ("tracked", "predicted")
        and (frame["component"] is None or connected[frame["component"]])
    ]
