"""Playing a recording like a live camera."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np

from tofuse.engine.errors import InputError, UnreadableFrameError
from tofuse.engine.frames import Frame, Recording


@dataclass
class Player:
    """Plays a recording in real time, dropping frames that were not requested in time.

    Like a live camera, it yields the newest frame to a late caller. Iterate over it, and push the
    frames into a `Mapper`.

    Attributes
    ----------
    recording
        The recording. Its timestamps must not decrease.
    speed
        Playback speed relative to real time.
    clock, sleep
        Functions that return the time in s, and that wait for a number of s.
    dropped
        Indices (in the source) of the frames dropped so far, including unreadable ones.

    Raises
    ------
    InputError
        If timestamps decrease, or the speed is not positive.
    """

    recording: Recording
    speed: float = 1.0
    clock: Callable[[], float] = time.perf_counter
    sleep: Callable[[float], None] = time.sleep
    dropped: list[int] = field(default_factory=list)

    def __post_init__(self) -> None:
        if not self.speed > 0:
            raise InputError(f"is {self.speed}", where="speed", remedy="use more than 0")
        if (np.diff(self.recording.timestamps) < 0).any():
            raise InputError(
                "has timestamps that decrease, so it can't be played",
                where=self.recording.path,
                remedy="sort its frames by time",
            )

    def __iter__(self) -> Iterator[Frame]:
        due = (self.recording.timestamps - self.recording.timestamps[0]) / self.speed
        start = self.clock()
        k = 0
        while k < len(due):
            now = self.clock() - start
            # The newest frame that is due, or else the next one.
            newest = max(int(np.searchsorted(due, now, side="right")) - 1, k)
            self.dropped += self.recording.indices[k:newest].tolist()
            if due[newest] > now:
                self.sleep(due[newest] - now)
            try:
                frame = self.recording[newest]
            except UnreadableFrameError:
                self.dropped.append(int(self.recording.indices[newest]))
            else:
                yield frame
            k = newest + 1
