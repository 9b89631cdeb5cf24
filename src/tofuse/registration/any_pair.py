"""The registration that `tofuse.register` makes, as a part of configurations."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import ClassVar

import numpy as np

from tofuse.arrays import Float64
from tofuse.errors import RegistrationError
from tofuse.geometry import se3
from tofuse.parts import part
from tofuse.recordings.frames import Frame, RangeFrame
from tofuse.registration.base import Registrar, Registration
from tofuse.registration.cloud_pair import follow_clouds, measured_as_clouds, register_clouds
from tofuse.registration.fpfh import Fpfh
from tofuse.registration.prepared_view import PreparedView, SurfaceOptions, prepare_view
from tofuse.registration.uncertainty import UncertaintyOptions
from tofuse.registration.verification import comparable
from tofuse.registration.view_pair import follow, register_pair
from tofuse.registration.viewpoint import as_image, viewpoint_of

FEWEST_POINTS = 10
# Views as they were recorded, far apart: multipath is in them, and bends each
# of them otherwise. See docs/uncertainty.md for how these were found.
_AS_RECORDED = UncertaintyOptions(hidden=0.01, offset=0.5, floor=0.006)
# Poses that shapes propose, at most, and points of a view whose shapes are described for it.
_PROPOSALS, _DESCRIBED = 8, 1500


@part("registration", "any-pair")
@dataclass(frozen=True)
class AnyPair(Registrar):
    """Two views that may be far apart: the pose, and whether it is to be believed.

    Images, and clouds that were seen from their origin, are registered by what both cameras saw
    (`registration.view_pair`). Other clouds, those for which that pose is not believed, and images
    with too little surface for it are registered as clouds (`registration.cloud_pair`).

    Attributes
    ----------
    search
        Whether poses are searched where the one that the guess leads to is not certain. Else that
        one is judged by itself.
    """

    search: bool = True
    takes: ClassVar[frozenset[str]] = frozenset({"range", "cloud"})

    def register(
        self, source: Frame, target: Frame, guess: Float64 | None, rng: np.random.Generator
    ) -> Registration:
        """See `Registrar.register`; without a guess the identity is tried first.

        Of poses that can't be told apart the one at the guess is taken.
        """
        for view in (source, target):
            if len(view) < FEWEST_POINTS:
                raise RegistrationError(f"has {len(view)} points", where=f"frame {view.index}")
        searches = self.search or guess is None
        are_images = isinstance(source, RangeFrame) and isinstance(target, RangeFrame)
        # Of other clouds the shapes are compared below.
        proposals = partial(_alike, source, target, rng) if are_images else None
        seen = _registered_as_images(source, target, guess, proposals, search=searches)
        if seen is not None and are_images:
            return seen
        if seen is not None and seen.believed:
            return measured_as_clouds(source, target, seen, rng)
        if not searches and guess is not None:
            return follow_clouds(source, target, guess, rng)
        return register_clouds(source, target, guess, rng, seen)


def _alike(source: Frame, target: Frame, rng: np.random.Generator) -> Float64:
    """Poses (N, 4, 4), under any rotation, that shapes which are alike propose."""
    try:
        found = Fpfh(points=_DESCRIBED, signed=True).candidates(source, target, rng)
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
    """Register what both cameras saw; None where a view is no image, or has too little surface.

    Raises
    ------
    RegistrationError
        If two range images are of different scale.
    """
    first, second = _as_image(source), _as_image(target)
    if first is None or second is None:
        return None
    (data, T_source_camera), (model, T_target_camera) = first, second
    T_camera_source, T_camera_target = se3.inverse(T_source_camera), se3.inverse(T_target_camera)
    # Views of one recording are near each other more often than not: of poses that can't be told
    # apart the one at the identity is taken, unless something else was guessed.
    start = T_camera_target @ (np.eye(4) if guess is None else guess) @ T_source_camera
    if not comparable(data.depth, model.depth):
        if isinstance(source, RangeFrame) and isinstance(target, RangeFrame):
            raise RegistrationError(
                f"has a median depth of {data.depth:.2g} m, and frame {target.index} of "
                f"{model.depth:.2g} m: views of so different a scale can't be compared",
                where=f"frame {source.index}",
                remedy="check the unit of depth",
            )
        return None  # as clouds, the unit of one of them may be found to be wrong
    if search:
        found = register_pair(data, model, start, proposals=proposals, uncertainty=_AS_RECORDED)
    else:
        found = follow(data, model, start, uncertainty=_AS_RECORDED)
    return None if found is None else found.between(T_target_camera, T_camera_source)


def _as_image(view: Frame) -> tuple[PreparedView, Float64] | None:
    """A view as its camera saw it, and T_view_camera (4, 4); None for clouds from no viewpoint."""
    options = SurfaceOptions()
    if isinstance(view, RangeFrame):
        return prepare_view(view, options), np.eye(4)
    viewpoint = viewpoint_of(view)
    image = None if viewpoint is None else as_image(view, viewpoint)
    return None if image is None else (prepare_view(image[0], options), image[1])
