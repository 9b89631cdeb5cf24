"""``tofuse.register``: one pair of views or clouds, with nothing to set up."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tofuse.errors import InputError, RegistrationError
from tofuse.geometry import se3
from tofuse.maps.surface_map import SurfaceOptions, surface_map
from tofuse.recordings.frames import CloudFrame, Frame, RangeFrame
from tofuse.registration.base import Registrar, Registration
from tofuse.registration.coarse_to_fine import CoarseToFine
from tofuse.registration.fpfh import Fpfh
from tofuse.registration.view_pair import register_pair

Float64 = NDArray[np.float64]

_FEWEST_POINTS = 10
_FURTHEST_M = 1e9
# Share of the points with a partner below which a start is doubted, and how many times as many
# another one must give.
_LEAST_SHARE, _CLEARLY = 1 / 3, 1.5


def register(
    source: Frame | ArrayLike,
    target: Frame | ArrayLike,
    *,
    guess: ArrayLike | None = None,
    method: Registrar | None = None,
    seed: int = 0,
) -> Registration:
    """Register two views, or two (N, 3) clouds in m.

    The pose of two range images is followed from the guess. Where both views then agree so well
    that it is as good as certain, that is the answer, within milliseconds. Else all poses within
    reach are searched (`registration.search`: turns up to 63 degrees about the vertical and 52
    about any axis, translations up to 0.6 of the median depth), and the best one is aligned and
    judged by what both views saw of it and by its lead over the best other pose.

    Clouds, and pairs of a cloud and an image, are registered by generalised ICP with a robust loss
    from coarse to fine, at resolutions found from the points (`CoarseToFine`); without a guess
    also by point features (`Fpfh`), where from the identity less than a third of the points find a
    partner. These methods can't say whether the pose is right.

    Parameters
    ----------
    source, target
        Frames of a recording, or arrays; non-finite points are dropped.
    guess
        (4, 4) T_target_source to start from; the identity unless given. Of poses of two images
        that can't be told apart the one at the guess is taken.
    method
        What registers, instead of the above.
    seed
        Of the random choice of points, for methods that choose.

    Returns
    -------
    The `T_target_source` maps points of the source into the target's frame, m. Of two images,
    `believed` says whether it is to be believed, `probability` how probably it is right (within
    5 % of the depth and 4 degrees), and `reason` why it is not believed: too little support or too
    little lead over `runner_up`, contradiction, degenerate directions. `converged` says none of
    that. Directions along which the views could slide (three on a flat wall) are in
    `unobservable`, and stay as they are in the guess.

    Raises
    ------
    InputError
        If an array has the wrong shape or fewer than ten finite points, or the guess is no rigid
        motion.
    RegistrationError
        If too few points correspond, an image is empty, or the median depths of two images differ
        more than fourfold.
    """
    start = np.eye(4) if guess is None else se3.check_pose(guess, where="guess")
    rng = np.random.default_rng([seed, 0])
    if method is None and isinstance(source, RangeFrame) and isinstance(target, RangeFrame):
        return _register_images(source, target, None if guess is None else start, rng)
    if method is None:
        method = CoarseToFine() if guess is not None else _NoGuess()
    if isinstance(source, RangeFrame | CloudFrame) or isinstance(target, RangeFrame | CloudFrame):
        views = _view(source, "source"), _view(target, "target")
        return method.register(*views, start, rng)
    return _register_arrays(_cloud(source, "source"), _cloud(target, "target"), start, method, rng)


def _register_images(
    source: RangeFrame, target: RangeFrame, guess: Float64 | None, rng: np.random.Generator
) -> Registration:
    """Search, and where images have too little surface for that, register their points."""
    for frame in (source, target):
        if len(frame) < _FEWEST_POINTS:
            raise RegistrationError(f"has {len(frame)} points", where=f"frame {frame.index}")
    options = SurfaceOptions()
    found = register_pair(surface_map(source, options), surface_map(target, options), guess)
    if found is not None:
        return found
    plain = _NoGuess() if guess is None else CoarseToFine()
    start = np.eye(4) if guess is None else guess
    reason = "there are too few surfaces to verify the pose"
    return replace(plain.register(source, target, start, rng), believed=False, reason=reason)


@dataclass(frozen=True)
class _NoGuess(Registrar):
    """From the identity, and where that leads nowhere, from what is alike in both views."""

    takes: ClassVar[frozenset[str]] = frozenset({"range", "cloud"})

    def register(
        self, source: Frame, target: Frame, guess: Float64, rng: np.random.Generator
    ) -> Registration:
        """See `Registrar.register`."""
        near, failure = None, None
        try:
            near = CoarseToFine().register(source, target, guess, rng)
        except RegistrationError as error:
            failure = error
        if near is not None and near.share >= _LEAST_SHARE:
            return near
        try:
            far = Fpfh().register(source, target, guess, rng)
        except RegistrationError:
            far = None
        if far is not None and (near is None or far.share > _CLEARLY * near.share):
            return far
        if near is None:
            assert failure is not None
            raise failure
        return near


def _register_arrays(
    source: Float64, target: Float64, guess: Float64, method: Registrar, rng: np.random.Generator
) -> Registration:
    """Register about the middle of the target: map coordinates are too long for float32."""
    to, back = np.eye(4), np.eye(4)
    to[:3, 3] = np.median(target, 0)
    back[:3, 3] = -to[:3, 3]
    data, model = (
        CloudFrame(index, 0.0, (points + back[:3, 3]).astype(np.float32), origin=back[:3, 3])
        for index, points in ((1, source), (0, target))
    )
    found = method.register(data, model, back @ guess @ to, rng)
    inward = se3.adjoint(back)
    free = found.unobservable @ se3.adjoint(to).T
    return replace(
        found,
        T_target_source=to @ found.T_target_source @ back,
        information=inward.T @ found.information @ inward,
        unobservable=free / np.linalg.norm(free, axis=1, keepdims=True),
    )


def _view(view: Frame | ArrayLike, name: str) -> Frame:
    if isinstance(view, RangeFrame | CloudFrame):
        return view
    return CloudFrame.of(_cloud(view, name))


def _cloud(points: ArrayLike, name: str) -> Float64:
    """Return the finite points of an array (n, 3)."""
    try:
        array = np.asarray(points)
    except ValueError as error:
        raise InputError("is not an array", where=name, remedy="give (N, 3) numbers") from error
    if array.ndim != 2 or array.shape[1] != 3 or array.dtype.kind not in "fiu":
        raise InputError(
            f"is an array of shape {array.shape} and type {array.dtype}",
            where=name,
            remedy="give a frame, or (N, 3) numbers in metres",
        )
    good = array[np.isfinite(array).all(1)].astype(np.float64)
    if len(good) < _FEWEST_POINTS:
        raise InputError(
            f"has {len(good)} finite points",
            where=name,
            remedy=f"give {_FEWEST_POINTS} or more",
        )
    if np.abs(good).max() > _FURTHEST_M:
        raise InputError(
            f"has coordinates up to {np.abs(good).max():.0e} m", where=name, remedy="give metres"
        )
    return good
