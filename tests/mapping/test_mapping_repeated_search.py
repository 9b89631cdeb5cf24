"""Repeated loop search along a long trajectory."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from revisited_path import Drifting, turn  # noqa: F401 - a fixture
from tofuse.engine.geometry import se3
from tofuse.engine.loops.loops import PriorLoop
from tofuse.engine.loops.revisits import Revisits
from tofuse.engine.mapping.mapper import Mapper
from tofuse.engine.mapping.methods import from_method
from tofuse.engine.refinement.refinement import NoRefinement
from tofuse.engine.stored_views.view_store import Spacing

# Bends the path so far that views of one place don't overlap by their poses.
BENT = 5.0


@dataclass(frozen=True)
class Spaced(Revisits):
    """Takes all views; more than `most` make the trajectory long."""

    most: int = 200

    def start(self, seed, given, views, search=None):
        spacing = Spacing(angle=1e-6, distance=1e-6, max_views=self.most, max_stretch=1)
        return super().start(seed, given, views, search, spacing=spacing)


def reconstructed(frames, truth, most):
    last = len(frames) - 1
    config = replace(
        from_method("default"),
        corrections=(),
        model_filters=(),
        odometry=Drifting(len(frames), drift=BENT, sigma=BENT),
        loops=Spaced(searches=0, similar_pairs=0, most=most),
        refinement=NoRefinement(),
    )
    ends = PriorLoop(0, last, se3.inverse(truth[0]) @ truth[last])
    mapper = Mapper(config, loops=[ends], threads=1)
    for k, frame in enumerate(frames):
        mapper.push(replace(frame, timestamp=float(k)))
    result = mapper.finish()
    accepted = {(loop.i, loop.j) for loop in result.diagnostics.loops if loop.accepted}
    return accepted, np.linalg.norm(result.trajectory[:, :3, 3] - truth[:, :3, 3], axis=1)


def test_loops_are_searched_again_where_first_ones_corrected_path(turn):  # noqa: F811
    frames, truth, _ = turn
    once, off_once = reconstructed(frames, truth, most=200)
    again, off_again = reconstructed(frames, truth, most=10)
    assert (0, len(frames) - 1) in once
    assert again > once
    assert max(off_once.max(), off_again.max()) < 0.05
