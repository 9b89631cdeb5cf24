"""The two kinds of view, and recordings, which are sequences of them.

A `RangeFrame` is a depth image with a camera, a `CloudFrame` has points only; each is a `Frame`. A
`Recording` reads frames lazily from a `Source`, which formats implement. `frame_ranges` names
frames in reports, and `depth_counts` reads depth stored as integers.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.frames import depth_counts, frame_ranges
    from tofuse.engine.frames.frames import (
        SATURATED_AMPLITUDE,
        AmplitudeKind,
        CloudFrame,
        DepthKind,
        Frame,
        RangeFrame,
        map_shift,
    )
    from tofuse.engine.frames.recording import (
        POSES_BY,
        ArraySource,
        DerivedSource,
        Recording,
        Source,
        evenly_spaced,
    )

__getattr__, __dir__, __all__ = face(__name__, __file__)
