"""Relocalization: global registration to earlier keyframes, within a budget of searches."""

from __future__ import annotations

from tofuse.arrays import Float64
from tofuse.odometry.keyframe_map import Keyframe, KeyframeMap
from tofuse.registration.base import Link, Registration
from tofuse.registration.prepared_view import PreparedView
from tofuse.registration.search import DISTINCT_M, SearchOptions, are_distinct_poses
from tofuse.registration.verification import FitStatistics, comparable
from tofuse.registration.view_pair import register_pair

# A search costs about as much as tracking 40 frames. With one per 40 frames, a lost camera costs no
# more than a tracked one; the first ones are free, as short recordings may have large steps.
_FRAMES_PER_SEARCH, _FREE_SEARCHES = 40, 24


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

    def __init__(self, search: SearchOptions | None, fit_statistics: FitStatistics) -> None:
        self._search, self._fit_statistics = search, fit_statistics
        self._budget = float(_FREE_SEARCHES)
        # Registrations of the last view, as several hypotheses need the same pair.
        self._cache: dict[tuple[int, int], Registration | None] = {}

    def count_frame(self) -> None:
        """Add a processed frame to the budget."""
        self._budget += 1 / _FRAMES_PER_SEARCH

    def links(
        self,
        view: PreparedView,
        keyframes: KeyframeMap,
        component: int,
        last: int | None = None,
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
        certain = adjacent or registration.stands_alone
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
            if not can_search or not comparable(view.depth, keyframe.depth):
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
