"""."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.quality import (
        cross_view_agreement,
        frame_samples,
        map_agreement,
        pose_accuracy,
        pose_deviation,
        trajectory_errors,
    )
    from tofuse.engine.quality.change_detection import Change, changes

__getattr__, __dir__, __all__ = face(__name__, __file__)
