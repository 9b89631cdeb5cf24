"""What a reconstruction returns, and how it is judged.

A `Reconstruction` consists of a trajectory, a pose graph, a model and `Diagnostics` with a
`FrameRecord` of each frame. `checks` derive a `Reason` for every weakness, `verdicts` rank them
to a `Verdict`, and `accuracy_card` sums the result up in one line.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.results import accuracy_card, checks, verdicts
    from tofuse.engine.results.types import (
        Component,
        Diagnostics,
        FrameRecord,
        Mirror,
        Reason,
        Reconstruction,
        SelfCalibration,
        SessionChange,
        SessionPair,
        SessionRecord,
        Verdict,
        in_main_model,
    )

__getattr__, __dir__, __all__ = face(__name__, __file__)
