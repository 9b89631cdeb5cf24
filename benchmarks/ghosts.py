"""Spurious and missing surface in models of a simulated flat.

Walks through simulated flats of four rooms, with all simulated camera errors (`direct`: without
multipath) and factory correction, are corrected and filtered by the default method and fused at the
true poses; with `--estimated` they are also reconstructed by it, and the result is aligned with the
ground truth by its trajectory. Printed for each:

- the rms error of the poses after alignment, which displaces real surfaces too;
- the fractions of mesh vertices (the same points as those of the cloud) farther than 5, 10 and 20
  cm from the nearest true surface;
- completeness: the fraction of the measured true surface, in cells of 2 cm, within 5 cm of the
  mesh: of all cells, of floors, and of dark surfaces (albedo below 0.3). A cell is measured if at
  least 3 valid pixels hit it, and at least half of them are accurate to 5 cm.

    python benchmarks/ghosts.py [--walks flat/sr4000/31/6 flat/sr4000/54/10/direct] [--estimated]
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import dataclass
from functools import cached_property, partial

import numpy as np

import sequences
from made_once import made_once
from tofuse.engine.arrays import Bool, Float64
from tofuse.engine.compute.thread_pool import threads
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.frames.recording import Recording
from tofuse.engine.fusion.mesh import Mesh
from tofuse.engine.fusion.range_view import RangeView
from tofuse.engine.fusion.tsdf import fuse_surface
from tofuse.engine.geometry import se3
from tofuse.engine.geometry.rays import unit_rays
from tofuse.engine.mapping.adaptation import adapted
from tofuse.engine.mapping.methods import from_method
from tofuse.engine.mapping.preparation import Preparation
from tofuse.engine.mapping.reconstructing import reconstruct
from tofuse.engine.quality.trajectory_errors import align
from tofuse.engine.views.prepared_view import prepare_view
from tofuse.engine.views.view_planes import SurfaceOptions
from tofuse.formats.recordings.open import open_recording
from tofuse.lab.experiments.surface_error import Surface, distances
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.record import RecordingPlan, plan, write

OUT = sequences.OUT / "recordings" / "ghosts"
WALKS = (
    "flat/sr4000/31/6",
    "flat/ifm-o3r/31/10",
    "flat/sr4000/52/10",
    "flat-alike/pico-flexx/53/10",
    "flat/sr4000/54/10/direct",
    "flat-alike/ifm-o3r/55/10/direct",
)
NEAR_M = 0.05
CELL_M = 0.02  # one measured point is kept per cell
PIXELS, RIGHT = 3, 0.5
DARK = 0.3
SAMPLES = 600_000  # per surface: 2.5 cm apart in a flat, with the triangles around each


@dataclass(frozen=True)
class Walk:
    """A simulated recording of a flat.

    Attributes
    ----------
    scene, camera
        Names in `simulation.scene.SCENES` and `simulation.models.CAMERAS`.
    seed
        Random seed of scene, path and noise.
    every
        Stride over the 1140 raw frames.
    direct
        Whether multipath is left out.
    """

    scene: str
    camera: str
    seed: int
    every: int
    direct: bool = False

    @classmethod
    def named(cls, name: str) -> Walk:
        """Parse scene/camera/seed/every, optionally with /direct."""
        scene, camera, seed, every, *options = name.split("/")
        return cls(scene, camera, int(seed), int(every), options == ["direct"])

    def __str__(self) -> str:
        name = f"{self.scene}/{self.camera}/{self.seed}/{self.every}"
        return f"{name}/direct" if self.direct else name

    @cached_property
    def plan(self) -> RecordingPlan:
        """The plan of the simulation."""
        return plan(
            self.scene,
            camera=self.camera,
            seed=self.seed,
            every=self.every,
            effects=Effects(multipath=not self.direct),
        )

    def recording(self) -> Recording:
        """The recording, simulated if it does not exist yet."""
        folder = OUT / str(self).replace("/", "_")
        return open_recording(made_once(folder, partial(write, self.plan)))

    @cached_property
    def surface(self) -> Surface:
        """The true surface, in the world frame of the true poses."""
        vertices, faces = self.plan.scene.truth_mesh()
        start = self.plan.raw[0] / self.plan.sequence.frame_rate_hz
        return Surface(se3.transform(self.plan.sequence.T_world_truth(start), vertices), faces)


@dataclass(frozen=True, eq=False)
class Places:
    """Measured points (P, 3) of the true surface in the world frame, with masks by kind."""

    points: Float64
    floor: Bool
    dark: Bool


def measured(walk: Walk, recording: Recording) -> Places:
    """The measured part of the true surface, see above."""
    scene, sequence = walk.plan.scene, walk.plan.sequence
    floors = [k for k, m in enumerate(scene.materials) if m.name.startswith("floor")]
    albedo = np.array([m.albedo for m in scene.materials])
    keys, right, points, surfaces = [], [], [], []
    for raw, T_world, frame in zip(walk.plan.raw, walk.plan.poses, recording, strict=True):
        assert isinstance(frame, RangeFrame)
        T = sequence.T_room_camera(raw / sequence.frame_rate_hz)
        rays = unit_rays(frame.camera.rays()[frame.valid])
        hits = scene.cast(T[:3, 3], rays @ T[:3, :3].T)
        hit = np.isfinite(hits.distance)
        at = se3.transform(T_world, rays[hit] * hits.distance[hit, None].astype(float))
        cell = np.floor(at / CELL_M).astype(np.int64) + (1 << 19)
        keys.append((cell[:, 0] << 40) | (cell[:, 1] << 20) | cell[:, 2])
        right.append(np.abs(frame.radial_range[frame.valid] - hits.distance)[hit] < NEAR_M)
        points.append(at.astype(np.float32))
        surfaces.append(hits.surface[hit])
    _, first, place = np.unique(np.concatenate(keys), return_index=True, return_inverse=True)
    count = np.bincount(place)
    good = np.bincount(place, np.concatenate(right))
    chosen = first[(count >= PIXELS) & (good >= RIGHT * count)]
    surface = np.concatenate(surfaces)[chosen]
    where = np.concatenate(points)[chosen].astype(float)
    return Places(where, np.isin(surface, floors), albedo[surface] < DARK)


def at_true_poses(recording: Recording) -> Mesh:
    """Mesh of the default method at the true poses."""
    assert recording.reference is not None
    config = adapted(from_method("default"), recording)
    preparation, views = Preparation(config), []
    for frame, T in zip(recording, recording.reference, strict=True):
        filtered = preparation.process(frame, T, None, None)
        preparation.add_pose(filtered.for_tracking, T)
        assert isinstance(filtered.for_tracking, RangeFrame)
        assert isinstance(filtered.for_model, RangeFrame)
        surface = prepare_view(filtered.for_tracking, SurfaceOptions())
        views.append(RangeView.of(filtered.for_model, surface))
    return fuse_surface(views, recording.reference, config.fusion)


def row(label: str, mesh: Mesh, T_true_world: Float64, walk: Walk, seen: Places, ate: float) -> str:
    """One line of the table."""
    vertices = se3.transform(T_true_world, mesh.vertices.astype(float))
    distance_m = distances(vertices, walk.surface, SAMPLES)
    found = distances(seen.points, Surface(vertices, mesh.faces), SAMPLES) <= NEAR_M
    ghosts = " | ".join(f"{100 * (distance_m > limit).mean():.3f}" for limit in (0.05, 0.10, 0.20))
    complete = " | ".join(f"{100 * found[m].mean():.1f}" for m in (..., seen.floor, seen.dark))
    return f"| {walk}, {label} | {1e3 * ate:.0f} | {len(mesh):,} | {ghosts} | {complete} |"


def main(arguments: list[str] | None = None) -> int:
    """Print a table."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--walks", nargs="+", default=WALKS, metavar="SCENE/CAMERA/SEED/EVERY")
    parser.add_argument("--estimated", action="store_true", help="also at estimated poses")
    parser.add_argument("--threads", type=int, default=2)
    options = parser.parse_args(arguments)
    print(
        "| walk, poses | ATE mm | vertices | > 5 cm % | > 10 cm % | > 20 cm % "
        "| complete % | floors % | dark % |\n|---|---|---|---|---|---|---|---|---|"
    )
    with threads(options.threads):
        for walk in map(Walk.named, options.walks):
            recording = walk.recording()
            seen = measured(walk, recording)
            print(row("true", at_true_poses(recording), np.eye(4), walk, seen, 0.0), flush=True)
            if not options.estimated:
                continue
            result = reconstruct(recording, threads=options.threads)
            assert result.mesh is not None
            assert recording.reference is not None
            known = result.has_pose
            truth, found = recording.reference[known], result.trajectory[known]
            T = align(found, truth)
            ate = float(np.sqrt((((T @ found)[:, :3, 3] - truth[:, :3, 3]) ** 2).sum(1).mean()))
            label = f"estimated ({known.sum()} of {len(known)})"
            print(row(label, result.mesh, T, walk, seen, ate), flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main())
