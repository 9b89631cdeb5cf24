"""A camera's intrinsics and distortion, from images of a checkerboard (Zhang 2000, OpenCV)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from scipy.optimize import least_squares

from tofuse.arrays import Float64
from tofuse.calibration.board import Board, find_corners, picture
from tofuse.calibration.board_pose import board_pose, pose_of
from tofuse.errors import InputError
from tofuse.geometry import se3
from tofuse.geometry.cameras import (
    DISTORTION_ORDER,
    MODELS,
    BrownConrady,
    Camera,
    Fisheye,
    Pinhole,
    Rational,
)
from tofuse.recordings.recording import Recording

LEAST_VIEWS = 4
_SEARCHED = 160  # frames at most in which the board is looked for
_USED = 40  # views at most: more take time and tell little
_MOVED_PX = 3.0  # views in which no corner moved farther are one
_WORSE = 3.0  # times the median view: a view that does not fit
_LEAST_WORSE_PX = 0.3
_LEAST_SPREAD = np.radians(6)  # of the board's normals
_MOST_SIGMA = 0.01  # of the focal length
_COVERED = 0.5
_CELLS = 8
_INTRINSIC = ("fx", "fy", "cx", "cy")


@dataclass(frozen=True, eq=False)
class BoardView:
    """A frame in which the board was found.

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
    """A lens, and how well it is known.

    Attributes
    ----------
    camera
        The lens.
    sigma
        Standard deviation of each of its numbers by name; those held at 0 have none.
    rms_px
        Distance of the corners from where the lens puts them, root mean square.
    before_px
        The same of the lens that the recording came with.
    views, rms_by_view_px
        Frames that were used, and the distance in each.
    left_out
        Frames that were not, each with the reason.
    covered
        Share of the image in which corners lay.
    warnings
        What a person should know, one line each.
    """

    camera: Pinhole
    sigma: dict[str, float]
    rms_px: float
    before_px: float
    views: tuple[int, ...]
    rms_by_view_px: tuple[float, ...]
    left_out: tuple[tuple[int, str], ...]
    covered: float
    warnings: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """Return plain data for JSON."""
        lens = {name: getattr(self.camera, name) for name in names_of(self.camera.model)}
        return {
            "model": self.camera.model,
            "width": self.camera.width,
            "height": self.camera.height,
            "lens": lens,
            "sigma": dict(self.sigma),
            "rms_px": self.rms_px,
            "rms_px_before": self.before_px,
            "views": list(self.views),
            "rms_by_view_px": list(self.rms_by_view_px),
            "left_out": [{"frame": k, "reason": reason} for k, reason in self.left_out],
            "covered": self.covered,
            "warnings": list(self.warnings),
        }


def names_of(model: str) -> tuple[str, ...]:
    """Return the names of a lens model's numbers, as its class has them."""
    return (*_INTRINSIC, *DISTORTION_ORDER[model])


def board_views(
    recording: Recording, board: Board, image: str = "amplitude"
) -> tuple[list[BoardView], list[tuple[int, str]], Camera]:
    """Find the board in up to 160 frames of a recording, evenly spaced.

    Parameters
    ----------
    recording
        Depth images with amplitude, or with colour that is registered to depth.
    board
        What to look for.
    image
        "amplitude" or "color".

    Returns
    -------
    The views that show the board, the frames that don't with the reason, and the camera.

    Raises
    ------
    InputError
        If the recording has no such images.
    """
    views: list[BoardView] = []
    left_out: list[tuple[int, str]] = []
    camera: Camera | None = None
    for item in recording.images(_SEARCHED):
        seen = picture(item, image)
        if seen is None:
            other = "color" if image == "amplitude" else "amplitude"
            raise InputError(
                f"frame {item.index} has no {image} on the pixels of its depth",
                where=recording.path,
                remedy=f"give --image {other}, or record it",
            )
        camera = camera or item.camera
        corners = find_corners(seen, board)
        if corners is None:
            left_out.append((item.index, "the board was not found"))
        else:
            views.append(BoardView(item.index, corners))
    if camera is None:
        raise InputError("has no readable frame", where=recording.path)
    return views, left_out, camera


def calibrate_lens(
    recording: Recording, board: Board, model: str = "brown", image: str = "amplitude"
) -> LensFit:
    """Estimate the lens of the depth camera from views of a checkerboard.

    Up to 40 views that differ are used. Views that fit three times worse than the median one are
    left out, one after another. Of "brown", only as many coefficients are kept as the views tell
    (by the Bayesian information criterion); the others are 0.

    Parameters
    ----------
    recording, board, image
        See `board_views`.
    model
        "pinhole", "brown", "rational" or "fisheye".

    Raises
    ------
    InputError
        If the board is seen too seldom, or its views are too alike to tell the lens.
    """
    if model not in MODELS:
        raise InputError(
            f"there is no lens model {model!r}",
            where="--model",
            remedy=f"use one of {', '.join(MODELS)}",
        )
    views, left_out, before = board_views(recording, board, image)
    found = len(views)
    views, same = _different(views)
    left_out += [(k, "is like another view") for k in same]
    _check_count(recording, board, views, found)
    size = before.width, before.height
    while True:
        fit = _fitted(model, views, board, size, recording.path)
        rms = fit.rms_by_view
        worst = int(np.argmax(rms))
        limit = max(_WORSE * float(np.median(rms)), _LEAST_WORSE_PX)
        if rms[worst] <= limit or len(views) <= LEAST_VIEWS:
            break
        left_out.append((views[worst].index, f"misses by {rms[worst]:.2f} px"))
        del views[worst]
    _check_spread(recording, fit)
    covered = _covered(views, size)
    own = [board_pose(before, view.corners, board) for view in views]
    misses = [pose[1] for pose in own if pose is not None]
    return LensFit(
        fit.camera,
        fit.sigma,
        _rms(rms),
        _rms(np.array(misses)) if misses else float("nan"),
        tuple(view.index for view in views),
        tuple(float(r) for r in rms),
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


def _different(views: list[BoardView]) -> tuple[list[BoardView], list[int]]:
    """Views of which none is like another, at most 40 evenly spaced; and those left out."""
    kept: list[BoardView] = []
    same: list[int] = []
    for view in views:
        if any(np.abs(view.corners - k.corners).max() < _MOVED_PX for k in kept):
            same.append(view.index)
        else:
            kept.append(view)
    if len(kept) > _USED:
        chosen = set(np.linspace(0, len(kept) - 1, _USED).round().astype(int).tolist())
        same += [view.index for k, view in enumerate(kept) if k not in chosen]
        kept = [view for k, view in enumerate(kept) if k in chosen]
    return kept, same


def _check_count(recording: Recording, board: Board, views: list[BoardView], found: int) -> None:
    if len(views) >= LEAST_VIEWS:
        return
    name = f"{board.columns} x {board.rows} inner corners"
    if found == 0:
        raise InputError(
            f"shows no board of {name} in {min(len(recording), _SEARCHED)} frames",
            where=recording.path,
            remedy="check --board; have all of the board in view, matt, with a white margin",
        )
    raise InputError(
        f"shows the board from {len(views)} places that differ (in {found} frames), and "
        f"{LEAST_VIEWS} is the least",
        where=recording.path,
        remedy="record it from 15 places or more, tilted to all sides and all over the image",
    )


def _check_spread(recording: Recording, fit: _Fit) -> None:
    normals = np.stack([T[:3, 2] * np.sign(T[2, 2]) for T in fit.poses])
    mean = normals.mean(0) / np.linalg.norm(normals.mean(0))
    spread = float(np.sqrt((np.arccos(np.clip(normals @ mean, -1, 1)) ** 2).mean()))
    known = max(fit.sigma["fx"] / fit.camera.fx, fit.sigma["fy"] / fit.camera.fy)
    if spread < _LEAST_SPREAD or not known < _MOST_SIGMA:
        raise InputError(
            f"shows the board from {len(fit.poses)} places too much alike (tilts differ by "
            f"{np.degrees(spread):.0f} degrees rms, the focal length is known to "
            f"{100 * known:.2g} %)",
            where=recording.path,
            remedy="tilt it by 20 to 40 degrees to all sides, near and far; check --board",
        )


def _covered(views: Sequence[BoardView], size: tuple[int, int]) -> float:
    """Share of the cells of a grid over the image that lie within a view's corners."""
    seen = np.zeros((_CELLS, _CELLS), bool)
    v, u = (np.mgrid[0:_CELLS, 0:_CELLS] + 0.5) / _CELLS
    for view in views:
        hull = cv2.convexHull(view.corners.astype(np.float32))
        for i, j in np.ndindex(seen.shape):
            at = (float(u[i, j] * size[0]), float(v[i, j] * size[1]))
            seen[i, j] |= cv2.pointPolygonTest(hull, at, False) >= 0
    return float(seen.mean())


def _warnings(fit: _Fit, covered: float, views: int) -> list[str]:
    out = []
    if covered < _COVERED:
        out.append(
            f"corners lay in {100 * covered:.0f} % of the image: the lens is extrapolated "
            "elsewhere; record the board near the borders too"
        )
    if views < 10:
        out.append(f"{views} views were used; 15 or more are safer")
    if fit.camera.model == "rational" and views < 15:
        out.append("a rational lens has 12 numbers; 15 views or more are safer")
    return out


def _rms(values: Float64) -> float:
    return float(np.sqrt((values**2).mean()))


_FREE = cv2.CALIB_FIX_K4 | cv2.CALIB_FIX_K5 | cv2.CALIB_FIX_K6
# Flags that hold coefficients at 0, and which remain; the last of a model has all of them.
_VARIANTS: dict[str, tuple[tuple[int, tuple[str, ...]], ...]] = {
    "pinhole": (
        (
            cv2.CALIB_FIX_K1 | cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST,
            (),
        ),
    ),
    "brown": (
        (cv2.CALIB_FIX_K2 | cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST, ("k1",)),
        (cv2.CALIB_FIX_K3 | cv2.CALIB_ZERO_TANGENT_DIST, ("k1", "k2")),
        (cv2.CALIB_FIX_K3, ("k1", "k2", "p1", "p2")),
        (cv2.CALIB_ZERO_TANGENT_DIST, ("k1", "k2", "k3")),
        (0, ("k1", "k2", "p1", "p2", "k3")),
    ),
    "rational": ((cv2.CALIB_RATIONAL_MODEL, DISTORTION_ORDER["rational"]),),
}


def _fitted(
    model: str, views: Sequence[BoardView], board: Board, size: tuple[int, int], path: str
) -> _Fit:
    """Fit a lens to views; of several variants, that with the least information criterion."""
    try:
        if model == "fisheye":
            return _fisheye(views, board, size)
        count = 2 * sum(len(view.corners) for view in views)
        best: tuple[float, _Fit] | None = None
        for flags, names in _VARIANTS[model]:
            fit = _opencv(model, flags, names, views, board, size)
            numbers = len(_INTRINSIC) + len(names) + 6 * len(views)
            score = count * np.log(fit.squares / count) + numbers * np.log(count)
            if best is None or score < best[0]:
                best = score, fit
    except (cv2.error, InputError, np.linalg.LinAlgError) as error:
        raise InputError(
            f"shows the board from {len(views)} places that no {model} lens explains",
            where=path,
            remedy="tilt it by 20 to 40 degrees to all sides, near and far; check --board",
        ) from error
    assert best is not None
    return best[1]


def _opencv(
    model: str,
    flags: int,
    names: tuple[str, ...],
    views: Sequence[BoardView],
    board: Board,
    size: tuple[int, int],
) -> _Fit:
    free = flags if model == "rational" else flags | _FREE
    out = cv2.calibrateCameraExtended(
        [board.points] * len(views),
        [view.corners.astype(np.float32) for view in views],
        size,
        np.eye(3),
        np.zeros(8),
        flags=free,
    )
    K, distortion, rvecs, tvecs, deviations = out[1], out[2].ravel(), out[3], out[4], out[5].ravel()
    classes: dict[str, type[Pinhole]] = {
        "pinhole": Pinhole,
        "brown": BrownConrady,
        "rational": Rational,
    }
    order = DISTORTION_ORDER["rational"]
    values = {n: float(v) for n, v in zip(order, distortion, strict=False) if n in names}
    camera = classes[model](
        size[0], size[1], float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]), **values
    )
    told = dict(zip((*_INTRINSIC, *order), deviations.tolist(), strict=False))
    sigma = {name: told[name] for name in (*_INTRINSIC, *names)}
    poses = [pose_of(r, t) for r, t in zip(rvecs, tvecs, strict=True)]
    return _of_poses(camera, sigma, poses, views, board)


def _of_poses(
    camera: Pinhole,
    sigma: dict[str, float],
    poses: list[Float64],
    views: Sequence[BoardView],
    board: Board,
) -> _Fit:
    missed = [_missed(camera, T, v, board) for T, v in zip(poses, views, strict=True)]
    squares = np.array([(m**2).sum() for m in missed])
    return _Fit(camera, sigma, poses, np.sqrt(squares / len(board.points)), float(squares.sum()))


def _missed(camera: Pinhole, T: Float64, view: BoardView, board: Board) -> Float64:
    return camera.project(se3.transform(T, board.points.astype(float))) - view.corners


def _fisheye(views: Sequence[BoardView], board: Board, size: tuple[int, int]) -> _Fit:
    """Least squares over lens and poses, started from a lens with one radial coefficient.

    OpenCV's own needs a good start, and gives no deviations.
    """
    flags, names = _VARIANTS["brown"][1]
    start = _opencv("brown", flags, names, views, board, size)
    order = names_of("fisheye")
    lens = np.array([*(getattr(start.camera, n) for n in _INTRINSIC), 0.0, 0.0, 0.0, 0.0])
    # Steps of about the same effect: pixels, shares, radians.
    scale = np.array([*lens[:2], *lens[:2], 1.0, 1.0, 1.0, 1.0])

    def camera_of(x: Float64) -> Fisheye:
        return Fisheye(*size, *(float(v) for v in lens + x[:8] * scale))

    def poses_of(x: Float64) -> list[Float64]:
        steps = x[8:].reshape(-1, 6)
        return [T @ se3.exp(step) for T, step in zip(start.poses, steps, strict=True)]

    def missed(x: Float64) -> Float64:
        camera = camera_of(x)
        parts = [_missed(camera, T, v, board) for T, v in zip(poses_of(x), views, strict=True)]
        return np.concatenate(parts).ravel()

    def slopes(x: Float64) -> Float64:
        base, step = missed(x), 1e-6
        J = np.zeros((base.size, x.size))
        for k in range(8):
            J[:, k] = (missed(x + step * np.eye(x.size)[k]) - base) / step
        rows = 2 * len(board.points)
        # A view's pose moves its own corners alone: all views at once.
        for axis in range(6):
            moved = x.copy()
            moved[8 + axis :: 6] += step
            change = ((missed(moved) - base) / step).reshape(-1, rows)
            for view in range(len(views)):
                J[view * rows : (view + 1) * rows, 8 + 6 * view + axis] = change[view]
        return J

    found = least_squares(missed, np.zeros(8 + 6 * len(views)), jac=slopes, method="lm")
    freedom = max(found.fun.size - found.x.size, 1)
    covariance = np.linalg.inv(found.jac.T @ found.jac)[:8, :8] * 2 * found.cost / freedom
    deviations = np.sqrt(np.diag(covariance)) * scale
    sigma = dict(zip(order, deviations.tolist(), strict=True))
    return _of_poses(camera_of(found.x), sigma, poses_of(found.x), views, board)
