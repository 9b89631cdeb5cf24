"""Detection of degenerate directions by the tracker: ROC over scenes with and without them.

Ground truth: a direction is degenerate if the noise-free information of the pair of views (exact
normals and albedo of the simulated scene, the camera's noise model, pixels within its ambiguity
range and seen by both views) gives a sigma above 1 cm or 1 degree along this eigenvector. Score:
the stated sigma along it, estimated from views with all camera effects. Pooled over empty room,
wall, corridor, corner and furnished room, each with uniform and with textured albedo; for geometry
alone, and with amplitude.

Exact surfaces are not all that constrains a camera: range errors differ between dark and bright
surfaces, and that relief is fixed to the surface. For each direction that is degenerate by the
exact geometry, alignments therefore start 3 cm or 3 degrees off, on either side, without a prior;
if they return to within 1, the images constrain it. The ROC area is also printed without these
directions.

"cross" is the symmetrised cross-information minus spurious information, "plain" the information
matrix, "covariance" the calibrated covariance. Multipath is compensated first, as by default.

    python benchmarks/degeneracy.py [--seeds 12] [--first 2000]
"""

from __future__ import annotations

import argparse
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from covariance import KINDS
from scoring import roc_area
from tofuse.engine.alignment.projective import UNITS, Level, ProjectiveOptions, Target, align
from tofuse.engine.alignment.uncertainty import covariance
from tofuse.engine.arrays import Float64
from tofuse.engine.cameras.cameras import ray_lengths
from tofuse.engine.geometry import se3
from tofuse.engine.geometry.rays import homogeneous, unit_rays
from tofuse.engine.sensor.multipath_correction import Multipath
from tofuse.engine.views.prepared_view import PreparedView, prepare_view
from tofuse.engine.views.view_planes import SurfaceOptions
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.models import CameraModel, camera_model, noise_of
from tofuse.lab.simulation.record import RecordingPlan
from tofuse.lab.world.scene import Scene, build

SUBPIXELS = 3
AWAY = 3.0  # in units of 1 cm and 1 degree
PATIENT = (Level(4, 15, 0.03, 0.1), Level(2, 8, 0.005, 0.02), Level(1, 6, 0.0, 0.0))
# Neighbours farther from the plane lie on another surface.
SAME_PLANE_M = 0.01


def true_information(
    scene: Scene, model: CameraModel, T_room_source: Float64, T_target_source: Float64
) -> tuple[Float64, Float64]:
    """(6, 6) noise-free information of geometry alone, and with amplitude."""
    camera = model.camera
    rays = camera.rays().astype(float)
    height, width = rays.shape[:2]
    lengths = ray_lengths(camera).astype(float)
    R, origin = T_room_source[:3, :3], T_room_source[:3, 3]

    def cast(x: Float64, y: Float64) -> tuple[Float64, Float64, Float64]:
        ray = unit_rays(np.stack([x, y], -1).reshape(-1, 2))
        hits = scene.cast(origin, ray @ R.T)
        shape = x.shape
        normal = hits.normal.astype(float) @ R
        return hits.distance.reshape(shape), normal.reshape(*shape, 3), hits.albedo.reshape(shape)

    distance, normal, albedo = cast(rays[..., 0], rays[..., 1])
    step = 1 / camera.fx
    offsets = (np.arange(SUBPIXELS) - (SUBPIXELS - 1) / 2) / SUBPIXELS * step
    fine = [cast(rays[..., 0] + a, rays[..., 1] + b)[2] for a in offsets for b in offsets]
    albedo = np.mean(fine, axis=0)

    seen = np.isfinite(distance) & (distance < model.ambiguity_m)
    distance = np.where(seen, distance, 1.0)
    points = homogeneous(rays) * (distance / lengths)[..., None]
    cosine = np.abs((normal * points).sum(-1)) / distance
    moved = se3.transform(T_target_source, points.reshape(-1, 3)).reshape(points.shape)
    pixel = camera.project(moved)
    with np.errstate(invalid="ignore"):
        seen &= (
            (pixel > -0.5).all(-1) & (pixel[..., 0] < width - 0.5) & (pixel[..., 1] < height - 0.5)
        )
    seen &= cosine > 0.05
    contrast, gain = model.modulation_contrast, model.counts_per_electron
    returned = albedo * cosine / distance**2 * model.transmission
    amplitude = np.maximum(model.signal_electrons * contrast * gain * returned, 1e-3)
    law = noise_of(model).amplitude
    assert law is not None
    sigma = np.sqrt(law.floor**2 + law.shot**2 / amplitude + law.dark**2 / amplitude**2)

    J = np.concatenate([normal, np.cross(points, normal)], -1)
    weight = np.where(seen, 1 / (2 * (sigma * np.maximum(cosine, 0.05)) ** 2), 0)
    geometry = np.einsum("ij,ijk,ijl->kl", weight, J, J)

    # Slopes of the log albedo by x/z and y/z, within one plane.
    log_albedo = np.log(np.maximum(albedo, 1e-6))
    slopes = np.zeros((height, width, 2))
    whole = seen.copy()
    whole[[0, -1]] = whole[:, [0, -1]] = False
    du = np.zeros((height, width))
    dv = np.zeros((height, width))
    for axis, out in ((1, du), (0, dv)):
        for sign in (-1, 1):
            near = np.roll(points, -sign, axis)
            plane_distance = np.abs(((near - points) * normal).sum(-1))
            whole &= (plane_distance < SAME_PLANE_M) & np.roll(seen, -sign, axis)
            out += sign * np.roll(log_albedo, -sign, axis) / 2
    xu = (np.roll(rays[..., 0], -1, 1) - np.roll(rays[..., 0], 1, 1)) / 2
    yv = (np.roll(rays[..., 1], -1, 0) - np.roll(rays[..., 1], 1, 0)) / 2
    slopes[..., 0], slopes[..., 1] = du / xu, dv / yv
    z = points[..., 2]
    m = np.stack([slopes[..., 0] / z, slopes[..., 1] / z, -(slopes * rays).sum(-1) / z], -1)
    K = np.concatenate([m, np.cross(points, m), -np.ones((height, width, 1))], -1)
    sigma_log = sigma * 2 * np.pi / model.period_m
    weight = np.where(whole, 1 / (2 * sigma_log**2), 0)
    photometric = np.einsum("ij,ijk,ijl->kl", weight, K, K)
    if photometric[6, 6] > 0:
        photometric[:6, :6] -= np.outer(photometric[:6, 6], photometric[6, :6]) / photometric[6, 6]
    return geometry, geometry + photometric[:6, :6]


def sigma_along(information: Float64, direction: Float64) -> float:
    """Conditional sigma along a unit direction, in units of 1 cm and 1 degree."""
    along = direction @ (information * np.outer(UNITS, UNITS)) @ direction
    return float(1 / np.sqrt(max(along, 1e-6)))


def returns(
    views: Sequence[PreparedView], T: Float64, direction: Float64, options: ProjectiveOptions
) -> bool:
    """Whether the images themselves constrain a direction, see above."""
    free = replace(
        options, levels=PATIENT, constrained=1e6, common_tilt=0.0, prior_m=3.0, prior_rad=3.0
    )
    targets = [Target(views[0], np.eye(4))]
    for start in (-AWAY, AWAY):
        guess = T @ se3.exp(start * direction * UNITS)
        found = align(views[1], targets, guess, free).T_world_source
        if abs(se3.log(se3.inverse(T) @ found) / UNITS @ direction) >= 1:
            return False
    return True


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=12)
    parser.add_argument("--first", type=int, default=2000)
    parser.add_argument("--camera", default="sr4000")
    parser.add_argument("--noise", default="poisson", choices=["poisson", "other"])
    arguments = parser.parse_args()
    model = camera_model(arguments.camera)
    effects = Effects(noise=arguments.noise)
    rows: dict[str, list[tuple[str, float, dict[str, float], float, bool]]] = defaultdict(list)
    for seed in range(arguments.first, arguments.first + arguments.seeds):
        for kind in KINDS:
            texture = bool(seed % 2)
            rng = np.random.default_rng([seed, KINDS.index(kind), 78])
            scene, sequence = build(kind, seed=seed, texture=texture)
            step = int(rng.integers(1, 5))
            first = int(rng.integers(0, sequence.frames - step))
            raw = np.array([first, first + step])
            made = RecordingPlan(scene, sequence, model, effects, seed, raw)
            compensation = Multipath().start()
            views = [
                prepare_view(compensation.apply(frame), SurfaceOptions())
                for frame in made.corrected_frames()
            ]
            poses = [sequence.T_room_camera(index / sequence.frame_rate_hz) for index in raw]
            T = se3.inverse(poses[0]) @ poses[1]
            truths = true_information(scene, model, poses[1], T)
            name = f"{kind} {'textured' if texture else 'uniform'}"
            for term, truth in zip(("geometry", "amplitude"), truths, strict=True):
                options = ProjectiveOptions(photometric=term == "amplitude")
                targets = [Target(views[0], np.eye(4))]
                aligned = align(views[1], targets, T, options)
                estimates = {"cross": aligned.cross, "plain": aligned.information}
                C = covariance(views[1], targets, aligned, options) / np.outer(UNITS, UNITS)
                values, vectors = np.linalg.eigh(truth * np.outer(UNITS, UNITS))
                weak = np.zeros(6)
                if len(aligned.unobservable):
                    weak = ((aligned.unobservable @ vectors) ** 2).sum(0)
                for k in range(6):
                    sigma = float(1 / np.sqrt(max(values[k], 1e-12)))
                    v = vectors[:, k]
                    scores = {n: sigma_along(H, v) for n, H in estimates.items()}
                    scores["covariance"] = float(np.sqrt(v @ C @ v))
                    back = sigma > 1 and returns(views, T, v, options)
                    rows[term].append((name, sigma, scores, float(weak[k]), back))
    for term, found in rows.items():
        truth = np.array([sigma > 1 for _, sigma, _, _, _ in found])
        back = np.array([back for *_, back in found])
        print(
            f"\n{term}: {len(found)} directions, {truth.sum()} unobservable, "
            f"{back.sum()} of which the images constrain"
        )
        for score in ("cross", "plain", "covariance"):
            values = np.array([scores[score] for _, _, scores, _, _ in found])
            right = (values > 1) == truth
            best = max((float(np.mean((values > t) == truth)), t) for t in np.sort(values))
            print(
                f"  {score:<11} ROC area {roc_area(values, truth):.3f} "
                f"({roc_area(values[~back], truth[~back]):.3f}), "
                f"right at 1: {right.mean():.1%}, best {best[0]:.1%} at {best[1]:.2f}"
            )
        flagged = np.array([weak > 0.5 for _, _, _, weak, _ in found])
        print(f"  reported as unobservable: right {np.mean(flagged == truth):.1%}")
        # A sigma of 0.7 to 1.4 units is ambiguous.
        clear = np.array([not 0.7 < sigma < 1.4 for _, sigma, _, _, _ in found])
        print(f"  of the {clear.sum()} unambiguous: right {np.mean((flagged == truth)[clear]):.1%}")
        for name in sorted({name for name, *_ in found}):
            mine = np.array([n == name for n, *_ in found])
            print(
                f"    {name:<22} {mine.sum():4} directions, {truth[mine].sum():3} unobservable, "
                f"{(flagged & truth)[mine].sum():3} found, {(flagged & ~truth)[mine].sum():3} false"
            )


if __name__ == "__main__":
    main()
