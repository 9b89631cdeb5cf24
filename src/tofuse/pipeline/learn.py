"""What parts must know about a whole recording before its first frame: a look ahead."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

from tofuse.corrections.base import Correction
from tofuse.filters.base import Filter
from tofuse.kernels.threads import threads as use_threads
from tofuse.odometry.given import GivenPoses
from tofuse.odometry.keyframes import Keyframes
from tofuse.parts import name_of
from tofuse.pipeline.config import Config, check_views, kind_of
from tofuse.pipeline.falloff import estimate_falloff
from tofuse.pipeline.progress import Progress, Silent
from tofuse.pipeline.trial import Prepare, trial
from tofuse.recordings.frames import Frame, RangeFrame
from tofuse.recordings.recording import Recording

# Frames, evenly spaced: enough to see what is behind an object that turns once.
_SAMPLE = 30


def learnt(
    config: Config,
    recording: Recording,
    threads: int | None = None,
    progress: Progress | None = None,
) -> Config:
    """Return the configuration with what its corrections and filters learn from the recording.

    Reads up to 30 frames, and only if a part learns at all; and some more for the falloff of the
    amplitude towards the corners. Corrections that are on trial are applied only where views
    show what they correct (`trial`); that reads some tens more.

    Parameters
    ----------
    threads
        How many to use; None: all cores. The result does not depend on it.
    progress
        Hears of corrections that are left out.

    Raises
    ------
    InputError
        If the recording does not show what a filter has to learn.
    """
    asked = config
    filters_learn = any(f.needs_fit for f in (*config.filters, *config.model_filters))
    # BLAS sums differ with its number of threads; ours don't.
    with use_threads(threads), threadpool_limits(1):
        if filters_learn or any(c.needs_fit for c in config.corrections):
            config = _taught(config, recording)
        for item in config.corrections:
            if item.needs_trial:
                config = _tried(config, item, recording, progress or Silent())
        left_out = sum(c.disabled for c in config.corrections)
        if filters_learn and left_out > sum(c.disabled for c in asked.corrections):
            # They have to learn from images as they will be.
            unlearnt = replace(config, filters=asked.filters, model_filters=asked.model_filters)
            config = _taught(unlearnt, recording)
        odometry = config.odometry
        if isinstance(odometry, Keyframes | GivenPoses) and odometry.surface.falloff is None:
            falloff = 0.0
            if _has_amplitude(recording):
                falloff = estimate_falloff(recording, _prepared(config), odometry.surface)
            surface = replace(odometry.surface, falloff=falloff)
            config = replace(config, odometry=replace(odometry, surface=surface))
    return config


def _has_amplitude(recording: Recording) -> bool:
    """Whether its images come with amplitude; colour cameras compensate their vignetting."""
    frame = recording.first_readable()
    return isinstance(frame, RangeFrame) and frame.amplitude_image is not None


def _taught(config: Config, recording: Recording) -> Config:
    frames = recording.readable(_SAMPLE)
    check_views(config, kind_of(frames[0]) if frames else "range")
    corrections, frames = _corrections(config.corrections, frames)
    filters, frames = _filters(config.filters, frames)
    model_filters, _ = _filters(config.model_filters, frames)
    return replace(config, corrections=corrections, filters=filters, model_filters=model_filters)


def _tried(config: Config, item: Correction, recording: Recording, progress: Progress) -> Config:
    """Return the configuration with a correction as it is after its trial."""
    without = replace(config, corrections=tuple(c for c in config.corrections if c is not item))
    ways = _prepared(without), _prepared(config)
    if _changes(config, recording, *ways):
        found = trial(recording, *ways)
        after = item.after_trial(found.helps, found.strength, found.error)
        if after.disabled:
            progress.note(f"correction {name_of(item)} not applied: {found.in_words()}")
    else:
        after = item.after_trial(helps=True)
    kept = tuple(after if c is item else c for c in config.corrections)
    return replace(config, corrections=kept)


def _changes(config: Config, recording: Recording, without: Prepare, corrected: Prepare) -> bool:
    """Whether a correction does anything to the first image of a recording."""
    frame = recording.first_readable()
    if frame is None:
        return False
    check_views(config, kind_of(frame))
    if not isinstance(frame, RangeFrame):
        return False
    before, after = without(frame), corrected(frame)
    assert isinstance(before, RangeFrame)
    assert isinstance(after, RangeFrame)
    return not np.array_equal(before.depth, after.depth)


def _prepared(config: Config) -> Prepare:
    """What is tracked of a frame whose neighbours are not known."""
    correctors = [correction.start() for correction in config.corrections]

    def made(frame: Frame) -> Frame:
        for corrector in correctors:
            frame = corrector.apply(frame)
        for item in config.filters:
            if item.window == 1:
                frame = frame.keep(item.mask(frame, ()))
        return frame

    return made


def _corrections(
    corrections: Sequence[Correction], frames: list[Frame]
) -> tuple[tuple[Correction, ...], list[Frame]]:
    """Let each correction learn from what the ones before it made; also returns what all made."""
    out = []
    for item in corrections:
        knowing = item.fit(frames) if item.needs_fit else item
        corrector = knowing.start()
        frames = [corrector.apply(frame) for frame in frames]
        out.append(knowing)
    return tuple(out), frames


def _filters(
    filters: Sequence[Filter], frames: list[Frame]
) -> tuple[tuple[Filter, ...], list[Frame]]:
    """Let each filter learn from what the ones before it left; also returns what they all left."""
    out = []
    for item in filters:
        knowing = item.fit(frames) if item.needs_fit else item
        if item.window == 1:  # a sample has no neighbours in time
            frames = [frame.keep(knowing.mask(frame, ())) for frame in frames]
        out.append(knowing)
    return tuple(out), frames
