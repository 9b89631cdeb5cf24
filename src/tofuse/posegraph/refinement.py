"""Refinement as a part: which views take part, what is believed, and how the others follow."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import ClassVar, Literal, Protocol

import numpy as np

from tofuse.arrays import Bool, Float32, Float64, Intp
from tofuse.files.spill import Spill
from tofuse.geometry import se3
from tofuse.kernels import refinement as kernels
from tofuse.parts import part
from tofuse.posegraph.build import Measured
from tofuse.posegraph.outside import Told
from tofuse.posegraph.refine import Beside, Refined, RefineOptions, refine
from tofuse.posegraph.submaps import InSubmap, fell, refine_submaps
from tofuse.posegraph.suspicion import Suspicion, loop_gap, of_submaps, suspicion
from tofuse.posegraph.views import KeptView, Outline, PosedView, Spilled, ViewStore
from tofuse.recordings.frames import Frame
from tofuse.registration.prepared_view import PreparedView

CameraError = Literal["offset", "scale", "focal"]

# Neighbouring pixels share their noise: so many count as one.
_SHARED_NOISE = 5.0
_ERRORS: dict[CameraError, int] = {
    "offset": kernels.OFFSET,
    "scale": kernels.SCALE,
    "focal": kernels.FOCAL,
}


@dataclass(frozen=True, eq=False)
class Refinement:
    """What a refinement made of a trajectory.

    Attributes
    ----------
    poses
        (N, 4, 4) T_world_camera; the first has not moved.
    kept
        Whether it is believed: only a trajectory whose views support each other better. Where they
        do so as well as before, but for chance, the poses stay, and what was measured counts.
    views, pairs
        How many took part.
    moved_m, moved_rad
        Largest motions of a view.
    support
        How well the views agree, up to 1, before and after: see `refine.Support`.
    errors
        Of the camera, by name, where they were estimated: what is missing from the range (m), from
        the depth (share), and by how much rays are wider than thought (share).
    edges
        What each pair measures by itself, in frame indices; none unless kept.
    suspicion
        What the views say of errors of the camera, where they were asked.
    stated
        Pairs (i, j) of edges that do not rest on what the two views see of each other.
    """

    poses: Float64
    kept: bool = False
    views: int = 0
    pairs: int = 0
    moved_m: float = 0.0
    moved_rad: float = 0.0
    support: tuple[float, float] = (0.0, 0.0)
    errors: dict[str, float] = field(default_factory=dict)
    edges: tuple[Measured, ...] = ()
    suspicion: Suspicion | None = None
    stated: tuple[tuple[int, int], ...] = ()


class Refiner(Protocol):
    """Refinement at work on one recording.

    Attributes
    ----------
    points
        Whether it looks at the points of frames, and not only at prepared views.
    """

    points: ClassVar[bool] = True

    def push(self, view: Frame, T_component_camera: Float64) -> None:
        """Add the next frame that has a pose, if it looks at points."""
        ...

    def finish(self, ids: Sequence[int], poses: Float64, told: Told | None = None) -> Refinement:
        """Refine the poses (N, 4, 4) of all frames, whose indices are `ids`, ascending.

        `told` is what other sensors say of them.
        """
        ...


class Refining(Protocol):
    """A method that makes poses better once loops are closed."""

    part_kind: ClassVar[str] = "refinement"

    def start(self, views: ViewStore[PreparedView]) -> Refiner:
        """Begin a new recording; prepared views are added to `views` as they come."""
        ...


@part("refinement", "none")
@dataclass(frozen=True)
class NoRefinement(Refining):
    """Leaves the poses as the optimiser found them."""

    def start(self, views: ViewStore[PreparedView]) -> Refiner:
        """See `Refining.start`."""
        return _Idle()


class _Idle(Refiner):
    points: ClassVar[bool] = False

    def push(self, view: Frame, T_component_camera: Float64) -> None:
        """Keep nothing."""

    def finish(self, ids: Sequence[int], poses: Float64, told: Told | None = None) -> Refinement:
        """See `Refiner.finish`."""
        return Refinement(poses)


@dataclass(frozen=True, eq=False)
class Known(Refining):
    """Leaves the poses, which were refined elsewhere, and tells what was measured there.

    Attributes
    ----------
    measured, stated
        In frame indices: what pairs of views measured, and what is known otherwise.
    """

    measured: tuple[Measured, ...]
    stated: tuple[Measured, ...]

    def start(self, views: ViewStore[PreparedView]) -> Refiner:
        """See `Refining.start`."""
        return _Known(self)


class _Known(_Idle):
    def __init__(self, known: Known) -> None:
        self._known = known

    def finish(self, ids: Sequence[int], poses: Float64, told: Told | None = None) -> Refinement:
        """See `Refiner.finish`."""
        there = set(ids)
        edges = (*self._known.measured, *self._known.stated)
        return Refinement(
            poses,
            kept=True,
            edges=tuple(e for e in edges if {e.i, e.j} <= there),
            stated=tuple((e.i, e.j) for e in self._known.stated),
        )


@part("refinement", "joint")
@dataclass(frozen=True)
class Joint(Refining):
    """Moves all views until each agrees with all that it overlaps with (eq 2.8), see `refine`.

    Views are spaced by the motion of the camera (`ViewStore`); frames in between follow them. The
    outcome is believed only if the views support each other at least as well as before, and views
    that lose support stay where their neighbours had them.

    Attributes
    ----------
    refine
        How they are refined.
    calibrate
        Errors of the camera that are estimated as well: "offset", "scale", "focal".
    loss
        A view has lost support if it fell by more.
    submap
        Up to so many views are refined together; of more, so many at a time, see `submaps`.
    """

    refine: RefineOptions = RefineOptions()  # noqa: RUF009 - immutable
    calibrate: tuple[CameraError, ...] = ()
    loss: float = 0.03
    submap: int = 300

    def __post_init__(self) -> None:
        if not 0 <= self.loss <= 1:
            raise ValueError(f"loss is {self.loss}, not 0 to 1")
        if not 10 <= self.submap <= 100_000:
            raise ValueError(f"submap is {self.submap}, not 10 to 100000")

    def start(self, views: ViewStore[PreparedView]) -> Refiner:
        """See `Refining.start`."""
        return _Joint(self, views)


class _Joint(Refiner):
    points: ClassVar[bool] = False

    def __init__(self, options: Joint, views: ViewStore[PreparedView]) -> None:
        self._options = options
        self._store = views

    def push(self, view: Frame, T_component_camera: Float64) -> None:
        """See `Refiner.push`. The views are in the store."""

    def finish(self, ids: Sequence[int], poses: Float64, told: Told | None = None) -> Refinement:
        """See `Refiner.finish`."""
        options = self._options
        row = {int(index): k for k, index in enumerate(ids)}
        posed = self._store.of(row)
        at = np.array([row[p.index] for p in posed], np.intp)
        if len(posed) < 2:
            return Refinement(poses, views=len(posed))
        before = poses[at]
        together = _together if len(posed) <= options.submap else _in_submaps
        refined, found = together(options, posed, before, told or Told(), self._store)
        support = refined.before.of_views(len(posed)), refined.after.of_views(len(posed))
        mean = float(support[0].mean()), float(support[1].mean())
        unchanged = Refinement(poses, False, len(posed), len(refined.pairs), support=mean)
        gained = support[1] - support[0]
        if not len(refined.pairs) or fell(gained):
            return unchanged
        after = without_losers(before, refined.poses, gained < -options.loss)
        if mean[1] < mean[0]:
            # They were refined before, and are as good as they can be; but what the pairs measure
            # says how good that is.
            after = before
        return replace(
            moved_to(unchanged, at, after),
            suspicion=found(),
            errors={name: float(refined.errors[_ERRORS[name]]) for name in options.calibrate},
            edges=measured_by([p.index for p in posed], refined),
        )


def _together(
    options: Joint,
    posed: Sequence[PosedView[PreparedView]],
    poses: Float64,
    told: Told,
    _: ViewStore[PreparedView],
) -> tuple[Refined, Callable[[], Suspicion]]:
    """Refine all views at once; returns also what tells what they say of their camera."""
    views = [_kept(p, options) for p in posed]
    beside = _beside([p.index for p in posed], told)
    numbers = [_ERRORS[name] for name in options.calibrate]
    refined = refine(views, poses, options.refine, calibrate=numbers, beside=beside)
    return refined, lambda: _suspicion(
        InSubmap(views, np.arange(len(views)), refined, beside), options
    )


def _in_submaps(
    options: Joint,
    posed: Sequence[PosedView[PreparedView]],
    poses: Float64,
    told: Told,
    store: ViewStore[PreparedView],
) -> tuple[Refined, Callable[[], Suspicion]]:
    """Refine views submap by submap; returns also what tells what they say of their camera."""
    ids = [p.index for p in posed]
    refined, said = refine_submaps(
        [_Seen.of(_kept(p, options), store.outlines) for p in posed],
        poses,
        options.refine,
        options.submap,
        lambda some: [_kept(posed[k], options) for k in some],
        lambda some: _beside(ids if some is None else [ids[k] for k in some], told),
        partial(_suspicion, options=options),
        [_ERRORS[name] for name in options.calibrate],
    )
    return refined, lambda: of_submaps(said)


@dataclass(frozen=True, eq=False)
class _Seen:
    """A view's outline, which may be on disk."""

    middle: Float64
    kept: Spilled[Outline]

    @classmethod
    def of(cls, view: KeptView, spill: Spill[Outline]) -> _Seen:
        return cls(view.middle, Spilled(view.outline, spill))

    @property
    def outline(self) -> Outline:
        """See `Outlined`."""
        return self.kept.get()


def _kept(posed: PosedView[PreparedView], options: Joint) -> KeptView:
    return KeptView.of(posed.view.with_pixel_variance().without_caches(), options.refine.points)


def _suspicion(one: InSubmap, options: Joint) -> Suspicion:
    """What refined views say of their camera."""
    refined = one.refined
    if not options.calibrate:
        return suspicion(one.views, refined, options.refine, one.beside)
    gap = loop_gap(one.views, refined, refined.poses, refined.errors, options.refine)
    return Suspicion(gap=gap)


def measured_by(ids: Sequence[int], refined: Refined) -> tuple[Measured, ...]:
    """What pairs measure by themselves, with what all of them together can know.

    What is wrong with a view is wrong in all its pairs, so that many know little more than one.
    """
    pairs = refined.pairs
    partners = np.bincount(pairs.ravel(), minlength=len(ids))
    shared = _SHARED_NOISE * 0.5 * partners[pairs].sum(1)
    return tuple(
        Measured(ids[i], ids[j], T, H / less)
        for (i, j), T, H, less in zip(
            pairs, refined.measured, refined.information, shared, strict=True
        )
    )


def _beside(ids: Sequence[int], told: Told) -> Beside:
    """What other sensors say of the views, on the scale of what their pixels say."""
    place = {index: k for k, index in enumerate(ids)}
    steps = told.between(ids)
    m = len(steps)
    gravity = told.gravity_of(ids)
    if gravity is not None:
        gravity = replace(
            gravity,
            sigma=gravity.sigma / np.sqrt(_SHARED_NOISE),
            gate=gravity.gate * _SHARED_NOISE,
        )
    return Beside(
        np.array([(place[s.i], place[s.j]) for s in steps], np.intp).reshape(m, 2),
        np.array([s.T_i_j for s in steps]).reshape(m, 4, 4),
        np.array([s.information * _SHARED_NOISE for s in steps]).reshape(m, 6, 6),
        gravity,
    )


def without_losers(before: Float64, after: Float64, lost: Bool) -> Float64:
    """Poses (N, 4, 4) `after`, but views that lost support stay where a neighbour had them.

    Parameters
    ----------
    before
        (N, 4, 4) poses that were refined.
    lost
        (N,) views that lost support.
    """
    out = after.copy()
    good = np.flatnonzero(~lost)
    for k in np.flatnonzero(lost) if len(good) else ():
        near = good[np.argmin(np.abs(good - k))]
        out[k] = out[near] @ se3.inverse(before[near]) @ before[k]
    return se3.inverse(out[0]) @ out if lost[0] else out


def without_errors(points: Float32, errors: Mapping[str, float]) -> Float32:
    """Points (N, 3) of a camera's frame where they are, if the camera errs like this.

    Parameters
    ----------
    errors
        As in `Refinement.errors`.
    """
    p = points.astype(np.float64)
    length = np.linalg.norm(p, axis=1, keepdims=True)
    moved = p * (
        1 + errors.get("offset", 0.0) / np.maximum(length, 1e-9) + errors.get("scale", 0.0)
    )
    moved[:, :2] += errors.get("focal", 0.0) * p[:, :2]
    return moved.astype(np.float32)


def moved_to(unchanged: Refinement, at: Intp, after: Float64) -> Refinement:
    """What is kept of a refinement by which the poses at positions `at` (ascending) become `after`.

    Parameters
    ----------
    unchanged
        As it would be told if it were not kept.
    after
        (M, 4, 4) T_world_camera.
    """
    motion = se3.log(se3.inverse(unchanged.poses[at]) @ after)
    return replace(
        unchanged,
        poses=followed(unchanged.poses, at, after),
        kept=True,
        moved_m=float(np.linalg.norm(motion[:, :3], axis=1).max()),
        moved_rad=float(np.linalg.norm(motion[:, 3:], axis=1).max()),
    )


def followed(poses: Float64, at: Intp, after: Float64) -> Float64:
    """All poses (N, 4, 4), when those at positions `at` (ascending) have become `after`.

    Each frame keeps its motion relative to the views before and after it, and lies between what
    the two say by its place between them.
    """
    every = np.arange(len(poses))
    right = np.clip(np.searchsorted(at, every), 0, len(at) - 1)
    left = np.clip(np.searchsorted(at, every, side="right") - 1, 0, len(at) - 1)
    relative = [after[k] @ se3.inverse(poses[at[k]]) @ poses for k in (left, right)]
    gap = at[right] - at[left]
    share = np.where(gap > 0, (every - at[left]) / np.maximum(gap, 1), 0.0)
    return se3.interpolate(relative[0], relative[1], share)
