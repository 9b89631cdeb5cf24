"""``tofuse.register``: one pair of views or clouds, with nothing to set up."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from tofuse.errors import InputError
from tofuse.geometry import se3
from tofuse.kernels.kdtree import KdTree
from tofuse.recordings.frames import CloudFrame, Frame, RangeFrame
from tofuse.registration.base import Registrar, Registration
from tofuse.registration.icp import algorithm_1

_SPACING_SAMPLE = 5000


def register(
    source: Frame | ArrayLike,
    target: Frame | ArrayLike,
    *,
    guess: ArrayLike | None = None,
    method: Registrar | None = None,
    seed: int = 0,
) -> Registration:
    """Register two views, or two (N, 3) clouds in m.

    Parameters
    ----------
    source, target
        Frames of a recording, or arrays; non-finite points are dropped.
    guess
        (4, 4) T_target_source to start from; the identity unless given.
    method
        What registers; Algorithm 1 unless given, on at most 5000 points of each, with twice the
        spacing of the target's points as its resolution.
    seed
        Of the random choice of points.

    Returns
    -------
    The `T_target_source` maps points of the source into the target's frame.

    Raises
    ------
    InputError
        If an array has the wrong shape, or the guess is no rigid motion.
    RegistrationError
        If there are too few points, or none correspond.
    """
    source_view, target_view = _view(source, "source"), _view(target, "target")
    start = np.eye(4) if guess is None else se3.check_pose(guess, where="guess")
    if method is None:
        method = algorithm_1(2 * spacing(target_view), points=_SPACING_SAMPLE)
    rng = np.random.default_rng([seed, 0])
    return method.register(source_view, target_view, start, rng)


def spacing(view: Frame) -> float:
    """Median distance in m between neighbours among 5000 evenly chosen points; 0.01 if too few."""
    points = view.points[:: max(1, len(view) // _SPACING_SAMPLE)].astype(np.float64)
    if len(points) < 2:
        return 0.01
    _, squared = KdTree(points).neighbours(points, 2)
    distances: NDArray[np.float64] = np.sqrt(squared[:, 1])
    positive = distances[distances > 0]
    return float(np.median(positive)) if len(positive) else 0.01


def _view(view: Frame | ArrayLike, name: str) -> Frame:
    if isinstance(view, RangeFrame | CloudFrame):
        return view
    try:
        return CloudFrame.of(view)
    except (InputError, ValueError, TypeError) as error:
        raise InputError(str(error), where=name) from error
