"""Loop closures: registrations of views that are far apart in time but show the same place.

A `LoopDetector` (`Revisits` for images, `Overlapping` for clouds) starts `Loops`, which are given
views and return `ClosedLoop`s, accepted or rejected with a reason. `Joining` connects a
`TrackedComponent` to others that were tracked separately, and returns each connected `Group` with
its `Join`s.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.loops import locating, revisits
    from tofuse.engine.loops.joining import Group, Joining
    from tofuse.engine.loops.loops import ClosedLoop, Confirmation, LoopDetector, Loops, PriorLoop
    from tofuse.engine.loops.merged_components import Join, JoinKind, TrackedComponent, cut_edges
    from tofuse.engine.loops.nearby import Nearby
    from tofuse.engine.loops.overlapping import Overlapping

__getattr__, __dir__, __all__ = face(__name__, __file__)
