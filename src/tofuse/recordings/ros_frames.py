"""The tf tree of ROS bags: poses of cameras in the world and relative to each other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tofuse.arrays import Float64
from tofuse.errors import InputError
from tofuse.geometry import quaternion, se3

_KIND = "tf2_msgs/msg/TFMessage"
_OLD_KIND = "tf/msg/tfMessage"
_STATIC = "static"  # in the name of the topic
# Largest interval between transforms to interpolate, and largest extrapolation, s.
_MAX_GAP_S, _MAX_EXTRAPOLATION_S = 0.5, 0.02
_MAX_DEPTH = 64


@dataclass(frozen=True, eq=False)
class _Edge:
    """The pose of a frame in its parent: T_parent_child (N, 4, 4) at ascending times (N,).

    If `fixed`, the last one applies at all times.
    """

    parent: str
    times: Float64
    T: Float64
    fixed: bool

    def at(self, times: Float64) -> Float64:
        """Return T_parent_child (M, 4, 4) at times (M,), NaN where unknown."""
        if self.fixed:
            return np.broadcast_to(self.T[-1], (len(times), 4, 4))
        out = np.full((len(times), 4, 4), np.nan)
        after = np.searchsorted(self.times, times)
        a, b = (after - 1).clip(0), after.clip(0, len(self.times) - 1)
        span = self.times[b] - self.times[a]
        fraction = np.where(span > 0, (times - self.times[a]) / np.where(span > 0, span, 1), 0.0)
        inside = (span <= _MAX_GAP_S) & (fraction >= 0) & (fraction <= 1)
        nearest = np.minimum(np.abs(times - self.times[a]), np.abs(times - self.times[b]))
        known = np.where(a == b, nearest <= _MAX_EXTRAPOLATION_S, inside)
        step = se3.log(se3.inverse(self.T[a[known]]) @ self.T[b[known]])
        out[known] = self.T[a[known]] @ se3.exp(fraction[known, None] * step)
        return out


class Transforms:
    """The tf tree of a bag."""

    def __init__(self, edges: dict[str, _Edge]) -> None:
        self._edges = edges

    @classmethod
    def read(cls, bag: Any) -> Transforms:
        """Read all transforms of a bag, except those that are not rigid motions."""
        chosen = [c for c in bag.connections if c.msgtype in (_KIND, _OLD_KIND)]
        rows: dict[str, list[tuple[float, str, Float64]]] = {}
        fixed: set[str] = set()
        if chosen:
            for connection, _, raw in bag.messages(connections=chosen):
                message = bag.deserialize(raw, connection.msgtype)
                for each in message.transforms:
                    child = frame_name(each.child_frame_id)
                    row = _row(each)
                    if row is None:
                        continue
                    rows.setdefault(child, []).append(row)
                    if _STATIC in connection.topic:
                        fixed.add(child)
        return cls({child: _edge(own, child in fixed) for child, own in rows.items()})

    def __bool__(self) -> bool:
        return bool(self._edges)

    def above(self, frame: str) -> list[str]:
        """Return the frame, its parent, and so on up to the root."""
        names = [frame]
        while names[-1] in self._edges and len(names) < _MAX_DEPTH:
            parent = self._edges[names[-1]].parent
            if parent in names:
                break
            names.append(parent)
        return names

    def moves(self, above: str, frame: str) -> bool:
        """Whether a frame moves relative to one above it."""
        return any(not self._edges[each].fixed for each in self._between(above, frame))

    def poses(self, above: str, frame: str, times: Float64) -> Float64:
        """Return T_above_frame (N, 4, 4) at times (N,), NaN where unknown."""
        T = np.broadcast_to(np.eye(4), (len(times), 4, 4))
        for each in self._between(above, frame):
            T = self._edges[each].at(times) @ T
        return np.array(T)

    def fixed(self, to: str, frame: str) -> Float64 | None:
        """Return T_to_frame (4, 4) if the frames don't move relative to each other, else None."""
        shared = next((each for each in self.above(frame) if each in self.above(to)), None)
        if shared is None or self.moves(shared, frame) or self.moves(shared, to):
            return None
        once = np.zeros(1)
        T_shared_frame, T_shared_to = (self.poses(shared, each, once)[0] for each in (frame, to))
        return np.asarray(se3.inverse(T_shared_to) @ T_shared_frame, np.float64)

    def _between(self, above: str, frame: str) -> Iterator[str]:
        for each in self.above(frame):
            if each == above:
                return
            yield each


def frame_name(name: Any) -> str:
    """Return the name of a frame without the leading slash of early ROS 1."""
    return str(name).lstrip("/")


def _row(each: Any) -> tuple[float, str, Float64] | None:
    """Time, parent and T_parent_child (4, 4) of a transform; None if it is not a rigid motion."""
    t, q = each.transform.translation, each.transform.rotation
    numbers = np.array([t.x, t.y, t.z, q.x, q.y, q.z, q.w], float)
    if not np.isfinite(numbers).all() or abs(quaternion.length(numbers[3:]) - 1) > 0.01:
        return None
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = quaternion.to_matrix(numbers[3:]), numbers[:3]
    try:
        T = se3.check_pose(T, where="tf")
    except InputError:
        return None
    stamp = each.header.stamp
    return float(stamp.sec) + float(stamp.nanosec) / 1e9, frame_name(each.header.frame_id), T


def _edge(rows: Sequence[tuple[float, str, Float64]], fixed: bool) -> _Edge:
    parent = rows[-1][1]
    rows = sorted((row for row in rows if row[1] == parent), key=lambda row: row[0])
    times = np.array([row[0] for row in rows])
    T = np.array([row[2] for row in rows])
    last = np.append(np.diff(times) > 0, True)
    return _Edge(parent, times[last], T[last], fixed)
