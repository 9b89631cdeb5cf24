"""Adapting a configuration to a recording before its first frame is tracked."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Literal, TypeVar, get_args

import numpy as np
from threadpoolctl import threadpool_limits

from tofuse.engine.alignment import ViewOptions
from tofuse.engine.arrays import Float64
from tofuse.engine.compute import threads as use_threads
from tofuse.engine.errors import InputError
from tofuse.engine.filters import Confidence, Filter
from tofuse.engine.frames import POSES_BY, DerivedSource, Frame, RangeFrame, Recording
from tofuse.engine.graph import external_sensors
from tofuse.engine.mapping.config import Config, check_views, kind_of
from tofuse.engine.mapping.falloff import RANGE, estimate_falloff
from tofuse.engine.mapping.trial import RUNS, Prepare, trial
from tofuse.engine.noise import NOISE, NoiseModel, noise_model_for
from tofuse.engine.parts import name_of
from tofuse.engine.progress import Progress, Silent
from tofuse.engine.sensor import Correction, Corrector, Noise
from tofuse.engine.stopwatch import timing
from tofuse.engine.tracking import Keyframes, given
from tofuse.engine.views import RAW_RANGE_FALLOFF

P = TypeVar("P", Correction, Filter)

# Number of evenly spaced frames: enough for the background behind an object that turns once.
_SAMPLE_FRAMES = 30


def adapted(
    config: Config,
    recording: Recording,
    threads: int | None = None,
    progress: Progress | None = None,
    trial_runs: int = RUNS,
) -> Config:
    """Return the configuration with all values that depend on the recording filled in.

    These are defaults (`with_recording_defaults`), the parameters that corrections and filters
    learn from up to 30 frames, and the falloffs of the amplitude and of colour.
    Corrections on trial are kept only if overlapping views show the error that they correct
    (`trial`). An adapted configuration is returned unchanged.

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
    trial_runs
        Number of runs of views of a trial.

    Raises
    ------
    InputError
        If a filter can't learn from the recording, or its noise.json is invalid.
    """
    config = with_recording_defaults(config, recording)
    initial = config
    filters_learn = any(f.needs_fit for f in (*config.filters, *config.model_filters))
    # BLAS results depend on its number of threads; those of our kernels don't.
    with use_threads(threads), threadpool_limits(1), timing("fitting"):
        if filters_learn or any(c.needs_fit for c in config.corrections):
            config = _fitted(config, recording)
        for item in config.corrections:
            if item.needs_trial:
                config = _after_trial(config, item, recording, progress or Silent(), trial_runs)
        left_out = sum(c.disabled for c in config.corrections)
        if filters_learn and left_out > sum(c.disabled for c in initial.corrections):
            # Filters must learn from images without the corrections that are left out.
            filters, model_filters = initial.filters, initial.model_filters
            config = replace(config, filters=filters, model_filters=model_filters)
            config = _fitted(config, recording)
        odometry = config.odometry
        if isinstance(odometry, Keyframes | given.GivenPoses):
            views = _with_falloffs(odometry.views, recording, _preparation(config))
            config = replace(config, odometry=replace(odometry, views=views))
    return config


def _with_falloffs(views: ViewOptions, recording: Recording, prepare: Prepare) -> ViewOptions:
    """Return the options with unspecified falloffs of amplitude and colour estimated."""
    if views.falloff is not None and views.range_falloff is not None:
        return views
    frame = recording.first_readable()
    image = frame if isinstance(frame, RangeFrame) else None
    amplitude = image is not None and image.amplitude_image is not None
    falloff, range_falloff = views.falloff, views.range_falloff
    if range_falloff is None:
        # Infrared is assumed to be that of a ToF camera, unless the recording shows otherwise.
        infrared = image is not None and amplitude and image.amplitude_kind == "ir"
        color = image is not None and not amplitude and image.color_image is not None
        range_falloff = RAW_RANGE_FALLOFF if infrared else 0.0
        if infrared or color:
            surface = replace(views.surface, falloff=falloff or 0.0, range_falloff=range_falloff)
            range_falloff = max(
                range_falloff + estimate_falloff(recording, prepare, surface, RANGE), 0.0
            )
    if falloff is None:
        # Colour cameras compensate their vignetting.
        surface = replace(views.surface, falloff=0.0, range_falloff=range_falloff)
        falloff = estimate_falloff(recording, prepare, surface) if amplitude else 0.0
    return replace(views, falloff=falloff, range_falloff=range_falloff)


def with_recording_defaults(config: Config, recording: Recording) -> Config:
    """Return the configuration with the recording's noise model, and its scale of confidence.

    Raises
    ------
    InputError
        If the recording has an invalid noise.json.
    """
    corrections = tuple(
        replace(c, model=_noise_model(recording)) if isinstance(c, Noise) and not c.model else c
        for c in config.corrections
    )
    config = replace(config, corrections=corrections)
    highest = _highest_confidence(recording)
    if highest is None:
        return config

    def on_scale(filters: tuple[Filter, ...]) -> tuple[Filter, ...]:
        return tuple(f.on_scale(highest) if isinstance(f, Confidence) else f for f in filters)

    filters, model_filters = on_scale(config.filters), on_scale(config.model_filters)
    return replace(config, filters=filters, model_filters=model_filters)


def _highest_confidence(recording: Recording) -> int | None:
    """Return the highest level of confidence, as stated or seen; None: the filters' own."""
    stated = recording.metadata.get("confidence_max")
    if isinstance(stated, int | float) and 1 <= stated <= 255:
        return round(stated)
    first = recording.first_readable()
    if not isinstance(first, RangeFrame) or first.confidence_image is None:
        return None
    frames = (f for f in recording.readable(_SAMPLE_FRAMES) if isinstance(f, RangeFrame))
    images = [f.confidence_image for f in frames if f.confidence_image is not None]
    seen = max((int(image.max()) for image in images), default=0)
    # Cameras with fewer levels would have no point left; with more, good levels may be low ones.
    return seen if 0 < seen < Confidence().highest else None


def _noise_model(recording: Recording) -> NoiseModel | None:
    """Return the noise model stated by the recording, or that of its camera family."""
    model = noise_model_for(recording)
    return None if model == NOISE["unknown"] else model


def _fitted(config: Config, recording: Recording) -> Config:
    """Return the configuration with its parts fitted to a sample of frames."""
    frames = recording.readable(_SAMPLE_FRAMES)
    check_views(config, kind_of(frames[0]) if frames else "range")
    corrections, frames = _fitted_parts(config.corrections, frames, _correcting)
    filters, frames = _fitted_parts(config.filters, frames, _filtering)
    model_filters, _ = _fitted_parts(config.model_filters, frames, _filtering)
    return replace(config, corrections=corrections, filters=filters, model_filters=model_filters)


@timing("trials")
def _after_trial(
    config: Config, item: Correction, recording: Recording, progress: Progress, runs: int
) -> Config:
    """Return the configuration after the trial of a correction."""
    others = replace(config, corrections=tuple(c for c in config.corrections if c is not item))
    correctors = [c.start() for c in config.corrections]
    uncorrected, corrected = _preparation(others), _preparation(config, correctors)
    corrector = correctors[config.corrections.index(item)]
    if _changes(config, recording, uncorrected, corrected):
        result = trial(recording, uncorrected, corrected, runs)
        tested = item.after_trial(corrector, result.improves, result.strength, result.error)
        if tested.disabled:
            progress.note(f"correction {name_of(item)} not applied: {result.in_words()}")
    else:
        tested = item.after_trial(corrector, improves=True)
    corrections = tuple(tested if c is item else c for c in config.corrections)
    return replace(config, corrections=corrections)


def _changes(
    config: Config, recording: Recording, uncorrected: Prepare, corrected: Prepare
) -> bool:
    """Whether a correction changes the first image of a recording."""
    frame = recording.first_readable()
    if frame is None:
        return False
    check_views(config, kind_of(frame))
    if not isinstance(frame, RangeFrame):
        return False
    before, after = uncorrected(frame), corrected(frame)
    assert isinstance(before, RangeFrame)
    assert isinstance(after, RangeFrame)
    return not np.array_equal(before.depth, after.depth)


def _preparation(config: Config, correctors: Sequence[Corrector] | None = None) -> Prepare:
    """Return the corrections and filters of single frames, without filters over time.

    `correctors` are those of the configuration's corrections if they have been started.
    """
    if correctors is None:
        correctors = [correction.start() for correction in config.corrections]
    steps = [*(c.apply for c in correctors), *map(_filtering, config.filters)]

    def prepare(frame: Frame) -> Frame:
        for step in steps:
            frame = step(frame)
        return frame

    return prepare


def _correcting(correction: Correction) -> Prepare:
    return correction.start().apply


def _filtering(item: Filter) -> Prepare:
    if item.window > 1:  # a single frame has no neighbours in time
        return lambda frame: frame
    return lambda frame: frame.keep(item.mask(frame, ()))


def _fitted_parts(
    parts: Sequence[P], frames: list[Frame], step_of: Callable[[P], Prepare]
) -> tuple[tuple[P, ...], list[Frame]]:
    """Fit each part to frames as the preceding ones leave them; and process the frames."""
    fitted = []
    for item in parts:
        fitted.append(item.fit(frames) if item.needs_fit else item)
        frames = list(map(step_of(fitted[-1]), frames))
    return tuple(fitted), frames


Prior = Literal["auto", "none", "device"]


def with_prior(
    recording: Recording, config: Config, prior: Prior, *, where: str = "prior"
) -> tuple[Recording, Config]:
    """Return the recording and the configuration with the chosen priors.

    Parameters
    ----------
    recording, config
        The recording and its configuration.
    prior
        "none": no external sensor; "device": gravity if known, and the poses of the odometry or of
        the device; "auto": those of the configuration, and if it uses gravity, also the poses of
        the device.
    where
        Names the argument in errors.

    Raises
    ------
    InputError
        If the prior is "device" and the recording has no poses of its device.
    """
    if prior not in get_args(Prior):
        raise InputError(f"is {prior!r}", where=where, remedy="use auto, none or device")
    if prior == "none":
        return recording, replace(config, priors=())
    uses_odometry = _uses(config, external_sensors.OdometryEdges)
    uses_gravity = _uses(config, external_sensors.GravityEdges)
    poses = recording.reference if POSES_BY in recording.metadata else None
    if prior == "auto" and (not (uses_gravity or uses_odometry) or poses is None):
        return recording, config
    if recording.odometry is None:
        if poses is None:
            raise InputError(
                "is device, and the recording has no poses of its device",
                where=where,
                remedy="put an odometry.txt next to the images, or use auto",
            )
        recording = with_odometry(recording, poses)
    if uses_odometry:
        return recording, config
    gravity = () if uses_gravity else (external_sensors.GravityEdges(),)
    return recording, replace(
        config, priors=(*config.priors, *gravity, external_sensors.OdometryEdges())
    )


def with_known_odometry(
    recording: Recording, config: Config, record: external_sensors.SensorRecord | None
) -> tuple[Recording, Config]:
    """Return both with known factors on odometry and its errors; without odometry if it is None.

    For a recording whose path rests on its odometry already, see `OdometryEdges.scale`.
    """
    if record is None:
        sensors = (p for p in config.priors if not isinstance(p, external_sensors.OdometryEdges))
        if recording.odometry is not None:
            recording = with_odometry(recording, np.full((len(recording), 4, 4), np.nan))
        return recording, replace(config, priors=tuple(sensors))
    recording, config = with_prior(recording, config, "auto")
    if recording.odometry is not None and record.lengths != 1:
        scaled = recording.odometry.copy()
        scaled[:, :3, 3] *= record.lengths
        recording = with_odometry(recording, scaled)
    sensors = (
        replace(p, scale=record.scale) if isinstance(p, external_sensors.OdometryEdges) else p
        for p in config.priors
    )
    return recording, replace(config, priors=tuple(sensors))


def with_odometry_prior(config: Config) -> Config:
    """Return the configuration with odometry as a prior, if it uses external sensors at all."""
    if not config.priors or _uses(config, external_sensors.OdometryEdges):
        return config
    return replace(config, priors=(*config.priors, external_sensors.OdometryEdges()))


def _uses(config: Config, sensor: type[external_sensors.ExternalSensor]) -> bool:
    return any(isinstance(used, sensor) for used in config.priors)


def with_odometry(recording: Recording, poses: Float64) -> Recording:
    """Return the recording with poses (N, 4, 4) as its odometry."""
    source = DerivedSource(recording.source)
    source.odometry = np.full((len(source.timestamps), 4, 4), np.nan)
    source.odometry[recording.indices] = poses
    return replace(recording, source=source)
