"""The recordings of a rig's cameras as one."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from tofuse.engine.arrays import Float64, Intp
from tofuse.engine.cameras import ray_lengths
from tofuse.engine.errors import InputError
from tofuse.engine.frames import Frame, RangeFrame, Recording, Source
from tofuse.engine.times import nearest
from tofuse.formats.rigs.rig_file import Rig

# Largest time difference within an instant, as a fraction of the frame interval.
_SAME_INSTANT = 0.6


class RigSource:
    """Images of all cameras in temporal order, with depth offsets relative to the first camera.

    Parameters
    ----------
    rig
        The rig; its cameras have the order of the recordings.
    recordings
        One for each camera.

    Attributes
    ----------
    instant, camera
        (N,) number of the instant and of the camera of each frame.
    """

    reference: Float64 | None = None
    odometry: Float64 | None = None
    gravity: Float64 | None = None

    def __init__(self, rig: Rig, recordings: Sequence[Recording]) -> None:
        self.rig = rig
        self._recordings = list(recordings)
        rows = self._rows()
        if not len(rows):
            raise InputError(
                "no images of its cameras are of the same time",
                where="the rig",
                remedy="pass recordings of the same time, or calibrate the clocks again",
            )
        self.instant, self.camera, self._row = rows.T
        self.timestamps = np.array(
            [
                float(recordings[c].timestamps[row]) + rig.cameras[c].time_offset_s
                for _, c, row in rows
            ]
        )
        self.metadata: dict[str, Any] = {
            key: value
            for key, value in recordings[0].metadata.items()
            if all(r.metadata.get(key) == value for r in recordings)
        }
        self.metadata["cameras"] = [camera.name for camera in rig.cameras]

    @staticmethod
    def of(recording: Recording) -> RigSource:
        """Return the source of a rig's recording."""
        assert isinstance(recording.source, RigSource)
        return recording.source

    @property
    def warnings(self) -> list[str]:
        """See `Source.warnings`."""
        lines = [
            f"{camera.name}: {warning}"
            for camera, recording in zip(self.rig.cameras, self._recordings, strict=True)
            for warning in recording.warnings
        ]
        if not any(camera.covariance.any() for camera in self.rig.cameras[1:]):
            lines.append(
                "the rig has no covariances: the accuracy leaves out errors of its cameras' poses"
            )
        return lines

    def _rows(self) -> Intp:
        """(N, 3) instant, camera, and position in the recording of each frame."""
        times = [
            recording.timestamps + camera.time_offset_s
            for recording, camera in zip(self._recordings, self.rig.cameras, strict=True)
        ]
        single = all(len(t) == 1 for t in times)
        intervals = [float(np.median(np.diff(t))) if len(t) > 1 else 0.0 for t in times]
        limits = [np.inf if single else _SAME_INSTANT * interval for interval in intervals]
        others = zip(times[1:], limits[1:], strict=True)
        table = np.stack(
            [np.arange(len(times[0])), *(nearest(t, times[0], limit) for t, limit in others)], 1
        )
        table = table[(table >= 0).all(1)]
        return np.stack([*np.indices(table.shape), table], -1).reshape(-1, 3)

    @property
    def T_rig_camera(self) -> Float64:
        """(N, 4, 4) mounting pose of the camera of each frame."""
        return np.stack([self.rig.cameras[c].T_rig_camera for c in self.camera])

    def origin(self, index: int) -> tuple[Source, int]:
        """Return the source that a frame is from, and its index there."""
        recording = self._recordings[int(self.camera[index])]
        return recording.source, int(recording.indices[self._row[index]])

    def read(self, index: int) -> Frame:
        """See `Source.read`."""
        camera = int(self.camera[index])
        frame = self._recordings[camera][int(self._row[index])]
        if isinstance(frame, RangeFrame):
            frame = with_range_added(frame, -self.rig.cameras[camera].depth_offset_m)
        return replace(frame, index=index, timestamp=float(self.timestamps[index]))


def check_one_camera(recording: Recording) -> None:
    """Raise InputError if a recording is a rig's: as that of one camera, it would jump."""
    if "cameras" in recording.metadata:
        raise InputError(
            "is a rig of several cameras",
            where=recording.path,
            remedy="pass the recording of one camera (`tofuse run` makes a model of all)",
        )


def with_range_added(frame: RangeFrame, metres: float) -> RangeFrame:
    """Return the image with `metres` added to its ranges."""
    if metres == 0:
        return frame
    scale = 1.0 if frame.depth_kind == "range" else 1.0 / ray_lengths(frame.camera)
    depth = np.where(frame.valid, np.maximum(frame.depth + metres * scale, 0), 0)
    return replace(frame, depth=np.nan_to_num(depth).astype(np.float32))
