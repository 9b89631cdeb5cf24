"""The frames that the checks look at: evenly spaced ones, and the one after each."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate

import numpy as np

from tofuse.arrays import Intp
from tofuse.errors import UnreadableFrameError
from tofuse.inspection.motion import Pair, aligned_pair
from tofuse.inspection.planar import Bending, Region, bending, regions_of
from tofuse.recordings.frames import Frame, RangeFrame
from tofuse.recordings.recording import Recording, evenly
from tofuse.registration.prepared_view import PreparedView, SurfaceOptions, prepare_view

# What is looked for is as wide as the image; more pixels would only take longer.
MAP_COLUMNS = 128


@dataclass(frozen=True, eq=False)
class Sample:
    """Some frames of a recording, and what is computed of them when a check asks for it.

    Attributes
    ----------
    recording
        All of it, for its time stamps.
    frames
        The frames that could be read, in order.
    steps
        (i, j) positions in `frames` of frames that follow each other in the recording.
    unreadable
        Of those that could not be read.
    turning
        Whether an object turns before a still camera, by the user's word.
    """

    recording: Recording
    frames: tuple[Frame, ...]
    steps: tuple[tuple[int, int], ...]
    unreadable: tuple[UnreadableFrameError, ...] = ()
    turning: bool = False

    @classmethod
    def of(cls, recording: Recording, count: int, *, turning: bool = False) -> Sample:
        """Read up to `count` pairs of neighbours, evenly spaced, the first and the last among them.

        Parameters
        ----------
        turning
            Whether an object turns before a still camera.
        """
        n = len(recording)
        firsts = evenly(np.arange(max(n - 1, 1)), count)
        wanted = np.unique(np.concatenate([firsts, np.minimum(firsts + 1, n - 1)]))
        frames: list[Frame] = []
        unreadable: list[UnreadableFrameError] = []
        place: dict[int, int] = {}
        for k in wanted.tolist():
            try:
                frames.append(recording[k])
            except UnreadableFrameError as error:
                unreadable.append(error)
                continue
            place[k] = len(frames) - 1
        breaks = set(part_starts(recording))
        steps = [
            (place[k], place[k + 1])
            for k in sorted(place)
            if k + 1 in place and k + 1 not in breaks
        ]
        return cls(recording, tuple(frames), tuple(steps), tuple(unreadable), turning)

    @cached_property
    def images(self) -> tuple[RangeFrame, ...]:
        """The frames that are range images with something in them."""
        return tuple(f for f in self.frames if isinstance(f, RangeFrame) and f.valid.any())

    @cached_property
    def maps(self) -> dict[int, PreparedView]:
        """Surfaces of the range images, by position in `frames`."""
        options = SurfaceOptions(columns=MAP_COLUMNS)
        return {
            k: prepare_view(f, options)
            for k, f in enumerate(self.frames)
            if isinstance(f, RangeFrame) and f.valid.any()
        }

    @cached_property
    def pairs(self) -> tuple[Pair, ...]:
        """Neighbours, and how the camera moved between them."""
        return tuple(
            aligned_pair(self.maps[i], self.maps[j], i, j)
            for i, j in self.steps
            if i in self.maps and j in self.maps
        )

    @cached_property
    def apart(self) -> tuple[Pair, ...]:
        """The first view and each other one."""
        first, *others = self.maps
        return tuple(aligned_pair(self.maps[first], self.maps[k], first, k) for k in others)

    @cached_property
    def regions(self) -> tuple[Region, ...]:
        """Pieces of the views that might be planes."""
        return tuple(
            region for k, view in self.maps.items() for region in regions_of(view, frame=k)
        )

    @cached_property
    def radius(self) -> float:
        """Largest distance of the rays of the first image from the axis."""
        rays = self.images[0].camera.rays()
        return float(np.sqrt(np.nanmax((rays * rays).sum(-1))))

    @cached_property
    def bending(self) -> Bending | None:
        """How surfaces bend, as z taken for range bends them."""
        return bending(self.regions, self.radius, "kind")

    @cached_property
    def period_m(self) -> float | None:
        """Range after which the phase repeats; None where not known."""
        known = {f.ambiguity_m for f in self.images}
        period = known.pop() if len(known) == 1 else None
        if period is None:
            told = self.recording.metadata.get("ambiguity_m")
            period = float(told) if isinstance(told, int | float) and told > 0 else None
        return period


def part_starts(recording: Recording) -> list[int]:
    """Positions in the recording at which another of several joined ones begins."""
    joined = recording.metadata.get("parts", ())
    starts = list(accumulate(part["frames"] for part in joined))[:-1]
    indices: Intp = recording.indices
    return [int(np.searchsorted(indices, s)) for s in starts]
