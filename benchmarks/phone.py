"""A phone's own poses, those by depth alone, and those by both.

`recorded`: recordings of phones. Pairs of colour images measure relative rotations without depth:
SIFT, the essential matrix, and a robust fit of the motion to all matches, from six random halves. A
pair is left out if fewer than 100 matches fit within 2 pixels, or if two fits differ by more than
1 degree and the worse one costs less than 1.1 times as much (degenerate geometry). Map consistency
is that of `map_agreement`.

`simulated`: phones with exact truth (`tofuse simulate --camera phone`). Their depth is smooth
and late, and its errors are smooth over the image and over time; colour comes with every third
frame; their own poses drift, and those of one kind jump halfway, as by a relocalization.

`surface`: the surface of simulated phones at the true poses, as it is fused and as it is displayed
(`display_surface`), compared with the true one: distance, share beyond 2 and 5 cm, and the share of
the true surface within 2 cm of it (a camera sees only a part of the scene).

    python benchmarks/phone.py recorded [--names iphone_chair_3dscannerapp]
    python benchmarks/phone.py simulated [--scenes room rail flat] [--seeds 2] [--frames 64]
    python benchmarks/phone.py surface [--scenes room flat] [--seeds 1]
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import combinations, product
from pathlib import Path

import cv2
import numpy as np
from scipy.optimize import least_squares

import sequences
from fusion import views_of
from tofuse.engine.arrays import Float32, Float64, Intp
from tofuse.engine.cameras import scaled
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.frames.recording import Recording, evenly_spaced
from tofuse.engine.fusion import display_surface
from tofuse.engine.fusion.tsdf import fuse_surface
from tofuse.engine.geometry import se3
from tofuse.engine.geometry.rays import homogeneous
from tofuse.engine.mapping.adaptation import Prior, adapted, with_prior
from tofuse.engine.mapping.methods import from_method
from tofuse.engine.mapping.reconstructing import reconstruct
from tofuse.engine.quality.map_agreement import map_consistency
from tofuse.engine.quality.trajectory_errors import displacement
from tofuse.engine.refinement import Joint
from tofuse.formats.recordings.open import open_recording
from tofuse.lab.experiments.surface_error import Surface, distances
from tofuse.lab.simulation.phone import PhoneErrors, PhonePlan, plan_phone, write_phone

PHONES = ("iphone_chair_3dscannerapp", "iphone_record3d", "iphone_stray", "iphone_room")
COLOR_IMAGES = 10  # evenly spaced
RATIO, STARTS = 0.8, 6
# A pair is left out with fewer matches within 2 pixels, or if another solution is nearly as good.
MIN_MATCHES, AMBIGUOUS, SAME_RAD = 100, 1.1, np.radians(1.0)
# Displayed triangles and the views that judge them, as in a run; points on compared surfaces.
TRIANGLES, WITNESSES, SAMPLES = 100_000, 60, 200_000


KINDS = {
    "usual drift": PhoneErrors(),
    "five times": PhoneErrors(drift=5.0),
    "jump": PhoneErrors(jump=1.0),
}


# ---- Colour --------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Features:
    """SIFT features of frame `k`: rays x/z and y/z (N, 2), descriptors, focal length in pixels."""

    k: int
    rays: Float64
    descriptors: Float32
    focal: float


def features_of(recording: Recording) -> Iterator[Features]:
    """Yield the features of evenly spaced colour images, at full resolution if there is one."""
    read = getattr(recording.source, "full_resolution_color", lambda index: None)
    sift = cv2.SIFT_create(8000, contrastThreshold=0.02)
    images = []
    for k, index in enumerate(recording.indices.tolist()):
        frame = recording.image(k)
        if frame is not None and frame.color_image is not None:
            images.append((k, index, frame))
    for c in evenly_spaced(np.arange(len(images)), COLOR_IMAGES):
        k, index, frame = images[c]
        full = read(index)
        color = frame.color_image if full is None else full
        lens = scaled(frame.camera, color.shape[1], color.shape[0])
        keypoints, found = sift.detectAndCompute(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY), None)
        pixels = np.array([p.pt for p in keypoints]).reshape(-1, 2)
        rays = (pixels - [lens.cx, lens.cy]) / [lens.fx, lens.fy]
        yield Features(k, rays, np.sqrt(found / found.sum(1, keepdims=True)), lens.fx)


def matched_rays(a: Features, b: Features) -> tuple[Float64, Float64]:
    """Return the rays (M, 2) in both images of features that are each other's best match."""
    matcher = cv2.BFMatcher()
    back = {m.queryIdx: m.trainIdx for (m,) in matcher.knnMatch(b.descriptors, a.descriptors, 1)}
    matches = [
        m
        for m, second in matcher.knnMatch(a.descriptors, b.descriptors, 2)
        if m.distance < RATIO * second.distance and back[m.trainIdx] == m.queryIdx
    ]
    return a.rays[[m.queryIdx for m in matches]], b.rays[[m.trainIdx for m in matches]]


def color_rotations(recording: Recording) -> list[tuple[int, int, Float64]]:
    """Return positions i, j and the rotation R_i_j by the colour images alone."""
    out = []
    for a, b in combinations(list(features_of(recording)), 2):
        R = rotation_between(a, b)
        if R is not None:
            out.append((a.k, b.k, R))
    return out


def rotation_between(a: Features, b: Features) -> Float64 | None:
    """Return R_a_b by the matches of two images; None if there is no unique solution."""
    x_a, x_b = matched_rays(a, b)
    if len(x_a) < MIN_MATCHES:
        return None
    rng = np.random.default_rng(0)
    found = [_fit(x_a, x_b, rng.permutation(len(x_a))[::2], a.focal) for _ in range(STARTS)]
    solutions = sorted((s for s in found if s is not None), key=lambda s: s.cost)
    if not solutions or solutions[0].inliers < MIN_MATCHES:
        return None
    best = solutions[0]
    others = (s for s in solutions if s.cost < AMBIGUOUS * best.cost)
    if any(se3.angle(s.R.T @ best.R) > SAME_RAD for s in others):
        return None
    return best.R


@dataclass(frozen=True, eq=False)
class _Solution:
    R: Float64
    cost: float
    inliers: int


def _fit(a: Float64, b: Float64, chosen: Intp, focal: float) -> _Solution | None:
    """Fit an essential matrix to the chosen matches, then the motion to all (Sampson, Cauchy)."""
    E, mask = cv2.findEssentialMat(
        a[chosen], b[chosen], np.eye(3), method=cv2.USAC_MAGSAC, prob=0.9999, threshold=2 / focal
    )
    if E is None or E.shape != (3, 3):
        return None
    _, R, t, _ = cv2.recoverPose(E, a[chosen], b[chosen], np.eye(3), mask=mask)
    h_a, h_b = homogeneous(a), homogeneous(b)

    def residuals(x: Float64) -> Float64:
        E = se3.hat(x[3:] / np.linalg.norm(x[3:])) @ cv2.Rodrigues(x[:3])[0]
        lines_b, lines_a = h_a @ E.T, h_b @ E
        scale = np.hypot(*lines_b[:, :2].T) ** 2 + np.hypot(*lines_a[:, :2].T) ** 2
        return np.asarray((h_b * lines_b).sum(1) / np.sqrt(scale))

    start = np.concatenate([cv2.Rodrigues(R)[0].ravel(), t.ravel()])
    fit = least_squares(residuals, start, loss="cauchy", f_scale=1 / focal)
    inliers = int((np.abs(fit.fun) < 2 / focal).sum())
    return _Solution(cv2.Rodrigues(fit.x[:3])[0].T, fit.cost, inliers)


def rotation_errors(poses: Float64, measured: list[tuple[int, int, Float64]]) -> Float64:
    """Angles (rad) between relative rotations of poses and measured ones."""
    R = poses[:, :3, :3]
    pairs = [(i, j, R_i_j) for i, j, R_i_j in measured if np.isfinite(R[[i, j]]).all()]
    return np.array([float(se3.angle((R[i].T @ R[j]).T @ R_i_j)) for i, j, R_i_j in pairs])


# ---- Simulated phones ----------------------------------------------------------------------------


@contextmanager
def opened(planned: PhonePlan) -> Iterator[Recording]:
    """Yield a planned recording as it is read from the folder of its app."""
    with tempfile.TemporaryDirectory() as folder:
        yield open_recording(write_phone(planned, Path(folder) / "scan"))


# ---- Rows ----------------------------------------------------------------------------------------


def methods(recording: Recording) -> Iterator[tuple[str, Float64, float]]:
    """Yield the poses of each method, and the stated bound on their errors (m), NaN without."""
    rows: list[tuple[str, Prior, bool]] = [
        ("depth", "none", False),
        ("depth, colour", "none", True),
    ]
    if recording.reference is not None:
        yield "phone", recording.reference, np.nan
        rows += [("depth, phone", "auto", False), ("all", "auto", True)]
    for name, prior, color in rows:
        source, config = with_prior(recording, from_method("default", "range"), prior)
        result = reconstruct(source, replace(config, refinement=Joint(color=color)))
        yield name, result.trajectory, result.diagnostics.accuracy.position_m


def present(data: Path, names: list[str], columns: int) -> Iterator[tuple[str, Recording]]:
    """Yield the recordings that are in a folder; the others get a row of the table each."""
    for name in names:
        if (data / name).is_dir():
            yield name, open_recording(data / name)
        else:
            print(f"| {name} | missing |" + (columns - 2) * " |")


def recorded(data: Path, names: list[str]) -> None:
    """Print the table of real phones."""
    print("| recording | poses | rotation, median (90 %), deg | pairs | map rms, mm | inliers |")
    print("|---|---|---|---|---|---|")
    for name, recording in present(data, names, columns=6):
        measured = color_rotations(recording)
        for method, poses, _ in methods(recording):
            angles = np.degrees(rotation_errors(poses, measured))
            rotation = "-"
            if len(angles):
                rotation = f"{np.median(angles):.2f} ({np.quantile(angles, 0.9):.2f})"
            m = map_consistency(recording, poses)
            print(
                f"| {name} | {method} | {rotation} | {len(angles)} | {1000 * m.rms_m:.1f} | "
                f"{m.inlier_ratio:.1%} |",
                flush=True,
            )


def simulated(scenes: list[str], seeds: int, frames: int) -> None:
    """Print the table of simulated phones."""
    print("| scene | poses of the phone | method | position rms, mm | rotation rms, deg | ", end="")
    print("map rms, mm | stated, mm | inside |")
    print("|---|---|---|---|---|---|---|---|")
    for scene, (kind, errors) in product(scenes, KINDS.items()):
        found: dict[str, list[tuple[float, float, float, float]]] = {}
        for seed in range(seeds):
            planned = plan_phone(scene, seed=seed, errors=errors, frames=frames)
            with opened(planned) as recording:
                for method, poses, bound in methods(recording):
                    row = (*_errors(recording, poses, planned.poses), bound)
                    found.setdefault(method, []).append(row)
        for method, rows in found.items():
            position, rotation, rms, stated = np.sqrt((np.array(rows) ** 2).mean(0))
            inside = sum(error <= bound for error, _, _, bound in rows)
            print(
                f"| {scene} | {kind} | {method} | {1000 * position:.1f} | "
                f"{np.degrees(rotation):.2f} | {1000 * rms:.1f} | "
                + (
                    "- | - |"
                    if method == "phone"
                    else f"{1000 * stated:.1f} | {inside} of {seeds} |"
                ),
                flush=True,
            )


def _errors(recording: Recording, poses: Float64, truth: Float64) -> tuple[float, float, float]:
    posed = np.isfinite(poses).all((1, 2))
    metres, rad = displacement(poses[posed], truth[posed])
    return metres, rad, map_consistency(recording, poses).rms_m


def surfaces(scenes: list[str], seeds: int, frames: int) -> None:
    """Print the table of surfaces."""
    print("| scene | seed | surface | triangles | mean, mm | > 2 cm | > 5 cm | complete |")
    print("|---|---|---|---|---|---|---|---|")
    for scene, seed in product(scenes, range(seeds)):
        planned = plan_phone(scene, seed=seed, frames=frames)
        with opened(replace(planned, color_every=0)) as recording:
            images = [f for f in recording if isinstance(f, RangeFrame)]
            config = adapted(from_method("default", "range"), recording)
        poses = planned.poses
        views, _, _ = views_of(images, config)
        vertices, faces = planned.scene.truth_mesh()
        T_world_truth = planned.motion.T_world_truth(planned.times[0])
        truth = Surface(se3.transform(T_world_truth, vertices), faces)
        fused = fuse_surface(views, poses).clustered(TRIANGLES)
        seen = evenly_spaced(np.arange(len(images)), WITNESSES)
        witnesses = [display_surface.Witness.of(images[k], poses[k]) for k in seen]
        shown, filled = display_surface.displayed(fused, witnesses)
        for name, mesh in (("fused", fused), (f"displayed, {filled} in holes", shown)):
            shape = Surface(mesh.vertices, mesh.faces)
            error = distances(shape.samples(SAMPLES)[0], truth)
            missed = distances(truth.samples(SAMPLES)[0], shape)
            print(
                f"| {scene} | {seed} | {name} | {len(mesh.faces)} | {1000 * error.mean():.1f} | "
                f"{(error > 0.02).mean():.2%} | {(error > 0.05).mean():.2%} | "
                f"{(missed < 0.02).mean():.2%} |",
                flush=True,
            )


def parsed(
    text: str, names: Sequence[str], simulated: Mapping[str, list[str]], frames: int | None = None
) -> argparse.Namespace:
    """Return the options of a script that looks at real or at simulated recordings.

    Parameters
    ----------
    text
        What the script does, in its first line.
    names
        Default of `--names` of the command `recorded`.
    simulated
        Defaults of `--scenes` of the other commands.
    frames
        Default of their `--frames`, if they have that.
    """
    parser = argparse.ArgumentParser(description=text.split("\n")[0])
    commands = parser.add_subparsers(dest="command", required=True)
    real = commands.add_parser("recorded")
    real.add_argument("--data", type=Path, default=sequences.DATA)
    real.add_argument("--names", nargs="+", default=list(names))
    for name, scenes in simulated.items():
        made = commands.add_parser(name)
        made.add_argument("--scenes", nargs="+", default=scenes)
        made.add_argument("--seeds", type=int, default=2)
        if frames is not None:
            made.add_argument("--frames", type=int, default=frames)
    return parser.parse_args()


def main() -> None:
    """Run the chosen part."""
    scenes = {"simulated": ["room", "rail"], "surface": ["room", "flat"]}
    options = parsed(__doc__, PHONES, scenes, frames=64)
    if options.command == "recorded":
        recorded(options.data, options.names)
    elif options.command == "surface":
        surfaces(options.scenes, options.seeds, options.frames)
    else:
        simulated(options.scenes, options.seeds, options.frames)


if __name__ == "__main__":
    main()
