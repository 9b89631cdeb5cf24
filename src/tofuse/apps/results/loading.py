"""Reading a result from its output folder."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from tofuse.apps.results.folders import check_result, component_name, is_result
from tofuse.apps.results.run_json import (
    frame_covariance,
    main_poses,
    opened,
    rotation_up_world,
    shift_of,
)
from tofuse.engine.arrays import Float64
from tofuse.engine.fusion import Cloud, GeometryRecord, Mesh
from tofuse.engine.graph import GraphPart, LoopRecord, certificate, external_sensors
from tofuse.engine.quality import pose_accuracy
from tofuse.engine.results import (
    Component,
    Diagnostics,
    FrameRecord,
    Reason,
    Reconstruction,
    SelfCalibration,
    SessionPair,
    SessionRecord,
)
from tofuse.formats.files import reading
from tofuse.formats.geometry import read_ply
from tofuse.formats.poses import read_g2o
from tofuse.formats.readers import read_las


def load_result(folder: str | Path) -> Reconstruction:
    """Read the output folder of a run.

    Empty, as they are not stored: poses before loop closure (NaN), the values of the optimiser's
    objective, the refinement, sample images, and the model before optimisation.

    Raises
    ------
    InputError
        If it is not an output folder, or its files are damaged or of different runs.
    """
    folder = reading.path_of(folder, "folder", "pass the folder of a result")
    check_result(folder)
    with opened(folder) as run:
        return _reconstruction(folder, run)


def _reconstruction(folder: Path, run: dict[str, Any]) -> Reconstruction:
    frames = tuple(_frame(each) for each in run["frames"])
    row = {frame.index: k for k, frame in enumerate(frames)}
    trajectory = np.full((len(frames), 4, 4), np.nan)
    indices, poses = main_poses(folder, run)
    shift = shift_of(run, folder / "run.json")
    trajectory[[row[index] for index in indices]] = poses
    diagnostics = Diagnostics(
        run["verdict"],
        tuple(
            Reason(
                r["code"],
                tuple((a, b) for a, b in r["ranges"]),
                r["text"],
                r.get("remedy", ""),
            )
            for r in run["reasons"]
        ),
        frames,
        tuple(LoopRecord(**p) for p in run["loops"]),
        np.full_like(trajectory, np.nan),
        (),
        {name: each["removed"] for name, each in run["filters"].items()},
        run["seconds"],
        run.get("cpu_seconds", {}),
        parts=tuple(_part(each) for each in run["optimiser"]),
        certified=_certificate(run.get("certificate")),
        priors=tuple(external_sensors.SensorRecord(**s) for s in run["priors"]),
        accuracy=_accuracy(run["accuracy"]),
        calibrated=_calibration(run.get("self_calibration")),
    )
    return Reconstruction(
        trajectory,
        np.array([frame.timestamp for frame in frames]),
        read_g2o(folder / "pose_graph.g2o"),
        _cloud(folder, shift),
        diagnostics,
        run["config"],
        {
            **run["input"],
            "warnings": run["warnings"],
            "findings": run["findings"],
            "rig": run.get("rig"),
        },
        run["seed"],
        run["threads"],
        read_mesh(folder / "mesh.ply"),
        tuple(_component(folder, k, c) for k, c in enumerate(run["components"])),
        tuple(_session(each) for each in run.get("sessions", ())),
        tuple(SessionPair(**each) for each in run.get("session_pairs", ())),
        up=rotation_up_world(run, folder / "run.json")[1],
        shift=shift,
    )


def _frame(data: dict[str, Any]) -> FrameRecord:
    unobservable = np.array(data["unobservable"], float).reshape(-1, 6)
    covariance = {"covariance": frame_covariance(data)}
    stated = {name: data[name] for name in data if name != "session"}
    return FrameRecord(**{**stated, **covariance, "unobservable": unobservable})


def _session(data: dict[str, Any]) -> SessionRecord:
    T = data["T_main_session"]
    return SessionRecord(**{**data, "T_main_session": None if T is None else np.array(T, float)})


def _certificate(data: dict[str, Any] | None) -> certificate.Certificate | None:
    if data is None:
        return None
    names = ("squared_error", "lower_bound", "eigenvalue", "isotropic")
    return certificate.Certificate(**{name: data[name] for name in names})


def _part(data: dict[str, Any]) -> GraphPart:
    names = ("first", "vertices", "edges", "before", "after", "converged")
    return GraphPart(**{name: data[name] for name in names})


def _bound(value: float | None) -> float:
    return np.inf if value is None else float(value)


def stated_accuracy(folder: Path) -> pose_accuracy.Accuracy:
    """Return the accuracy that a result states; InputError if it was edited."""
    with opened(folder) as run:
        return _accuracy(run["accuracy"])


def _accuracy(data: dict[str, Any]) -> pose_accuracy.Accuracy:
    worst = data["worst"]
    if worst:
        bounds = _bound(worst["position_m"]), _bound(worst["rotation_rad"])
        worst = pose_accuracy.WorstFrame(worst["frame"], *bounds)
    return pose_accuracy.Accuracy(
        _bound(data["position_m"]),
        _bound(data["rotation_rad"]),
        _bound(data["relative"]),
        data["assessed"],
        worst,
        tuple(data["unbounded"]),
        tuple(data["by_odometry"]),
        tuple(data["by_motion"]),
        data.get("causes_m", {}),
        **{name: data[name] for name in ("degrees", "camera_sigmas", "surface_m") if name in data},
    )


def _calibration(data: dict[str, Any] | None) -> SelfCalibration | None:
    if data is None:
        return None
    return SelfCalibration(
        data["focal"],
        data["offset_m"],
        data["center_x"],
        data["center_y"],
        data["distortion"],
        data["sigma"],
        (_bound(data["stated_bound_m"]), _bound(data["corrected_bound_m"])),
    )


def _component(folder: Path, number: int, data: dict[str, Any]) -> Component:
    T = data["T_main_component"]
    component_folder = folder / component_name(number)
    return Component(
        tuple((a, b) for a, b in data["frames"]),
        None if T is None else np.array(T, float).reshape(4, 4),
        data["joined"],
        load_result(component_folder) if T is None and is_result(component_folder) else None,
        data.get("reached", 0.0),
    )


def read_cloud(folder: Path) -> GeometryRecord:
    """Read the points of a result: `cloud.ply`, or `cloud.laz` if they are many.

    Raises
    ------
    InputError
        If there are none, or they are damaged.
    """
    compressed = folder / "cloud.laz"
    if compressed.is_file() and not (folder / "cloud.ply").exists():
        return _compressed_cloud(compressed)
    return read_ply(folder / "cloud.ply")


def _compressed_cloud(path: Path) -> GeometryRecord:
    points = read_las(path)
    names = set(points.point_format.dimension_names)

    def columns(*of: str) -> Any:
        return np.stack([points[name] for name in of], 1) if names.issuperset(of) else None

    color = columns("red", "green", "blue")
    return GeometryRecord(
        np.asarray(points.xyz),
        normals=columns("normal x", "normal y", "normal z"),
        color=None if color is None else (color >> 8).astype(np.uint8),
        scalars={name: np.asarray(points[name]) for name in ("views", "sigma") if name in names},
    )


def _cloud(folder: Path, shift: Float64) -> Cloud:
    record = read_cloud(folder)
    sigma = record.scalars.get("sigma")
    return Cloud(
        record.shifted(-shift).points.astype(np.float32),
        record.normals,
        record.color,
        np.asarray(record.scalars["views"], np.int32),
        None if sigma is None else np.asarray(sigma, np.float32),
    )


def read_mesh(path: Path) -> Mesh | None:
    """Read the surface of a result, None if it has none.

    Columns that another program left out are 0.
    """
    return Mesh.of(read_ply(path)) if path.is_file() else None
