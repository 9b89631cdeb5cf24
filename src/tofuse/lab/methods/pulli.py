"""Pairwise alignments as constraints of a global alignment (Pulli 1999)."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tofuse.arrays import Float64
from tofuse.errors import RegistrationError
from tofuse.geometry import se3
from tofuse.kernels.icp import transform_points
from tofuse.lab.methods.compatibility import Boundary
from tofuse.lab.methods.multiview import Cloud, Pairs, Relaxing, resolution_of, rotation_to
from tofuse.parts import part
from tofuse.registration.icp import Icp
from tofuse.registration.rejectors import MaxDistance
from tofuse.registration.selectors import All
from tofuse.registration.stopping import SmallStep
from tofuse.registration.surface_metrics import PointToPlane

# Points that represent a pair's alignment, and max updates of a view.
_MATES, _TURNS = 200, 200


@part("refinement", "pulli", label="validated")
@dataclass(frozen=True)
class Pulli(Relaxing):
    """Registers overlapping views pairwise, once; then distributes the residual errors.

    The alignment of a pair is stored as *concrete pairs*: points of one view and their transformed
    positions in the other. These are the constraints of the second phase, which uses no surfaces
    and so can't converge to a wrong match. It starts with the view of the most constraints, adds
    the dormant view with the most links to the active ones, and aligns it with them in closed form;
    a view that moved by more than the tolerance queues its neighbours, until the queue is empty.
    The error is distributed evenly over all pairs (section 4).

    Attributes
    ----------
    rounds
        One: the pairs are the registered ones.
    tolerance
        Motion of a view above which its neighbours are updated, in resolutions.
    """

    rounds: int = 1
    tolerance: float = 1e-3

    def relax(self, poses: Float64, pairs: Sequence[Pairs], clouds: Sequence[Cloud]) -> Float64:
        """See `Relaxing.relax`."""
        unit = resolution_of(clouds)
        icp = Icp(
            unit,
            source=All(),
            target=All(),
            rejectors=(MaxDistance(self.reach), Boundary()),
            metric=PointToPlane(),
            stopping=SmallStep(),
        )
        mates = []
        for p in pairs:
            if p.i > p.j:
                continue
            guess = se3.inverse(poses[p.j]) @ poses[p.i]
            try:
                found = icp.register(
                    clouds[p.i].view, clouds[p.j].view, guess, np.random.default_rng(0)
                )
            except RegistrationError:
                continue
            some = p.p_i[:: max(1, len(p.p_i) // _MATES)]
            there = transform_points(found.T_target_source, some)
            mates.append(Pairs(p.i, p.j, some, there, np.full_like(some, np.nan)))
        return spread(poses, mates, self.tolerance * unit)


def spread(poses: Float64, mates: Sequence[Pairs], tolerance: float) -> Float64:
    """Align views by concrete pairs, one view at a time, until none moves by `tolerance` (m)."""
    n = len(poses)
    of: list[list[Pairs]] = [[m for m in mates if k in (m.i, m.j)] for k in range(n)]
    out = poses.copy()
    first = max(range(n), key=lambda k: (len(of[k]), -k))
    active, dormant = {first}, set(range(n)) - {first}
    while dormant:
        links = {k: sum(_other(m, k) in active for m in of[k]) for k in dormant}
        view = max(sorted(dormant), key=lambda k: links[k])
        dormant.remove(view)
        active.add(view)
        queue, turns = deque([view]), 0
        while queue and turns < _TURNS * n:
            turns += 1
            k = queue.popleft()
            moved = _aligned(k, out, [m for m in of[k] if _other(m, k) in active])
            shift = _shift(k, out[k], moved, of[k])
            out[k] = moved
            if shift > tolerance:
                waiting = set(queue)
                neighbours = sorted({_other(m, k) for m in of[k]} & active - waiting)
                queue.extend(neighbours)
    return out


def _other(mates: Pairs, k: int) -> int:
    return mates.j if mates.i == k else mates.i


def _aligned(k: int, poses: Float64, mates: Sequence[Pairs]) -> Float64:
    """Pose (4, 4) of view k that best aligns its points with their mates."""
    if not mates:
        return np.asarray(poses[k])
    own = np.concatenate([m.p_i if m.i == k else m.p_j for m in mates])
    there = np.concatenate(
        [transform_points(poses[_other(m, k)], m.p_j if m.i == k else m.p_i) for m in mates]
    )
    a, b = own.mean(0), there.mean(0)
    T = np.eye(4)
    T[:3, :3] = rotation_to((own - a).T @ (there - b))
    T[:3, 3] = b - T[:3, :3] @ a
    return T


def _shift(k: int, before: Float64, after: Float64, mates: Sequence[Pairs]) -> float:
    own = [m.p_i if m.i == k else m.p_j for m in mates]
    return max(
        (
            float(np.abs(transform_points(before, p) - transform_points(after, p)).max())
            for p in own
        ),
        default=0.0,
    )
