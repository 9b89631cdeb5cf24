"""Pairwise alignments as constraints of a global alignment (Pulli 1999)."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.errors import RegistrationError
from tofuse.engine.geometry import se3
from tofuse.engine.icp import Icp, icp_kernels, icp_parts, surface_metrics
from tofuse.engine.parts import part
from tofuse.lab.methods.compatibility import Boundary
from tofuse.lab.methods.multiview import Cloud, Pairs, RelaxationMethod, resolution_of

# Approximate number of concrete pairs per registered pair of views, and max updates of a view.
_PAIRS_PER_CONSTRAINT, _MAX_UPDATES = 200, 200


@part("refinement", "pulli", label="validated")
@dataclass(frozen=True)
class Pulli(RelaxationMethod):
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
        """See `RelaxationMethod.relax`."""
        resolution = resolution_of(clouds)
        icp = Icp(
            resolution,
            source=icp_parts.All(),
            target=icp_parts.All(),
            rejectors=(icp_parts.MaxDistance(self.reach), Boundary()),
            metric=surface_metrics.PointToPlane(),
            stopping=icp_parts.SmallStep(),
        )
        constraints = []
        ends = {(p.i, p.j) for p in pairs}
        for p in pairs:
            if p.i > p.j and (p.j, p.i) in ends:
                continue
            guess = se3.inverse(poses[p.j]) @ poses[p.i]
            try:
                registration = icp.register(
                    clouds[p.i].view, clouds[p.j].view, guess, np.random.default_rng(0)
                )
            except RegistrationError:
                continue
            sample = p.p_i[:: max(1, len(p.p_i) // _PAIRS_PER_CONSTRAINT)]
            transformed = icp_kernels.transform_points(registration.T_target_source, sample)
            constraints.append(Pairs(p.i, p.j, sample, transformed, np.full_like(sample, np.nan)))
        return distribute_errors(poses, constraints, self.tolerance * resolution)


def distribute_errors(poses: Float64, constraints: Sequence[Pairs], tolerance: float) -> Float64:
    """Align views by concrete pairs, one view at a time, until none moves by `tolerance` (m)."""
    n = len(poses)
    constraints_of: list[list[Pairs]] = [
        [c for c in constraints if k in (c.i, c.j)] for k in range(n)
    ]
    out = poses.copy()
    first = max(range(n), key=lambda k: (len(constraints_of[k]), -k))
    active, dormant = {first}, set(range(n)) - {first}
    while dormant:
        links = {k: sum(_other(c, k) in active for c in constraints_of[k]) for k in dormant}
        view = max(sorted(dormant), key=lambda k: links[k])
        dormant.remove(view)
        active.add(view)
        queue, updates = deque([view]), 0
        while queue and updates < _MAX_UPDATES * n:
            updates += 1
            k = queue.popleft()
            updated = _align_view(k, out, [c for c in constraints_of[k] if _other(c, k) in active])
            displacement = _displacement(k, out[k], updated, constraints_of[k])
            out[k] = updated
            if displacement > tolerance:
                queued = set(queue)
                neighbours = sorted({_other(c, k) for c in constraints_of[k]} & active - queued)
                queue.extend(neighbours)
    return out


def _other(pairs: Pairs, k: int) -> int:
    return pairs.j if pairs.i == k else pairs.i


def _align_view(k: int, poses: Float64, constraints: Sequence[Pairs]) -> Float64:
    """Pose (4, 4) of view k that best satisfies the constraints."""
    if not constraints:
        return np.asarray(poses[k])
    own_points = np.concatenate([c.p_i if c.i == k else c.p_j for c in constraints])
    other_points = np.concatenate(
        [
            icp_kernels.transform_points(poses[_other(c, k)], c.p_j if c.i == k else c.p_i)
            for c in constraints
        ]
    )
    a, b = own_points.mean(0), other_points.mean(0)
    R = se3.nearest_rotation((other_points - b).T @ (own_points - a))
    return se3.pose(R, b - R @ a)


def _displacement(k: int, before: Float64, after: Float64, constraints: Sequence[Pairs]) -> float:
    own_points = [c.p_i if c.i == k else c.p_j for c in constraints]
    return max(
        (
            float(
                np.abs(
                    icp_kernels.transform_points(before, p) - icp_kernels.transform_points(after, p)
                ).max()
            )
            for p in own_points
        ),
        default=0.0,
    )
