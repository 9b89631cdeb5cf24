"""How far poses are from the right ones."""

from __future__ import annotations

import numpy as np

from tofuse.engine.geometry import se3


def pose_error(
    found: np.ndarray, true: np.ndarray, points: np.ndarray | None = None
) -> tuple[float, float]:
    """Error of a pose, or the largest of several, in m and degrees.

    With points, the metres are those by which their median is moved to the wrong place.
    """
    gap = se3.inverse(true) @ found
    shift = gap[..., :3, 3]
    if points is not None:
        middle = np.median(points, 0)[None].astype(float)
        shift = se3.transform(found, middle) - se3.transform(true, middle)
    metres = np.linalg.norm(shift, axis=-1)
    return float(np.max(metres)), float(np.degrees(np.max(se3.angle(gap))))


def assert_near(found: np.ndarray, true: np.ndarray, metres: float, degrees: float) -> None:
    error = pose_error(found, true)
    assert error[0] < metres, error
    assert error[1] < degrees, error
