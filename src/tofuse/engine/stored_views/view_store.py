"""Views for the global stages: storage, and selection of overlapping ones."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Generic, Protocol, TypeVar
from weakref import finalize

import numpy as np
from scipy.spatial import cKDTree

from tofuse.engine.alignment import projective
from tofuse.engine.arrays import Float32, Float64, Int64, Intp
from tofuse.engine.compute import Scratch, Spill, run_chunks
from tofuse.engine.geometry import PlaceCounts, se3
from tofuse.engine.stored_views import pair_equation_kernels as kernels
from tofuse.engine.stored_views import shared_error
from tofuse.engine.views import PreparedView, Projection, residual_kernels

# For estimates of the overlap: maximum number of points of a view, and width of its image.
_OVERLAP_POINTS = residual_kernels.LANES
_OVERLAP_COLUMNS = 40
# A point is on a surface of another view within this distance, as a fraction of its z, and above
# this cosine between the normals.
_MAX_DISTANCE = 0.1
_MIN_COSINE = 0.5
# Up to this many views, all pairs are compared; of more, each view with those of the nearest
# places, and with those just before it, so that the cost is linear in the length of the path.
_MAX_EXHAUSTIVE, _NEAREST, _PREVIOUS = 512, 192, 64
# Fraction of the memory for views that is reserved for coarse ones: small, but all in use.
_COARSE_FRACTION = 0.25


@dataclass(frozen=True, eq=False)
class CoarseView:
    """A subsampled view, for estimates of the overlap.

    Attributes
    ----------
    points
        (N, POINT_SIZE) of sampled pixels, see `points_of`.
    target
        (H, W, PIXEL_SIZE) low-resolution target image for the points of other views.
    projection
        Projection of points into it.
    """

    points: Float32
    target: Float32
    projection: Projection

    @classmethod
    def of(cls, surface: PreparedView, points: Float32) -> CoarseView:
        """Subsample a view and its points (N, POINT_SIZE)."""
        sampled = points[:: max(1, -(-len(points) // _OVERLAP_POINTS))].copy()
        coarse = surface.subsampled(_OVERLAP_COLUMNS)
        return cls(sampled, coarse.target, coarse.projection)

    def scaled(self, factor: float) -> CoarseView:
        """Return the view with its depth scaled."""
        k, target = residual_kernels, self.target.copy()
        target[..., k.DISTANCE] *= factor
        target[..., k.VARIANCE] *= factor**2
        return replace(self, points=_scaled_points(self.points, factor), target=target)

    @property
    def centroid(self) -> Float64:
        """(3,) centroid of the points, in the camera's frame."""
        p = self.points[:, residual_kernels.POINT : residual_kernels.POINT + 3]
        return np.asarray(p.mean(0, dtype=float) if len(p) else np.zeros(3), np.float64)


class HasCoarseView(Protocol):
    """A view of which the overlap with others can be estimated."""

    @property
    def centroid(self) -> Float64:
        """(3,) centroid of its points, in its camera's frame."""
        ...

    @property
    def coarse(self) -> CoarseView:
        """See `CoarseView`."""
        ...


@dataclass(frozen=True, eq=False)
class SampledView:
    """The data of a prepared view that its alignment with others needs, half of its memory.

    Attributes
    ----------
    index
        Of the frame in its recording.
    depth
        Median z, m.
    target
        (H, W, PIXEL_SIZE) target image, see `make_target`.
    projection
        Projection of points into it.
    points
        (N, POINT_SIZE) sampled points, which are compared with other views.
    coarse
        For estimates of the overlap.
    has_albedo, measures_range
        As of `PreparedView`.
    target_scale
        By which the depth in the target image is multiplied where it is used: the images of all
        views are not in memory twice.
    recording
        Number of its recording, if several are joined.
    """

    index: int
    depth: float
    target: Float32
    projection: Projection
    points: Float32
    coarse: CoarseView
    has_albedo: bool = False
    measures_range: bool = False
    target_scale: float = 1.0
    recording: int = 0

    @classmethod
    def of(cls, surface: PreparedView, points: int, recording: int = 0) -> SampledView:
        """Sample approximately `points` points of a view."""
        sampled = sampled_points(surface, points)
        return cls(
            surface.index,
            surface.depth,
            surface.target,
            surface.projection,
            sampled,
            CoarseView.of(surface, sampled),
            surface.has_albedo,
            surface.measures_range,
            recording=recording,
        )

    def with_points(self, which: Intp | slice) -> SampledView:
        """Return the view with a subset of its points."""
        return replace(self, points=np.ascontiguousarray(self.points[which]))

    def scaled(self, factor: float) -> SampledView:
        """Return the view with its depth scaled."""
        if factor == 1:
            return self
        return replace(
            self,
            depth=self.depth * factor,
            points=_scaled_points(self.points, factor),
            coarse=self.coarse.scaled(factor),
            target_scale=self.target_scale * factor,
        )

    @property
    def target_image(self) -> residual_kernels.TargetImage:
        """The target image, without `target_scale`, and its projection."""
        p = self.projection
        return residual_kernels.TargetImage(self.target, p.lookup, p.frame)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the target image."""
        return self.target.shape[0], self.target.shape[1]

    @property
    def centroid(self) -> Float64:
        """(3,) centroid of its points, in the camera's frame."""
        return self.coarse.centroid

    @cached_property
    def patches(self) -> Int64:
        """(N,) patch of the image that each point belongs to, see `shared_error`."""
        return shared_error.patches_of(self.points, self.projection)

    @cached_property
    def sigma(self) -> float:
        """Median sigma of the points' z, m."""
        p = self.points
        return (
            float(np.median(p[:, residual_kernels.SIGMA] * p[:, residual_kernels.POINT + 2]))
            if len(p)
            else 0.01
        )


def _scaled_points(points: Float32, factor: float) -> Float32:
    """Return points (N, POINT_SIZE) with their depth scaled."""
    k, points = residual_kernels, points.copy()
    points[:, k.POINT : k.POINT + 3] *= factor
    points[:, k.POINT_ALBEDO_SLOPE : k.POINT_ALBEDO_SLOPE + 3] /= factor
    return points


def sampled_points(surface: PreparedView, count: int) -> Float32:
    """Return approximately `count` points (N, POINT_SIZE) of a view, on a regular grid."""
    return projective.points_of(surface, max(1, round(np.sqrt(surface.z.size / count))))


@dataclass(frozen=True)
class Spacing:
    """Selection of views by the motion of the camera.

    Attributes
    ----------
    angle, distance
        A view is stored when the camera has moved this far since the last one: rad, and fraction of
        the median depth.
    max_views
        When there are more, every other one is dropped, and the required motion is doubled.
    max_stretch
        Largest factor on the required motion, so that the views of a place suffice however long the
        path is.
    views_per_place
        At the largest factor, the views of a place that is visited repeatedly are thinned after
        this many, see `PlaceCounts`.
    """

    angle: float = 0.03
    distance: float = 0.015
    max_views: int = 300
    max_stretch: float = 4.0
    views_per_place: int = 16

    def is_exceeded(self, motion: Float64, depth: float, stretch: float) -> bool:
        """Whether a motion (4, 4) at this depth, m, is larger than `stretch` times the required."""
        reach = stretch * self.distance * depth
        return not se3.is_within(motion, reach, stretch * self.angle)

    def places(self) -> PlaceCounts:
        """Return counts of the places that are as wide as the largest required motion."""
        return PlaceCounts(
            self.max_stretch * self.angle, self.max_stretch * self.distance, self.views_per_place
        )


class Storable(Protocol):
    """Data of a view that a `ViewStore` can store."""

    @property
    def index(self) -> int:
        """Of the frame in its recording."""
        ...

    @property
    def depth(self) -> float:
        """Median distance of its surfaces, m."""
        ...


V = TypeVar("V", bound=Storable)


T = TypeVar("T")


class Spilled(Generic[T]):
    """An item that may be on disk, until it is garbage collected."""

    def __init__(self, item: T, spill: Spill[T]) -> None:
        self._spill, self._number = spill, spill.put(item)
        finalize(self, spill.drop, self._number).atexit = False

    def get(self) -> T:
        """Return the item."""
        return self._spill.get(self._number)


@dataclass(frozen=True, eq=False)
class SpilledCoarseView:
    """The coarse version of a view, possibly on disk; see `HasCoarseView`.

    Attributes
    ----------
    centroid
        (3,) centroid of its points, in its camera's frame, m.
    spilled
        Handle of the stored view.
    """

    centroid: Float64
    spilled: Spilled[CoarseView]

    @property
    def coarse(self) -> CoarseView:
        """The coarse view; read from disk if it is not in memory."""
        return self.spilled.get()


class PosedView(Generic[V]):
    """A view with its pose.

    Parameters
    ----------
    T_component_camera
        (4, 4) pose in the frame of its component.
    spill
        Storage; in memory unless given.
    recording
        Number of its recording, if several are joined.

    Attributes
    ----------
    index
        Of the frame in its recording.
    depth
        Median distance of its surfaces, m.
    """

    def __init__(
        self,
        view: V,
        T_component_camera: Float64,
        component: int = 0,
        spill: Spill[V] | None = None,
        recording: int = 0,
    ) -> None:
        self.index, self.depth, self.recording = view.index, view.depth, recording
        self.T_component_camera, self.component = T_component_camera, component
        self._kept: V | Spilled[V] = view if spill is None else Spilled(view, spill)

    @property
    def view(self) -> V:
        """The stored view; read from disk if it is not in memory, so call it once."""
        return self._kept.get() if isinstance(self._kept, Spilled) else self._kept


class ViewStore(Generic[V]):
    """The views for the global stages: spaced by motion.

    Parameters
    ----------
    spacing
        Selection by motion.
    always
        Frames that are stored in any case.
    scratch
        Limits the memory, coarse views included; unlimited by default.

    Attributes
    ----------
    views
        In the order of their frames. The first of each component stays.
    coarse
        Storage for the coarse versions of these views.
    recording
        Number of the recording of the next views.
    """

    def __init__(
        self,
        spacing: Spacing,
        always: Collection[int] = (),
        scratch: Scratch = Scratch(),  # noqa: B008 - immutable
    ) -> None:
        self.views: list[PosedView[V]] = []
        self.recording = 0
        self.coarse: Spill[CoarseView] = scratch.part(_COARSE_FRACTION)
        self._spacing, self._always = spacing, frozenset(always)
        self._spill: Spill[V] = scratch.part(1 - _COARSE_FRACTION)
        self._stretch = 1.0
        self._places = spacing.places()
        # Pose and component of the last view, as if places were not thinned.
        self._last: tuple[Float64, int] | None = None

    def push(
        self,
        view: V,
        T_component_camera: Float64,
        component: int = 0,
        reduced: Callable[[V], V] = lambda view: view,
    ) -> None:
        """Add the next view, after `reduced`, if it is selected."""
        if self._is_selected(view, T_component_camera, component):
            T, spill = T_component_camera, self._spill
            self._add(PosedView(reduced(view), T, component, spill, self.recording))

    def push_posed(self, posed: PosedView[V]) -> None:
        """Add the next view of another store, if it is selected."""
        if self._is_selected(posed, posed.T_component_camera, posed.component):
            self._add(posed)

    def _is_selected(self, view: Storable, T_component_camera: Float64, component: int) -> bool:
        """Whether the camera has moved enough to a place with few views, or a view is required."""
        s, last = self._spacing, self._last
        if view.index in self._always or last is None or last[1] != component:
            self._last = T_component_camera, component
            return True
        motion = se3.inverse(last[0]) @ T_component_camera
        if not s.is_exceeded(motion, view.depth, self._stretch):
            return False
        self._last = T_component_camera, component
        max_stretch = 2 * self._stretch > s.max_stretch
        return not max_stretch or self._places.keeps(view.depth, T_component_camera, component)

    def of(self, frames: Collection[int]) -> list[PosedView[V]]:
        """Stored views of these frames."""
        return [view for view in self.views if view.index in frames]

    def _add(self, posed: PosedView[V]) -> None:
        self.views.append(posed)
        s = self._spacing
        if len(self.views) > s.max_views and 2 * self._stretch <= s.max_stretch:
            self._drop_every_other()
            self._last = self.views[-1].T_component_camera, self.views[-1].component
            self._stretch *= 2

    def _drop_every_other(self) -> None:
        kept: list[PosedView[V]] = []
        count = 0
        for view in self.views:
            if not kept or kept[-1].component != view.component:
                count = 0
            if count % 2 == 0 or view.index in self._always:
                kept.append(view)
            count += 1
        # If nearly every view is a separate component, some of these have to be dropped.
        self.views = kept if len(kept) < self._spacing.max_views else self.views[::2]


def overlaps(
    views: Sequence[HasCoarseView], poses: Float64, min_overlap: float, *, first: int = 0
) -> tuple[Intp, Float64]:
    """Return the pairs of views that overlap, and their overlaps.

    The overlap is the smaller of both directions: the fraction of points close to a surface of the
    other view with a similar normal, so that some drift is tolerated. Of many views only pairs
    that may overlap are compared, see `candidate_pairs`.

    Parameters
    ----------
    views
        N views.
    poses
        (N, 4, 4) T_world_camera.
    min_overlap
        Smallest overlap.
    first
        Pairs with j before this view are left out.

    Returns
    -------
    pairs (M, 2), i < j, in the order of j, then i; overlaps (M,).
    """
    target, source = candidate_pairs(world_centroids(views, poses), first)
    axes = poses[:, :3, 2]
    similar_direction = np.einsum("ni,ni->n", axes[target], axes[source]) > 0
    target, source = target[similar_direction], source[similar_direction]
    overlap = _visible_fractions(views, poses, target, source, min_overlap)
    overlapping = overlap >= min_overlap
    target, source = target[overlapping], source[overlapping]
    overlap = np.minimum(
        overlap[overlapping], _visible_fractions(views, poses, source, target, min_overlap)
    )
    order = np.lexsort((target, source))
    order = order[overlap[order] >= min_overlap]
    return np.stack([target[order], source[order]], 1), overlap[order]


def world_centroids(views: Sequence[HasCoarseView], poses: Float64) -> Float64:
    """(N, 3) centroids of the points of views, in the world of their poses (N, 4, 4)."""
    centroids = np.array([view.centroid for view in views]).reshape(-1, 3)
    return np.asarray(np.einsum("nij,nj->ni", poses[:, :3, :3], centroids) + poses[:, :3, 3])


def candidate_pairs(centroids: Float64, first: int = 0) -> tuple[Intp, Intp]:
    """Return pairs of views that may overlap, by the centroids (N, 3) of their points.

    All pairs, if there are few views; otherwise each view with those of the nearest centroids and
    with those just before it. Returns the positions i < j of all pairs with j >= first.
    """
    n = len(centroids)
    if n <= _MAX_EXHAUSTIVE:
        i, j = np.triu_indices(n, 1)
    elif first == n - 1:  # for the newest view alone, brute force is cheaper than a tree
        distances = np.linalg.norm(centroids[:-1] - centroids[-1], axis=1)
        nearest = np.argpartition(distances, _NEAREST)[:_NEAREST]
        i = np.union1d(nearest, np.arange(max(0, n - 1 - _PREVIOUS), n - 1))
        j = np.full(len(i), n - 1)
    else:
        _, neighbours = cKDTree(centroids).query(centroids, k=_NEAREST)
        views = np.repeat(np.arange(n), _NEAREST)
        before = np.arange(n)[:, None] - np.arange(1, _PREVIOUS + 1)
        others = np.concatenate([neighbours.ravel(), before.ravel()])
        views = np.concatenate([views, np.repeat(np.arange(n), _PREVIOUS)])
        valid = (others >= 0) & (others != views)
        low, high = np.minimum(views, others)[valid], np.maximum(views, others)[valid]
        i, j = np.divmod(np.unique(low.astype(np.int64) * n + high), n)
    selected = j >= first
    return np.asarray(i[selected], np.intp), np.asarray(j[selected], np.intp)


def _visible_fractions(
    views: Sequence[HasCoarseView], poses: Float64, target: Intp, source: Intp, min_overlap: float
) -> Float64:
    """Fraction of each source's points that its target observes; 0 if below `min_overlap`."""
    used, row = np.unique(source, return_inverse=True)
    point_sets = [views[k].coarse.points for k in used]
    starts = np.concatenate([[0], np.cumsum([len(points) for points in point_sets])])
    points = (
        np.concatenate(point_sets)
        if point_sets
        else np.zeros((0, residual_kernels.POINT_SIZE), np.float32)
    )
    inverse, used_poses = se3.inverse(poses), np.ascontiguousarray(poses[used])
    order, targets, ends = by_target(target)
    out = np.zeros(len(target))

    def work(a: int, b: int) -> None:
        for t in range(a, b):
            k, rows = targets[t], order[ends[t] : ends[t + 1]]
            view = views[k].coarse
            fractions = np.empty(len(rows))
            kernels.overlaps(
                points,
                starts,
                row[rows],
                residual_kernels.TargetImage(
                    view.target, view.projection.lookup, view.projection.frame
                ),
                inverse[k],
                used_poses,
                _MAX_DISTANCE,
                _MIN_COSINE,
                min_overlap,
                fractions,
            )
            out[rows] = fractions

    run_chunks(work, len(targets), 32)
    return out


def by_target(target: Intp) -> tuple[Intp, Intp, Intp]:
    """Return the order of pairs by their targets (M,), the T targets, and where each begins.

    The last is (T + 1,), with the end. All sources of a target in succession keep it in the cache.
    """
    order = np.argsort(target, kind="stable")
    targets, begin = np.unique(target[order], return_index=True)
    return order, targets, np.append(begin, len(target))
