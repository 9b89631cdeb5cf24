"""."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.quality import samples
    from tofuse.engine.quality.change_detection import Change, changes
    from tofuse.engine.quality.consistency import Consistency, map_consistency, poses_of_frames
    from tofuse.engine.quality.cross_view import (
        CrossViewConsistency,
        compare_views,
        cross_view_consistency,
        prepare_for_comparison,
        restore_thinned,
    )
    from tofuse.engine.quality.pair_measurements import measured_pairs
    from tofuse.engine.quality.pose_accuracy import (
        UNOBSERVED_ERROR_FACTOR,
        Accuracy,
        ObservedErrors,
        WorstFrame,
        accuracy_of,
        covariances_of,
        degenerate_directions,
        without_degenerate,
    )
    from tofuse.engine.quality.pose_deviation import Deviation, deviation, fitted
    from tofuse.engine.quality.samples import FrameSample, FrameSamples
    from tofuse.engine.quality.trajectory_errors import (
        MAX_GAP_S,
        TrajectoryError,
        align,
        displacement,
        distances_between,
        evaluate_trajectory,
    )

__getattr__, __dir__, __all__ = face(__name__, __file__)
