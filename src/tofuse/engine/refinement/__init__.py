"""."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.refinement import calibration_check, joint_alignment, plane_refinement
    from tofuse.engine.refinement.joint_alignment import Priors
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
