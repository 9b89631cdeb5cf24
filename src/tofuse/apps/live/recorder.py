"""Recording a live camera to a native recording."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from tofuse.apps.live.device import DeviceError, Stream
from tofuse.engine.errors import InputError, OutputError, TofuseError
from tofuse.engine.frames import RangeFrame
from tofuse.formats.files import staging
from tofuse.formats.recordings import RecordingWriter

_JOIN_TIMEOUT_S = 5.0  # for a camera's last frame
QUEUE_FRAMES = 64  # maximum number that may wait for the disk
MIN_SIGMA_UNIT_M = 1e-5


@dataclass(frozen=True)
class Recorded:
    """The result of a recording.

    Attributes
    ----------
    folder
        The recording.
    frames
        Number of frames written.
    dropped
        Number of frames dropped, as the disk was too slow.
    ended_by
        Reason for the end: "asked" as requested, or the error of the camera or the disk.
    """

    folder: Path
    frames: int
    dropped: int
    ended_by: str


def record(
    stream: Stream,
    folder: str | Path,
    *,
    seconds: float | None = None,
    frames: int | None = None,
    stopped: Callable[[], bool] = lambda: False,
    progress: Callable[[int], None] | None = None,
    seen: Callable[[RangeFrame], None] | None = None,
) -> Recorded:
    """Write the frames of a camera as a native recording.

    The camera is read on its own thread, so that a slow disk drops frames without delaying others.
    If the camera fails or the disk is full, the frames so far are kept. The folder appears when it
    is complete.

    Parameters
    ----------
    stream
        A running camera.
    folder
        Must not exist, or be empty.
    seconds, frames
        Limits by the camera's clock, and by count; None: no limit.
    stopped
        Called after each frame; recording ends if it returns true.
    progress
        Called with the number of frames written so far.
    seen
        Called with each frame.

    Raises
    ------
    DeviceError
        If the camera sent no frame.
    OutputError
        If the folder isn't empty, or no frame can be written.
    """
    if (seconds is not None and not seconds > 0) or (frames is not None and frames < 1):
        raise InputError("there is nothing to record", remedy="use more seconds, or frames")
    with staging.new_folder(folder) as temporary, _Reader(stream) as reader:
        first = reader.next()
        if first is None:
            raise reader.error or DeviceError("sent no frame", where=stream.settings.sensor)
        writer = _writer(stream, first, temporary)
        frame: RangeFrame | None = first
        failure: TofuseError | None = None
        while frame is not None:
            if seconds is not None and frame.timestamp - first.timestamp >= seconds:
                break
            try:
                writer.add(frame)
            except TofuseError as error:
                failure = error
                break
            if progress is not None:
                progress(len(writer))
            if seen is not None:
                seen(frame)
            if len(writer) == frames or stopped():
                break
            frame = reader.next()
        if frame is None:
            failure = reader.error
        failure = _finish(writer, failure)
    ended_by = str(failure or "asked").replace(str(temporary), str(folder))
    return Recorded(Path(folder), len(writer), reader.dropped, ended_by)


def _finish(writer: RecordingWriter, failure: TofuseError | None) -> TofuseError | None:
    """Finish a recording, where the disk is full without some of the last frames.

    Returns what it failed by, if it did; raises it if no frame is left.
    """
    while len(writer):
        try:
            writer.finish()
            return failure
        except OutputError as error:
            failure = error
            writer.remove_last()
    assert failure is not None
    raise failure


class _Reader(AbstractContextManager["_Reader"]):
    """Reads a camera on its own thread into a queue, and drops new frames while it is full."""

    def __init__(self, stream: Stream) -> None:
        self.dropped = 0
        self.error: DeviceError | None = None
        self._stream = stream
        self._queue: queue.Queue[RangeFrame] = queue.Queue(QUEUE_FRAMES)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._work, name="tofuse-camera", daemon=True)
        self._thread.start()

    def next(self) -> RangeFrame | None:
        """Wait for the next frame; None if the camera has failed."""
        while self._thread.is_alive() or not self._queue.empty():
            with suppress(queue.Empty):
                return self._queue.get(timeout=0.1)
        return None

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        # A camera that has gone silent may never return from `read`; the thread is a daemon.
        self._thread.join(_JOIN_TIMEOUT_S)

    def _work(self) -> None:
        try:
            for frame in self._stream:
                if self._stop.is_set():
                    return
                try:
                    self._queue.put_nowait(frame)
                except queue.Full:
                    self.dropped += 1
        except DeviceError as error:
            self.error = error
        except Exception as error:  # the maker's package may raise anything
            problem = f"failed ({type(error).__name__}: {error})"
            self.error = DeviceError(problem, where=self._stream.settings.sensor)


def _writer(stream: Stream, first: RangeFrame, folder: Path) -> RecordingWriter:
    settings = stream.settings
    sigma_unit = None
    if first.sigma_image is not None:
        max_sigma = float(np.nanmax(first.sigma_image, initial=0.0))
        # Later frames may be noisier than the first.
        sigma_unit = max(MIN_SIGMA_UNIT_M, 4 * max_sigma / 65535)
    return RecordingWriter(folder, **vars(settings), sigma_unit_m=sigma_unit)
