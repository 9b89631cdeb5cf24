"""A map of what a camera sees while it records."""

from __future__ import annotations

import queue
import threading
from contextlib import AbstractContextManager, suppress

from tofuse.engine.errors import InputError
from tofuse.engine.frames import RangeFrame
from tofuse.engine.mapping import Mapper
from tofuse.engine.progress import Progress


class LiveMap(AbstractContextManager["LiveMap"]):
    """Maps those frames of a running camera for which there is time, on a thread of its own.

    Parameters
    ----------
    progress
        Receives the frames with their poses.
    """

    def __init__(self, progress: Progress) -> None:
        self._progress = progress
        self._waiting: queue.Queue[RangeFrame] = queue.Queue(1)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._work, name="tofuse-map", daemon=True)
        self._thread.start()

    def offer(self, frame: RangeFrame) -> None:
        """Map a frame, unless an earlier one is waiting."""
        with suppress(queue.Full):
            self._waiting.put_nowait(frame)

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()

    def _work(self) -> None:
        self._progress.stage("tracking")
        mapper = Mapper(progress=self._progress)
        while not self._stop.is_set() or not self._waiting.empty():
            with suppress(queue.Empty):
                frame = self._waiting.get(timeout=0.1)
                try:
                    mapper.push(frame)
                except InputError as error:  # the recording goes on
                    self._progress.note(f"frame {frame.index} is not mapped: {error}")
        self._progress.stage("recorded")
