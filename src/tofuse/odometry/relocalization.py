"""Finding a lost camera again among earlier keyframes, within a budget of searches."""

from __future__ import annotations

from tofuse.arrays import Float64
from tofuse.odometry.keyframe_map import Keyframe, KeyframeMap
from tofuse.registration.base import Link, Registration
from tofuse.registration.prepared_view import PreparedView
from tofuse.registration.search import SearchOptions
from tofuse.registration.verification import UsualFit, comparable
from tofuse.registration.view_pair import register_pair

# A search costs about as much as tracking so many frames. With one search for so many frames, being
# lost costs no more than tracking does; some are free, as short recordings may be all large steps.
_FRAMES_PER_SEARCH, _FREE = 40, 24


class Relocalizer:
    """Searches a view in the newest keyframe and in the one that looks most like it.

    The budget counts frames, not seconds, so that every machine makes the same searches.

    Parameters
    ----------
    search
        How far and how finely is searched; None never searches.
    usual
        How views of this camera usually fit.
    """

    def __init__(self, search: SearchOptions | None, usual: UsualFit) -> None:
        self._search, self._usual = search, usual
        self._left = float(_FREE)
        # Registrations of the last view, as several of its explanations ask for the same pair.
        self._known: dict[tuple[int, int], Registration | None] = {}

    def count_frame(self) -> None:
        """Say that a frame was processed, which adds to the budget."""
        self._left += 1 / _FRAMES_PER_SEARCH

    def links(
        self,
        view: PreparedView,
        keyframes: KeyframeMap,
        component: int,
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
            link = self.link(view, keyframe, adjacent=keyframe.view.index == last)
            if link is not None:
                found.append(link)
                if link.certain:
                    break
        return tuple(found)

    def link(self, view: PreparedView, keyframe: Keyframe, *, adjacent: bool) -> Link | None:
        """Register a view to a keyframe, if the budget allows and the pose is probable.

        Views that are adjacent in time see the same place, so that a probable pose is certain.
        """
        found = self._probable(view, keyframe)
        if found is None:
            return None
        certain = adjacent or found.stands_alone
        return Link(keyframe.view.index, view.index, found, certain, found.how)

    def agrees(self, view: PreparedView, keyframe: Keyframe, T: Float64) -> bool | None:
        """Whether a registration without a guess finds T_keyframe_camera; None if it finds none."""
        found = self._probable(view, keyframe)
        if found is None or self._search is None:
            return None
        return not self._search.differ(found.T_target_source, T)

    def _probable(self, view: PreparedView, keyframe: Keyframe) -> Registration | None:
        """Register a view to a keyframe, if the budget allows; the same pair once."""
        pair = view.index, keyframe.view.index
        if pair not in self._known:
            if self._search is None or self._left < 1 or not comparable(view.depth, keyframe.depth):
                return None
            self._left -= 1
            # Even where an alignment seems certain: a box looks alike from its other side.
            found = register_pair(
                view, keyframe.view, usual=self._usual, options=self._search, always_search=True
            )
            self._known = {p: r for p, r in self._known.items() if p[0] == view.index}
            self._known[pair] = found
        found = self._known[pair]
        return found if found is not None and found.is_probable else None
