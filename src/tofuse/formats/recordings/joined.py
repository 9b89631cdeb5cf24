"""Sources made of others: several in sequence, in another unit, or restricted in depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.frames import CloudFrame, DerivedSource, Frame, RangeFrame, Source


class JoinedSource:
    """Several sources in sequence, which may be joined themselves."""

    def __init__(self, parts: Sequence[Source], names: Sequence[str]) -> None:
        self.parts = list(parts)
        self.concurrent = all(getattr(p, "concurrent", False) for p in self.parts)
        counts = [len(p.timestamps) for p in self.parts]
        self.starts = np.concatenate([[0], np.cumsum(counts)]).astype(int)
        self._names, self._notes = list(names), list[str]()
        self.timestamps = self._joined_times(names)
        self.reference = _joined([p.reference for p in self.parts], counts, (4, 4))
        self.odometry = _joined([p.odometry for p in self.parts], counts, (4, 4))
        self.gravity = _joined([p.gravity for p in self.parts], counts, (4,))
        self.metadata: dict[str, Any] = dict(self.parts[0].metadata)
        for part in self.parts[1:]:
            # Only values common to all parts.
            self.metadata = {
                key: value
                for key, value in self.metadata.items()
                if key in part.metadata and part.metadata[key] == value
            }
        self.metadata["parts"] = [
            part
            for source, name, count in zip(self.parts, names, counts, strict=True)
            for part in _parts(source, name, count)
        ]

    @property
    def warnings(self) -> list[str]:
        """See `Source.warnings`."""
        return [*_joined_warnings(self.parts, self._names), *self._notes]

    def _joined_times(self, names: Sequence[str]) -> Float64:
        times: list[Float64] = []
        for part, name in zip(self.parts, names, strict=True):
            part_times = part.timestamps
            last = max((float(t.max()) for t in times), default=-np.inf)
            if part_times.min() <= last:
                steps = np.diff(part_times)
                step = float(np.median(steps)) if len(steps) else 1.0
                shift = last + max(step, 1e-3) - float(part_times.min())
                part_times = part_times + shift
                self._notes.append(f"{name}: timestamps start again, shifted by {shift:.6g} s")
            times.append(part_times)
        return np.concatenate(times)

    def origin(self, index: int) -> tuple[Source, int]:
        """Return the source that a frame is from, and its index there."""
        part = int(np.searchsorted(self.starts, index, side="right")) - 1
        return self.parts[part], index - int(self.starts[part])

    def read(self, index: int) -> Frame:
        """See `Source.read`."""
        part, index_there = self.origin(index)
        frame = part.read(index_there)
        return replace(frame, index=index, timestamp=float(self.timestamps[index]))


def _parts(source: Source, name: str, count: int) -> list[dict[str, Any]]:
    """The name and the number of frames of each recording that a source consists of."""
    parts = source.metadata.get("parts")
    if parts is None:
        return [{"name": name, "frames": count}]
    return [part | {"name": f"{name}, {part['name']}"} for part in parts]


def _joined_warnings(parts: Sequence[Source], names: Sequence[str]) -> list[str]:
    """The parts' warnings, each once, naming the part where they differ."""
    lines: dict[str, list[str]] = {}
    for part, name in zip(parts, names, strict=True):
        for line in part.warnings:
            lines.setdefault(line, []).append(name)
    return [
        line if len(where) == len(parts) or where[0] in line else f"{', '.join(where)}: {line}"
        for line, where in lines.items()
    ]


def _joined(
    arrays: Sequence[Float64 | None], counts: Sequence[int], shape: tuple[int, ...]
) -> Float64 | None:
    if all(array is None for array in arrays):
        return None
    parts = zip(arrays, counts, strict=True)
    return np.concatenate(
        [np.full((n, *shape), np.nan) if array is None else array for array, n in parts]
    )


# Of an image, m.
_LENGTHS = ("depth", "sigma_image", "shared_sigma_image")


class ScaledSource(DerivedSource):
    """A source in another unit: its depth, or the points and poses of clouds, times a factor."""

    def __init__(self, source: Source, factor: float, *, poses: bool) -> None:
        super().__init__(source)
        self.factor = factor
        units = {name: source.metadata.get(name) for name in ("depth_unit_m", "sigma_unit_m")}
        scaled = {name: factor * unit_m for name, unit_m in units.items() if unit_m is not None}
        self.metadata = source.metadata | scaled
        if poses:
            scale = np.ones((4, 4))
            scale[:3, 3] = factor
            self.reference, self.odometry = (
                None if T is None else scale * T for T in (source.reference, source.odometry)
            )

    def read(self, index: int) -> Frame:
        """See `Source.read`."""
        frame = super().read(index)
        names = ("sigma",) if isinstance(frame, CloudFrame) else _LENGTHS
        lengths: dict[str, Any] = {
            name: (self.factor * image).astype(np.float32)
            for name in names
            if (image := getattr(frame, name)) is not None
        }
        if isinstance(frame, RangeFrame):
            return replace(frame, **lengths)
        return CloudFrame.of(
            self.factor * (frame.points + frame.shift),
            index=frame.index,
            timestamp=frame.timestamp,
            origin=self.factor * (frame.origin + frame.shift),
            up=frame.up,
            normals=frame.normals,
            amplitude=frame.amplitude,
            color=frame.color,
            **lengths,
        )


class LimitedSource(DerivedSource):
    """A source restricted to points between two depths in m: z of images, distance in clouds."""

    def __init__(self, source: Source, min_depth: float, max_depth: float) -> None:
        super().__init__(source)
        self.min_depth, self.max_depth = min_depth, max_depth

    def read(self, index: int) -> Frame:
        """See `Source.read`."""
        frame = super().read(index)
        distance = frame.z if isinstance(frame, RangeFrame) else frame.radial_range
        return frame.keep((distance >= self.min_depth) & (distance <= self.max_depth))
