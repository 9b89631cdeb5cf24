"""The result of registering one pair of views: poses in the files' coordinates, and the folder."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from tofuse._version import __version__
from tofuse.apps.results import folders, run_json
from tofuse.engine.alignment import Registration
from tofuse.engine.arrays import Float64
from tofuse.engine.clouds import NearOrigin
from tofuse.engine.fusion import GeometryRecord
from tofuse.engine.geometry import se3, unit_vectors
from tofuse.formats.geometry import write_ply
from tofuse.formats.recordings import SingleView

MARKER = "registration.json"
CONTRACT = folders.Contract.of_files(
    MARKER, "transform.txt", "aligned.ply", "report.html", keys=("T_target_source",)
)


@dataclass(frozen=True, eq=False)
class PairResult:
    """A registration of two views.

    Attributes
    ----------
    source, target
        The views, near the origin: a cloud in map coordinates has the `shift` to them. A source of
        unknown scale is at the scale that was found.
    registration
        The registration of these views.
    guess
        The file of the initial guess, or None.
    seconds
        Time that registration took.
    """

    source: SingleView
    target: SingleView
    registration: Registration
    guess: str | None = None
    seconds: float = 0.0

    @cached_property
    def in_files(self) -> Registration:
        """The registration in the coordinates of the files."""
        return NearOrigin(self.source.frame, self.target.frame, None).in_files(self.registration)

    @property
    def T_target_source(self) -> Float64:
        """(4, 4), maps coordinates of the source's file to those of the target's."""
        return self.in_files.T_target_source

    @property
    def similarity(self) -> Float64:
        """(4, 4) T_target_source with the scale: it maps unscaled coordinates of the source."""
        return self.T_target_source @ np.diag([*[self.registration.scale] * 3, 1.0])

    @property
    def moved_m(self) -> Float64:
        """(3,) displacement of the source's `shift`, m: the translation if that is zero."""
        center = self.source.frame.shift
        displacement: Float64 = se3.transform(self.T_target_source, center[None])[0] - center
        return displacement

    @property
    def runner_up(self) -> Float64 | None:
        """(4, 4) T_target_source of the best rival pose; None where there is none."""
        return self.in_files.runner_up

    @property
    def runner_up_distance(self) -> tuple[float, float] | None:
        """Distance of the runner-up at the source's median point (m), and its angle (rad)."""
        T_rival = self.registration.runner_up
        if T_rival is None:
            return None
        T = self.registration.T_target_source
        center = np.median(self.source.frame.points.astype(float), axis=0)[None]
        displacement = se3.transform(T_rival, center) - se3.transform(T, center)
        return float(np.linalg.norm(displacement)), float(se3.angle(se3.inverse(T) @ T_rival))

    @cached_property
    def free_motions(self) -> tuple[Float64, Float64]:
        """Unobservable directions: axes (a, 3) of translations, and axes (b, 3) of rotations."""
        directions = np.asarray(self.registration.unobservable, float).reshape(-1, 6)
        if not len(directions):
            return np.zeros((0, 3)), np.zeros((0, 3))
        # An orthonormal basis in metres, with as many pure translations as possible.
        _, s, vt = np.linalg.svd(directions * np.array([1, 1, 1, *[self.registration.lever_m] * 3]))
        basis = vt[: int((s > 1e-9 * s[0]).sum())]
        u, rotations, _ = np.linalg.svd(basis[:, 3:])
        basis = u.T @ basis
        is_rotation = (
            np.concatenate([rotations, np.zeros(len(basis))])[: len(basis)] > _MAX_ROTATION
        )
        return unit_vectors(basis[~is_rotation, :3]), unit_vectors(basis[is_rotation, 3:])

    def aligned(self) -> Float64:
        """(N, 3) points of the source in the coordinates of the target's file, m."""
        points = se3.transform(
            self.registration.T_target_source, self.source.frame.points.astype(np.float64)
        )
        return points + self.target.frame.shift


# A free direction with a smaller fraction of rotation counts as a translation.
_MAX_ROTATION = 0.4
# Attributes of a registration in `registration.json`.
_EVIDENCE = (
    "believed", "probability", "given_guess", "reason", "remedy", "converged", "overlap", "support",
    "contradiction", "margin",
)  # fmt: skip
_FIT = ("rms_m", "correspondences", "points", "iterations")


def pair_json(result: PairResult) -> dict[str, Any]:
    """Return the content of `registration.json`: SI units and radians, null where unknown."""
    registration = result.registration
    covariance, (sigma_m, sigma_rad) = registration.covariance, registration.sigma
    return run_json.plain(
        {
            "schema": 1,
            "version": __version__,
            "source": _view_json(result.source),
            "target": _view_json(result.target),
            "guess": result.guess,
            "T_target_source": result.T_target_source,
            "scale": registration.scale,
            "scale_sigma": registration.scale_sigma,
            **{name: getattr(registration, name) for name in _EVIDENCE},
            "runner_up": result.runner_up,
            "unobservable": registration.unobservable,
            "covariance": None if covariance is None else covariance.ravel(),
            "sigma_m": sigma_m,
            "sigma_rad": sigma_rad,
            "information": np.asarray(registration.information).ravel(),
            "reference_point_m": result.source.frame.shift,
            **{name: getattr(registration, name) for name in _FIT},
            "seconds": round(result.seconds, 4),
            "warnings": [*dict.fromkeys((*result.source.warnings, *result.target.warnings))],
        }
    )


def _view_json(view: SingleView) -> dict[str, Any]:
    return {
        "name": view.name,
        "path": view.path,
        "format": view.format,
        "frame": view.index,
        "points": len(view.frame),
    }


def write_aligned(result: PairResult, path: Path) -> None:
    """Write the source in the target's coordinates, with normals, colour and intensity."""
    frame = result.source.frame
    points = result.aligned()
    normals = frame.normals
    if normals is not None:
        normals = (normals @ result.registration.T_target_source[:3, :3].T).astype(np.float32)
    write_ply(
        path,
        GeometryRecord(
            points,
            normals=normals,
            color=frame.color,
            scalars={} if frame.amplitude is None else {"intensity": frame.amplitude},
        ),
    )
