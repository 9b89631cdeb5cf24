"""The tf tree of ROS bags: poses of cameras in the world and relative to each other."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from tofuse.arrays import Float64
from tofuse.errors import InputError
from tofuse.geometry import quaternion, se3

_ROS2_TYPE = "tf2_msgs/msg/TFMessage"
_ROS1_TYPE = "tf/msg/tfMessage"
_STATIC = "static"  # in the name of the topic
# Largest interval between transforms to interpolate, and largest extrapolation, s.
_MAX_GAP_S, _MAX_EXTRAPOLATION_S = 0.5, 0.02
_MAX_DEPTH = 64


@dataclass(frozen=True, eq=False)
class _Edge:
    """The pose of a frame in its parent: T_parent_child (N, 4, 4) at ascending times (N,).

    If `static`, the last one applies at all times.
    """

    parent: str
    times: Float64
    T: Float64
    static: bool

    def at(self, times: Float64) -> Float64:
        """Return T_parent_child (M, 4, 4) at times (M,), NaN where unknown."""
        if self.static:
            return np.broadcast_to(self.T[-1], (len(times), 4, 4))
        out = np.full((len(times), 4, 4), np.nan)
        after = np.searchsorted(self.times, times)
        a, b = (after - 1).clip(0), after.clip(0, len(self.times) - 1)
        span = self.times[b] - self.times[a]
        fraction = np.where(span > 0, (times - self.times[a]) / np.where(span > 0, span, 1), 0.0)
        inside = (span <= _MAX_GAP_S) & (fraction >= 0) & (fraction <= 1)
        nearest = np.minimum(np.abs(times - self.times[a]), np.abs(times - self.times[b]))
        valid = np.where(a == b, nearest <= _MAX_EXTRAPOLATION_S, inside)
        step = se3.log(se3.inverse(self.T[a[valid]]) @ self.T[b[valid]])
        out[valid] = self.T[a[valid]] @ se3.exp(fraction[valid, None] * step)
        return out


class Transforms:
    """The tf tree of a bag."""

    def __init__(self, edges: dict[str, _Edge]) -> None:
        self._edges = edges

    @classmethod
    def read(cls, bag: Any) -> Transforms:
        """Read all transforms of a bag, except those that are not rigid motions."""
        connections = [c for c in bag.connections if c.msgtype in (_ROS2_TYPE, _ROS1_TYPE)]
        rows: dict[str, list[tuple[float, str, Float64]]] = {}
        static: set[str] = set()
        if connections:
            for connection, _, raw in bag.messages(connections=connections):
                message = bag.deserialize(raw, connection.msgtype)
                for transform in message.transforms:
                    child = frame_name(transform.child_frame_id)
                    row = _row(transform)
                    if row is None:
                        continue
                    rows.setdefault(child, []).append(row)
                    if _STATIC in connection.topic:
                        static.add(child)
        return cls(
            {child: _edge(child_rows, child in static) for child, child_rows in rows.items()}
        )

    def __bool__(self) -> bool:
        return bool(self._edges)

    def ancestors(self, frame: str) -> list[str]:
        """Return the frame and its ancestors, up to the root."""
        frames = [frame]
        while frames[-1] in self._edges and len(frames) < _MAX_DEPTH:
            parent = self._edges[frames[-1]].parent
            if parent in frames:
                break
            frames.append(parent)
        return frames

    def moves(self, ancestor: str, frame: str) -> bool:
        """Whether a frame moves relative to one of its ancestors."""
        return any(not self._edges[child].static for child in self._between(ancestor, frame))

    def poses(self, ancestor: str, frame: str, times: Float64) -> Float64:
        """Return T_ancestor_frame (N, 4, 4) at times (N,), NaN where unknown."""
        T = np.broadcast_to(np.eye(4), (len(times), 4, 4))
        for child in self._between(ancestor, frame):
            T = self._edges[child].at(times) @ T
        return np.array(T)

    def static_transform(self, target: str, frame: str) -> Float64 | None:
        """Return T_target_frame (4, 4) if the frames are fixed to each other, else None."""
        common = next(
            (name for name in self.ancestors(frame) if name in self.ancestors(target)), None
        )
        if common is None or self.moves(common, frame) or self.moves(common, target):
            return None
        time = np.zeros(1)
        T_common_frame, T_common_target = (
            self.poses(common, name, time)[0] for name in (frame, target)
        )
        return np.asarray(se3.inverse(T_common_target) @ T_common_frame, np.float64)

    def _between(self, ancestor: str, frame: str) -> Iterator[str]:
        for name in self.ancestors(frame):
            if name == ancestor:
                return
            yield name


def frame_name(name: Any) -> str:
    """Return the name of a frame without the leading slash of early ROS 1."""
    return str(name).lstrip("/")


def _row(transform: Any) -> tuple[float, str, Float64] | None:
    """Time, parent and T_parent_child (4, 4) of a transform; None if it is not a rigid motion."""
    t, q = transform.transform.translation, transform.transform.rotation
    values = np.array([t.x, t.y, t.z, q.x, q.y, q.z, q.w], float)
    if not np.isfinite(values).all() or abs(quaternion.length(values[3:]) - 1) > 0.01:
        return None
    try:
        T = se3.check_pose(quaternion.to_pose(values[3:], values[:3]), where="tf")
    except InputError:
        return None
    stamp = transform.header.stamp
    return float(stamp.sec) + float(stamp.nanosec) / 1e9, frame_name(transform.header.frame_id), T


def _edge(rows: Sequence[tuple[float, str, Float64]], static: bool) -> _Edge:
    parent = rows[-1][1]
    rows = sorted((row for row in rows if row[1] == parent), key=lambda row: row[0])
    times = np.array([row[0] for row in rows])
    T = np.array([row[2] for row in rows])
    is_last = np.append(np.diff(times) > 0, True)
    return _Edge(parent, times[is_last], T[is_last], static)
