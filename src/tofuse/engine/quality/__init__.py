"""Measures of a result's quality, most of them without a ground truth.

`pose_accuracy` bounds the errors of poses by their covariance. `cross_view_agreement` and
`map_agreement` compare overlapping images at given poses, `pose_deviation` the poses with
registrations, `trajectory_errors` with a reference; `pose_causes` names what is wrong with them.
`changes` tells what moved between two recordings; `ambiguous_frames` and `ambiguous_places` where a
scene repeats itself.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.quality import (
        background,
        cross_view_agreement,
        frame_samples,
        map_agreement,
        pose_accuracy,
        pose_causes,
        pose_deviation,
        trajectory_errors,
    )
    from tofuse.engine.quality.change_detection import Change, changes
    from tofuse.engine.quality.rival_places import ambiguous_places
    from tofuse.engine.quality.rival_steps import ambiguous_frames

__getattr__, __dir__, __all__ = face(__name__, __file__)
