"""Calibration of intrinsics and distortion from images of a checkerboard (Zhang 2000)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from scipy.linalg import block_diag
from scipy.optimize import least_squares

from tofuse.apps.calibration.board import Board, board_pose, search_board
from tofuse.engine import quantities
from tofuse.engine.arrays import Float64
from tofuse.engine.cameras import DISTORTION_ORDER, MODELS, Camera, Pinhole
from tofuse.engine.errors import InputError
from tofuse.engine.frames import Recording, evenly_spaced
from tofuse.engine.geometry import se3

MIN_VIEWS = 4
_MAX_FRAMES = 160  # maximum number of frames in which the board is searched
_MAX_VIEWS = 40  # maximum number of views
_MIN_MOTION_PX = 3.0  # of the corner that moves most between distinct views
_OUTLIER_RATIO = 3.0  # ratio to the median view's residual at which a view is an outlier
_MIN_OUTLIER_PX = 0.3
_MIN_SPREAD = np.radians(6)  # of the board's normals
_MAX_SIGMA = 0.01  # of the focal length
_MIN_COVERED = 0.5
_CELLS = 64
_STEP = 1e-6  # of derivatives
_INTRINSIC = ("fx", "fy", "cx", "cy")


@dataclass(frozen=True, eq=False)
class BoardView:
    """A frame in which the board was detected.

    Attributes
    ----------
    index
        Of the frame.
    corners
        (N, 2) pixels, in the order of `Board.points`.
    """

    index: int
    corners: Float64


@dataclass(frozen=True)
class LensFit:
    """A calibrated lens and its uncertainty.

    Attributes
    ----------
    camera
        The lens.
    sigma
        Standard deviation of each parameter by name, without those fixed to 0.
    rms_px
        Rms reprojection error of the corners.
    rms_px_before
        The same for the recording's original lens.
    views
        Frames that were used.
    left_out
        Frames that were not used, each with the reason.
    covered
        Fraction of the image covered by corners.
    warnings
        For the user, one line each.
    """

    camera: Pinhole
    sigma: dict[str, float]
    rms_px: float
    rms_px_before: float
    views: tuple[int, ...]
    left_out: tuple[tuple[int, str], ...]
    covered: float
    warnings: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        camera = self.camera
        return {
            **{name: getattr(camera, name) for name in ("model", "width", "height")},
            "lens": {name: getattr(camera, name) for name in names_of(camera.model)},
            **{name: value for name, value in vars(self).items() if name != "camera"},
            "left_out": [{"frame": k, "reason": reason} for k, reason in self.left_out],
        }


def names_of(model: str) -> tuple[str, ...]:
    """Return the names of a lens model's parameters, as in its class."""
    return (*_INTRINSIC, *DISTORTION_ORDER[model])


def board_views(
    recording: Recording, board: Board, image: str = "amplitude"
) -> tuple[list[BoardView], list[tuple[int, str]], Camera]:
    """Detect the board in up to 160 frames of a recording, see `search_board`.

    Returns
    -------
    The views that show the board, the other frames with the reason, and the camera.

    Raises
    ------
    InputError
        If the recording has no such images.
    """
    views: list[BoardView] = []
    left_out: list[tuple[int, str]] = []
    camera: Camera | None = None
    for frame, corners in search_board(recording, board, image, _MAX_FRAMES):
        camera = camera or frame.camera
        if corners is None:
            left_out.append((frame.index, "the board was not found"))
        else:
            views.append(BoardView(frame.index, corners))
    if camera is None:
        raise InputError("has no readable frame", where=recording.path)
    return views, left_out, camera


def calibrate_lens(
    recording: Recording, board: Board, model: str = "brown", image: str = "amplitude"
) -> LensFit:
    """Estimate the lens of the depth camera from views of a checkerboard.

    Up to 40 distinct views are used. Views with three times the median reprojection error are
    removed one by one. The number of coefficients of "brown" is selected by the Bayesian
    information criterion; the others are 0.

    Parameters
    ----------
    recording, board, image
        See `board_views`.
    model
        "pinhole", "brown", "rational" or "fisheye".

    Raises
    ------
    InputError
        If too few views show the board, or they are too similar to determine the lens.
    """
    views, left_out, before = board_views(recording, board, image)
    detected = len(views)
    views, similar = _distinct(views)
    left_out += [(k, "is like another view") for k in similar]
    _check_count(recording, board, views, detected)
    size = before.width, before.height
    while True:
        fit = _fit_lens(model, views, board, size, recording.path)
        rms = fit.rms_by_view
        worst = int(np.argmax(rms))
        limit = max(_OUTLIER_RATIO * float(np.median(rms)), _MIN_OUTLIER_PX)
        if rms[worst] <= limit or len(views) <= MIN_VIEWS:
            break
        left_out.append((views[worst].index, f"misses by {rms[worst]:.2f} px"))
        del views[worst]
    _check_spread(recording, fit)
    covered = _covered(views, size)
    original_poses = [board_pose(before, view.corners, board) for view in views]
    original_errors = [pose[1] for pose in original_poses if pose is not None]
    return LensFit(
        fit.camera,
        fit.sigma,
        _rms(rms),
        _rms(np.array(original_errors)) if original_errors else float("nan"),
        tuple(view.index for view in views),
        tuple(sorted(left_out)),
        covered,
        tuple(_warnings(fit, covered, len(views))),
    )


@dataclass(frozen=True, eq=False)
class _Fit:
    camera: Pinhole
    sigma: dict[str, float]
    poses: list[Float64] = field(repr=False)  # T_camera_board
    rms_by_view: Float64
    squares: float


def _distinct(views: list[BoardView]) -> tuple[list[BoardView], list[int]]:
    """Return at most 40 evenly spaced distinct views, and the frames of the others."""
    distinct: list[BoardView] = []
    similar: list[int] = []
    for view in views:
        if any(np.abs(view.corners - k.corners).max() < _MIN_MOTION_PX for k in distinct):
            similar.append(view.index)
        else:
            distinct.append(view)
    if len(distinct) > _MAX_VIEWS:
        chosen = set(evenly_spaced(np.arange(len(distinct)), _MAX_VIEWS).tolist())
        similar += [view.index for k, view in enumerate(distinct) if k not in chosen]
        distinct = [view for k, view in enumerate(distinct) if k in chosen]
    return distinct, similar


def _check_count(recording: Recording, board: Board, views: list[BoardView], detected: int) -> None:
    if len(views) >= MIN_VIEWS:
        return
    name = f"{board.columns} x {board.rows} inner corners"
    if detected == 0:
        raise InputError(
            f"shows no board of {name} in {min(len(recording), _MAX_FRAMES)} frames",
            where=recording.path,
            remedy="check --board; have all of the board in view, matt, with a white margin",
        )
    raise InputError(
        f"shows the board from {len(views)} distinct viewpoints (in "
        f"{quantities.count(detected, 'frame')}); at least "
        f"{MIN_VIEWS} are needed",
        where=recording.path,
        remedy="record it from 15 places or more, tilted to all sides and all over the image",
    )


def _check_spread(recording: Recording, fit: _Fit) -> None:
    normals = np.stack([T[:3, 2] * np.sign(T[2, 2]) for T in fit.poses])
    mean = normals.mean(0) / np.linalg.norm(normals.mean(0))
    spread = float(np.sqrt((np.arccos(np.clip(normals @ mean, -1, 1)) ** 2).mean()))
    relative_sigma = max(fit.sigma["fx"] / fit.camera.fx, fit.sigma["fy"] / fit.camera.fy)
    if spread < _MIN_SPREAD or not relative_sigma < _MAX_SIGMA:
        raise InputError(
            f"shows the board from {len(fit.poses)} viewpoints too similar (tilts differ by "
            f"{np.degrees(spread):.0f} degrees rms, the focal length is known to "
            f"{100 * relative_sigma:.2g} %)",
            where=recording.path,
            remedy="tilt it by 20 to 40 degrees to all sides, near and far; check --board",
        )


def _covered(views: Sequence[BoardView], size: tuple[int, int]) -> float:
    """Return the fraction of a grid's cells that lie within the corners of a view."""
    covered = np.zeros((_CELLS, _CELLS), np.uint8)
    for view in views:
        cells = cv2.convexHull(
            ((view.corners + 0.5) / size * _CELLS - 0.5).round().astype(np.int32)
        )
        cv2.fillConvexPoly(covered, cells, 1)
    return float(covered.mean())


def _warnings(fit: _Fit, covered: float, views: int) -> list[str]:
    out = []
    if covered < _MIN_COVERED:
        out.append(
            f"corners cover {100 * covered:.0f} % of the image: the lens is extrapolated "
            "elsewhere; record the board near the borders too"
        )
    if views < 10:
        out.append(f"{views} views were used; 15 or more are recommended")
    if fit.camera.model == "rational" and views < 15:
        out.append("a rational lens has 12 parameters; 15 views or more are recommended")
    return out


def _rms(values: Float64) -> float:
    return float(np.sqrt((values**2).mean()))


# The free coefficients of each variant of a model, the full one last; the others are 0.
_VARIANTS: dict[str, tuple[tuple[str, ...], ...]] = {
    "pinhole": ((),),
    "brown": (
        ("k1",),
        ("k1", "k2"),
        ("k1", "k2", "p1", "p2"),
        ("k1", "k2", "k3"),
        ("k1", "k2", "p1", "p2", "k3"),
    ),
    "rational": (DISTORTION_ORDER["rational"],),
    "fisheye": (DISTORTION_ORDER["fisheye"],),
}


def _fit_lens(
    model: str, views: Sequence[BoardView], board: Board, size: tuple[int, int], path: str
) -> _Fit:
    """Fit a lens to views, selecting the variant with the smallest information criterion."""
    try:
        start = _initial_fit(views, board, size)
        count = 2 * sum(len(view.corners) for view in views)
        best: tuple[float, _Fit] | None = None
        for names in _VARIANTS[model]:
            fit = _least_squares(MODELS[model], names, start, views, board)
            parameters = len(_INTRINSIC) + len(names) + 6 * len(views)
            score = count * np.log(fit.squares / count) + parameters * np.log(count)
            if best is None or score < best[0]:
                best = score, fit
    except (cv2.error, InputError, np.linalg.LinAlgError, ValueError) as error:
        raise InputError(
            f"shows the board from {len(views)} viewpoints that no {model} lens fits",
            where=path,
            remedy="tilt it by 20 to 40 degrees to all sides, near and far; check --board",
        ) from error
    assert best is not None
    return best[1]


def _initial_fit(views: Sequence[BoardView], board: Board, size: tuple[int, int]) -> _Fit:
    """Return a fit with one radial coefficient, from which all models converge."""
    corners = [view.corners.astype(np.float32) for view in views]
    K = cv2.initCameraMatrix2D([board.points] * len(views), corners, size)
    camera = Pinhole(*size, *(float(v) for v in (K[0, 0], K[1, 1], K[0, 2], K[1, 2])))
    poses = [board_pose(camera, view.corners, board) for view in views]
    if any(pose is None for pose in poses):
        raise ValueError("a view has no pose")
    start = _Fit(camera, {}, [pose[0] for pose in poses if pose is not None], np.zeros(0), 0.0)
    return _least_squares(MODELS["brown"], ("k1",), start, views, board)


def _least_squares(
    model: type[Pinhole],
    names: tuple[str, ...],
    start: _Fit,
    views: Sequence[BoardView],
    board: Board,
) -> _Fit:
    """Fit the named coefficients, intrinsics and all poses, from other intrinsics and poses."""
    free = (*_INTRINSIC, *names)
    width, height = start.camera.width, start.camera.height
    lens = np.array([*(getattr(start.camera, n) for n in _INTRINSIC), *[0.0] * len(names)])
    # Parameters are scaled to steps of similar effect: ratios, radians.
    scale = np.array([*lens[:2], *lens[:2], *[1.0] * len(names)])
    first_poses, points = np.array(start.poses), board.points.astype(float)

    def unpacked(x: Float64) -> tuple[Pinhole, Float64]:
        values = (lens + x[: len(free)] * scale).tolist()
        camera = model(width, height, **dict(zip(free, values, strict=True)))
        return camera, first_poses @ se3.exp(x[len(free) :].reshape(-1, 6))

    def errors(x: Float64) -> Float64:
        camera, poses = unpacked(x)
        seen = camera.extrapolate(np.concatenate([se3.transform(T, points) for T in poses]))
        return (seen - np.concatenate([view.corners for view in views])).ravel()

    # A pose affects the corners of its own view only, so all poses are perturbed at once.
    count = len(views)
    own = np.kron(np.eye(count), np.ones((2 * len(points), 6)))
    axes = block_diag(np.eye(len(free)), np.tile(np.eye(6), count))

    def jacobian(x: Float64) -> Float64:
        base = errors(x)
        J = np.stack([(errors(x + _STEP * axis) - base) / _STEP for axis in axes], 1)
        return np.hstack([J[:, : len(free)], own * np.tile(J[:, len(free) :], count)])

    solution = least_squares(errors, np.zeros(axes.shape[1]), jacobian, method="lm")
    freedom = max(solution.fun.size - solution.x.size, 1)
    information = solution.jac.T @ solution.jac
    covariance = np.linalg.inv(information) * 2 * solution.cost / freedom
    deviations = np.sqrt(np.diag(covariance)[: len(free)]) * scale
    camera, poses = unpacked(solution.x)
    squares = (solution.fun**2).reshape(count, -1).sum(1)
    sigma = dict(zip(free, deviations.tolist(), strict=True))
    return _Fit(camera, sigma, list(poses), np.sqrt(squares / len(points)), float(squares.sum()))
