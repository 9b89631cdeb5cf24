"""The frames that are checked: evenly spaced ones, and the successor of each."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate

import numpy as np

from tofuse.arrays import Intp
from tofuse.errors import UnreadableFrameError
from tofuse.inspection.pair_motion import Pair, aligned_pair
from tofuse.inspection.planar import Distortion, Region, fit_distortion, regions_of
from tofuse.recordings.frames import Frame, RangeFrame
from tofuse.recordings.recording import Recording, evenly_spaced
from tofuse.registration.prepared_view import PreparedView, prepare_view
from tofuse.registration.surface_options import SurfaceOptions

# Faults affect the full image; a higher resolution would only take longer.
VIEW_COLUMNS = 128


@dataclass(frozen=True, eq=False)
class Sample:
    """A sample of frames of a recording, with lazily computed views, pairs and regions.

    Attributes
    ----------
    recording
        The full recording, for its timestamps.
    frames
        The readable frames of the sample, in order.
    steps
        (i, j) positions in `frames` of consecutive frames of the recording.
    unreadable
        Errors of the unreadable frames.
    turning
        Whether, according to the user, an object turns in front of a stationary camera.
    """

    recording: Recording
    frames: tuple[Frame, ...]
    steps: tuple[tuple[int, int], ...]
    unreadable: tuple[UnreadableFrameError, ...] = ()
    turning: bool = False

    @classmethod
    def of(cls, recording: Recording, count: int, *, turning: bool = False) -> Sample:
        """Read up to `count` pairs of neighbours, evenly spaced, including the first and the last.

        Parameters
        ----------
        recording
            The recording to sample.
        count
            Number of pairs.
        turning
            Whether an object turns in front of a stationary camera.
        """
        n = len(recording)
        first_of_pair = evenly_spaced(np.arange(max(n - 1, 1)), count)
        selected = np.unique(np.concatenate([first_of_pair, np.minimum(first_of_pair + 1, n - 1)]))
        frames: list[Frame] = []
        unreadable: list[UnreadableFrameError] = []
        position_of: dict[int, int] = {}
        for k in selected.tolist():
            try:
                frames.append(recording[k])
            except UnreadableFrameError as error:
                unreadable.append(error)
                continue
            position_of[k] = len(frames) - 1
        breaks = set(part_starts(recording))
        steps = [
            (position_of[k], position_of[k + 1])
            for k in sorted(position_of)
            if k + 1 in position_of and k + 1 not in breaks
        ]
        return cls(recording, tuple(frames), tuple(steps), tuple(unreadable), turning)

    @cached_property
    def images(self) -> tuple[RangeFrame, ...]:
        """The range images with valid pixels."""
        return tuple(f for f in self.frames if isinstance(f, RangeFrame) and f.valid.any())

    @cached_property
    def views(self) -> dict[int, PreparedView]:
        """Prepared views of the range images, by position in `frames`."""
        options = SurfaceOptions(columns=VIEW_COLUMNS)
        return {
            k: prepare_view(f, options)
            for k, f in enumerate(self.frames)
            if isinstance(f, RangeFrame) and f.valid.any()
        }

    @cached_property
    def pairs(self) -> tuple[Pair, ...]:
        """The aligned pairs of consecutive frames."""
        return tuple(
            aligned_pair(self.views[i], self.views[j], i, j)
            for i, j in self.steps
            if i in self.views and j in self.views
        )

    @cached_property
    def distant_pairs(self) -> tuple[Pair, ...]:
        """The first view aligned with each other one."""
        first, *others = self.views
        return tuple(aligned_pair(self.views[first], self.views[k], first, k) for k in others)

    @cached_property
    def regions(self) -> tuple[Region, ...]:
        """The smooth regions of all views."""
        return tuple(
            region for k, view in self.views.items() for region in regions_of(view, frame=k)
        )

    @cached_property
    def radius(self) -> float:
        """Largest distance of the rays (x/z, y/z) of the first image from the axis."""
        rays = self.images[0].camera.rays()
        return float(np.sqrt(np.nanmax((rays * rays).sum(-1))))

    @cached_property
    def distortion(self) -> Distortion | None:
        """The distortion of planes, in the model for a wrong depth kind."""
        return fit_distortion(self.regions, self.radius, "kind")

    @cached_property
    def period_m(self) -> float | None:
        """Range in m after which the phase repeats; None if not known."""
        periods = {f.ambiguity_m for f in self.images}
        period = periods.pop() if len(periods) == 1 else None
        if period is None:
            stated = self.recording.metadata.get("ambiguity_m")
            period = float(stated) if isinstance(stated, int | float) and stated > 0 else None
        return period


def part_starts(recording: Recording) -> list[int]:
    """Return the positions in a recording at which further joined recordings begin."""
    parts = recording.metadata.get("parts", ())
    starts = list(accumulate(part["frames"] for part in parts))[:-1]
    indices: Intp = recording.indices
    return [int(np.searchsorted(indices, s)) for s in starts]
