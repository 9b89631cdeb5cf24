"""The keyframes of all components, and searches for the pose of a view relative to them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from tofuse.engine.alignment import Link, Registration, projective
from tofuse.engine.arrays import Float32, Float64
from tofuse.engine.geometry import se3
from tofuse.engine.search import (
    DISTINCT_M,
    SearchOptions,
    are_distinct_poses,
    register_pair,
    verification,
)
from tofuse.engine.views import PreparedView, view_descriptors

# Maximum number of keyframes, so that memory is constant.
CAPACITY = 40
# Largest shift between the descriptors of similar views, as a fraction of the image width.
_MAX_SHIFT = 0.5
# A search costs about as much as tracking 40 frames. With one per 40 frames, a lost camera costs no
# more than a tracked one; the first ones are free, as short recordings may have large steps.
_FRAMES_PER_SEARCH, _FREE_SEARCHES = 40, 24


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
        return view_descriptors.view_descriptor(self.view)

    @cached_property
    def target(self) -> projective.Target:
        """The target of alignments with it."""
        return projective.Target(self.view, se3.inverse(self.T_component_camera))


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

    def newest_of(self, component: int, accepts: Callable[[PreparedView], bool]) -> Keyframe | None:
        """Return the newest keyframe of a component with a view that is accepted."""
        of_component = (k for k in reversed(self._keyframes) if k.component == component)
        return next((k for k in of_component if accepts(k.view)), None)

    def add(self, keyframe: Keyframe) -> None:
        """Add the newest keyframe; beyond the capacity, remove the most redundant one."""
        if self._keyframes:  # from here on used for relocalization only
            previous = self._keyframes[-1]
            self._keyframes[-1] = replace(previous, view=previous.view.without_caches())
        self._keyframes.append(keyframe)
        if len(self._keyframes) > CAPACITY:
            del self._keyframes[self._most_redundant()]

    def remove_after(self, keyframe: Keyframe) -> None:
        """Remove the later keyframes of its component."""
        self._keyframes = [
            k
            for k in self._keyframes
            if k.component != keyframe.component or k.view.index <= keyframe.view.index
        ]

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
        distances = se3.change_of_view(T_camera_keyframes, depth)
        return self._keyframes[
            -1 if distances[-1] < verification.MAX_OVERLAP_DISTANCE else int(np.argmin(distances))
        ]

    def most_similar(self, view: PreparedView, component: int) -> Keyframe | None:
        """Return the most similar keyframe of another component; of ties the newest."""
        others = [k for k in self._keyframes if k.component != component]
        if not others:
            return None
        descriptors = np.stack([k.descriptor for k in others])
        distances = view_descriptors.dissimilarity(
            view_descriptors.view_descriptor(view), descriptors, _MAX_SHIFT
        )
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


class Relocalizer:
    """Registers a view to the newest keyframe and to the most similar one, without a guess.

    The budget counts frames, not seconds, so that the searches are the same on every machine.

    Parameters
    ----------
    search
        Range and effort of the search; None never searches.
    fit_statistics
        Usual fit of views of this camera.
    """

    def __init__(
        self, search: SearchOptions | None, fit_statistics: verification.FitStatistics
    ) -> None:
        self._search, self._fit_statistics = search, fit_statistics
        self._budget = float(_FREE_SEARCHES)
        # Registrations of the last view, as several hypotheses need the same pair.
        self._cache: dict[tuple[int, int], Registration | None] = {}

    def count_frame(self) -> None:
        """Add a processed frame to the budget."""
        self._budget += 1 / _FRAMES_PER_SEARCH

    def links(
        self, view: PreparedView, keyframes: KeyframeMap, component: int, last: int | None = None
    ) -> tuple[Link, ...]:
        """Register a view to keyframes of other components, up to the first certain link.

        Parameters
        ----------
        view, component
            The view and the number of its component.
        keyframes
            All keyframes.
        last
            Index of the frame just before the view, if it has a pose.
        """
        candidates: list[Keyframe] = []
        if len(keyframes) and keyframes.newest.component != component:
            candidates.append(keyframes.newest)
        similar = keyframes.most_similar(view, component)
        if similar is not None and similar not in candidates:
            candidates.append(similar)
        links = []
        for keyframe in candidates:
            link = self.link(view, keyframe, adjacent=keyframe.view.index == last)
            if link is not None:
                links.append(link)
                if link.certain:
                    break
        return tuple(links)

    def link(self, view: PreparedView, keyframe: Keyframe, *, adjacent: bool) -> Link | None:
        """Register a view to a keyframe, if the budget allows and the pose is probable.

        Views that are adjacent in time see the same place, so that a probable pose is certain.
        """
        registration = self._probable(view, keyframe)
        if registration is None:
            return None
        certain = adjacent or registration.is_decisive
        return Link(keyframe.view.index, view.index, registration, certain, registration.how)

    def confirms(self, view: PreparedView, keyframe: Keyframe, T: Float64) -> bool | None:
        """Whether a search confirms T_keyframe_camera (4, 4); None if it finds no probable pose."""
        registration = self._probable(view, keyframe)
        if registration is None or self._search is None:
            return None
        return not are_distinct_poses(registration.T_target_source, T)

    def _probable(self, view: PreparedView, keyframe: Keyframe) -> Registration | None:
        """Register a view to a keyframe, each pair once, if the budget allows."""
        pair = view.index, keyframe.view.index
        if pair not in self._cache:
            can_search = self._search is not None and self._budget >= 1
            if not can_search or not verification.comparable(view.depth, keyframe.depth):
                return None
            self._budget -= 1
            # Even where an alignment seems certain: a box looks the same from its opposite side.
            registration = register_pair(
                view,
                keyframe.view,
                fit_statistics=self._fit_statistics,
                options=self._search,
                always_search=True,
                rival_m=DISTINCT_M,
            )
            self._cache = {p: r for p, r in self._cache.items() if p[0] == view.index}
            self._cache[pair] = registration
        registration = self._cache[pair]
        return registration if registration is not None and registration.is_probable else None
