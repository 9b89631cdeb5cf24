"""A simulated scene in memory: only the raw frames of given strides."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.filters import apply_filters
from tofuse.engine.frames import ArraySource, Frame, Recording
from tofuse.engine.geometry import se3, triangles
from tofuse.engine.mapping import Config
from tofuse.lab.simulation import Effects, RecordingPlan, plan

# About 1 cm apart in a room, so that distances are accurate to half of that.
_SURFACE_POINTS = 500_000


@dataclass(frozen=True, eq=False)
class RecordedScene:
    """Some raw frames of a simulated scene, numbered from 0 in the order of the raw sequence.

    Attributes
    ----------
    plan
        The recording's plan; `plan.raw` are the indices of the raw frames.
    frames
        The camera's frames, after its factory correction.
    poses
        (N, 4, 4) true T_world_camera; the first is the identity.
    """

    plan: RecordingPlan
    frames: tuple[Frame, ...]
    poses: Float64

    def every(self, stride: int) -> Recording:
        """Return every `stride`-th raw frame as a recording."""
        indices = np.flatnonzero(self.plan.raw % stride == 0)
        source = ArraySource(self.frames, self.poses)
        return Recording(source, f"simulated {self.plan.scene.name}", "simulated", indices)

    def filtered(self, config: Config) -> tuple[RecordedScene, Config]:
        """Filter all frames once, for runs with common filters; return the remaining configuration.

        Filters that depend on previous frames remain in the configuration.
        """
        if config.window > 1:
            return self, config
        frames = tuple(apply_filters(config.filters, frame)[0] for frame in self.frames)
        return replace(self, frames=frames), replace(config, filters=())

    @cached_property
    def T_truth_world(self) -> Float64:
        """(4, 4) from the recording's world to the frame of the true surface, which has z up."""
        return se3.inverse(self.plan.sequence.T_world_truth(0.0))

    @cached_property
    def surface(self) -> Float64:
        """(K, 3) random points on the true surface, in its own frame (z up), m."""
        vertices, faces = self.plan.scene.truth_mesh()
        rng = np.random.default_rng([0, _SURFACE_POINTS])
        return triangles.random_points(vertices[faces], _SURFACE_POINTS, rng)

    @cached_property
    def surface_tree(self) -> Any:
        """`surface` as a SciPy cKDTree."""
        from scipy.spatial import cKDTree

        return cKDTree(self.surface)


def record_scene(
    scene: str,
    strides: Sequence[int],
    seed: int,
    *,
    limit: int | None = None,
    effects: Effects | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> RecordedScene:
    """Simulate the raw frames of a scene for a set of strides, each frame once.

    Parameters
    ----------
    scene
        One of the simulator's.
    limit
        Maximum number of raw frames.
    effects
        Errors of the camera; all of them by default.
    progress
        Called with the number of frames done and the total.
    """
    planned = plan(scene, seed=seed, every=1, frames=limit, effects=effects or Effects())
    needed = np.any([planned.raw % stride == 0 for stride in strides], axis=0)
    planned = replace(planned, raw=planned.raw[needed])
    return RecordedScene(planned, tuple(planned.corrected_frames(progress)), planned.poses)
