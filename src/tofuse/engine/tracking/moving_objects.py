"""Segmentation of moving objects, from views whose poses are known.

A point that lies in the free space of another view has moved there; a surface that lies in the
free space of a later view has moved away. Either contradicts a static scene by a likelihood ratio,
see `moving_object_kernels`. The log-odds of each pixel accumulate over frames and are propagated
with the motion of the camera, and connected pixels are segmented with hysteresis.
Occlusion and disocclusion by the foreground are no evidence: no free space was observed there.

The static scene is consistent with the given poses. A wrong pose makes views disagree as well:
`Moving` states how well the rest of the view agrees, and a pair of views updates the log-odds only
if at least `_MIN_AGREEMENT` of it does.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from dataclasses import dataclass, replace

import cv2
import numpy as np

from tofuse.engine.arrays import Bool, Float32, Float64, UInt8
from tofuse.engine.compute import median, run_chunks
from tofuse.engine.connections import NEIGHBOURS
from tofuse.engine.frames import RangeFrame
from tofuse.engine.geometry import se3
from tofuse.engine.tracking import moving_object_kernels as kernels
from tofuse.engine.views import PreparedView

# The image is divided into cells of n x n pixels, in at most this number of columns; one pixel of
# each is compared.
_COLUMNS = 112
# Factor per frame of the difference of the log-odds from their prior: evidence decays.
_DECAY = 0.95
# Log-odds beyond which a pixel is segmented, and beyond which it is if connected to such a pixel.
# An isolated pixel needs two frames with full evidence to reach the first.
_DETECT, _EXTEND = 1.5, -0.5
# Log-odds of all pixels of a segment.
_CORE = _DETECT + 0.5 * kernels.MAX_EVIDENCE
# Fraction of the pixels of a segment that must be beyond `_DETECT`, and the smallest segment, as a
# fraction of the image.
_MIN_CORE, _MIN_SIZE = 0.25, 0.004
# Minimum fraction of the comparisons outside of the mask that agree, for a pair of views to be
# evidence of motion. Below, a wrong pose is as likely.
_MIN_AGREEMENT = 0.5
# Disagreement outside of the objects, as a fraction of their size, up to which they explain it.
_SCATTERED = 0.1
# Moving fraction of a view above which the static rest is realigned, and the mask reported.
MIN_MOVING_FRACTION = 0.01
# Number of reference views whose log-odds are kept.
_MAX_REFERENCES = 40
# Rows of cells of a chunk; fixed, so that the result does not depend on the number of threads.
_CHUNK_ROWS = 60
# Every n-th cell is used to estimate the scale of the residuals.
_SCALE_EVERY = 2
# Robust scale of up to half outliers: iterations, cut-off in sigmas, and the median of the absolute
# values of a normal distribution within the cut-off.
_SCALE_ITERATIONS, _SCALE_CUT, _TRUNCATED_MEDIAN = 5, 3.0, 0.6724
_LOWER_QUARTILE = 0.3186  # of the absolute values of a normal distribution
_MIN_RESIDUALS = 50
# The scale is that of the pair, but at most this multiple of the median of recent ones: errors of a
# wrong pose must not be taken for noise.
_SCALE_WINDOW, _MAX_SCALE_RATIO = 31, 3.0
_NEIGHBOURS = np.ones((3, 3), np.uint8)


@dataclass(frozen=True, eq=False)
class _LastView:
    """The previous view, its pose, and its cells."""

    view: PreparedView
    T_world_camera: Float64
    cells: kernels.Cells


@dataclass(frozen=True, eq=False)
class PairUpdate:
    """Updated cells of both views of a pair, and the scale of its residuals if it is reliable."""

    last: _LastView
    reference: int
    cells: kernels.Cells
    scale: float | None


@dataclass(frozen=True, eq=False)
class Moving:
    """Segmentation of a pair of views, and how well the rest of them agrees.

    Attributes
    ----------
    view
        (H, W) pixels of the view that moved.
    reference
        (H, W) pixels of the reference whose surface has moved since, or moved already.
    fraction
        Moving pixels among the valid ones of the view.
    compared
        Number of conclusive comparisons in both directions (they agree, or one view sees through a
        surface of the other), outside of the masks.
    agreement
        Fraction of these that agree; 0 without any. Low after masking: the pose is wrong, or
        moving objects are not segmented yet.
    scale
        Robust scale of the residuals outside of the previous mask, in sigmas of noise and
        systematic errors.
    reliable
        Whether the pair agreed enough for its disagreements to be counted as motion. If not, the
        masks are propagated from earlier frames.
    pair_update
        What `MovingObjects.update` stores.
    """

    view: Bool
    reference: Bool
    fraction: float
    compared: int
    agreement: float
    scale: float
    reliable: bool
    pair_update: PairUpdate

    @property
    def explains_disagreement(self) -> bool:
        """Whether the views disagree where objects are, and hardly elsewhere.

        Smoothed depth, and a pose that is wrong, disagree all over the image.
        """
        return self.reliable and 1 - self.agreement <= _SCATTERED * self.fraction

    def applied(self, view: PreparedView) -> PreparedView:
        """Return the view without its pixels that moved."""
        return without_pixels(view, self.view)

    def applied_to_reference(self, reference: PreparedView) -> PreparedView:
        """Return the reference without its pixels that moved."""
        return without_pixels(reference, self.reference)


def without_pixels(view: PreparedView, mask: Bool) -> PreparedView:
    """Return a view that has no surface at some pixels: no plane, no albedo, no noise.

    Their depth stays, as the ray is free up to it; its sigma is 0, "unknown", so that it does not
    become a surface again.

    Parameters
    ----------
    view
        The view, which is not changed.
    mask
        (H, W) pixels to exclude.
    """
    if mask.shape != view.z.shape:
        raise ValueError(f"the mask is {mask.shape}, the view {view.z.shape}")
    if not mask.any():
        return view
    keep = ~mask
    pixel_variance = view.pixel_variance
    return replace(
        view,
        sigma=view.sigma * keep,
        planes=view.planes * keep[..., None],
        plane_variance=view.plane_variance * keep,
        albedo=np.where(keep[..., None], view.albedo, np.float32(np.nan))
        if view.has_albedo
        else view.albedo,
        pixel_variance=None if pixel_variance is None else pixel_variance * keep,
    )


def at_size(mask: Bool, frame: RangeFrame) -> Bool:
    """Return the mask of a prepared view at the size of the frame's image."""
    rows, columns = frame.valid.shape
    step = columns // mask.shape[1]
    large = mask.repeat(step, 0).repeat(step, 1)
    out = np.zeros((rows, columns), np.bool_)
    out[: large.shape[0], : large.shape[1]] = large[:rows, :columns]
    return out


class MovingObjects:
    """Segments moving objects, from views whose poses relative to keyframes are known.

    Before a view is aligned, exclude `predicted_mask` from it and `reference_mask` from the
    keyframe; afterwards `compare` both, and `update` with the result. Where the masks are much
    larger than those (an object just began to move), realign without them: they are right before
    the pose is. `compare` takes unmasked views. References are identified by their
    `PreparedView.index`; one that was the last view keeps its cells.

    Parameters
    ----------
    max_references
        Number of reference views whose log-odds are kept.

    Attributes
    ----------
    in_last_view
        Whether objects moved in the last view.
    """

    def __init__(self, max_references: int = _MAX_REFERENCES) -> None:
        self._max_references = max_references
        self.in_last_view = False
        self._last: _LastView | None = None
        self._references: OrderedDict[int, kernels.Cells] = OrderedDict()
        self._scales: deque[float] = deque(maxlen=_SCALE_WINDOW)

    @property
    def typical_scale(self) -> float:
        """Typical scale of the residuals of recent pairs, in sigmas; at least 1."""
        return max(median(np.array(self._scales)), 1.0) if self._scales else 1.0

    def reset(self) -> None:
        """Forget the last view, as the camera was lost after it; references are kept."""
        self._last, self.in_last_view = None, False

    def predicted_mask(self, T_world_camera_predicted: Float64, view: PreparedView) -> Bool:
        """Return the (H, W) pixels of an unaligned view that belong to the last view's mask.

        An object is assumed to be nearly where it was, in the scene or in front of the camera: the
        mask is dilated, and limited to surfaces of about its depth.

        Parameters
        ----------
        T_world_camera_predicted
            (4, 4) predicted pose of the view.
        view
            The view, which is not changed.
        """
        last = self._last
        shape = view.z.shape
        if last is None or not last.cells.moving.any():
            return np.zeros(shape, np.bool_)
        stride = stride_of(view)
        moving = np.empty(_cell_shape(shape, stride), np.bool_)
        T = np.ascontiguousarray(se3.inverse(last.T_world_camera) @ T_world_camera_predicted)
        kernels.predict(_sampled(view), _sampled(last.view), last.cells, T, moving)
        return _pixels(moving, shape, stride)

    def reference_mask(self, reference: PreparedView) -> Bool:
        """Return the (H, W) pixels of a keyframe whose surface has moved."""
        return _pixels(self._reference(reference).moving, reference.z.shape, stride_of(reference))

    def none_in(self, reference: PreparedView) -> bool:
        """Whether nothing moves in a keyframe that views were compared with."""
        cells = self._references.get(reference.index)
        return cells is not None and not cells.moving.any()

    def compare(
        self,
        view: PreparedView,
        T_world_camera: Float64,
        reference: PreparedView,
        T_world_reference: Float64,
        *,
        suspected: bool = False,
    ) -> Moving:
        """Segment a view that was aligned with a keyframe, and the keyframe; the state stays.

        Parameters
        ----------
        view, T_world_camera
            The view and its (4, 4) pose.
        reference, T_world_reference
            The keyframe and its (4, 4) pose.
        suspected
            Whether motion is suspected, as the views conflict: then pixels are segmented if they
            move more likely than not, for which the evidence of one frame is enough.
        """
        cells, arrived = self._propagated(view, T_world_camera)
        reference_cells = self._reference(reference)
        T_reference_view = np.ascontiguousarray(se3.inverse(T_world_reference) @ T_world_camera)
        ratios = kernels.residual_ratios(
            _sampled(view), cells.moving, _SCALE_EVERY, _sampled(reference), T_reference_view
        )
        scale = _robust_scale(ratios)
        typical_scale = median(np.array(self._scales)) if self._scales else scale
        # The noise may be underestimated, but not overestimated.
        clipped_scale = max(1.0, min(scale, _MAX_SCALE_RATIO * max(typical_scale, 1.0)))
        outcome, evidence = compared(
            view, reference, reference_cells.moving, T_reference_view, clipped_scale
        )
        T_view_reference = np.ascontiguousarray(se3.inverse(T_reference_view))
        reference_outcome, reference_evidence = compared(
            reference, view, cells.moving, T_view_reference, clipped_scale
        )

        pair = ((outcome, cells), (reference_outcome, reference_cells))
        # What is near fills many cells: its surface is small.
        counts_before = np.sum([_counts(seen, c.moving) for seen, c in pair], axis=0)
        area_before = np.sum([_counts(seen, c.moving, c.depth) for seen, c in pair], axis=0)
        reliable = any(
            bool(total[0] >= _MIN_AGREEMENT * total.sum() and total[0] > 0)
            for total in (counts_before, area_before)
        )
        tracked = cells.tracked
        if reliable:
            # Surfaces behind the reference were disoccluded, unless they were tracked from there.
            was_moving = (tracked > 0) | (cells.odds > _EXTEND)
            evidence[(outcome == kernels.BEHIND) & ~was_moving] = 0
            reference_evidence[reference_outcome == kernels.BEHIND] = 0
            # The last view observed free space there; the reference adds evidence only if in front.
            arrived_only = arrived & (outcome != kernels.IN_FRONT)
            evidence[arrived_only] += np.float32(kernels.MAX_EVIDENCE)
            cells = self._updated(cells, evidence)
            reference_cells = self._updated(reference_cells, reference_evidence)
            tracked = np.where(outcome == kernels.AGREES, np.uint8(1), tracked)
        else:
            evidence, reference_evidence = cells.odds, reference_cells.odds
        detect = 0.0 if suspected else _DETECT
        cells = self._segmented(cells._replace(tracked=tracked), evidence, detect)
        reference_cells = self._segmented(reference_cells, reference_evidence, detect)
        counts = _counts(outcome, cells.moving) + _counts(reference_outcome, reference_cells.moving)
        mask = _pixels(cells.moving, view.z.shape, stride_of(view))
        valid = view.z > 0
        return Moving(
            view=mask,
            reference=_pixels(reference_cells.moving, reference.z.shape, stride_of(reference)),
            fraction=_fraction(mask & valid, valid),
            compared=int(counts.sum()),
            agreement=float(counts[0] / max(counts.sum(), 1)),
            scale=scale,
            reliable=reliable,
            pair_update=PairUpdate(
                _LastView(view, T_world_camera, cells),
                reference.index,
                reference_cells,
                scale if reliable else None,
            ),
        )

    def with_cells(self, moving: Moving, more: Bool) -> Moving:
        """Return a segmentation in which more cells (rows, columns) of the view move."""
        pair, stride = moving.pair_update, stride_of(moving.pair_update.last.view)
        view, cells = pair.last.view, pair.last.cells
        odds = np.where(more, np.maximum(cells.odds, np.float32(_CORE)), cells.odds)
        cells = cells._replace(odds=odds, moving=cells.moving | more)
        mask, valid = _pixels(cells.moving, view.z.shape, stride), view.z > 0
        return replace(
            moving,
            view=mask,
            fraction=_fraction(mask & valid, valid),
            pair_update=replace(pair, last=replace(pair.last, cells=cells)),
        )

    def update(self, moving: Moving) -> None:
        """Update the state with the result of `compare` for the accepted pose."""
        pair = moving.pair_update
        self._last, self.in_last_view = pair.last, moving.fraction > 0
        self._store(pair.reference, pair.cells)
        if pair.scale is not None:
            self._scales.append(pair.scale)

    def _reference(self, reference: PreparedView) -> kernels.Cells:
        """Return the cells of a reference so far."""
        shape = _cell_shape(reference.z.shape, stride_of(reference))
        cells = self._references.get(reference.index)
        if cells is None and self._last is not None and self._last.view.index == reference.index:
            cells = self._last.cells
        if cells is None or cells.odds.shape != shape:
            stride = stride_of(reference)
            depth = np.ascontiguousarray(reference.z[::stride, ::stride])
            odds = np.full(shape, kernels.PRIOR_ODDS, np.float32)
            cells = kernels.Cells(depth, odds, np.zeros(shape, np.bool_), np.zeros(shape, np.uint8))
        return cells

    def _store(self, index: int, cells: kernels.Cells) -> None:
        self._references[index] = cells
        self._references.move_to_end(index)
        while len(self._references) > self._max_references:
            self._references.popitem(last=False)

    def _propagated(
        self, view: PreparedView, T_world_camera: Float64
    ) -> tuple[kernels.Cells, Bool]:
        """Propagate the cells of the last view to this one; and return which surfaces are new."""
        last, stride = self._last, stride_of(view)
        shape = _cell_shape(view.z.shape, stride)
        depth, odds = np.empty(shape, np.float32), np.empty(shape, np.float32)
        tracked, arrived = np.empty(shape, np.uint8), np.empty(shape, np.bool_)
        if last is None:
            T, previous = np.eye(4), view
            cells = kernels.Cells(
                np.zeros(shape, np.float32), odds, np.zeros(shape, np.bool_), tracked
            )
        else:
            T, previous = se3.inverse(last.T_world_camera) @ T_world_camera, last.view
            cells = last.cells
        T = np.ascontiguousarray(T)
        # At the rim of the tracked region a cell may belong to an adjacent surface.
        inner = np.asarray(cv2.erode(cells.tracked, _NEIGHBOURS), np.uint8)
        last_cells = cells._replace(tracked=inner)
        sampled, sampled_previous = _sampled(view), _sampled(previous)

        def work(a: int, b: int) -> None:
            kernels.propagate(
                sampled, sampled_previous, last_cells, T,
                depth, odds, tracked, arrived, a, b,
            )  # fmt: skip

        run_chunks(work, shape[0], max(1, shape[0] // _CHUNK_ROWS))
        return kernels.Cells(depth, odds, odds > _DETECT, tracked), arrived

    def _updated(self, cells: kernels.Cells, evidence: Float32) -> kernels.Cells:
        """Add the evidence of a pair of views."""
        prior = np.float32(kernels.PRIOR_ODDS)
        odds = prior + np.float32(_DECAY) * (cells.odds - prior) + evidence
        max_odds = _DETECT + 2 * kernels.MAX_EVIDENCE
        return cells._replace(odds=np.clip(odds, 2 * prior, max_odds).astype(np.float32))

    def _segmented(self, cells: kernels.Cells, evidence: Float32, detect: float) -> kernels.Cells:
        """Segment cells with hysteresis.

        `evidence` is that of this frame: segments are not extended over cells that agree in it.
        """
        odds, depth = cells.odds, cells.depth
        certain = odds > detect
        unsegmented = cells._replace(moving=np.zeros(odds.shape, np.bool_))
        if not certain.any():
            return unsegmented
        likely = (odds > _EXTEND).view(np.uint8)
        likely = np.asarray(cv2.morphologyEx(likely, cv2.MORPH_OPEN, _NEIGHBOURS), np.uint8)
        count, labels, stats, _ = cv2.connectedComponentsWithStats(likely, connectivity=4)
        sizes = stats[:, cv2.CC_STAT_AREA]
        core = np.bincount(labels[certain], minlength=count)
        kept = (core >= _MIN_CORE * sizes) & (sizes >= _MIN_SIZE * odds.size)
        kept[0] = False
        if not kept.any():
            return unsegmented
        moving = self._completed(kept[labels], depth)
        # All of a segment moves as likely as its core, unless this frame shows that it is static.
        odds = np.where(moving & (evidence >= 0), np.maximum(odds, np.float32(_CORE)), odds)
        # Comparisons at the outline are inconclusive. One more cell mixes both surfaces; the next
        # is the object's if it is at the same depth.
        near_depth = cv2.dilate(np.where(moving, depth, np.float32(0)), _NEIGHBOURS, iterations=2)
        dilated = cv2.dilate(moving.view(np.uint8), _NEIGHBOURS) > 0
        dilated |= (near_depth > 0) & (
            np.abs(near_depth - depth) <= np.float32(kernels.MAX_MOTION) * near_depth
        )
        moving = moving | (dilated & (evidence >= 0) & (odds >= kernels.PRIOR_ODDS))
        return cells._replace(odds=odds, moving=moving)

    def _completed(self, moving: Bool, depth: Float32) -> Bool:
        """Complete the mask on surfaces of which more than half moves.

        Where an object still overlaps itself, it agrees with the reference.
        """
        jump = np.float32(0.5 * kernels.EDGE_JUMP)
        interior = depth > 0
        for a, b in NEIGHBOURS:
            interior[a] &= np.abs(depth[a] - depth[b]) <= jump * depth[b]
        count, labels = cv2.connectedComponents(interior.view(np.uint8), connectivity=4)
        sizes = np.bincount(labels.ravel(), minlength=count)
        moving_count = np.bincount(labels[moving], minlength=count)
        majority = 2 * moving_count > sizes
        majority[0] = False
        return np.asarray(moving | majority[labels], np.bool_)


def compared(
    view: PreparedView, other: PreparedView, other_moving: Bool, T_other_view: Float64, scale: float
) -> tuple[UInt8, Float32]:
    """Return outcomes and log-likelihood ratios of the cells of a view, against another one.

    Parameters
    ----------
    view, other
        The view, and the one it is compared with.
    other_moving
        Cells of the other view that are known to move.
    T_other_view
        (4, 4).
    scale
        Factor of the sigmas.
    """
    shape = _cell_shape(view.z.shape, stride_of(view))
    sampled, sampled_other = _sampled(view), _sampled(other)
    outcome, llr = np.empty(shape, np.uint8), np.empty(shape, np.float32)

    def work(a: int, b: int) -> None:
        kernels.compare(
            sampled, sampled_other, other_moving, T_other_view, scale, outcome, llr, a, b,
        )  # fmt: skip

    run_chunks(work, shape[0], max(1, shape[0] // _CHUNK_ROWS))
    return outcome, llr


def stride_of(view: PreparedView) -> int:
    """Return the number of pixels from one cell to the next."""
    return -(-view.z.shape[1] // _COLUMNS)


def _sampled(view: PreparedView) -> kernels.View:
    grid = view.projection
    return kernels.View(
        view.rays, view.z, view.sigma, view.planes, view.plane_variance,
        grid.lookup, grid.frame, stride_of(view),
    )  # fmt: skip


def _cell_shape(shape: tuple[int, ...], stride: int) -> tuple[int, int]:
    return -(-shape[0] // stride), -(-shape[1] // stride)


def _pixels(cells: Bool, shape: tuple[int, ...], stride: int) -> Bool:
    """Return a mask of cells as (H, W) pixels."""
    if stride > 1:
        cells = np.repeat(np.repeat(cells, stride, axis=0), stride, axis=1)
    return np.ascontiguousarray(cells[: shape[0], : shape[1]])


def _robust_scale(ratios: Float32) -> float:
    """Return the scale of absolute values of normal errors with up to half outliers."""
    if len(ratios) < _MIN_RESIDUALS:
        return 1.0
    scale = float(np.partition(ratios, len(ratios) // 4)[len(ratios) // 4]) / _LOWER_QUARTILE
    for _ in range(_SCALE_ITERATIONS):
        kept = ratios[ratios <= _SCALE_CUT * scale]
        previous, scale = scale, median(kept) / _TRUNCATED_MEDIAN if len(kept) else scale
        if abs(scale - previous) <= 0.01 * previous:
            break
    return scale


def _counts(outcome: UInt8, mask: Bool, depth: Float32 | None = None) -> Float64:
    """Return the numbers of comparisons that agree, and of free-space violations, not masked.

    Given the depth of the cells, they are counted by their area, which grows with its square.
    """
    weight = np.ones(mask.shape) if depth is None else depth.astype(np.float64) ** 2
    outcomes = (outcome == kernels.AGREES, outcome == kernels.IN_FRONT)
    return np.array([weight[selected & ~mask].sum() for selected in outcomes])


def _fraction(mask: Bool, valid: Bool) -> float:
    return int(np.count_nonzero(mask)) / (int(np.count_nonzero(valid)) or 1)
