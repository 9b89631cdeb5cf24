"""Verdicts of `tofuse compare` and components of `tofuse repeat`, on parts with known deviations.

    python benchmarks/compare.py [--parts 300] [--first SEED] [--picture docs/images/compare.png]
    python benchmarks/compare.py --data ../shared/data

Each part is a plate with two blocks of random sizes, sampled as a fused scan is: from a number of
views around it, each with noise and with an error of its pose, so that the surface has errors that
neighbouring places share. It is as drawn, or has a bump, a shifted face, a bent plate or another
scale. True is the largest deviation of the noise-free surface after the same best fit,
at what the views see. With `--data`, real recordings are compared with each other, and with the
plane on which tags lie.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np

import lengths
import tofuse
from tofuse.apps.compare.comparing import Comparison, compared
from tofuse.apps.compare.nearest import Reach, Reference
from tofuse.apps.compare.page import compare_scene
from tofuse.apps.compare.repeating import Session, repeated
from tofuse.apps.compare.surface import Surface
from tofuse.apps.report import scene
from tofuse.engine.arrays import Float64
from tofuse.engine.quality.trajectory_errors import align
from tofuse.lab.world import mesh as meshes

TOLERANCE_M = 0.002
VIEWS = (3, 12, 48)
KINDS = ("as drawn", "bump", "shifted face", "bent", "scaled")
_POINTS = 8_000
_NOISE_M, _POSE_M, _POSE_RAD = 0.002, 0.0012, 0.003  # of a view


def drawn(rng: np.random.Generator) -> Surface:
    """Return a plate with two blocks, as a CAD model."""
    length, width, height = rng.uniform([0.18, 0.12, 0.03], [0.3, 0.2, 0.06])
    blocks = [
        meshes.box(
            [0.3 * length, 0.4 * width, 0.05], [0.22 * length, 0.1 * width, height / 2 + 0.02]
        ),
        meshes.box(
            [0.2 * length, 0.3 * width, 0.04], [-0.3 * length, -0.2 * width, height / 2 + 0.01]
        ),
    ]
    mesh = meshes.joined([meshes.box([length, width, height]), *blocks])
    vertices = np.asarray(mesh.vertices, float)
    return Surface("part", vertices, np.zeros_like(vertices), np.asarray(mesh.faces, np.int32))


@dataclass(frozen=True, eq=False)
class Part:
    """Points on the outside of a part as drawn, and its displacement there along the normal."""

    reference: Reference
    points: Float64
    normals: Float64
    displacement: Float64

    @classmethod
    def made(cls, rng: np.random.Generator, kind: str, size_m: float, count: int = _POINTS) -> Part:
        """Make a part that deviates by about a size."""
        reference = Reference.of(drawn(rng))
        points, normals = sampled(reference, count, rng)
        top = points[(normals[:, 2] > 0.9)]
        extent = np.ptp(points, axis=0)
        shape = np.zeros(len(points))
        if kind == "bump":
            centre = top[rng.integers(len(top))]
            shape = np.exp(-((points - centre) ** 2).sum(1) / rng.uniform(0.015, 0.03) ** 2)
        elif kind == "shifted face":
            faces = np.unique(reference.region)[:8]
            region = reference.region[
                reference.distances(points, normals, Reach(1e-3, 1e-3)).element
            ]
            shape = 1.0 * (region == rng.choice(faces))
        elif kind == "bent":
            shape = 2 * normals[:, 2] * (points[:, 0] / extent[0]) ** 2 * 2
        elif kind == "scaled":
            shape = (points * normals).sum(1) / (0.5 * extent.max())
        return cls(reference, points, normals, shape * size_m * rng.choice([-1, 1]))

    def compared(self, views: int, seed: list[int]) -> tuple[Comparison, float]:
        """Return the comparison of a scan from views around and above, and the true largest one."""
        rng = np.random.default_rng(seed)
        total, count = np.zeros(len(self.points)), np.zeros(len(self.points))
        for _ in range(views):
            azimuth, height = rng.uniform(-np.pi, np.pi), rng.uniform(0.3, 1.2)
            level = np.cos(height)
            eye = np.array([np.cos(azimuth) * level, np.sin(azimuth) * level, np.sin(height)])
            sees = self.normals @ eye > 0.2
            error = rng.normal(size=6) * np.repeat([_POSE_M, _POSE_RAD], 3) / 3**0.5
            moved = error[:3] + np.cross(error[3:], self.points)
            total += sees * ((moved * self.normals).sum(1) + rng.normal(0, _NOISE_M, len(total)))
            count += sees
        seen = count >= max(1, 0.1 * views)
        points, normals, n = self.points[seen], self.normals[seen], count[seen]
        variance = (_POSE_M**2 + _POSE_RAD**2 * (points**2).sum(1)) / 3
        measured = points + normals * (self.displacement[seen] + total[seen] / n)[:, None]
        shared = float(np.sqrt(np.mean(variance / n)))
        scan = Surface("scan", measured, normals, None, True, _NOISE_M / np.sqrt(n), shared)
        found = compared(scan, self.reference, TOLERANCE_M, searched=False)
        assessed = found.deviations.place >= 0
        J = np.concatenate([normals, np.cross(points, normals)], axis=1)[assessed]
        true = self.displacement[seen][assessed]
        true = true - J @ np.linalg.lstsq(J, true, rcond=None)[0]
        return found, float(np.abs(true).max())


def sampled(reference: Reference, count: int, rng: np.random.Generator) -> tuple[Float64, Float64]:
    """Return random points of a surface, evenly by area, and normals; no hidden ones."""
    chosen = rng.choice(len(reference.area), count, p=reference.area / reference.area.sum())
    weights = rng.dirichlet([1, 1, 1], count)[:, :, None]
    points, normals = (weights * reference.triangles[chosen]).sum(1), reference.normals[chosen]
    inside = np.zeros(count, bool)
    corners = reference.surface.points.reshape(-1, 8, 3)
    for low, high in zip(corners.min(1), corners.max(1), strict=True):
        inside |= ((points > low) & (points < high)).all(1)
    return points[~inside], normals[~inside]


def verdicts(parts: int, first: int) -> None:
    """Print verdicts by the true deviation and the number of views."""
    rows = []
    for k in range(first, first + parts):
        rng = np.random.default_rng([1, k])
        kind = KINDS[k % len(KINDS)]
        size = 0.0 if kind == "as drawn" else rng.uniform(0, 2.5) * TOLERANCE_M
        part = Part.made(rng, kind, size)
        for views in VIEWS:
            found, truth = part.compared(views, [2, k, views])
            rows.append((views, truth, str(found.verdict)))
    print("| views | parts | false passes | false fails | undecided | bad parts that fail |")
    print("|---|---|---|---|---|---|")
    for views in VIEWS:
        of = [(truth > TOLERANCE_M, verdict) for v, truth, verdict in rows if v == views]
        passes = sum(bad and verdict == "pass" for bad, verdict in of)
        fails = sum(not bad and verdict == "fail" for bad, verdict in of)
        open_ = sum(verdict == "undecided" for _, verdict in of) / len(of)
        caught = sum(bad and verdict == "fail" for bad, verdict in of)
        wrong = f"{passes} ({passes / len(of):.1%}) | {fails} ({fails / len(of):.1%})"
        print(
            f"| {views} | {len(of)} | {wrong} | {open_:.0%} | {caught} of {sum(b for b, _ in of)} |"
        )


def detection(parts: int, first: int) -> None:
    """Print how often nothing seems to change, and how often a change of the limit is seen."""
    calm = found = 0
    for k in range(first, first + parts):
        rng = np.random.default_rng([3, k])
        part = Part.made(rng, "as drawn", 0.0)
        first, _ = part.compared(12, [4, k])
        calm += first.changed == 0
        places = first.deviations.places
        at = int(rng.integers(len(places.deviation)))
        near = np.linalg.norm(part.points - places.centres[at], axis=1) < 2 * places.size
        near &= part.normals @ places.normals[at] > 0.9
        limit = first.regions[places.region[at]].detectable_m
        J = np.concatenate([part.normals, np.cross(part.points, part.normals)], axis=1)
        kept = near - J @ np.linalg.lstsq(J, 1.0 * near, rcond=None)[0]
        shift = limit / kept[near].mean() * near  # the best fit takes a part of it
        again, _ = replace(part, displacement=shift).compared(12, [4, k])
        changed = again.deviations.places
        hit = np.linalg.norm(changed.centres - places.centres[at], axis=1) < 1.5 * places.size
        found += bool((changed.changed & hit).any())
    print(f"nothing changed and nothing significant: {calm} of {parts}")
    print(f"changes of the detection limit that are significant: {found} of {parts}")


def repetitions(studies: int, first: int) -> None:
    """Print variance components of repeated scans, relative to the true ones."""
    ratios = []
    for k in range(first, first + studies):
        rng = np.random.default_rng([6, k])
        part = Part.made(rng, "as drawn", 0.0)
        sessions = []
        noise_m, within_m, between_m = 0.0005, 0.0006, 0.0009
        for s in range(5):
            of_session = smooth(part, rng) * between_m
            for r in range(4):
                d = of_session + smooth(part, rng) * within_m
                d += rng.normal(0, noise_m, len(d))
                points = part.points + part.normals * d[:, None]
                sigma = np.full(len(d), noise_m)
                shared = float(np.hypot(within_m, between_m))
                surface = Surface("scan", points, part.normals, None, True, sigma, shared)
                sessions.append(Session(f"{s}/{r}", str(s), None, surface))
        found = repeated(sessions, searched=False)
        surface = found.components[0]
        assert surface.repeatability is not None
        assert surface.reproducibility is not None
        row = (surface.repeatability / within_m, surface.reproducibility / between_m)
        ratios.append((*row, found.held[0].share))
    a = np.array(ratios)
    print(
        f"repeatability / true: {a[:, 0].mean():.3f} ({a[:, 0].min():.2f} to {a[:, 0].max():.2f})"
    )
    print(
        f"reproducibility / true: {a[:, 1].mean():.3f} ({a[:, 1].min():.2f} to {a[:, 1].max():.2f})"
    )
    print(f"within the stated bounds: {a[:, 2].mean():.1%}")


def smooth(part: Part, rng: np.random.Generator, waves: int = 40) -> Float64:
    """Return a random field along the normals of a part, of unit variance, without rigid motion.

    It is correlated over a tenth of the part.
    """
    points = part.points
    length = 0.1 * float(np.linalg.norm(np.ptp(points, axis=0)))
    k = rng.normal(size=(3, waves)) / length
    field = np.cos(points @ k + rng.uniform(0, 2 * np.pi, waves)).sum(1)
    J = np.concatenate([part.normals, np.cross(points, part.normals)], axis=1)
    field -= J @ np.linalg.lstsq(J, field, rcond=None)[0]
    return field / float(np.sqrt((field**2).mean()))


def recorded(data: Path) -> None:
    """Print what differs in real recordings in which nothing does.

    The table of `azure_kinect_tags` from the plane through its tags' corners, which its colour
    images and true poses give; two clips of `iphone_room`, every other frame each; and the two
    positions of `sr4000_corridor`, of which nothing but the images says how far apart they are.
    """
    print("| recording | places | of size, mm | differ (median), mm | not significant | seen |")
    print("|---|---|---|---|---|---|")
    tags = tofuse.open(data / "azure_kinect_tags").select(every=4)
    corners = np.array([*lengths.true_corners(tags).values()])
    assert tags.reference is not None
    plane, off = _plane_through(corners, tags.reference[0, :3, 3])
    result = tofuse.reconstruct(tags)
    guess = align(result.trajectory, tags.reference)
    _row("azure_kinect_tags, plane", tofuse.compare(result, plane, guess=guess))
    room = tofuse.open(data / "iphone_room")
    clips = [tofuse.reconstruct(room.select(start=k, every=2)) for k in range(2)]
    _row("iphone_room, two clips", tofuse.compare(clips[1], clips[0]))
    stands = [tofuse.open(data / "sr4000_corridor" / name) for name in ("Y1", "Y2")]
    first, second = (tofuse.reconstruct(stand) for stand in stands)
    found = tofuse.compare(second, first)
    _row("sr4000_corridor, two positions", found)
    print(f"The tags' {len(corners)} corners are off their plane by {1e3 * off:.2f} mm (rms).")
    T = found.deviations.T_reference_measured
    print(f"The camera moved by {np.round(1e3 * T[:3, 3]).astype(int)} mm in the corridor.")


def _plane_through(points: Float64, eye: Float64) -> tuple[tofuse.Mesh, float]:
    """Return a rectangle through points (N, 3), facing an eye, and their rms distance from it."""
    centre = points.mean(0)
    _, scatter, axes = np.linalg.svd(points - centre, full_matrices=False)
    flat = (points - centre) @ axes[:2].T
    (a, b), (c, d) = flat.min(0), flat.max(0)
    vertices = (np.array([(a, b), (c, b), (c, d), (a, d)]) @ axes[:2] + centre).astype(np.float32)
    faces = np.array([(0, 1, 2), (0, 2, 3)], np.int32)
    if np.cross(vertices[1] - vertices[0], vertices[2] - vertices[0]) @ (eye - centre) < 0:
        faces = faces[:, ::-1].copy()
    zeros = np.zeros(4, np.float32)
    mesh = tofuse.Mesh(vertices, faces, np.zeros((4, 3), np.float32), None, zeros, np.ones(4, int))
    return mesh, float(scatter[2] / np.sqrt(len(points)))


def _row(name: str, found: Comparison) -> None:
    places = found.deviations.places
    inside = np.abs(places.deviation) <= 1.96 * places.sigma
    print(
        f"| {name} | {len(inside)} | {1e3 * places.size:.0f} | "
        f"{1e3 * np.median(np.abs(places.deviation)):.1f} | {inside.mean():.0%} | "
        f"{found.seen:.0%} |\n{found.sentence}",
        flush=True,
    )


def draw(path: Path) -> None:
    """Write a picture of a part with a bump."""
    rng = np.random.default_rng([1, 6])
    part = Part.made(rng, "bump", 0.006, count=60_000)
    drawn, _ = compare_scene(part.compared(24, [0])[0])
    image = scene.render(drawn, (720, 450), yaw=scene.opening_yaw(drawn))
    cv2.imwrite(str(path), image[..., ::-1], [cv2.IMWRITE_PNG_COMPRESSION, 9])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--parts", type=int, default=300)
    parser.add_argument("--first", type=int, default=1000, help="seed of the first part")
    parser.add_argument("--data", type=Path, help="compare the real recordings of this folder")
    parser.add_argument("--picture", type=Path, help="only write this picture")
    arguments = parser.parse_args()
    parts = arguments.parts
    if arguments.picture is not None:
        draw(arguments.picture)
        return
    if arguments.data is not None:
        recorded(arguments.data)
        return
    repetitions(max(parts // 100, 1), arguments.first)
    detection(max(parts // 4, 1), arguments.first)
    verdicts(parts, arguments.first)


if __name__ == "__main__":
    main()
