"""Adapting a configuration to a recording before its first frame is tracked."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

from tofuse.corrections.base import Correction
from tofuse.corrections.noise import Noise
from tofuse.filters.base import Filter
from tofuse.filters.confidence import Confidence
from tofuse.kernels.threads import threads as use_threads
from tofuse.odometry.given import GivenPoses
from tofuse.odometry.keyframes import Keyframes
from tofuse.odometry.view_options import ViewOptions
from tofuse.parts import name_of
from tofuse.pipeline.config import Config, check_views, kind_of
from tofuse.pipeline.falloff import RANGE, estimate_falloff
from tofuse.pipeline.progress import Progress, Silent
from tofuse.pipeline.trial import Prepare, trial
from tofuse.recordings.frames import Frame, RangeFrame
from tofuse.recordings.noise import noise_model_for
from tofuse.recordings.recording import Recording
from tofuse.registration.prepared_view import RAW_RANGE_FALLOFF
from tofuse.sensor.noise import NOISE, NoiseModel

# Frames, evenly spaced: enough for the background behind an object that turns once.
_SAMPLE = 30


def adapted(
    config: Config,
    recording: Recording,
    threads: int | None = None,
    progress: Progress | None = None,
) -> Config:
    """Return the configuration with everything that is left to the recording filled in.

    These are defaults that depend on the recording (`with_recording_defaults`), what corrections
    and filters learn from up to 30 frames, and the falloffs of the amplitude and of colour.
    Corrections on trial are kept only if overlapping views show the error that they correct
    (`trial`). An adapted configuration stays as it is.

    Parameters
    ----------
    config
        The configuration.
    recording
        The recording that it is adapted to.
    threads
        Number of threads; None: all cores. The result does not depend on it.
    progress
        Is notified of corrections that are left out.

    Raises
    ------
    InputError
        If a filter can't learn from the recording, or its noise.json is invalid.
    """
    config = with_recording_defaults(config, recording)
    initial = config
    filters_learn = any(f.needs_fit for f in (*config.filters, *config.model_filters))
    # BLAS sums differ with its number of threads; ours don't.
    with use_threads(threads), threadpool_limits(1):
        if filters_learn or any(c.needs_fit for c in config.corrections):
            config = _learned(config, recording)
        for item in config.corrections:
            if item.needs_trial:
                config = _tried(config, item, recording, progress or Silent())
        left_out = sum(c.disabled for c in config.corrections)
        if filters_learn and left_out > sum(c.disabled for c in initial.corrections):
            # Filters must learn from images without the corrections that are left out.
            filters, model_filters = initial.filters, initial.model_filters
            config = replace(config, filters=filters, model_filters=model_filters)
            config = _learned(config, recording)
        odometry = config.odometry
        if isinstance(odometry, Keyframes | GivenPoses):
            views = _with_falloffs(odometry.views, recording, _preparation(config))
            config = replace(config, odometry=replace(odometry, views=views))
    return config


def _with_falloffs(views: ViewOptions, recording: Recording, prepare: Prepare) -> ViewOptions:
    """Return the options with the falloffs of amplitude and of colour that were not given."""
    if views.falloff is not None and views.range_falloff is not None:
        return views
    frame = recording.first_readable()
    image = frame if isinstance(frame, RangeFrame) else None
    amplitude = image is not None and image.amplitude_image is not None
    falloff, by_range = views.falloff, views.range_falloff
    if by_range is None:
        # Infrared is that of a time-of-flight camera, unless the recording shows otherwise.
        infrared = image is not None and amplitude and image.amplitude_kind == "ir"
        color = image is not None and not amplitude and image.color_image is not None
        by_range = RAW_RANGE_FALLOFF if infrared else 0.0
        if infrared or color:
            surface = replace(views.surface, falloff=falloff or 0.0, range_falloff=by_range)
            by_range = max(by_range + estimate_falloff(recording, prepare, surface, RANGE), 0.0)
    if falloff is None:
        # Colour cameras compensate their vignetting.
        surface = replace(views.surface, falloff=0.0, range_falloff=by_range)
        falloff = estimate_falloff(recording, prepare, surface) if amplitude else 0.0
    return replace(views, falloff=falloff, range_falloff=by_range)


def with_recording_defaults(config: Config, recording: Recording) -> Config:
    """Return the configuration with the recording's noise model, and its scale of confidence.

    Raises
    ------
    InputError
        If the recording has an invalid noise.json.
    """
    corrections = tuple(
        replace(c, model=_known_noise(recording)) if isinstance(c, Noise) and not c.model else c
        for c in config.corrections
    )
    config = replace(config, corrections=corrections)
    highest = recording.metadata.get("confidence_max")
    if not isinstance(highest, int | float) or not 1 <= highest <= 255:
        return config
    scaled = (
        tuple(f.on_scale(round(highest)) if isinstance(f, Confidence) else f for f in filters)
        for filters in (config.filters, config.model_filters)
    )
    filters, model_filters = scaled
    return replace(config, filters=filters, model_filters=model_filters)


def _known_noise(recording: Recording) -> NoiseModel | None:
    """Return the noise model that the recording states, or that of its camera's family."""
    model = noise_model_for(recording)
    return None if model == NOISE["unknown"] else model


def _learned(config: Config, recording: Recording) -> Config:
    """Return the configuration with what its parts learn from a sample of frames."""
    frames = recording.readable(_SAMPLE)
    check_views(config, kind_of(frames[0]) if frames else "range")
    corrections, frames = _learned_corrections(config.corrections, frames)
    filters, frames = _learned_filters(config.filters, frames)
    model_filters, _ = _learned_filters(config.model_filters, frames)
    return replace(config, corrections=corrections, filters=filters, model_filters=model_filters)


def _tried(config: Config, item: Correction, recording: Recording, progress: Progress) -> Config:
    """Return the configuration with the decision of a correction's trial."""
    others = replace(config, corrections=tuple(c for c in config.corrections if c is not item))
    without, corrected = _preparation(others), _preparation(config)
    if _changes(config, recording, without, corrected):
        result = trial(recording, without, corrected)
        decided = item.after_trial(result.helps, result.strength, result.error)
        if decided.disabled:
            progress.note(f"correction {name_of(item)} not applied: {result.in_words()}")
    else:
        decided = item.after_trial(helps=True)
    corrections = tuple(decided if c is item else c for c in config.corrections)
    return replace(config, corrections=corrections)


def _changes(config: Config, recording: Recording, without: Prepare, corrected: Prepare) -> bool:
    """Whether a correction changes the first image of a recording."""
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


def _preparation(config: Config) -> Prepare:
    """Return the corrections and filters of single frames, without filters over time."""
    correctors = [correction.start() for correction in config.corrections]

    def prepare(frame: Frame) -> Frame:
        for corrector in correctors:
            frame = corrector.apply(frame)
        for item in config.filters:
            if item.window == 1:
                frame = frame.keep(item.mask(frame, ()))
        return frame

    return prepare


def _learned_corrections(
    corrections: Sequence[Correction], frames: list[Frame]
) -> tuple[tuple[Correction, ...], list[Frame]]:
    """Let each correction learn from frames corrected by those before; and correct the frames."""
    learned = []
    for item in corrections:
        item = item.fit(frames) if item.needs_fit else item
        corrector = item.start()
        frames = [corrector.apply(frame) for frame in frames]
        learned.append(item)
    return tuple(learned), frames


def _learned_filters(
    filters: Sequence[Filter], frames: list[Frame]
) -> tuple[tuple[Filter, ...], list[Frame]]:
    """Let each filter learn from frames filtered by those before; and filter the frames."""
    learned = []
    for item in filters:
        item = item.fit(frames) if item.needs_fit else item
        if item.window == 1:  # a sample has no neighbours in time
            frames = [frame.keep(item.mask(frame, ())) for frame in frames]
        learned.append(item)
    return tuple(learned), frames
