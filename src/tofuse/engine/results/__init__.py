"""."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.results import accuracy_card, checks, verdicts
    from tofuse.engine.results.types import (
        Component,
        Diagnostics,
        FrameRecord,
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
