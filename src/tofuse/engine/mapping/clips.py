"""Frames and views without a model: of a recording with known poses, and of a clip as tracked."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.errors import UnreadableFrameError
from tofuse.engine.frames import Frame, RangeFrame, Recording
from tofuse.engine.geometry import se3
from tofuse.engine.mapping.color_frames import Unread
from tofuse.engine.mapping.config import Config
from tofuse.engine.mapping.preparation import Preparation
from tofuse.engine.mapping.reconstructing import past_frames
from tofuse.engine.progress import Progress, Silent
from tofuse.engine.stored_views import PosedView, Spacing, ViewStore
from tofuse.engine.tracking import given
from tofuse.engine.views import PreparedView, prepare_view

# Views of a map, of which a place needs few, and width of their images.
_SPACING = Spacing(0.12, 0.06, max_views=4000, max_stretch=1.0, views_per_place=1)
_COLUMNS = 200


def map_views(
    recording: Recording, config: Config, poses: Mapping[int, Float64]
) -> list[PosedView[PreparedView]]:
    """Prepare the views of a recording at T_map_camera (4, 4) by index, spaced by motion.

    Only these are read. The odometry of the configuration must be `GivenPoses`.
    """
    selected = spaced_frames(recording, poses, _SPACING)
    return [
        PosedView(prepared_view(frame, config, past), poses[frame.index])
        for frame, past in _read(recording, config, selected)
        if isinstance(frame, RangeFrame)
    ]


def spaced_frames(
    recording: Recording, poses: Mapping[int, Float64], spacing: Spacing
) -> list[int]:
    """Return the frames that are spaced by motion, by poses (4, 4) of frames by index."""
    first = recording.first_readable()
    depth = 1.0 if first is None else first.mean_depth
    selected: ViewStore[Unread] = ViewStore(spacing)
    for index, T in sorted(poses.items()):
        selected.push(Unread(index, depth), T)
    return [unread.index for unread in selected.views]


def filtered_frames(
    recording: Recording, config: Config, indices: Iterable[int]
) -> Iterator[Frame]:
    """Yield the readable frames among these, corrected, and filtered as for the model."""
    preparation = Preparation(config)
    for frame, past in _read(recording, config, indices):
        yield preparation.process(frame, None, past, None).for_model


def _read(
    recording: Recording, config: Config, indices: Iterable[int]
) -> Iterator[tuple[Frame, list[Frame]]]:
    """Yield the readable frames, and those before that filters need."""
    for index in indices:
        try:
            frame = recording.source.read(index)
        except UnreadableFrameError:
            continue
        yield frame, past_frames(recording, index, config.window - 1)


def prepared_view(frame: RangeFrame, config: Config, past: Sequence[Frame] = ()) -> PreparedView:
    """Correct, filter and prepare an image, as those of a map."""
    filtered = Preparation(config).process(frame, None, past, None).for_tracking
    assert isinstance(config.odometry, given.GivenPoses)
    assert isinstance(filtered, RangeFrame)
    view = prepare_view(filtered, config.odometry.views.surface)
    return view.subsampled(_COLUMNS).without_caches()


@dataclass(frozen=True, eq=False)
class Clip:
    """A part of a recording that was tracked without a gap.

    Attributes
    ----------
    poses
        (4, 4) T_clip_camera by frame index.
    unobservable
        (k, 6) directions of the right perturbation that tracking did not constrain, by the index of
        the frames where there are any.
    store
        Views spaced by motion.
    """

    poses: dict[int, Float64] = field(default_factory=dict)
    unobservable: dict[int, Float64] = field(default_factory=dict)
    store: ViewStore[PreparedView] = field(default_factory=lambda: ViewStore(Spacing()))

    def motion(self, start: int, end: int) -> tuple[Float64, Float64]:
        """Return T_start_end (4, 4) of two frames, and the directions that it does not constrain.

        The latter (k, 6) are those of tracking between them, as right perturbations of the motion.
        """
        T_end = se3.inverse(self.poses[end])
        first, last = sorted((start, end))
        directions = [
            d @ se3.adjoint(T_end @ self.poses[k]).T
            for k, d in self.unobservable.items()
            if first < k <= last
        ]
        T = se3.inverse(self.poses[start]) @ self.poses[end]
        return T, np.concatenate([np.zeros((0, 6)), *directions])


def tracked_clips(
    recording: Recording, config: Config, progress: Progress | None = None
) -> tuple[list[Clip], dict[int, str]]:
    """Track a recording; return its clips, and for each frame without a pose the reason."""
    progress = progress or Silent()
    preparation, tracker = Preparation(config), config.odometry.start(0, config.search)
    clips: dict[int, Clip] = {}
    lost: dict[int, str] = {}
    for index, frame in _frames(recording):
        if isinstance(frame, UnreadableFrameError):
            lost[index] = str(frame)
            continue
        past = past_frames(recording, index, config.window - 1)
        step = tracker.push(preparation.process(frame, None, past, None).for_tracking)
        if step.T_component_camera is None or step.surface is None:
            lost[index] = step.reason
            continue
        clip = clips.setdefault(step.component, Clip())
        clip.poses[index] = step.T_component_camera
        if step.status == "predicted":
            clip.unobservable[index] = np.eye(6)
        elif step.registration is not None and len(step.registration.unobservable):
            clip.unobservable[index] = step.registration.unobservable
        clip.store.push(
            step.surface, step.T_component_camera, reduced=lambda v: v.subsampled(_COLUMNS)
        )
    return list(clips.values()), lost


def _frames(recording: Recording) -> Iterator[tuple[int, Frame | UnreadableFrameError]]:
    yield from zip(recording.indices.tolist(), recording.read_all(), strict=True)
