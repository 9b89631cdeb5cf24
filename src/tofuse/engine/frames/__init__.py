"""."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.frames.depth_counts import (
        INVALID_DEPTH,
        MAX_COUNTS,
        depth_from_counts,
        depth_from_numbers,
    )
    from tofuse.engine.frames.frames import (
        SATURATED_AMPLITUDE,
        AmplitudeKind,
        CloudFrame,
        DepthKind,
        Frame,
        RangeFrame,
    )
    from tofuse.engine.frames.ranges import (
        Range,
        in_words,
        is_single,
        numbers,
        runs,
        runs_of,
        size,
        union,
    )
    from tofuse.engine.frames.recording import (
        NOISE_MODEL,
        POSES_BY,
        ArraySource,
        Recording,
        Source,
        evenly_spaced,
    )

__getattr__, __dir__, __all__ = face(__name__, __file__)
