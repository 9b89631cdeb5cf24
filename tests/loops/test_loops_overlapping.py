"""Loops between clouds that overlap, many steps apart."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pytest

from tofuse.engine.alignment.base import Registration
from tofuse.engine.frames.frames import CloudFrame
from tofuse.engine.geometry import se3
from tofuse.engine.loops.loops import Confirmation, PriorLoop
from tofuse.engine.loops.overlapping import Overlapping
from tofuse.engine.stored_views.view_store import Spacing, ViewStore

VIEWS, ARC = 16, 0.7  # of a turntable; half of the angle that a view shows, rad


def turntable(size=1.0):
    """Views of a can that turns once, each in a frame of its own, and their poses."""
    rng = np.random.default_rng(0)
    angle, height = rng.uniform(-np.pi, np.pi, 30_000), rng.uniform(0, 1, 30_000)
    can = size * np.stack([np.cos(angle), np.sin(angle), height], 1)
    clouds, poses = [], {}
    for k, middle in enumerate(np.linspace(0, 2 * np.pi, VIEWS, endpoint=False)):
        seen = np.abs(np.angle(np.exp(1j * (angle - middle)))) < ARC
        poses[k] = se3.exp([*size * rng.normal(size=3), *rng.normal(size=3)])
        clouds.append(CloudFrame(k, float(k), se3.transform(se3.inverse(poses[k]), can[seen])))
    return clouds, poses


@dataclass(frozen=True)
class Scripted:
    """Registers by the guess; what it believes of frames (i, j) is given."""

    believes: bool
    tried: list = field(default_factory=list)

    def register(self, source, target, guess, rng):
        self.tried.append((target.index, source.index))
        found = Registration(guess, True, 5, 80, 100, 0.2, 0.01, np.eye(6))
        return replace(found, believed=self.believes, reason="" if self.believes else "ambiguous")


def closed(registrar, clouds, poses, given=()):
    """Loops between clouds; those without a pose are lost."""
    confirmation = Confirmation((registrar,))
    detector = Overlapping(confirmation=confirmation).start(0, given, ViewStore(Spacing()))
    for cloud in clouds:
        if cloud.index in poses:
            detector.push(cloud, poses[cloud.index])
    return detector.finish(poses, {})


@pytest.mark.parametrize("size", [0.01, 1.0, 1000.0])
def test_turntable_is_closed_once_whatever_its_size(size):
    """The first and the last view overlap most of those many steps apart; no other is needed."""
    registrar = Scripted(believes=True)
    [loop] = closed(registrar, *turntable(size))
    assert (loop.record.i, loop.record.j, loop.record.accepted) == (0, VIEWS - 1, True)


def test_path_that_does_not_return_has_no_candidates():
    clouds, poses = turntable()
    registrar = Scripted(believes=True)
    assert closed(registrar, clouds, {k: poses[k] for k in range(10)}) == []
    assert registrar.tried == []


@pytest.mark.parametrize("first", range(0, 20, 3))
@pytest.mark.parametrize("steps", [6, 7])
def test_loops_span_seven_steps_wherever_they_are(first, steps):
    """Only two of the views are at the same place."""
    [cloud, *_], _ = turntable()
    views = [replace(cloud, index=k) for k in range(30)]
    places = {k: first if k == first + steps else k for k in range(30)}
    poses = {k: se3.translation([10.0 * place, 0, 0]) for k, place in places.items()}
    registrar = Scripted(believes=True)
    closed(registrar, views, poses)
    assert registrar.tried == ([(first, first + steps)] if steps == 7 else [])


def test_rejected_candidates_are_few():
    registrar = Scripted(believes=False)
    loops = closed(registrar, *turntable())
    assert 1 < len(registrar.tried) <= 3
    assert not any(loop.record.accepted for loop in loops)


def test_given_loops_count_and_lost_views_are_left_out():
    clouds, poses = turntable()
    registrar = Scripted(believes=True)
    by_hand = se3.inverse(poses[1]) @ poses[15]
    given = [PriorLoop(1, 15, by_hand), PriorLoop(0, 14)]
    del poses[0]
    found = closed(registrar, clouds, poses, given)
    pairs = {(loop.record.i, loop.record.j): loop.record for loop in found}
    assert pairs[1, 15].reason == "given with its motion"
    assert pairs[0, 14].reason == "frame 0 has no pose"
    assert registrar.tried == []
