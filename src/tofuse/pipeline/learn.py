"""What parts must know about a whole recording before its first frame: a look ahead."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from threadpoolctl import threadpool_limits

from tofuse.errors import UnreadableFrameError
from tofuse.filters.base import Filter
from tofuse.filters.correction import Correction
from tofuse.kernels.threads import threads as use_threads
from tofuse.pipeline.config import Config, check_views, kind_of
from tofuse.recordings.frames import Frame
from tofuse.recordings.recording import Recording

# Frames, evenly spaced: enough to see what is behind an object that turns once.
_SAMPLE = 30


def learnt(config: Config, recording: Recording, threads: int | None = None) -> Config:
    """Return the configuration with what its corrections and filters learn from the recording.

    Reads up to 30 frames, and only if a part learns at all.

    Parameters
    ----------
    threads
        How many to use; None: all cores. The result does not depend on it.

    Raises
    ------
    InputError
        If the recording does not show what a filter has to learn.
    """
    filters_learn = any(f.learns for f in (*config.filters, *config.model_filters))
    if not filters_learn and not any(c.learns for c in config.corrections):
        return config
    sample = recording.sample(_SAMPLE)
    frames = [item for item in sample if not isinstance(item, UnreadableFrameError)]
    check_views(config, kind_of(frames[0]) if frames else "range")
    # BLAS sums differ with its number of threads; ours don't.
    with use_threads(threads), threadpool_limits(1):
        corrections, frames = _corrections(config.corrections, frames)
        filters, frames = _filters(config.filters, frames)
        model_filters, _ = _filters(config.model_filters, frames)
    return replace(config, corrections=corrections, filters=filters, model_filters=model_filters)


def _corrections(
    corrections: Sequence[Correction], frames: list[Frame]
) -> tuple[tuple[Correction, ...], list[Frame]]:
    """Let each correction learn from what the ones before it made; also returns what all made."""
    out = []
    for item in corrections:
        knowing = item.learnt(frames) if item.learns else item
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
        knowing = item.learnt(frames) if item.learns else item
        if item.window == 1:  # a sample has no neighbours in time
            frames = [frame.keep(knowing.mask(frame, ())) for frame in frames]
        out.append(knowing)
    return tuple(out), frames
