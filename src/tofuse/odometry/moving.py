"""Segmentation of what moves by itself, from views whose poses are known.

A point in space that another view saw through has moved there; a surface that a later view sees
through has moved away. Either contradicts a static scene by a likelihood ratio, see
`tofuse.kernels.moving_objects`. The log-odds of each pixel accumulate over frames, propagated by
the camera's motion, and connected pixels are segmented with hysteresis. What a static camera's
foreground hides or reveals is no evidence: nothing was seen through there.

Everything is judged by the poses given, so the static scene is what agrees with them. A wrong pose
makes views disagree as well: `Moving` says how well the rest of the view agrees, and nothing is
learnt from a pair of which less than `MovingOptions.min_agreement` does.
"""

from __future__ import annotations

from collections import OrderedDict, deque
from dataclasses import dataclass, replace

import cv2
import numpy as np

from tofuse.arrays import Bool, Float32, Float64, Int64, UInt8
from tofuse.geometry import se3
from tofuse.kernels import moving_objects as kernels
from tofuse.kernels.median import median
from tofuse.kernels.threads import run_chunks
from tofuse.recordings.frames import RangeFrame
from tofuse.registration.prepared_view import PreparedView

# Rows of cells of a chunk; fixed, so that the number of threads changes nothing.
_CHUNK_ROWS = 60
# Every n-th cell is taken to estimate the scale of the residuals.
_SCALE_EVERY = 2
# Iterations, cut-off in sigmas, and the median of the absolute values that are left of a normal
# distribution, of a scale that outliers of up to half of the samples don't spoil.
_SCALE_ITERATIONS, _SCALE_CUT, _MEDIAN_WITHIN = 5, 3.0, 0.6724
_LOWER_QUARTILE = 0.3186  # of the absolute values of a normal distribution
_FEWEST_RESIDUALS = 50
# The scale is that of the pair, but at most so many times the median of the last ones: a wrong pose
# must not make its own errors pass for noise.
_SCALES, _MAX_SCALE_RATIO = 31, 3.0
_NEIGHBOURS = np.ones((3, 3), np.uint8)


@dataclass(frozen=True)
class MovingOptions:
    """How what moves is segmented.

    Attributes
    ----------
    columns
        The image is divided into cells of n x n pixels, so that there are at most so many columns
        of them. One pixel of each is compared.
    model_error
        Standard deviation of the errors of a depth that its noise does not show, as a fraction:
        what data sheets of depth cameras state as accuracy.
    edge_jump
        Neighbours whose depths differ by more than this fraction are an outline.
    misregistration
        By how many pixels (of the view as prepared) views may be misregistered, besides noise.
    outliers
        Probability that a comparison of a static pixel is wrong for other reasons than noise.
        Limits the evidence of one frame.
    self_overlap
        Probability that a moving pixel agrees with the keyframe nevertheless: the object still
        overlaps itself. Limits how much one frame that agrees says; by as much less it says where
        the keyframe's surface is known to move.
    prior
        Probability that a pixel moves, before it was compared.
    decay
        Factor per frame of how far the log-odds are from their prior: evidence is forgotten.
    detect, extend
        Log-odds beyond which a pixel is segmented, and beyond which it is if it is connected to
        one of these. An isolated pixel needs two frames with full evidence to reach the first.
    min_core
        Fraction of the pixels of a segment that must be beyond `detect`.
    min_size
        Smallest segment, as a fraction of the image.
    tolerance
        Fraction of its depth by which the surface at a pixel may move between frames.
    reach
        By how many cells a predicted mask is larger than the last one.
    min_agreement
        Least fraction of the comparisons outside of the mask that must agree for a pair of views
        to be evidence of motion. Less, and the pose is as likely to be wrong.
    keyframes
        Of how many reference views the log-odds are remembered.
    """

    columns: int = 112
    model_error: float = 0.005
    edge_jump: float = 0.04
    misregistration: int = 2
    outliers: float = 0.05
    self_overlap: float = 0.3
    prior: float = 0.05
    decay: float = 0.95
    detect: float = 1.5
    extend: float = -0.5
    min_core: float = 0.25
    min_size: float = 0.004
    tolerance: float = 0.05
    reach: int = 3
    min_agreement: float = 0.5
    keyframes: int = 40

    def __post_init__(self) -> None:
        if not 16 <= self.columns <= 4096:
            raise ValueError(f"columns is {self.columns}, not 16 to 4096")
        if not 0 <= self.misregistration <= 10:
            raise ValueError(f"misregistration is {self.misregistration}, not 0 to 10 pixels")
        if not 0 <= self.reach <= 10:
            raise ValueError(f"reach is {self.reach}, not 0 to 10 cells")
        if not 1 <= self.keyframes <= 10_000:
            raise ValueError(f"keyframes is {self.keyframes}, not 1 to 10000")
        for name in ("outliers", "self_overlap", "prior"):
            if not 0 < getattr(self, name) < 1:
                raise ValueError(f"{name} is {getattr(self, name)}, not between 0 and 1")
        for name in (
            "model_error",
            "edge_jump",
            "decay",
            "min_core",
            "min_size",
            "tolerance",
            "min_agreement",
        ):
            if not 0 <= getattr(self, name) <= 1:
                raise ValueError(f"{name} is {getattr(self, name)}, not 0 to 1")
        if not -20 <= self.extend <= self.detect <= 20:
            raise ValueError("extend and detect must be ascending log-odds from -20 to 20")


@dataclass(frozen=True, eq=False)
class _Cells:
    """What is known of the cells of a view: (rows, columns) each.

    `depth` m, 0 unknown; `odds` log-odds of motion; `moving` the segmentation; `tracked` 1 where
    the surface was seen to agree with a reference, and was followed since then.
    """

    depth: Float32
    odds: Float32
    moving: Bool
    tracked: UInt8


@dataclass(frozen=True, eq=False)
class _Last:
    """The view before: where it was, and its cells."""

    view: PreparedView
    T_world_camera: Float64
    cells: _Cells


@dataclass(frozen=True, eq=False)
class Learnt:
    """What a pair of views shows of the cells of both, and the scale of its residuals."""

    last: _Last
    reference: int
    cells: _Cells
    scale: float | None


@dataclass(frozen=True, eq=False)
class Moving:
    """What moved in a pair of views, and how well the rest of them agrees.

    Attributes
    ----------
    view
        (H, W) pixels of the view that moved.
    reference
        (H, W) pixels of the reference whose surface has moved since, or moved already.
    fraction
        Moving pixels among the valid ones of the view.
    compared
        Comparisons of both directions that tell (they agree, or one view sees through a surface of
        the other), outside of the masks.
    agreement
        Those that agree, as a fraction; 0 without any. Low after masking: the pose is wrong, or
        much moves that is not segmented yet.
    agreement_unmasked
        The same of all comparisons, masked or not. The masks explain the difference between both.
    scale
        Robust scale of the residuals outside of what moved before, in sigmas of noise and
        `MovingOptions.model_error`.
    scale_ratio
        The same over its median in earlier frames. Well above 1: the pose is wrong.
    segments
        Connected components of `view`.
    reliable
        Whether the pair agreed enough for its disagreements to be counted as motion. If not, the
        masks are those of earlier frames, carried along.
    learnt
        What `MovingObjects.learn` keeps.
    """

    view: Bool
    reference: Bool
    fraction: float
    compared: int
    agreement: float
    agreement_unmasked: float
    scale: float
    scale_ratio: float
    segments: int
    reliable: bool
    learnt: Learnt

    def applied(self, view: PreparedView) -> PreparedView:
        """Return the view without its pixels that moved."""
        return without_pixels(view, self.view)

    def applied_to_reference(self, reference: PreparedView) -> PreparedView:
        """Return the reference without its pixels that moved."""
        return without_pixels(reference, self.reference)


def without_pixels(view: PreparedView, mask: Bool) -> PreparedView:
    """Return a view that has no surface at some pixels: no plane, no albedo, no noise.

    Their depth stays, as it tells up to where the ray was free; to keep it from being taken for a
    surface again, its sigma is 0, which is "unknown".

    Parameters
    ----------
    view
        Is not changed.
    mask
        (H, W) pixels to leave out.
    """
    if mask.shape != view.z.shape:
        raise ValueError(f"the mask is {mask.shape}, the view {view.z.shape}")
    if not mask.any():
        return view
    keep = ~mask
    own = view.pixel_variance
    return replace(
        view,
        sigma=view.sigma * keep,
        planes=view.planes * keep[..., None],
        plane_variance=view.plane_variance * keep,
        albedo=np.where(keep[..., None], view.albedo, np.float32(np.nan))
        if view.has_albedo
        else view.albedo,
        pixel_variance=None if own is None else own * keep,
    )


def at_size(mask: Bool, frame: RangeFrame) -> Bool:
    """A mask of the prepared view at the size of the frame's image."""
    rows, columns = frame.valid.shape
    step = columns // mask.shape[1]
    large = np.kron(mask, np.ones((step, step), np.bool_))
    out = np.zeros((rows, columns), np.bool_)
    out[: large.shape[0], : large.shape[1]] = large[:rows, :columns]
    return out


class MovingObjects:
    """Segments what moves by itself, from views whose poses relative to keyframes are known.

    Before a view is aligned, leave `predicted_mask` out of it and `reference_mask` out of the
    keyframe; afterwards `compare` both, and `learn` the outcome. Where the masks have grown much
    beyond those (something just began to move), align once more without them: they are right before
    the pose is. `compare` takes whole views. References are recognised by their
    `PreparedView.index`; one that was the last view learnt keeps what was learnt of it.
    """

    def __init__(self, options: MovingOptions | None = None) -> None:
        self.options = MovingOptions() if options is None else options
        self._last: _Last | None = None
        self._references: OrderedDict[int, _Cells] = OrderedDict()
        self._scales: deque[float] = deque(maxlen=_SCALES)

    def reset(self) -> None:
        """Forget the last view, after which the camera was lost; references are remembered."""
        self._last = None

    def predicted_mask(self, T_world_camera_predicted: Float64, view: PreparedView) -> Bool:
        """(H, W) pixels of a view, not yet aligned, that belong to what moved in the last view.

        An object is assumed to be nearly where it was, in the scene or before the camera: the mask
        is widened, and bound to surfaces of about its depth.

        Parameters
        ----------
        T_world_camera_predicted
            (4, 4) of the view.
        """
        options, last = self.options, self._last
        shape = view.z.shape
        if last is None or not last.cells.moving.any():
            return np.zeros(shape, np.bool_)
        stride = self._stride(view)
        moving = np.empty(_cell_shape(shape, stride), np.bool_)
        before = last.view
        kernels.predict(
            view.rays, view.z, stride, last.cells.depth, last.cells.moving, self._stride(before),
            before.z.shape, before.projection.lookup, before.projection.frame,
            np.ascontiguousarray(se3.inverse(last.T_world_camera) @ T_world_camera_predicted),
            2 * options.tolerance, options.reach, moving,
        )  # fmt: skip
        return _pixels(moving, shape, stride)

    def reference_mask(self, reference: PreparedView) -> Bool:
        """(H, W) pixels of a keyframe that are known to have moved."""
        return _pixels(
            self._reference(reference).moving, reference.z.shape, self._stride(reference)
        )

    def compare(
        self,
        view: PreparedView,
        T_world_camera: Float64,
        reference: PreparedView,
        T_world_reference: Float64,
        *,
        suspected: bool = False,
    ) -> Moving:
        """Segment a view that was aligned with a keyframe, and the keyframe; nothing is kept.

        Parameters
        ----------
        view, T_world_camera
            The view and its (4, 4) pose.
        reference, T_world_reference
            The keyframe and its (4, 4) pose.
        suspected
            Whether the views conflict anyway, so that motion is the likely reason: then pixels are
            segmented that move more likely than not, which one frame can show.
        """
        options = self.options
        now, arrived = self._carried(view, T_world_camera)
        then = self._reference(reference)
        T = np.ascontiguousarray(se3.inverse(T_world_reference) @ T_world_camera)
        scale = self._scale(view, now.moving, reference, T)
        typical = median(np.array(self._scales)) if self._scales else scale
        # Noise is not less than it is claimed to be, but may be more.
        used = max(1.0, min(scale, _MAX_SCALE_RATIO * max(typical, 1.0)))
        seen, evidence = self._compare(view, reference, then.moving, T, used)
        inverse = np.ascontiguousarray(se3.inverse(T))
        met, evidence_then = self._compare(reference, view, now.moving, inverse, used)

        before = _counts(seen, now.moving) + _counts(met, then.moving)
        reliable = bool(before[0] >= options.min_agreement * before.sum() and before[0] > 0)
        tracked = now.tracked
        if reliable:
            # What is behind the reference was revealed, unless it had been followed from there.
            follows = (tracked > 0) | (now.odds > options.extend)
            evidence[(seen == kernels.BEHIND) & ~follows] = 0
            evidence_then[met == kernels.BEHIND] = 0
            # The last view saw through there, which the reference does not say a second time.
            alone = arrived & (seen != kernels.IN_FRONT)
            evidence[alone] += np.float32(self._max_evidence)
            now = self._learnt(now, evidence)
            then = self._learnt(then, evidence_then)
            tracked = np.where(seen == kernels.AGREES, np.uint8(1), tracked)
        else:
            evidence, evidence_then = now.odds, then.odds
        detect = 0.0 if suspected else options.detect
        now, segments = self._segmented(replace(now, tracked=tracked), evidence, detect)
        then, _ = self._segmented(then, evidence_then, detect)
        rest = _counts(seen, now.moving) + _counts(met, then.moving)
        everything = _counts(seen, None) + _counts(met, None)
        mask = _pixels(now.moving, view.z.shape, self._stride(view))
        valid = view.z > 0
        return Moving(
            view=mask,
            reference=_pixels(then.moving, reference.z.shape, self._stride(reference)),
            fraction=_fraction(mask & valid, valid),
            compared=int(rest.sum()),
            agreement=float(rest[0] / max(rest.sum(), 1)),
            agreement_unmasked=float(everything[0] / max(everything.sum(), 1)),
            scale=scale,
            scale_ratio=scale / max(typical, 1e-6),
            segments=segments,
            reliable=reliable,
            learnt=Learnt(
                _Last(view, T_world_camera, now),
                reference.index,
                then,
                scale if reliable else None,
            ),
        )

    def learn(self, moving: Moving) -> None:
        """Keep what `compare` found, of the pose that turned out to be the right one."""
        learnt = moving.learnt
        self._last = learnt.last
        self._remember(learnt.reference, learnt.cells)
        if learnt.scale is not None:
            self._scales.append(learnt.scale)

    @property
    def _max_evidence(self) -> float:
        return -float(np.log(self.options.outliers))

    def _stride(self, view: PreparedView) -> int:
        return -(-view.z.shape[1] // self.options.columns)

    @property
    def _prior(self) -> float:
        return float(np.log(self.options.prior / (1 - self.options.prior)))

    def _reference(self, reference: PreparedView) -> _Cells:
        """What is known of a reference so far."""
        shape = _cell_shape(reference.z.shape, self._stride(reference))
        known = self._references.get(reference.index)
        if known is None and self._last is not None and self._last.view.index == reference.index:
            known = self._last.cells
        if known is None or known.odds.shape != shape:
            stride = self._stride(reference)
            none = np.ascontiguousarray(reference.z[::stride, ::stride])
            odds = np.full(shape, self._prior, np.float32)
            known = _Cells(none, odds, np.zeros(shape, np.bool_), np.zeros(shape, np.uint8))
        return known

    def _remember(self, index: int, cells: _Cells) -> None:
        self._references[index] = cells
        self._references.move_to_end(index)
        while len(self._references) > self.options.keyframes:
            self._references.popitem(last=False)

    def _carried(self, view: PreparedView, T_world_camera: Float64) -> tuple[_Cells, Bool]:
        """What is known of the cells of a view from the last one, and what arrived since."""
        options, last, stride = self.options, self._last, self._stride(view)
        shape = _cell_shape(view.z.shape, stride)
        depth, odds = np.empty(shape, np.float32), np.empty(shape, np.float32)
        tracked, arrived = np.empty(shape, np.uint8), np.empty(shape, np.bool_)
        if last is None:
            T, before = np.eye(4), view
            cells = _Cells(np.zeros(shape, np.float32), odds, np.zeros(shape, np.bool_), tracked)
        else:
            T, before = se3.inverse(last.T_world_camera) @ T_world_camera, last.view
            cells = last.cells
        T = np.ascontiguousarray(T)
        # At the rim of what is followed a cell may be that of a surface beside it.
        tracked_before = np.asarray(cv2.erode(cells.tracked, _NEIGHBOURS), np.uint8)
        grid = before.projection

        def work(a: int, b: int) -> None:
            kernels.propagate(
                view.rays, view.z, view.sigma, view.planes, view.plane_variance, stride,
                cells.depth, cells.odds, cells.moving, tracked_before, self._stride(before),
                before.z.shape, grid.lookup, grid.frame, T, options.tolerance, self._prior, depth,
                odds, tracked, arrived, a, b,
            )  # fmt: skip

        run_chunks(work, shape[0], max(1, shape[0] // _CHUNK_ROWS))
        return _Cells(depth, odds, odds > options.detect, tracked), arrived

    def _scale(
        self, view: PreparedView, moving: Bool, reference: PreparedView, T: Float64
    ) -> float:
        """Robust scale of the residuals between two views, in sigmas."""
        grid = reference.projection
        ratios = kernels.residual_ratios(
            view.rays, view.z, view.sigma, view.planes, view.plane_variance, moving,
            self._stride(view), _SCALE_EVERY, reference.z, reference.sigma, reference.planes,
            reference.plane_variance, grid.lookup, grid.frame, T, self.options.model_error,
        )  # fmt: skip
        return _robust_scale(ratios)

    def _compare(
        self,
        view: PreparedView,
        other: PreparedView,
        other_moving: Bool,
        T_other_view: Float64,
        scale: float,
    ) -> tuple[UInt8, Float32]:
        """Outcomes and log-likelihood ratios of the cells of a view, against another one."""
        options, stride, grid = self.options, self._stride(view), other.projection
        shape = _cell_shape(view.z.shape, stride)
        outcome, llr = np.empty(shape, np.uint8), np.empty(shape, np.float32)

        def work(a: int, b: int) -> None:
            kernels.compare(
                view.rays, view.z, view.sigma, view.planes, view.plane_variance, stride,
                other.z, other.sigma, other.planes, other.plane_variance, other_moving,
                self._stride(other), grid.lookup, grid.frame, T_other_view, scale,
                options.model_error, options.edge_jump, options.misregistration,
                self._max_evidence, -float(np.log(options.self_overlap)), options.self_overlap,
                outcome, llr, a, b,
            )  # fmt: skip

        run_chunks(work, shape[0], max(1, shape[0] // _CHUNK_ROWS))
        return outcome, llr

    def _learnt(self, cells: _Cells, evidence: Float32) -> _Cells:
        """Add the evidence of a pair of views."""
        options, prior = self.options, np.float32(self._prior)
        odds = prior + np.float32(options.decay) * (cells.odds - prior) + evidence
        most = options.detect + 2 * self._max_evidence
        return replace(cells, odds=np.clip(odds, 2 * prior, most).astype(np.float32))

    def _segmented(self, cells: _Cells, evidence: Float32, detect: float) -> tuple[_Cells, int]:
        """Segment cells with hysteresis, and count the segments.

        `evidence` of this frame: segments are not grown over what agrees in it.
        """
        options, odds, depth = self.options, cells.odds, cells.depth
        certain = odds > detect
        none = replace(cells, moving=np.zeros(odds.shape, np.bool_))
        if not certain.any():
            return none, 0
        likely = (odds > options.extend).view(np.uint8)
        likely = np.asarray(cv2.morphologyEx(likely, cv2.MORPH_OPEN, _NEIGHBOURS), np.uint8)
        count, labels, stats, _ = cv2.connectedComponentsWithStats(likely, connectivity=4)
        sizes = stats[:, cv2.CC_STAT_AREA]
        core = np.bincount(labels[certain], minlength=count)
        kept = (core >= options.min_core * sizes) & (sizes >= options.min_size * odds.size)
        kept[0] = False
        if not kept.any():
            return none, 0
        moving = self._completed(kept[labels], depth)
        # All of a segment is as likely to move as what made it one, unless it is seen to be static.
        sure = np.float32(options.detect + 0.5 * self._max_evidence)
        odds = np.where(moving & (evidence >= 0), np.maximum(odds, sure), odds)
        # At the outline no comparison tells. One cell more mixes both surfaces; another one is the
        # object's if it is as far away.
        near = cv2.dilate(np.where(moving, depth, np.float32(0)), _NEIGHBOURS, iterations=2)
        grown = cv2.dilate(moving.view(np.uint8), _NEIGHBOURS) > 0
        grown |= (near > 0) & (np.abs(near - depth) <= np.float32(options.tolerance) * near)
        moving = moving | (grown & (evidence >= 0) & (odds >= self._prior))
        return replace(cells, odds=odds, moving=moving), int(kept.sum())

    def _completed(self, moving: Bool, depth: Float32) -> Bool:
        """Add the rest of surfaces of which most moves.

        Where an object still overlaps itself, it agrees with the reference.
        """
        jump = np.float32(0.5 * self.options.edge_jump)
        inside = depth > 0
        for a, b in ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1])):
            inside[a] &= np.abs(depth[a] - depth[b]) <= jump * depth[b]
        count, labels = cv2.connectedComponents(inside.view(np.uint8), connectivity=4)
        sizes = np.bincount(labels.ravel(), minlength=count)
        moved = np.bincount(labels[moving], minlength=count)
        most = 2 * moved > sizes
        most[0] = False
        return np.asarray(moving | most[labels], np.bool_)


def _cell_shape(shape: tuple[int, ...], stride: int) -> tuple[int, int]:
    return -(-shape[0] // stride), -(-shape[1] // stride)


def _pixels(cells: Bool, shape: tuple[int, ...], stride: int) -> Bool:
    """(H, W) of what holds for cells."""
    if stride > 1:
        cells = np.repeat(np.repeat(cells, stride, axis=0), stride, axis=1)
    return np.ascontiguousarray(cells[: shape[0], : shape[1]])


def _robust_scale(ratios: Float32) -> float:
    """Scale of absolute values that are normal but for outliers, up to half of them."""
    if len(ratios) < _FEWEST_RESIDUALS:
        return 1.0
    scale = float(np.partition(ratios, len(ratios) // 4)[len(ratios) // 4]) / _LOWER_QUARTILE
    for _ in range(_SCALE_ITERATIONS):
        kept = ratios[ratios <= _SCALE_CUT * scale]
        before, scale = scale, median(kept) / _MEDIAN_WITHIN if len(kept) else scale
        if abs(scale - before) <= 0.01 * before:
            break
    return scale


def _counts(outcome: UInt8, masked: Bool | None) -> Int64:
    """How many comparisons agree, and how many see through a surface."""
    of = [outcome == kernels.AGREES, outcome == kernels.IN_FRONT]
    if masked is not None:
        of = [here & ~masked for here in of]
    return np.array([np.count_nonzero(here) for here in of])


def _fraction(part: Bool, whole: Bool) -> float:
    return int(np.count_nonzero(part)) / (int(np.count_nonzero(whole)) or 1)
