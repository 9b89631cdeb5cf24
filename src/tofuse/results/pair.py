"""What registering one pair of views gives: poses in the files' coordinates, and the folder."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from tofuse._version import __version__
from tofuse.arrays import Float64
from tofuse.files.atomic import write_text
from tofuse.files.geometry_record import GeometryRecord
from tofuse.files.moving import Names
from tofuse.files.ply import write_ply
from tofuse.files.pose import pose_text
from tofuse.geometry import se3
from tofuse.recordings.cloud_files import MAP_COORDINATES_M
from tofuse.recordings.frames import Frame
from tofuse.recordings.single import SingleView
from tofuse.registration.base import Registration
from tofuse.results.folder import Contract, OutputFolder, json_of
from tofuse.results.output import plain

MARKER = "registration.json"
FILES = ("transform.txt", "aligned.ply", "report.html", MARKER)


@dataclass(frozen=True, eq=False)
class LocalView:
    """A view moved near the origin, where single precision is enough.

    Attributes
    ----------
    view
        As it was read.
    frame
        The same with `center` at its origin.
    center
        (3,) m, in the coordinates of the file; zero for images, and for clouds near the origin.
    """

    view: SingleView
    frame: Frame
    center: Float64


@dataclass(frozen=True, eq=False)
class PairResult:
    """A registration of two views.

    Attributes
    ----------
    source, target
        The views.
    found
        The registration of the local frames.
    start
        (4, 4) where it started, of the local frames.
    guess
        The file that the start was read from, or None.
    seconds
        How long registering took.
    """

    source: LocalView
    target: LocalView
    found: Registration
    start: Float64
    guess: str | None = None
    seconds: float = 0.0

    def in_files(self, T: Float64) -> Float64:
        """Turn a (4, 4) motion between the local frames into one between the files' coordinates."""
        out = np.array(T, float)
        out[:3, 3] += self.target.center - out[:3, :3] @ self.source.center
        return out

    @property
    def T_target_source(self) -> Float64:
        """(4, 4), maps coordinates of the source's file into those of the target's."""
        return self.in_files(self.found.T_target_source)

    @property
    def moved_m(self) -> Float64:
        """(3,) how the source's `center` moves: the translation, where that is the origin."""
        center = self.source.center
        moved: Float64 = se3.transform(self.T_target_source, center[None])[0] - center
        return moved

    @property
    def runner_up(self) -> Float64 | None:
        """(4, 4) of the best other pose, likewise; None where none was found or looked for."""
        other = self.found.runner_up
        return None if other is None else self.in_files(other)

    @property
    def runner_up_distance(self) -> tuple[float, float] | None:
        """How far the runner-up moves the middle of the source (m), and turns it (rad)."""
        other = self.found.runner_up
        if other is None:
            return None
        T = self.found.T_target_source
        middle = np.median(self.source.frame.points.astype(float), axis=0)[None]
        step = se3.transform(other, middle) - se3.transform(T, middle)
        return float(np.linalg.norm(step)), float(se3.angle(se3.inverse(T) @ other))

    @cached_property
    def lever_m(self) -> float:
        """How far the source's points are from `center`: what makes metres of radians."""
        distance = np.linalg.norm(self.source.frame.points.astype(float), axis=1)
        return max(float(np.median(distance)), 1e-6) if len(distance) else 1.0

    @cached_property
    def covariance(self) -> Float64 | None:
        """(6, 6) of the right perturbation at the source's `center`; None if not bounded."""
        if len(self.found.unobservable):
            return None
        return self._observed_covariance

    @cached_property
    def sigma(self) -> tuple[float | None, float | None]:
        """Standard deviations (m, rad) in the worst observable direction.

        None where that is not known, or no direction is observable.
        """
        covariance = self._observed_covariance
        if covariance is None:
            return None, None
        worst = [float(np.linalg.eigvalsh(covariance[k, k])[-1]) for k in (_MOVE, _TURN)]
        # In metres both are about as large; what is nothing beside the other is only rounding.
        limit = 1e-12 * max(worst[0], worst[1] * self.lever_m**2)
        known = worst[0] > limit, worst[1] * self.lever_m**2 > limit
        move, turn = (float(np.sqrt(max(value, 0.0))) for value in worst)
        return move if known[0] else None, turn if known[1] else None

    @property
    def _observed_covariance(self) -> Float64 | None:
        """(6, 6), without the unobservable directions; None where the information is unusable."""
        units = np.array([1, 1, 1, *[self.lever_m] * 3])
        information = np.asarray(self.found.information, float)
        if information.shape != (6, 6) or not np.isfinite(information).all():
            return None
        basis = np.eye(6)
        if len(self.found.unobservable):
            _, s, vt = np.linalg.svd(self.found.unobservable * units)
            basis = vt[int((s > 1e-9 * s[0]).sum()) :].T
        if basis.shape[1] == 0:
            return None
        scaled = information / np.outer(units, units)
        values, vectors = np.linalg.eigh(basis.T @ scaled @ basis)
        if not values[0] > 1e-12 * values[-1]:
            return None
        half = basis @ vectors / np.sqrt(values)
        return half @ half.T / np.outer(units, units)

    @cached_property
    def free_motions(self) -> tuple[Float64, Float64]:
        """Axes (a, 3) along which the source can slide, and (b, 3) about which it can turn."""
        free = np.asarray(self.found.unobservable, float).reshape(-1, 6)
        if not len(free):
            return np.zeros((0, 3)), np.zeros((0, 3))
        # An orthonormal basis in metres, turned so that as many as can be are mere slides.
        _, s, vt = np.linalg.svd(free * np.array([1, 1, 1, *[self.lever_m] * 3]))
        basis = vt[: int((s > 1e-9 * s[0]).sum())]
        u, turn, _ = np.linalg.svd(basis[:, 3:])
        basis = u.T @ basis
        turns = np.concatenate([turn, np.zeros(len(basis))])[: len(basis)] > _MOSTLY_SLIDE
        return _unit(basis[~turns, :3]), _unit(basis[turns, 3:])

    def aligned(self) -> Float64:
        """(N, 3) all points of the source, in the coordinates of the target's file."""
        points = se3.transform(
            self.found.T_target_source, self.source.frame.points.astype(np.float64)
        )
        return points + self.target.center


_MOVE, _TURN = slice(0, 3), slice(3, 6)
# Below this share of turning a free direction is called a slide.
_MOSTLY_SLIDE = 0.4


def _unit(vectors: Float64) -> Float64:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-12)


def pair_json(result: PairResult) -> dict[str, Any]:
    """Return the content of `registration.json`: SI units and radians, null for what is unknown."""
    found = result.found
    sigma_m, sigma_rad = result.sigma
    covariance = result.covariance
    data: dict[str, Any] = plain(
        {
            "schema": 1,
            "version": __version__,
            "source": _view_json(result.source),
            "target": _view_json(result.target),
            "guess": result.guess,
            "T_target_source": result.T_target_source,
            "believed": found.believed,
            "probability": found.probability,
            "reason": found.reason,
            "converged": found.converged,
            "overlap": found.overlap,
            "support": found.support,
            "contradiction": found.contradiction,
            "margin": found.margin,
            "runner_up": result.runner_up,
            "unobservable": found.unobservable,
            "covariance": None if covariance is None else covariance.ravel(),
            "sigma_m": sigma_m,
            "sigma_rad": sigma_rad,
            "information": np.asarray(found.information).ravel(),
            "reference_point_m": result.source.center,
            "rms_m": found.rms_m,
            "correspondences": found.correspondences,
            "points": found.points,
            "iterations": found.iterations,
            "seconds": round(result.seconds, 4),
            "warnings": [*result.source.view.warnings, *result.target.view.warnings],
        }
    )
    return data


def _view_json(local: LocalView) -> dict[str, Any]:
    view = local.view
    return {
        "name": view.name,
        "path": view.path,
        "format": view.format,
        "frame": view.index,
        "points": len(view.frame),
    }


def is_registration(folder: Path) -> bool:
    """Say whether a folder holds an earlier registration."""
    data = json_of(folder / MARKER)
    return data is not None and {"schema", "version", "T_target_source"} <= set(data)


CONTRACT = Contract(Names(frozenset(FILES)), MARKER, is_registration)


def pair_folder(path: Path, *, overwrite: bool = False) -> OutputFolder:
    """Check and create the folder for a registration; see `OutputFolder` for errors."""
    return OutputFolder(path, overwrite=overwrite, contract=CONTRACT)


def write_pair(
    result: PairResult, folder: OutputFolder, report: Callable[[PairResult, Path], None]
) -> None:
    """Write the files of a registration; `report` writes the page to the path that it gets.

    Raises
    ------
    OutputError
        If a file can't be written; then nothing that was there before has changed.
    """
    with folder.staging() as staging:
        write_text(staging / "transform.txt", pose_text(result.T_target_source))
        write_aligned(result, staging / "aligned.ply")
        report(result, staging / "report.html")
        text = json.dumps(pair_json(result), indent=1, allow_nan=False)
        write_text(staging / MARKER, text + "\n")


def write_aligned(result: PairResult, path: Path) -> None:
    """Write the source in the target's coordinates, with all that is known of each point."""
    frame = result.source.frame
    points = result.aligned()
    normals = frame.normals
    if normals is not None:
        normals = (normals @ result.found.T_target_source[:3, :3].T).astype(np.float32)
    write_ply(
        path,
        GeometryRecord(
            points,
            normals=normals,
            color=frame.color,
            scalars={} if frame.amplitude is None else {"intensity": frame.amplitude},
        ),
        double=bool(np.abs(points).max(initial=0) > MAP_COORDINATES_M),
    )
