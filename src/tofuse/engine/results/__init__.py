"""."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.results.accuracy_card import SEPARATOR, bound, card, length, weakest_frame
    from tofuse.engine.results.checks import (
        Evidence,
        accuracy_reasons,
        cross_view_reasons,
        judge,
        tolerance_of,
    )
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
    from tofuse.engine.results.verdicts import ADVICE, REASONS, ranked, verdict_of

__getattr__, __dir__, __all__ = face(__name__, __file__)
