"""The keyframes of all components, for alignment and relocalization."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from tofuse.arrays import Float32, Float64
from tofuse.geometry import se3
from tofuse.registration.prepared_view import PreparedView
from tofuse.registration.projective import Target
from tofuse.registration.verification import MAX_OVERLAP_DISTANCE
from tofuse.registration.view_descriptor import dissimilarity, view_descriptor

# Maximum number of keyframes, so that memory is constant.
CAPACITY = 40
# Largest shift between the descriptors of similar views, as a fraction of the image width.
_MAX_SHIFT = 0.5


@dataclass(frozen=True, eq=False)
class Keyframe:
    """A view with its pose (4, 4) in its component; doubtful if it fitted unusually badly."""

    view: PreparedView
    T_component_camera: Float64
    component: int
    doubtful: bool = False

    @property
    def depth(self) -> float:
        """Median depth, m."""
        return self.view.depth

    @cached_property
    def descriptor(self) -> Float32:
        """See `view_descriptor`."""
        return view_descriptor(self.view)

    @cached_property
    def target(self) -> Target:
        """The target of alignments with it."""
        return Target(self.view, se3.inverse(self.T_component_camera))


class KeyframeMap:
    """At most `CAPACITY` keyframes, oldest first.

    Parameters
    ----------
    angle, distance
        Motion after which a view becomes a keyframe: rad, and as a fraction of the median depth.
    """

    def __init__(self, angle: float, distance: float) -> None:
        self._angle, self._distance = angle, distance
        self._keyframes: list[Keyframe] = []

    def __len__(self) -> int:
        return len(self._keyframes)

    @property
    def newest(self) -> Keyframe:
        """The keyframe that views are tracked against."""
        return self._keyframes[-1]

    def add(self, keyframe: Keyframe) -> None:
        """Add the newest keyframe; beyond the capacity, remove the most redundant one."""
        if self._keyframes:  # from here on used for relocalization only
            previous = self._keyframes[-1]
            self._keyframes[-1] = replace(previous, view=previous.view.without_caches())
        self._keyframes.append(keyframe)
        if len(self._keyframes) > CAPACITY:
            del self._keyframes[self._most_redundant()]

    def is_far(self, T_component_camera: Float64, keyframe: Keyframe) -> bool:
        """Whether a pose (4, 4) is so far from a keyframe that its view becomes the next one."""
        T_keyframe_camera = se3.inverse(keyframe.T_component_camera) @ T_component_camera
        max_m = self._distance * keyframe.depth
        return not se3.is_within(T_keyframe_camera, max_m, self._angle)

    def overlapping(self, T_component_camera: Float64) -> Keyframe:
        """Return the newest keyframe, or the nearest one if the newest does not overlap a view.

        Parameters
        ----------
        T_component_camera
            (4, 4) pose of the view.
        """
        T_component_keyframes = np.stack([k.T_component_camera for k in self._keyframes])
        T_camera_keyframes = se3.inverse(T_component_camera) @ T_component_keyframes
        depth = np.array([k.depth for k in self._keyframes])
        distances = np.linalg.norm(T_camera_keyframes[:, :3, 3], axis=1) / depth + np.asarray(
            se3.angle(T_camera_keyframes)
        )
        return self._keyframes[
            -1 if distances[-1] < MAX_OVERLAP_DISTANCE else int(np.argmin(distances))
        ]

    def most_similar(self, view: PreparedView, component: int) -> Keyframe | None:
        """Return the most similar keyframe of another component; of ties the newest."""
        others = [k for k in self._keyframes if k.component != component]
        if not others:
            return None
        descriptors = np.stack([k.descriptor for k in others])
        distances = dissimilarity(view_descriptor(view), descriptors, _MAX_SHIFT)
        return others[int(np.flatnonzero(distances == distances.min())[-1])]

    def _most_redundant(self) -> int:
        """Return the position of the later one of the two keyframes that are nearest in pose.

        The earlier one has drifted less. The newest one, which views are tracked against, stays,
        and so does the last one of each component.
        """
        candidates = self._keyframes[:-1]
        T = np.stack([k.T_component_camera for k in candidates])
        component = np.array([k.component for k in candidates])
        max_distance = self._distance * np.array([k.depth for k in candidates])
        positions = T[:, :3, 3]
        translation = np.linalg.norm(positions[:, None] - positions, axis=-1) / np.minimum(
            max_distance[:, None], max_distance
        )
        trace = np.einsum("aij,bij->ab", T[:, :3, :3], T[:, :3, :3])
        angle = np.arccos(np.clip((trace - 1) / 2, -1, 1)) / self._angle
        pose_distance = np.hypot(translation, angle)
        pose_distance[np.triu_indices(len(candidates))] = np.inf
        pose_distance[component[:, None] != component] = np.inf
        if np.isinf(pose_distance).all():  # one keyframe per component: remove the oldest
            return 0
        return int(np.argmin(pose_distance.min(1)))
