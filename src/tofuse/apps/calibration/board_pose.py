"""Pose of a checkerboard in the frame of a calibrated camera."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from tofuse.apps.calibration.board import Board
from tofuse.engine.arrays import Float64
from tofuse.engine.cameras import Camera
from tofuse.engine.geometry import se3


def board_pose(camera: Camera, corners: Float64, board: Board) -> tuple[Float64, float] | None:
    """Return T_camera_board (4, 4) from corners (N, 2) in pixels, and their rms error in pixels.

    By infinitesimal plane-based pose estimation (Collins and Bartoli 2014), refined by
    Levenberg-Marquardt. None if corners lie outside the valid area of the lens.
    """
    rays = cv2.remap(
        np.asarray(camera.rays(), np.float32),
        corners[:, 0].astype(np.float32),
        corners[:, 1].astype(np.float32),
        cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_REPLICATE,
    ).reshape(-1, 2)
    if not np.isfinite(rays).all():
        return None
    points = board.points.astype(float)
    observed = rays.astype(float)
    try:
        found, rvec, tvec = cv2.solvePnP(points, observed, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE)
        if not found:
            return None
        rvec, tvec = cv2.solvePnPRefineLM(points, observed, np.eye(3), None, rvec, tvec)
    except cv2.error:
        return None
    T = pose_of(rvec, tvec)
    errors = camera.project(se3.transform(T, points)) - corners
    rms = float(np.sqrt((errors**2).sum(1).mean()))
    return (T, rms) if np.isfinite(rms) else None


def pose_of(rvec: NDArray[np.generic], tvec: NDArray[np.generic]) -> Float64:
    """Return the (4, 4) motion of OpenCV's rotation vector and translation."""
    T = np.eye(4)
    T[:3, :3] = cv2.Rodrigues(np.asarray(rvec, float))[0]
    T[:3, 3] = np.asarray(tvec, float).ravel()
    return T
