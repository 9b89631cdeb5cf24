"""Neighbouring views must agree after loop closure as well as before."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np

from pose_errors import pose_error
from tofuse.engine.alignment.base import Registration
from tofuse.engine.geometry import se3
from tofuse.engine.graph.external_sensors import SensorPriors
from tofuse.engine.graph.graph import LoopRecord
from tofuse.engine.loops.loops import ClosedLoop
from tofuse.engine.loops.revisits import degraded_neighbours
from tofuse.engine.mapping.backend import BackEnd, Job
from tofuse.engine.mapping.methods import from_method
from tofuse.engine.tracking.base import Step

SIGMA = np.array([0.003] * 3 + [0.002] * 3)
SIDEWAYS = se3.exp(np.array([0.08, 0.0, 0.0, 0.0, 0.0, 0.0]))


def test_separated_neighbours_are_found_where_registrations_are_uncertain(posed_views) -> None:
    posed, truth = posed_views
    pulled = np.concatenate([truth[:3], truth[3:] @ SIDEWAYS])
    everywhere = frozenset(range(len(truth)))
    assert list(degraded_neighbours(posed, truth, pulled, everywhere)) == [(2, 3)]
    assert list(degraded_neighbours(posed, truth, pulled, frozenset({3}))) == [(2, 3)]
    assert not list(degraded_neighbours(posed, truth, pulled, everywhere - {3}))
    # A loop that repairs a pair is accepted, and so is one that changes nothing.
    assert not list(degraded_neighbours(posed, pulled, truth, everywhere))
    assert not list(degraded_neighbours(posed, truth, truth, everywhere))


def chain(posed, truth, inflation, wrong):
    """A back end whose registrations are correct, except that of the frame `wrong`."""
    entries, poses = [], {}
    information = np.diag(SIGMA**-2)
    T = np.eye(4)
    for k in range(len(truth)):
        step = Step("tracked", "", T)
        if k:
            T_before = se3.inverse(truth[k - 1]) @ truth[k]
            T_before = T_before @ SIDEWAYS if k == wrong else T_before
            T = T @ T_before
            own = information / inflation.get(k, 1.0) ** 2
            found = Registration(T_before, True, 5, 100, 100, 0.1, 0.01, own)
            factor = inflation.get(k, 1.0)
            step = Step("tracked", "", T, k - 1, found, doubtful=factor > 1, inflation=factor)
        record = SimpleNamespace(index=k, timestamp=0.1 * k, unobservable=np.zeros((0, 6)))
        entries.append(SimpleNamespace(record=record, step=step))
        poses[k] = T
    log = SimpleNamespace(posed=entries, entries=entries)
    kept = SimpleNamespace(views=SimpleNamespace(of=lambda row: posed))
    progress = SimpleNamespace(stage=lambda *_: None)
    job = Job(from_method("default"), kept, (), progress)
    return BackEnd(job, log, poses, ())


def closed(truth) -> ClosedLoop:
    record = LoopRecord(0, len(truth) - 1, True, "made")
    return ClosedLoop(record, se3.inverse(truth[0]) @ truth[-1], np.diag(SIGMA**-2))


def test_loop_gap_does_not_separate_consistent_images(posed_views) -> None:
    posed, truth = posed_views
    wrong, unusual = 2, len(truth) - 2
    loop = closed(truth)
    end = chain(posed, truth, {unusual: 100.0}, wrong)

    def moved(graph, k):
        T = se3.inverse(graph.poses[k - 1]) @ graph.poses[k]
        return np.linalg.norm((se3.inverse(T) @ se3.inverse(truth[k - 1]) @ truth[k])[:3, 3])

    # Least squares alone separates the uncertain pair, which was correct.
    plain = end._config.optimiser.optimise(end._tracked.build([loop])).graph
    assert moved(plain, unusual) > 0.07
    optimisation, confirmed = end._optimise(end._tracked.build([loop]), [loop], SensorPriors())
    assert confirmed == {unusual}
    assert moved(optimisation.graph, unusual) < 0.04
    assert moved(optimisation.graph, wrong) < moved(plain, wrong)


def test_registration_contradicted_by_images_stays_uncertain(posed_views) -> None:
    posed, truth = posed_views
    wrong = 3
    loop = closed(truth)
    end = chain(posed, truth, {wrong: 100.0}, wrong)
    optimisation, confirmed = end._optimise(end._tracked.build([loop]), [loop], SensorPriors())
    assert not confirmed
    relative = se3.inverse(optimisation.graph.poses[2]) @ optimisation.graph.poses[3]
    assert pose_error(relative, se3.inverse(truth[2]) @ truth[3])[0] < 0.005
