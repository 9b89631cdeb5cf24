"""Invalid or degenerate graphs: each optimiser reports them, and leaves them unchanged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tofuse.engine.errors import InputError
from tofuse.engine.geometry import se3
from tofuse.engine.graph.castellani import Castellani
from tofuse.engine.graph.graph import PoseGraph
from tofuse.engine.graph.levenberg import LevenbergMarquardt
from tofuse.lab.methods.elch import Elch
from tofuse.lab.methods.lu_milios import LuMilios
from walked_graph import walk

OPTIMISERS = [LevenbergMarquardt(), Castellani(), LuMilios(), Elch()]
GRAPH, TRUTH, _ = walk(10, 4)


def corrupted(name: str, k: int, value: object) -> PoseGraph:
    values = getattr(GRAPH, name).copy()
    values[k] = value
    return replace(GRAPH, **{name: values})


FAR = np.eye(4)
FAR[0, 3] = 1e200
MOTIONS = {
    "pose 2 is not finite": corrupted("poses", 2, np.nan),
    "measurement 3 is not finite": corrupted("measurements", 3, np.inf),
    "pose 4 is not a rigid motion": corrupted("poses", 4, np.diag([2.0, 2, 2, 1])),
    "pose 5 is not a rigid motion": corrupted("poses", 5, np.diag([1.0, 1, -1, 1])),
    "measurement 6 is not a rigid motion": corrupted("measurements", 6, FAR),
}
INFORMATION = {
    "information 3 is not finite": corrupted("information", 3, np.nan),
    "edge 3 4: the information matrix is not positive": corrupted("information", 3, -np.eye(6)),
}


@pytest.mark.parametrize("says", MOTIONS)
@pytest.mark.parametrize("optimiser", OPTIMISERS, ids=lambda o: type(o).__name__)
def test_invalid_poses_are_refused(optimiser, says):
    with pytest.raises(InputError, match=says):
        optimiser.optimise(MOTIONS[says])


@pytest.mark.parametrize("says", INFORMATION)
@pytest.mark.parametrize("optimiser", OPTIMISERS, ids=lambda o: type(o).__name__)
def test_invalid_information_is_refused_unless_unused(optimiser, says):
    if isinstance(optimiser, Castellani):
        found = optimiser.optimise(INFORMATION[says]).graph.poses
        np.testing.assert_array_equal(found, optimiser.optimise(GRAPH).graph.poses)
    else:
        with pytest.raises(InputError, match=says):
            optimiser.optimise(INFORMATION[says])


@pytest.mark.parametrize(("ends", "says"), [((5, 5), "to itself"), ((5, 10), "not there")])
def test_invalid_edges_are_refused(ends, says):
    edges = GRAPH.edges.copy()
    edges[3] = ends
    with pytest.raises(InputError, match=says):
        replace(GRAPH, edges=edges)


@pytest.mark.parametrize("optimiser", OPTIMISERS, ids=lambda o: type(o).__name__)
def test_disconnected_parts_are_independent(optimiser):
    n = len(GRAPH.ids)
    both = PoseGraph(
        np.concatenate([GRAPH.ids, 100 + GRAPH.ids, [500]]),
        np.concatenate([GRAPH.poses, GRAPH.poses, se3.exp(np.ones((1, 6)))]),
        np.concatenate([GRAPH.edges, GRAPH.edges + n]),
        np.concatenate([GRAPH.measurements] * 2),
        np.concatenate([GRAPH.information] * 2),
        np.concatenate([GRAPH.loop] * 2),
    )
    alone, done = optimiser.optimise(GRAPH).graph.poses, optimiser.optimise(both).graph.poses
    np.testing.assert_allclose(done[:n], alone, atol=1e-5)
    np.testing.assert_allclose(done[n:-1], alone, atol=1e-5)
    np.testing.assert_allclose(done[-1], both.poses[-1], atol=1e-12)


@pytest.mark.parametrize("optimiser", OPTIMISERS, ids=lambda o: type(o).__name__)
def test_optimal_graph_stays_and_is_not_improved(optimiser):
    i, j = GRAPH.edges.T
    exact = replace(GRAPH, poses=TRUTH, measurements=se3.inverse(TRUTH[i]) @ TRUTH[j])
    np.testing.assert_allclose(optimiser.optimise(exact).graph.poses, TRUTH, atol=1e-9)
    nothing = replace(
        GRAPH, **{name: getattr(GRAPH, name)[:0] for name in ("edges", "measurements")},
        information=GRAPH.information[:0], loop=GRAPH.loop[:0],
    )  # fmt: skip
    done = optimiser.optimise(nothing)
    np.testing.assert_allclose(done.graph.poses, GRAPH.poses, atol=1e-12)
    assert not done.improved
    assert optimiser.optimise(GRAPH).improved or isinstance(optimiser, Elch)
