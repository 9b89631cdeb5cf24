"""Finding a lost camera again among earlier keyframes, within a budget of searches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from tofuse.maps.surface_map import SurfaceMap
from tofuse.odometry.keyframe_map import Keyframe, KeyframeMap
from tofuse.registration.search import Match, search
from tofuse.registration.verification import Belief, Link, UsualFit, comparable, link_of

Float64 = NDArray[np.float64]

# A search costs about as much as tracking so many frames. With one search for so many frames, being
# lost costs no more than tracking does; some are free, as short recordings may be all large steps.
_FRAMES_PER_SEARCH, _FREE = 40, 24


class Relocalizer:
    """Searches a view in the newest keyframe and in the one that looks most like it.

    The budget counts frames, not seconds, so that every machine makes the same searches.

    Parameters
    ----------
    belief
        What is believed of a search; None never searches.
    """

    def __init__(self, belief: Belief | None) -> None:
        self._belief = belief
        self._left = float(_FREE)
        self._last: tuple[tuple[int, int], Match | None] | None = None  # what was searched last

    def count_frame(self) -> None:
        """Say that a frame was processed, which adds to the budget."""
        self._left += 1 / _FRAMES_PER_SEARCH

    def links(
        self,
        view: SurfaceMap,
        keyframes: KeyframeMap,
        component: int,
        usual: UsualFit,
        last: int | None = None,
    ) -> tuple[Link, ...]:
        """Register a view of a component to keyframes of others; stops at a link that is certain.

        `last` is the frame just before the view, if it has a pose.
        """
        candidates: list[Keyframe] = []
        if len(keyframes) and keyframes.newest.component != component:
            candidates.append(keyframes.newest)
        alike = keyframes.alike(view, component)
        if alike is not None and alike not in candidates:
            candidates.append(alike)
        found = []
        for keyframe in candidates:
            link = self.link(view, keyframe, usual, adjacent=keyframe.view.index == last)
            if link is not None:
                found.append(link)
                if link.certain:
                    break
        return tuple(found)

    def link(
        self, view: SurfaceMap, keyframe: Keyframe, usual: UsualFit, *, adjacent: bool
    ) -> Link | None:
        """Register a view to a keyframe, if the budget allows."""
        match = self._match(view, keyframe)
        if match is None or self._belief is None:
            return None
        return link_of(match, view, keyframe.view, self._belief, usual, adjacent=adjacent)[0]

    def confirms(self, view: SurfaceMap, keyframe: Keyframe, T_keyframe_camera: Float64) -> bool:
        """Whether a search finds the pose (4, 4) that an alignment found.

        Two methods that agree need not lead by any margin, but both images must support the pose.
        """
        match = self._match(view, keyframe)
        if match is None or self._belief is None:
            return False
        if replace(self._belief, margin=0.0).objection(match, alone=False):
            return False
        return not self._belief.search.differ(match.T_target_source, T_keyframe_camera)

    def contradicts(self, view: SurfaceMap, keyframe: Keyframe, T_keyframe_camera: Float64) -> bool:
        """Whether a search finds another pose than the (4, 4) of an alignment."""
        match = self._match(view, keyframe)
        if match is None or self._belief is None or self._belief.objection(match, alone=False):
            return False
        return self._belief.search.differ(match.T_target_source, T_keyframe_camera)

    def _match(self, view: SurfaceMap, keyframe: Keyframe) -> Match | None:
        """Search a view in a keyframe, if the budget allows; the same pair is searched once."""
        pair = view.index, keyframe.view.index
        if self._last is not None and self._last[0] == pair:
            return self._last[1]
        known = comparable(view.depth, keyframe.depth)
        if self._belief is None or self._left < 1 or not known:
            return None
        self._left -= 1
        self._last = pair, search(view, keyframe.view, self._belief.search)
        return self._last[1]
