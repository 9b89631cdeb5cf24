"""Ghost surfaces: how much of the model of a flat is where nothing is, and how much is missing.

Walks through simulated flats of four rooms, by several cameras with every error that the simulator
knows and their factory correction, are reconstructed by the default method. Its trajectory is
aligned with the truth, rigidly. Printed of each walk are

- the rms error of the poses after that, as far as errors of the poses displace the model;
- the shares of the mesh's vertices and of the cloud's points that are farther than 5 cm from the
  nearest true surface, and for `--true-poses` of the mesh that is made at the true poses;
- completeness: the share of the true surface that was measured, by places of 2 cm, that the mesh
  has within 5 cm: of all, of floors, and of what is dark (albedo below 0.3). A place was measured if
  at least 3 valid pixels hit it, and at least half of them are right to 5 cm.

With `--causes`, vertices at true poses that are ghosts are traced to the pixels that made them:
those of all views that lie within 5 cm of the vertex, by their weight, and the flags that the
simulator gave them.

    python benchmarks/ghosts.py [--walks flat/sr4000/31/6] [--true-poses] [--causes]
"""

from __future__ import annotations

import argparse
import shutil
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import sequences
from tofuse.evaluation.surface import Shape, distances
from tofuse.evaluation.trajectory import displacement
from tofuse.files.images import read_image
from tofuse.geometry import se3
from tofuse.recordings.frames import RangeFrame
from tofuse.recordings.open import open_recording
from tofuse.recordings.recording import Recording
from tofuse.simulation.record import Plan, plan, simulate

Float64 = NDArray[np.float64]
Bool = NDArray[np.bool_]

OUT = sequences.OUT / "recordings" / "ghosts"
NEAR_M = 0.05
CELL_M = 0.02  # of the places that were measured, one stands for each such cube
PIXELS, RIGHT = 3, 0.5
DARK = 0.3
SAMPLES = 1_500_000  # of the flat: 1.5 cm apart


@dataclass(frozen=True)
class Walk:
    """A simulated recording of a flat.

    Attributes
    ----------
    scene, camera
        Of `simulation.scene.SCENES` and `sensor.models.CAMERAS`.
    seed
        Of scene, path and noise.
    every
        Every so-many-th of 1140 raw frames is taken.
    """

    scene: str
    camera: str
    seed: int
    every: int

    @classmethod
    def named(cls, name: str) -> Walk:
        """The walk called scene/camera/seed/every."""
        scene, camera, seed, every = name.split("/")
        return cls(scene, camera, int(seed), int(every))

    def __str__(self) -> str:
        return f"{self.scene}/{self.camera}/{self.seed}/{self.every}"

    @property
    def folder(self) -> Path:
        """Where it is kept."""
        return OUT / str(self).replace("/", "_")

    @cached_property
    def plan(self) -> Plan:
        """What is recorded."""
        return plan(self.scene, camera=self.camera, seed=self.seed, every=self.every)

    def recording(self) -> Recording:
        """The recording, made unless it was before."""
        if not self.folder.is_dir():
            unfinished = self.folder.with_suffix(".part")
            shutil.rmtree(unfinished, ignore_errors=True)
            simulate(
                self.scene,
                unfinished,
                camera=self.camera,
                seed=self.seed,
                every=self.every,
            )
            unfinished.rename(self.folder)
        return open_recording(self.folder)

    @cached_property
    def surface(self) -> Shape:
        """The true surface, in the world of the true poses."""
        vertices, faces = self.plan.scene.truth_mesh()
        start = self.plan.raw[0] / self.plan.sequence.frame_rate_hz
        return Shape(se3.transform(self.plan.sequence.T_world_truth(start), vertices), faces)


@dataclass(frozen=True, eq=False)
class Places:
    """Places (P, 3) of the true surface that were measured, in the world, and of what kind."""

    points: Float64
    floor: Bool
    dark: Bool


def measured(walk: Walk, recording: Recording) -> Places:
    """The true surface that pixels saw, see above."""
    scene, sequence = walk.plan.scene, walk.plan.sequence
    floors = [k for k, m in enumerate(scene.materials) if m.name.startswith("floor")]
    albedo = np.array([m.albedo for m in scene.materials])
    keys, right, points, surfaces = [], [], [], []
    for raw, T_world, frame in zip(walk.plan.raw, walk.plan.poses, recording, strict=True):
        assert isinstance(frame, RangeFrame)
        T = sequence.T_room_camera(raw / sequence.frame_rate_hz)
        rays = np.insert(frame.camera.rays()[frame.valid].astype(float), 2, 1, -1)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
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
