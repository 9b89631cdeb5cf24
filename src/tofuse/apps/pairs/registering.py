"""``tofuse.register``: one pair of anything that has points."""

from __future__ import annotations

from dataclasses import MISSING, fields, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from tofuse.apps.pairs.views import View, view_of
from tofuse.engine.alignment import Registrar, Registration
from tofuse.engine.bounds import Bounds
from tofuse.engine.clouds import AnyPair, NearOrigin, register_similar
from tofuse.engine.compute import one_blas_thread
from tofuse.engine.errors import InputError, signals_as_themselves
from tofuse.engine.frames import RangeFrame
from tofuse.engine.geometry import se3
from tofuse.engine.parts import check_number, discover, name_of, registered
from tofuse.engine.quantities import percent
from tofuse.engine.search import pose_probability
from tofuse.formats.recordings import FACTORS

# Packages with registration methods.
_METHODS = ("tofuse.engine.icp", "tofuse.engine.clouds", "tofuse.lab.methods")
# Risks that poses are accepted at: the engine rejects those beyond the largest.
MAX_RISK = round(1 - pose_probability.ACCEPTED, 6)
RISKS = Bounds(0, MAX_RISK)


@signals_as_themselves()
def register(
    source: View,
    target: View,
    *,
    guess: ArrayLike | None = None,
    method: Registrar | str | None = None,
    scale: bool | float = False,
    risk: float = MAX_RISK,
    seed: int = 0,
) -> Registration:
    """Register two views, clouds, meshes or results.

    The views are first aligned from the guess. If their agreement makes that pose practically
    certain, it is returned, within milliseconds for images. Otherwise poses are searched; the best
    one is aligned, and evaluated by the agreement of both views and by its lead over the best other
    pose. Two images, and clouds detected to be seen from their origin, are searched exhaustively:
    rotations up to 63 degrees about the vertical and 52 about any axis, translations up to 0.6 of
    the median depth. Clouds are also registered by feature matching (FPFH) under any rotation;
    without a guess always, as a symmetric body fits as well in another pose.

    Parameters
    ----------
    source, target
        Frames of a recording; (N, 3) points in m, of which non-finite ones are dropped; an object
        with `points`, such as a `Cloud` or one of Open3D; a `Mesh`, sampled evenly by area; a
        `Reconstruction`: its cloud. Or the path of a result, of a mesh (.ply, .obj, .stl, .glb; m)
        or of a view as in ``tofuse register``.
    guess
        (4, 4) T_target_source to start from; the identity unless given. Of ambiguous poses the one
        at the guess is returned.
    method
        Registration method, or the name of one ("icp", "coarse-to-fine"); the above unless given.
    scale
        Whether the source is of unknown scale, as models from images alone are. The `scale` of the
        result is then the factor of its points before `T_target_source` is applied, between a
        fourth and four times that of equal extents, and `scale_sigma` its standard deviation; this
        takes seconds. Or that factor, if it is known, such as 0.001 for a source in mm.
    risk
        Largest probability, up to 0.1, that a `believed` pose is wrong. As most are nearly
        certain, a hundredth of all is expected to be wrong with 0.1.
    seed
        Seed of the random selection of points, for methods that use one.

    Returns
    -------
    `T_target_source` maps points of the source into the target's frame, m. `believed` states
    whether the pose is verified, `probability` how probably it is right (images: within 5 % of the
    depth and 4 degrees; clouds: within 5 % of the extent), and `reason` why it is rejected: too
    little support or too little lead over `runner_up`, contradiction, degenerate directions.
    `given_guess`: whether that holds only near the guess, as another pose fits as well, or none was
    tried. `converged` implies none of that. `sigma` (m, rad) and `covariance` state its accuracy.
    Degenerate directions (three on a flat wall) are in `unobservable`, and keep the guess. A
    `method` without verification leaves `believed` None.

    Raises
    ------
    InputError
        If a view can't be used or has fewer than ten finite points, the guess is no rigid motion,
        there is no such method, or the risk is out of range; if `scale` is combined with a guess
        or a method.
    RegistrationError
        If too few points correspond, clouds fit at no scale, an image is empty, or the median
        depths of two images differ more than fourfold.
    """
    check_number(seed, Bounds(0), "seed", whole=True)
    check_number(risk, RISKS, "risk")
    start = None if guess is None else se3.check_pose(guess, where="guess")
    factor = None
    if not isinstance(scale, bool | np.bool_):
        factor = check_number(scale, FACTORS, "scale")
    near = NearOrigin.of(view_of(source, "source", factor), view_of(target, "target"), start)
    if scale and factor is None:
        near, registration = registered_scaled(near, method, seed)
    else:
        registration = registered_near(near, registrar_of(method), seed)
    return near.in_files(at_risk(with_factor(registration, factor), risk))


def with_factor(registration: Registration, factor: float | None) -> Registration:
    """Return the registration of a source in another unit, with its factor as the exact scale."""
    return registration if factor is None else replace(registration, scale=factor, scale_sigma=0.0)


def at_risk(registration: Registration, risk: float) -> Registration:
    """Reject an accepted pose that is wrong with a larger probability than the accepted risk."""
    probability = registration.probability
    if not registration.believed or probability is None or 1 - probability <= risk:
        return registration
    chance = percent(1 - probability)
    reason = f"wrong with a probability of {chance}, above the accepted {percent(risk)}"
    return replace(registration, believed=False, reason=reason)


def registrar_of(method: Registrar | str | None) -> Registrar:
    """Return a registration method by its name; `AnyPair` for None.

    Raises
    ------
    InputError
        If there is no such method.
    """
    if method is None:
        return AnyPair()
    if isinstance(method, str):
        for package in _METHODS:
            discover(package)
    named = {
        name: cls for name, cls in registered("registration").items() if not _required_options(cls)
    }
    if isinstance(method, str) and method in named:
        found: Registrar = named[method]()
        return found
    if isinstance(method, type | str) or not hasattr(method, "register"):
        raise InputError(
            f"is {method!r}", where="method", remedy=f"use one of {', '.join(sorted(named))}"
        )
    return method


def registered_scaled(
    near: NearOrigin, method: Registrar | str | None = None, seed: int = 0
) -> tuple[NearOrigin, Registration]:
    """Return two views, the source at the scale of the target, and their registration.

    Raises
    ------
    InputError
        If there is a guess or a method.
    """
    for name, value in (("guess", near.guess), ("method", method)):
        if value is not None:
            raise InputError("does not apply to --scale", where=name, remedy="leave one out")
    with one_blas_thread():
        found = register_similar(near.source, near.target, np.random.default_rng([seed, 0]))
    return replace(near, source=found.source), found.registration


def _required_options(part: Any) -> list[str]:
    defaults = ("default", "default_factory")
    return [f.name for f in fields(part) if all(getattr(f, d) is MISSING for d in defaults)]


def registered_near(near: NearOrigin, registrar: Registrar, seed: int = 0) -> Registration:
    """Return the registration of two views near the origin, in their coordinates.

    Raises
    ------
    InputError
        If the method doesn't work on such views.
    """
    for view in (near.source, near.target):
        kind = "range" if isinstance(view, RangeFrame) else "cloud"
        if kind not in registrar.takes:
            raise InputError(
                f"{name_of(registrar)} takes no {kind} views",
                where="method",
                remedy="pass frames of a camera, or use another",
            )
    guess = near.guess
    if guess is None and not isinstance(registrar, AnyPair):
        guess = np.eye(4)
    with one_blas_thread():
        # `AnyPair` distinguishes the identity from no guess.
        return registrar.register(
            near.source,
            near.target,
            guess,  # type: ignore[arg-type]
            np.random.default_rng([seed, 0]),
        )
