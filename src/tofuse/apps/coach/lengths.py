"""How well the distance of two points of a model is known.

Errors of the poses move a point with the keyframes that saw it, so that two points in the same
views share them: what counts is the joint covariance of the keyframes of both. Errors of the camera
deform what each view sees, and that of the depth scale stretches everything. The noise of the
surface is added at both ends.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Self

import numpy as np
from scipy.special import stdtrit

from tofuse.apps.coach.known import Known
from tofuse.engine.arrays import Float32, Float64, UInt8
from tofuse.engine.geometry import KdTree, se3
from tofuse.engine.results import Reconstruction


@dataclass(frozen=True, eq=False)
class LengthErrors:
    """What the errors of lengths in a model follow from.

    Attributes
    ----------
    points
        (P, 3) of its surfaces, in the world.
    weights
        (P, K) of the keyframes that saw each, up to a factor.
    poses
        (K, 4, 4).
    covariance
        (6K, 6K) of small motions of the keyframes in the world, about `centre`.
    """

    points: Float64
    weights: Float64
    poses: Float64
    covariance: Float64
    centre: Float64
    by_cov: float

    @classmethod
    def of(cls, result: Reconstruction, rays: Float64 | None = None) -> Self | None:
        known = Known.of_result(result, rays)
        if known is None:
            return None
        W = known.seen.pixels.T.astype(float)
        seen = W.any(1)
        C = known.covariance
        P = known._to_positions
        return cls(
            known.surfaces.points[seen].astype(float),
            W[seen] / W[seen].sum(1, keepdims=True),
            known.poses,
            C,
            known.centre,
            float(np.trace(P @ C @ P.T)) / len(known.poses),
        )

    def parts(self, a: Float64, b: Float64):
        a = a - self.centre
        b = b - self.centre
        L = np.linalg.norm(a - b, axis=1)
        e = (a - b) / L[:, None]
        tree = KdTree(self.points)
        out = []
        hs = []
        foc = []
        off = []
        K = len(self.poses)
        R = self.poses[:, :3, :3]
        t = self.poses[:, :3, 3]
        for p in (a, b):
            k, _ = tree.nearest(p)
            w = self.weights[k]
            row = np.concatenate([e, np.cross(p, e)], 1)
            hs.append(w[:, :, None] * row[:, None])
            d = p[:, None] - t
            z = np.einsum("nki,ki->nk", d, R[:, :, 2])
            lat = d - z[..., None] * R[:, :, 2]
            foc.append(np.einsum("nk,nki,ni->n", w, lat, e))
            off.append(
                np.einsum("nk,nki,ni->n", w, d / np.linalg.norm(d, axis=2, keepdims=True), e)
            )
        h = (hs[0] - hs[1]).reshape(len(a), -1)
        pose = np.einsum("ni,ij,nj->n", h, self.covariance, h)
        return L, pose, foc[0] - foc[1], off[0] - off[1]
