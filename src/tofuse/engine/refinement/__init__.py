"""Joint refinement: the poses of all overlapping views are optimised together, after loop closure.

A `RefinementMethod` (`Joint` for images, `plane_refinement` for clouds) starts a `Refiner`, which
returns a `Refinement`: poses, edges for the pose graph, and evidence of their errors, from a
`calibration_check` and from halves of the images. `joint_alignment` is its least-squares problem.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.refinement import (
        calibration_check,
        fixed_pattern,
        joint_alignment,
        plane_refinement,
    )
    from tofuse.engine.refinement.refinement import (
        AlreadyRefined,
        Joint,
        NoRefinement,
        Refinement,
        RefinementMethod,
        Refiner,
        pairwise_measurements,
        propagate_poses,
        without_errors,
    )
    from tofuse.engine.refinement.split_half import refined_by_halves

__getattr__, __dir__, __all__ = face(__name__, __file__)
