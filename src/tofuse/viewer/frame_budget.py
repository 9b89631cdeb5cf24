"""Number of triangles that a browser renders smoothly, from the times of its camera messages."""

from __future__ import annotations

import numpy as np

# 60 million triangles per second at 30 frames per second: a tenth or less of the data sheets'
# figures for integrated graphics.
MAX_SHOWN_FACES = 2_000_000
# While the camera moves, viser sends its pose once per rendered frame, at most every 20 ms.
_TARGET_S = 1 / 30
_SLOW_S, _FAST_S = 1.2 * _TARGET_S, 0.8 * _TARGET_S
_WINDOW_S, _MIN_INTERVALS = 0.15, 2  # from which a frame interval is estimated
_PAUSE_S = 10.0  # longer intervals are pauses
_MAX_CHANGE = 8.0  # between estimates: one may be disturbed by tiles that are being loaded
_REST_S, _REST_INTERVALS = 0.3, 2.5  # without messages, after which the camera is at rest
_RESTING_FACTOR = 8.0  # by which an image at rest may take longer


class FrameBudget:
    """Adapts the number of triangles to the frame rate of a client.

    Parameters
    ----------
    min_faces
        Triangles of the coarsest surface, the minimum.

    Attributes
    ----------
    moving
        Maximum number of triangles while the camera moves.
    """

    def __init__(self, min_faces: int) -> None:
        self._min_faces = min(min_faces, MAX_SHOWN_FACES)
        self.moving = max(int(MAX_SHOWN_FACES / _RESTING_FACTOR), self._min_faces)
        self._times: list[float] = []
        self._interval = 0.0

    @property
    def resting(self) -> int:
        """Maximum number of triangles while the camera is at rest."""
        return min(MAX_SHOWN_FACES, int(_RESTING_FACTOR * self.moving))

    @property
    def rest_s(self) -> float:
        """Time in s after the last message from which the camera is at rest."""
        return max(_REST_S, _REST_INTERVALS * self._interval)

    def moved(self, time: float, shown_faces: int) -> None:
        """Take account of a camera message.

        Parameters
        ----------
        time
            When it arrived, s.
        shown_faces
            Triangles that the client shows.
        """
        if self._times and time - self._times[-1] > _PAUSE_S:
            self._times.clear()
        self._times.append(time)
        intervals = np.diff(self._times)
        if len(intervals) < _MIN_INTERVALS or intervals.sum() < _WINDOW_S:
            return
        # Input in steps, such as that of a wheel, adds pauses: the shorter intervals are frames.
        self._interval = float(np.quantile(intervals, 0.25, method="lower"))
        self._times = [time]
        if self._interval > _SLOW_S:
            factor = max(_TARGET_S / self._interval, 1 / _MAX_CHANGE)
            self.moving = max(self._min_faces, int(factor * min(self.moving, shown_faces)))
        elif self._interval < _FAST_S:
            self.moving = min(MAX_SHOWN_FACES, 2 * self.moving)
