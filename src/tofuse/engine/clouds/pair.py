"""``tofuse.register``: registration of one pair of views or clouds; and its default method."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import ClassVar
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import ArrayLike

from tofuse.engine.alignment import Registrar, Registration, UncertaintyOptions
from tofuse.engine.arrays import Float64
from tofuse.engine.bounds import Bounds
from tofuse.engine.clouds.cloud_pair import follow_clouds, register_clouds, with_cloud_information
from tofuse.engine.clouds.fpfh import candidates
from tofuse.engine.clouds.near_origin import NearOrigin
from tofuse.engine.clouds.viewpoint import as_image, viewpoint_of
from tofuse.engine.compute import one_blas_thread
from tofuse.engine.errors import InputError, RegistrationError
from tofuse.engine.frames import CloudFrame, Frame, RangeFrame
from tofuse.engine.geometry import se3
from tofuse.engine.parts import check_number, part, registered
from tofuse.engine.search import follow, register_pair, verification
from tofuse.engine.views import PreparedView, SurfaceOptions, prepare_view

MIN_POINTS = 10
# For recorded views with a wide baseline, which multipath distorts individually.
# docs/uncertainty.md describes the calibration.
_RECORDED_VIEWS = UncertaintyOptions(hidden=0.01, offset=0.5, floor=0.006)
# Maximum number of points of a cloud.
_MAX_POINTS = 320_000
# Cache: a view is registered to several others.
_thinned_views: WeakKeyDictionary[Frame, Frame] = WeakKeyDictionary()
# Maximum number of poses proposed by feature matching, and of described points of a view.
_PROPOSALS, _DESCRIBED_POINTS = 8, 1500


@part("registration", "any-pair")
@dataclass(frozen=True)
class AnyPair(Registrar):
    """Registration of two views with a wide baseline, with verification of the pose.

    Images, and clouds seen from their origin, are registered as images (`search.view_pair`).
    Other clouds, clouds whose image registration is rejected, and images with too few planes
    are registered as clouds (`clouds.cloud_pair`).

    Attributes
    ----------
    search
        Whether poses are searched if the one aligned from the guess is not certain. Else that one
        is evaluated without rivals.
    """

    search: bool = True
    takes: ClassVar[frozenset[str]] = frozenset({"range", "cloud"})

    def register(
        self, source: Frame, target: Frame, guess: Float64 | None, rng: np.random.Generator
    ) -> Registration:
        """See `Registrar.register`; without a guess the identity is tried first.

        Of ambiguous poses the one at the guess is returned.
        """
        for view in (source, target):
            if len(view) < MIN_POINTS:
                raise RegistrationError(f"has {len(view)} points", where=f"frame {view.index}")
        source, target = _thinned(source), _thinned(target)
        searches = self.search or guess is None
        are_images = isinstance(source, RangeFrame) and isinstance(target, RangeFrame)
        # Other clouds are matched by features below.
        proposals = partial(_feature_proposals, source, target) if are_images else None
        image_registration = _registered_as_images(
            source, target, guess, proposals, search=searches
        )
        if image_registration is not None and are_images:
            return image_registration
        if image_registration is not None and image_registration.believed:
            return with_cloud_information(source, target, image_registration, rng)
        if not searches and guess is not None:
            return follow_clouds(source, target, guess, rng)
        return register_clouds(source, target, guess, rng, image_registration)


def _thinned(view: Frame) -> Frame:
    """Return a view with enough points for its registration; of larger clouds a random subset."""
    if not isinstance(view, CloudFrame) or len(view) <= _MAX_POINTS:
        return view
    if view not in _thinned_views:
        chosen = np.random.default_rng(0).choice(len(view), _MAX_POINTS, replace=False)
        kept = np.zeros(len(view), bool)
        kept[chosen] = True
        _thinned_views[view] = view.keep(kept)
    return _thinned_views[view]


def _feature_proposals(source: Frame, target: Frame) -> Float64:
    """Return the poses (N, 4, 4) proposed by feature matching, under any rotation."""
    try:
        found = candidates(source, target, points=_DESCRIBED_POINTS, signed=True)
    except RegistrationError:
        return np.zeros((0, 4, 4))
    return np.stack([pose.T_target_source for pose in found.poses[:_PROPOSALS]])


def _registered_as_images(
    source: Frame,
    target: Frame,
    guess: Float64 | None,
    proposals: Callable[[], Float64] | None,
    *,
    search: bool,
) -> Registration | None:
    """Register two views as images; None if one is not an image, or has too few planes.

    Raises
    ------
    RegistrationError
        If two range images are of different scale.
    """
    source_image, target_image = _as_image(source), _as_image(target)
    if source_image is None or target_image is None:
        return None
    (data, T_source_camera), (model, T_target_camera) = source_image, target_image
    T_camera_source, T_camera_target = se3.inverse(T_source_camera), se3.inverse(T_target_camera)
    # Views of one recording are mostly close to each other: of ambiguous poses the one at the
    # identity is returned, unless a guess is given.
    start = T_camera_target @ (np.eye(4) if guess is None else guess) @ T_source_camera
    if not verification.comparable(data.depth, model.depth):
        if isinstance(source, RangeFrame) and isinstance(target, RangeFrame):
            raise RegistrationError(
                f"has a median depth of {data.depth:.2g} m, and frame {target.index} of "
                f"{model.depth:.2g} m: views of so different a scale can't be compared",
                where=f"frame {source.index}",
                remedy="check the unit of depth",
            )
        return None  # registration as clouds may detect a wrong unit
    if search:
        registration = register_pair(
            data, model, start, proposals=proposals, uncertainty=_RECORDED_VIEWS
        )
    else:
        registration = follow(data, model, start, uncertainty=_RECORDED_VIEWS)
    return None if registration is None else registration.between(T_target_camera, T_camera_source)


def _as_image(view: Frame) -> tuple[PreparedView, Float64] | None:
    """Return a view's image and T_view_camera (4, 4); None for clouds without a viewpoint."""
    if isinstance(view, RangeFrame):
        return prepare_view(view, SurfaceOptions()), np.eye(4)
    viewpoint = viewpoint_of(view)
    image = None if viewpoint is None else as_image(view, viewpoint)
    if image is None:
        return None
    # The optical axis of such an image is not that of a lens.
    return prepare_view(image[0], SurfaceOptions(falloff=0.0)), image[1]


def register(
    source: Frame | ArrayLike,
    target: Frame | ArrayLike,
    *,
    guess: ArrayLike | None = None,
    method: Registrar | str | None = None,
    seed: int = 0,
) -> Registration:
    """Register two views, or two (N, 3) clouds in m.

    The views are first aligned from the guess. If their agreement makes that pose practically
    certain, it is returned, within milliseconds for images. Else poses are searched; the best one
    is aligned and evaluated by the agreement of both views and by its lead over the best rival. Two
    images, and clouds detected to be seen from their origin, are searched exhaustively
    (`search.search`: rotations up to 63 degrees about the vertical and 52 about any axis,
    translations up to 0.6 of the median depth). Clouds are also registered by feature matching
    (`clouds.fpfh`), under any rotation; without a guess in any case, as a symmetric body fits
    as well in another pose.

    Parameters
    ----------
    source, target
        Frames of a recording, or arrays; non-finite points are dropped.
    guess
        (4, 4) T_target_source to start from; the identity unless given. Of ambiguous poses of two
        images the one at the guess is returned.
    method
        Registration method, or the name of one ("icp", "coarse-to-fine"); the above unless given.
    seed
        Seed of the random selection of points, for methods that use one.

    Returns
    -------
    `T_target_source` maps points of the source into the target's frame, m. `believed` states
    whether the pose is verified, `probability` how probably it is right (images: within 5 % of the
    depth and 4 degrees; clouds: within 5 % of the extent), and `reason` why it is rejected: too
    little support or too little lead over `runner_up`, contradiction, degenerate directions.
    `converged` implies none of that. Degenerate directions (three on a flat wall) are in
    `unobservable`, and keep the guess. A `method` without verification leaves `believed` None.

    Raises
    ------
    InputError
        If an array has the wrong shape or fewer than ten finite points, the guess is no rigid
        motion, or there is no such method.
    RegistrationError
        If too few points correspond, an image is empty, or the median depths of two images differ
        more than fourfold.
    """
    check_number(seed, Bounds(0), "seed", whole=True)
    start = None if guess is None else se3.check_pose(guess, where="guess")
    near = NearOrigin.of(_view(source, "source"), _view(target, "target"), start)
    rng = np.random.default_rng([seed, 0])
    registrar = _registrar(method)
    registration = _registered(near.source, near.target, near.guess, registrar, rng)
    return near.in_files(registration)


def _registrar(method: Registrar | str | None) -> Registrar:
    if method is None:
        return AnyPair()
    named = registered("registration")
    if isinstance(method, str) and method in named:
        found: Registrar = named[method]()
        return found
    if isinstance(method, type | str) or not hasattr(method, "register"):
        raise InputError(
            f"is {method!r}", where="method", remedy=f"use one of {', '.join(sorted(named))}"
        )
    return method


def _registered(
    source: Frame,
    target: Frame,
    guess: Float64 | None,
    registrar: Registrar,
    rng: np.random.Generator,
) -> Registration:
    with one_blas_thread():
        if isinstance(registrar, AnyPair):
            return registrar.register(source, target, guess, rng)
        return registrar.register(source, target, np.eye(4) if guess is None else guess, rng)


def _view(view: Frame | ArrayLike, name: str) -> Frame:
    if isinstance(view, RangeFrame | CloudFrame):
        return view
    return CloudFrame.of(_cloud(view, name))


def _cloud(points: ArrayLike, name: str) -> Float64:
    """Return the finite points of an array (n, 3)."""
    try:
        array = np.asarray(points)
    except ValueError as error:
        raise InputError("is not an array", where=name, remedy="pass (N, 3) numbers") from error
    if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind not in "fiu":
        raise InputError(
            f"is an array of shape {array.shape} and type {array.dtype}",
            where=name,
            remedy="pass a frame, or (N, 3) numbers in metres; for a file, tofuse.open(path)[0]",
        )
    finite = array[np.isfinite(array).all(1)].astype(np.float64)
    if len(finite) < MIN_POINTS:
        raise InputError(
            f"has {len(finite)} finite points",
            where=name,
            remedy=f"use {MIN_POINTS} or more",
        )
    if np.abs(finite).max() > se3.MAX_COORDINATE_M:
        raise InputError(
            f"has coordinates up to {np.abs(finite).max():.0e} m", where=name, remedy="use metres"
        )
    return finite
