"""Normal equations of pairs of overlapping views, with correspondences found by projection.

Every pair is compared in both directions. The unknowns of a directed pair are its relative pose,
errors that the camera has in all views, and the exposure, which is eliminated. The sigmas of a
pair are estimated from its residuals.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from tofuse.engine.alignment import projective
from tofuse.engine.alignment import step_kernels as steps
from tofuse.engine.arrays import Float64, Int64, Intp
from tofuse.engine.cameras import lens
from tofuse.engine.compute import run_chunks
from tofuse.engine.compute import tukey_kernels as tukey
from tofuse.engine.geometry import se3
from tofuse.engine.stored_views import pair_equation_kernels as kernels
from tofuse.engine.stored_views import shared_error
from tofuse.engine.stored_views.pair_equation_kernels import marginalise_shared_errors
from tofuse.engine.stored_views.view_store import SampledView, by_target
from tofuse.engine.views import residual_kernels

# Pairs of a chunk, of which the equations, or the errors of patches, are computed.
_PAIRS_A_CHUNK, _DISCOUNTED_A_CHUNK = 32, 8
# Approximate number of pairs from which the disagreement of patches is estimated.
_PAIRS_SAMPLED = 200
# Residuals that an estimate of scale needs.
_MIN_COMPARED = 50
# Column of the product of two unknowns in the rows of pairs.
_PRODUCT = np.zeros((kernels.UNKNOWNS, kernels.UNKNOWNS), np.intp)
_PRODUCT[np.triu_indices(kernels.UNKNOWNS)] = np.arange(kernels.PRODUCTS, kernels.GRADIENT)
_PRODUCT = np.maximum(_PRODUCT, _PRODUCT.T)
# Exposure, and scales of distance and of albedo, before they are estimated.
_USUAL_SCALES = 0.0, 1.0, 0.1


@dataclass(frozen=True)
class Round:
    """Iterations with the same noise inflation: as in `projective.Level`."""

    iterations: int
    inflation_m: float
    photometric_inflation: float


@dataclass(frozen=True)
class RefineOptions:
    """Options of the joint alignment.

    Attributes
    ----------
    rounds
        From coarse to fine. Before each, overlaps are recomputed if any view has moved by more
        than about 2 cm or 2 degrees.
    overlap
        Smallest overlap of a pair, as a fraction of the views.
    neighbours
        Largest number of earlier partners of each view, spread evenly over those that overlap.
    points
        Approximate number of points of each view.
    photometric
        As in `ProjectiveOptions`.
    convergence
        Iterations end when no view moves by more, in units of 1 cm and 1 degree, and no error of
        the camera changes by more, in units of 1 % and 1 cm.
    error_convergence
        Where errors of the camera are estimated, iterations end as well when none of them changes
        by more twice in succession: single views that are poorly determined keep moving.
    shared
        Depth errors that the pixels of a patch share, as a multiple of the disagreement of the
        patches; 0: none. Only in the last round, between views with albedo, and where no error of
        the camera is estimated. See `shared_error`.
    """

    rounds: tuple[Round, ...] = (Round(2, 0.02, 0.1), Round(2, 0.005, 0.03), Round(5, 0.0, 0.0))
    overlap: float = 0.3
    neighbours: int = 10
    points: int = 1500
    photometric: bool = True
    convergence: float = 0.02
    error_convergence: float = 0.0
    shared: float = 1.0


@dataclass(eq=False)
class DirectedPairs:
    """Directed pairs of views, the scales of each, and its latest normal equations.

    Attributes
    ----------
    views, options
        As for `joint_alignment.refine`.
    target, source
        (P,) positions of the views.
    exposure, scale_g, scale_p
        (P,) exposure, and factors of the sigmas of distance and of albedo; a `scale_p` of 0 means
        that the albedo is not compared.
    max_scale
        (P,) largest `scale_g`.
    sources
        Points of all views.
    rows
        (P, SIZE) sums of each pair, in the order of `pair_equation_kernels`.
    sums
        (P, PATCHES, PATCH_SIZE) the same sums for each patch of the target; empty unless needed.
    """

    views: Sequence[SampledView]
    options: RefineOptions
    target: Intp
    source: Intp
    exposure: Float64
    scale_g: Float64
    scale_p: Float64
    max_scale: Float64
    sources: kernels.SourcePoints
    rows: Float64 = field(default_factory=lambda: np.zeros((0, kernels.SIZE)))
    sums: Float64 = field(default_factory=lambda: np.zeros((0, 0, kernels.PATCH_SIZE)))

    @property
    def pairs(self) -> Intp:
        """(M, 2) positions of the views i < j."""
        count = len(self.target) // 2
        return np.stack([self.target[:count], self.source[:count]], 1)

    @classmethod
    def of(
        cls,
        views: Sequence[SampledView],
        pairs: Intp,
        options: RefineOptions,
        scales: Float64 | None = None,
    ) -> DirectedPairs:
        """Return both directions of each pair (M, 2), with `scales` of `KnownScales.of`, if any."""
        target, source = _both_directions(pairs)
        max_scale = np.maximum(3.0, projective.MAX_SIGMA_M / np.array([v.sigma for v in views]))
        scales = np.tile(_USUAL_SCALES, (len(target), 1)) if scales is None else scales
        exposure, scale_g, scale_p = scales.T.copy()
        photometric = np.array([v.has_albedo for v in views]) & options.photometric
        scale_p[~(photometric[target] & photometric[source])] = 0.0
        sources = _sources(views, by_patch=options.shared > 0 and bool(photometric.any()))
        max_scale = max_scale[source]
        return cls(views, options, target, source, exposure, scale_g, scale_p, max_scale, sources)

    def subset(self, which: Intp) -> DirectedPairs:
        """Return a subset of the pairs, which is yet to be evaluated."""
        exposure, scale_g, scale_p = (column[which] for column in self._scales())
        return replace(
            self,
            target=self.target[which],
            source=self.source[which],
            exposure=exposure,
            scale_g=scale_g,
            scale_p=scale_p,
            max_scale=self.max_scale[which],
        )

    @property
    def known_scales(self) -> KnownScales:
        """The exposures and scales of the pairs."""
        return KnownScales(self.target, self.source, np.stack(self._scales(), 1))

    def with_points(self, which: Sequence[Intp]) -> DirectedPairs:
        """Return the pairs with a part of the points of each view, yet to be evaluated."""
        views = [view.with_points(kept) for view, kept in zip(self.views, which, strict=True)]
        own = self.subset(np.arange(len(self.target)))  # with exposures and scales of its own
        return replace(own, views=views, sources=_sources(views, by_patch=False))

    def put(self, which: Intp, subset: DirectedPairs) -> None:
        """Copy the exposure and scales of a subset into these pairs."""
        for scale, updated in zip(self._scales(), subset._scales(), strict=True):
            scale[which] = updated

    def _scales(self) -> tuple[Float64, Float64, Float64]:
        return self.exposure, self.scale_g, self.scale_p

    def evaluate(
        self,
        poses: Float64,
        errors: Float64,
        fixed_errors: Int64,
        stage: Round,
        *,
        by_patch: bool = False,
    ) -> None:
        """Sum the normal equations of every directed pair: replace `rows` and `sums`.

        Parameters
        ----------
        poses
            (N, 4, 4) T_world_camera.
        errors, fixed_errors
            (ERRORS,) errors of the camera, and mask: 0 for those that are estimated, else 1.
        stage
            Noise inflation.
        by_patch
            Whether to sum over patches as well, for `discount_shared`.
        """
        views = self.views
        order, targets, ends = by_target(self.target)
        target, source = self.target[order], self.source[order]
        exposure, scale_g, scale_p = (column[order] for column in self._scales())
        T_target_source = se3.inverse(poses[target]) @ poses[source]
        rows = np.empty((len(target), kernels.SIZE))
        sums = np.empty((len(rows), shared_error.PATCHES if by_patch else 0, kernels.PATCH_SIZE))

        def work(a: int, b: int) -> None:
            for first in range(a, b, kernels.TARGETS):
                last = min(first + kernels.TARGETS, b)
                used = [views[k] for k in targets[first:last]]
                images = [view.target_image for view in used]
                images += images[-1:] * (kernels.TARGETS - len(images))
                pairs = slice(ends[first], ends[last])
                kernels.target_equations(
                    self.sources,
                    source[pairs],
                    tuple(images),
                    kernels.TargetViews(
                        np.array([view.measures_range for view in used]),
                        np.array([view.target_scale for view in used]),
                        ends[first : last + 1] - ends[first],
                    ),
                    T_target_source[pairs],
                    kernels.PairResiduals(
                        exposure[pairs],
                        scale_g[pairs],
                        scale_p[pairs],
                        stage.inflation_m,
                        projective.ROBUST,
                        projective.MIN_COSINE,
                    ),
                    errors,
                    fixed_errors,
                    rows[pairs],
                    sums[pairs],
                )

        run_chunks(work, len(targets), -(-len(rows) // _PAIRS_A_CHUNK))
        # Planes fitted to mere noise can have unbounded coefficients: such pairs say nothing.
        unknown = ~(np.isfinite(rows).all(1) & np.isfinite(sums).all((1, 2)))
        rows[unknown], sums[unknown] = 0.0, 0.0
        self.rows, self.sums = np.empty_like(rows), np.empty_like(sums)
        self.rows[order], self.sums[order] = rows, sums

    @property
    def depends_on_patches(self) -> bool:
        """Whether errors that patches share are modelled.

        Only if there are photometric residuals: without them no more accurate residuals remain.
        """
        return self.options.shared > 0 and bool((self.scale_p > 0).any())

    def shared_variance(self, poses: Float64) -> tuple[Float64, float]:
        """Return the (P,) variances of depth errors that patches share, m^2, and that at growth 1.

        `poses` (N, 4, 4) are those of the last `evaluate` with `by_patch`. See `shared_error`.
        """
        variance = np.zeros(len(self.target))
        photometric = np.flatnonzero(self.scale_p > 0)
        T = se3.inverse(poses[self.target[photometric]]) @ poses[self.source[photometric]]
        depth = np.array([v.depth for v in self.views])[self.target[photometric]]
        growth = shared_error.growth(depth, se3.angle(T), np.linalg.norm(T[:, :3, 3], axis=1))
        # Views of one recording come from one camera: their patches are correlated in the same way.
        correlation = shared_error.patch_correlation(self.views[0].shape)
        sampled_rows = np.arange(0, len(photometric), -(-len(photometric) // _PAIRS_SAMPLED))
        sampled = photometric[sampled_rows]
        disagreement = shared_error.disagreement(
            self.sums[sampled], self.rows[sampled], correlation
        )
        at_growth_1 = self.options.shared**2 * disagreement.variance(growth[sampled_rows])
        variance[photometric] = at_growth_1 * growth
        return variance, at_growth_1

    def discount_shared(self, variance: Float64) -> None:
        """Remove what errors explain that patches share, from the equations and the residuals.

        `variance` (P,) is that of `shared_variance`, after an `evaluate` with `by_patch`.
        """
        correlation = shared_error.patch_correlation(self.views[0].shape)
        pairs = np.flatnonzero(variance)

        def work(a: int, b: int) -> None:
            marginalise_shared_errors(
                self.sums,
                correlation,
                variance[pairs[a:b]],
                pairs[a:b],
                projective.ROBUST,
                self.rows,
            )

        run_chunks(work, len(pairs), -(-len(pairs) // _DISCOUNTED_A_CHUNK))

    def without_exposure(self, errors: Sequence[int] = ()) -> tuple[Float64, Float64]:
        """Return normal equations of pairs without their exposure, which is eliminated and updated.

        Parameters
        ----------
        errors
            E errors of the camera, by their number in `kernels`.

        Returns
        -------
        (P, 6 + E, 6 + E) matrices and (P, 6 + E) gradients, of the right perturbation of
        T_target_source and these errors.
        """
        kept = np.array([*range(6), *(7 + k for k in errors)], np.intp)
        rows, e = self.rows, kernels.EXPOSURE
        pivot = np.maximum(rows[:, _PRODUCT[e, e]], 1e-9)
        gradient = rows[:, kernels.GRADIENT + e]
        self.exposure -= np.clip(gradient / pivot, -0.3, 0.3)
        coupling = rows[:, _PRODUCT[kept, e]]
        ratio = coupling / pivot[:, None]
        H = rows[:, _PRODUCT[np.ix_(kept, kept)]] - ratio[:, :, None] * coupling[:, None]
        return H, rows[:, kernels.GRADIENT + kept] - ratio * gradient[:, None]

    def rescale(self, stage: Round) -> None:
        """Estimate the sigmas of each pair from its residuals, as the tracker does."""
        counts = np.ascontiguousarray(self.rows[:, kernels.HISTOGRAM :])
        enough = counts.sum(1) >= _MIN_COMPARED
        distance_scale = np.empty(len(counts))
        steps.scales_of_distances(counts, distance_scale)
        self.scale_g[enough] = np.clip(distance_scale, 0.7, self.max_scale)[enough]
        weight = self.rows[:, kernels.WEIGHT_P]
        mean_square = self.rows[:, kernels.SQUARES_P] / np.maximum(weight, 1e-9)
        albedo_scale = np.sqrt(mean_square / tukey.consistency(projective.ROBUST))
        used = (weight > 0) & (self.scale_p > 0)
        scale = np.clip(np.hypot(albedo_scale, stage.photometric_inflation), 0.005, 0.5)
        self.scale_p[used] = scale[used]


@dataclass(frozen=True, eq=False)
class KnownScales:
    """Exposures and scales of directed pairs from an alignment, with which another one begins.

    Attributes
    ----------
    target, source
        (P,) positions of the views.
    scales
        (P, 3) exposure, `scale_g` and `scale_p` of `DirectedPairs`.
    """

    target: Intp
    source: Intp
    scales: Float64

    def of(self, pairs: Intp) -> Float64:
        """(2 M, 3) those of both directions of pairs (M, 2); usual ones where they are unknown."""
        target, source = _both_directions(pairs)
        scales = np.tile(_USUAL_SCALES, (len(target), 1))
        row = {ts: k for k, ts in enumerate(zip(self.target, self.source, strict=True))}
        rows = np.array([row.get(ts, -1) for ts in zip(target, source, strict=True)], np.intp)
        scales[rows >= 0] = self.scales[rows[rows >= 0]]
        return scales


def _both_directions(pairs: Intp) -> tuple[Intp, Intp]:
    """Return the targets and sources (2 M,) of pairs (M, 2), first of all (i, j), then (j, i)."""
    i, j = pairs.T
    return np.concatenate([i, j]), np.concatenate([j, i])


def _sources(views: Sequence[SampledView], *, by_patch: bool) -> kernels.SourcePoints:
    """Concatenated points of all views; a view that occurs several times is stored once."""
    unique = {id(v): v for v in views}
    row = {key: k for k, key in enumerate(unique)}
    row_of_view = np.array([row[id(v)] for v in views], np.intp)
    points = [
        np.zeros((0, residual_kernels.POINT_SIZE), np.float32),
        *(v.points for v in unique.values()),
    ]
    patches = [v.patches for v in unique.values()] if by_patch else []
    offsets = np.cumsum([len(p) for p in points])
    return kernels.SourcePoints(
        np.concatenate(points),
        np.concatenate([np.zeros(0, np.int64), *patches]),
        offsets[row_of_view],
        offsets[row_of_view + 1],
        np.array([v.measures_range for v in views], np.bool_),
        # Views of one recording come from one camera.
        views[0].projection.lens if views else lens.UNDISTORTED,
    )
