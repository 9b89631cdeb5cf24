"""Distractors that pass through the view of a moving camera: a walking person, a sliding box.

They cross the image periodically from side to side, at a distance at which they cover a given
fraction of it at mid-pass, and are far below the floor between passes. The camera's true poses are
relative to the room and not affected.
"""

from __future__ import annotations

from collections.abc import Sequence as SequenceOf
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.errors import InputError
from tofuse.engine.geometry import se3, unit_rays
from tofuse.lab.scenes import HAIR, SHIRT, SKIN, TROUSERS
from tofuse.lab.simulation.models import CameraModel
from tofuse.lab.world import Body, Material, Mesh, Scene, Sequence, paths
from tofuse.lab.world import mesh as meshes

Kind = Literal["person", "box"]

CARTON = Material("carton", 0.45, 0.25, "print", (0.2, 0.2, 0.2))

# Pose between passes.
_T_HIDDEN = se3.translation((0, 0, -100.0))
_MIN_DISTANCE_M = 0.6
# Max distance relative to that of the background.
_BACKGROUND_RATIO = 0.75
_SCALES = (1.0, 0.85, 0.7, 0.55, 0.4, 0.3, 0.2)
_LIMB_RAD, _GAIT_HZ = 0.42, 0.9
_MARGIN_RAD = 0.05
_COLUMNS = 44


@dataclass(frozen=True)
class Passing:
    """Kind, period and apparent size of a passing distractor.

    Attributes
    ----------
    kind
        "person" walks with swinging limbs; "box" slides.
    fraction
        Fraction of the image covered at mid-pass, 0 to 1. The body is scaled down where the room
        has not enough depth.
    seconds
        Time to cross the image.
    period_s
        Time from the start of one pass to that of the next.
    start_s
        Start of the first pass, after the first frame.
    """

    kind: Kind = "person"
    fraction: float = 0.25
    seconds: float = 2.0
    period_s: float = 4.0
    start_s: float = 1.0

    def __post_init__(self) -> None:
        if self.kind not in ("person", "box"):
            raise InputError(f"is {self.kind!r}", where="passing", remedy="use person or box")
        if not 0 < self.fraction < 1:
            raise InputError(
                f"is {self.fraction}", where="fraction", remedy="use one between 0 and 1"
            )
        if not 0 < self.seconds <= self.period_s:
            raise InputError(
                f"is {self.seconds} s of {self.period_s} s",
                where="passing",
                remedy="let a pass end before the next one begins",
            )


@dataclass(frozen=True, eq=False)
class _Part:
    """One rigid part: its mesh relative to the joint, the joint's position, and its swing."""

    mesh: Mesh
    joint: Float64 = field(default_factory=lambda: np.zeros(3))
    swing: float = 0.0

    def T_body_part(self, t: float) -> Float64:
        """(4, 4) pose in the body's frame at time t in s of its gait."""
        angle = self.swing * _LIMB_RAD * np.sin(2 * np.pi * _GAIT_HZ * t)
        return se3.pose(se3.so3_exp([0, angle, 0]), self.joint)


@dataclass(frozen=True, eq=False)
class _Crossing:
    """One crossing on the floor: from one border of the view through its middle to the other."""

    start: float
    end: float
    waypoints: Float64  # (3, 2) in m, at the start, the middle and the end

    def T_room_body(self, t: float) -> Float64:
        """(4, 4) pose at time t in s, facing the direction of motion."""
        u = (t - self.start) / (self.end - self.start)
        weights = np.array([(1 - u) * (1 - 2 * u), 4 * u * (1 - u), u * (2 * u - 1)])
        slopes = np.array([4 * u - 3, 4 - 8 * u, 4 * u - 1])
        velocity = slopes @ self.waypoints
        T = paths.rotation([0, 0, np.arctan2(velocity[1], velocity[0])])
        T[:2, 3] = weights @ self.waypoints
        return T


def add_distractor(
    scene: Scene,
    sequence: Sequence,
    model: CameraModel,
    passing: Passing,
    *,
    first: float,
    last: float,
    seed: int = 0,
    texture: bool = True,
) -> tuple[Scene, Sequence]:
    """Add a passing distractor to a scene and its sequence.

    Parameters
    ----------
    scene, sequence, model
        The scene, the motion and the camera.
    passing
        The distractor.
    first, last
        Times in s of the first and the last frame.
    seed
        Seed for the side from which it enters.
    texture
        False gives it the uniform albedo.

    Returns
    -------
    The extended scene and sequence.
    """
    materials, unscaled = _person() if passing.kind == "person" else _box()
    duration = passing.seconds
    starts = np.arange(first + passing.start_s, last, passing.period_s)
    mid_times = starts + duration / 2
    view = _View.of(model)
    max_distances = [_max_distance(scene, sequence, view, t) for t in mid_times]
    for scale in _SCALES:
        # A box keeps its height, or it would be below the field of view.
        size = np.full(3, scale) if passing.kind == "person" else np.array([scale, scale, 1.0])
        parts = [_scaled(part, size) for part in unscaled]
        bodies = [Body(part.mesh) for part in parts]

        def coverage(t: float, distance: float, parts: list[_Part], bodies: list[Body]) -> float:
            position = _ahead(sequence.T_room_camera(t), distance, 0.0)
            T = paths.rotation([0, 0, _heading(sequence.T_room_camera(t)) + np.pi / 2])
            T[:2, 3] = position
            return view.coverage(
                sequence.T_room_camera(t), bodies, [T @ p.T_body_part(0) for p in parts]
            )

        coverages = [
            coverage(t, far, parts, bodies) for t, far in zip(mid_times, max_distances, strict=True)
        ]
        if not coverages or np.median(coverages) <= passing.fraction:
            break
    side = 1 if np.random.default_rng([seed, 5]).random() < 0.5 else -1
    crossings = []
    for k, (t, far) in enumerate(zip(mid_times, max_distances, strict=True)):
        lower, upper = _MIN_DISTANCE_M, far
        for _ in range(10):
            midpoint = 0.5 * (lower + upper)
            if coverage(t, midpoint, parts, bodies) < passing.fraction:
                upper = midpoint
            else:
                lower = midpoint
        body_radius = max(np.hypot(*(part.mesh.vertices[:, :2].T)).max() for part in parts)
        # Beyond the border by half its width, so that it enters the view gradually.
        border_angle = view.half_angle + np.arctan2(body_radius, upper) + _MARGIN_RAD
        waypoints = [
            _ahead(sequence.T_room_camera(s), upper, angle)
            for s, angle in zip(
                (t - duration / 2, t, t + duration / 2),
                np.array([1, 0, -1]) * border_angle * side * (-1) ** k,
                strict=True,
            )
        ]
        crossings.append(_Crossing(t - duration / 2, t + duration / 2, np.array(waypoints)))

    def path_of(part: _Part) -> paths.Path:
        def path(t: float) -> Float64:
            for crossing in crossings:
                if crossing.start <= t <= crossing.end:
                    return crossing.T_room_body(t) @ part.T_body_part(t)
            return _T_HIDDEN.copy()

        return path

    surface_materials = materials if texture else [m.uniform() for m in materials]
    return (
        scene.with_passing(surface_materials, [part.mesh for part in parts]),
        sequence.with_passing([path_of(part) for part in parts]),
    )


@dataclass(frozen=True, eq=False)
class _View:
    """Coarse unit rays (N, 3) of a camera, and half of its horizontal field of view."""

    rays: Float64
    half_angle: float

    @classmethod
    def of(cls, model: CameraModel) -> _View:
        camera = model.camera
        step = max(1, camera.width // _COLUMNS)
        xy = camera.rays()[step // 2 :: step, step // 2 :: step].reshape(-1, 2).astype(float)
        xy = xy[np.isfinite(xy).all(1)]
        return cls(unit_rays(xy), float(np.arctan(np.abs(xy[:, 0]).max())))

    def coverage(
        self, T_room_camera: Float64, bodies: SequenceOf[Body], poses: SequenceOf[Float64]
    ) -> float:
        """Fraction of the image covered by bodies at poses T_room_body."""
        nearest = np.full(len(self.rays), np.inf)
        for body, T in zip(bodies, poses, strict=True):
            T_body_camera = se3.inverse(T) @ T_room_camera
            origins = np.ascontiguousarray(T_body_camera[None, :3, 3])
            body.cast(origins, np.ascontiguousarray(self.rays @ T_body_camera[:3, :3].T), nearest)
        return float(np.isfinite(nearest).mean())


def _max_distance(scene: Scene, sequence: Sequence, view: _View, t: float) -> float:
    """Largest distance in m of a pass: in front of most of the visible surfaces."""
    T = sequence.T_room_camera(t)
    hits = scene.cast(T[:3, 3], view.rays @ T[:3, :3].T, sequence.T_room_bodies(t))
    depth = hits.distance * view.rays[:, 2]
    visible = depth[np.isfinite(depth)]
    return (
        max(_BACKGROUND_RATIO * float(np.median(visible)), _MIN_DISTANCE_M) if len(visible) else 2.0
    )


def _heading(T_room_camera: Float64) -> float:
    return float(np.arctan2(T_room_camera[1, 2], T_room_camera[0, 2]))


def _ahead(T_room_camera: Float64, distance: float, angle: float) -> Float64:
    """Position (2,) on the floor at `distance` m from the camera, `angle` rad to the left."""
    heading = _heading(T_room_camera) + angle
    return T_room_camera[:2, 3] + distance * np.array([np.cos(heading), np.sin(heading)])


def _scaled(part: _Part, size: Float64) -> _Part:
    return _Part(part.mesh.warped(lambda p: size * p), size * part.joint, part.swing)


def _person() -> tuple[list[Material], list[_Part]]:
    """Parts of a standing person of 1.76 m facing +x: trunk and head, legs, arms."""
    shirt, trousers, skin, hair = range(4)
    rod, ellipsoid = meshes.rod, meshes.superellipsoid

    def joined(*parts: tuple[int, Mesh]) -> Mesh:
        return meshes.joined([part.of_surface(surface) for surface, part in parts])

    trunk = joined(
        (shirt, ellipsoid((0.25, 0.42, 0.62), (0.6, 0.8), (12, 24)).translated(0, 0, 1.20)),
        (trousers, ellipsoid((0.26, 0.36, 0.28), (0.7, 0.8), (10, 20)).translated(0, 0, 0.93)),
        (skin, rod((0, 0, 1.45), (0.01, 0, 1.58), 0.055)),
        (skin, ellipsoid((0.20, 0.16, 0.24), (1, 1), (12, 20)).translated(0.02, 0, 1.64)),
        (hair, ellipsoid((0.20, 0.18, 0.18), (1, 1), (10, 18)).translated(-0.005, 0, 1.67)),
    )
    leg = joined(
        (trousers, rod((0, 0, 0.03), (0.01, 0, -0.42), 0.085, 0.06)),
        (trousers, rod((0.01, 0, -0.42), (0, 0, -0.84), 0.06, 0.045)),
        (hair, ellipsoid((0.28, 0.10, 0.09), (0.6, 0.6)).translated(0.05, 0, -0.865)),
    )
    arm = joined(
        (shirt, rod((0, 0, 0.04), (0, 0, -0.28), 0.055, 0.042)),
        (shirt, rod((0, 0, -0.28), (0.05, 0, -0.52), 0.042, 0.03)),
        (skin, ellipsoid((0.06, 0.09, 0.17)).translated(0.07, 0, -0.60)),
    )
    parts = [_Part(trunk)]
    for side in (-1, 1):
        parts.append(_Part(leg, np.array([0, 0.095 * side, 0.91]), side))
        parts.append(_Part(arm, np.array([0, 0.25 * side, 1.43]), -side))
    return [SHIRT, TROUSERS, SKIN, HAIR], parts


def _box() -> tuple[list[Material], list[_Part]]:
    """A tall carton on the floor."""
    return [CARTON], [_Part(meshes.box((0.5, 0.5, 1.6), (0, 0, 0.8)))]
