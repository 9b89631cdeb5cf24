"""Registration of one pair of views or clouds: the method of ``tofuse.register``."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from weakref import WeakKeyDictionary

import numpy as np

from tofuse.engine import quantities
from tofuse.engine.alignment import Registrar, Registration, UncertaintyOptions
from tofuse.engine.arrays import Float64
from tofuse.engine.clouds.cloud_pair import follow_clouds, register_clouds, with_cloud_information
from tofuse.engine.clouds.fpfh import candidates
from tofuse.engine.clouds.isolated import sampled, without_isolated
from tofuse.engine.clouds.viewpoint import as_image, viewpoint_of
from tofuse.engine.errors import RegistrationError
from tofuse.engine.frames import CloudFrame, Frame, RangeFrame
from tofuse.engine.geometry import se3
from tofuse.engine.parts import part
from tofuse.engine.search import follow, register_pair, verification
from tofuse.engine.views import PreparedView, SurfaceOptions, prepare_view

MIN_POINTS = 10
# For recorded views with a wide baseline, which multipath distorts individually.
# docs/uncertainty.md describes the calibration.
_RECORDED_VIEWS = UncertaintyOptions(hidden=0.01, offset=0.5, floor=0.006)
# Maximum number of points of a cloud.
_MAX_POINTS = 320_000
# Cache: a view is registered to several others; None of one that stays as it is.
_cleaned_views: WeakKeyDictionary[Frame, Frame | None] = WeakKeyDictionary()
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

    def register(
        self, source: Frame, target: Frame, guess: Float64 | None, rng: np.random.Generator
    ) -> Registration:
        """See `Registrar.register`; without a guess the identity is tried first.

        Of ambiguous poses the one at the guess is returned.
        """
        for view in (source, target):
            if len(view) < MIN_POINTS:
                raise RegistrationError(
                    f"has {quantities.count(len(view), 'point')}", where=f"frame {view.index}"
                )
        source, target = _cleaned(source), _cleaned(target)
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
            found = with_cloud_information(source, target, image_registration, rng)
            if guess is not None or not found.given_guess:
                return found
        if not searches and guess is not None:
            return follow_clouds(source, target, guess, rng)
        return register_clouds(source, target, guess, rng, image_registration)


def _cleaned(view: Frame) -> Frame:
    """Return a view without isolated points, and of larger clouds a random subset."""
    if not isinstance(view, CloudFrame):
        return view
    if view not in _cleaned_views:
        cleaned = without_isolated(sampled(view, _MAX_POINTS))
        _cleaned_views[view] = None if cleaned is view else cleaned
    found = _cleaned_views[view]
    return view if found is None else found


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
