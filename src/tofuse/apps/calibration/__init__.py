"""Calibration of one camera from recordings: its lens, its depth errors and its noise.

A lens and a depth correction come from views of a checkerboard or of planes, noise from a static
scene; each with its uncertainty, and as a file that readers apply.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.apps.calibration.board import Board
    from tofuse.apps.calibration.camera_json import (
        check_new,
        fields_without_lens,
        recording_fields,
        write_camera_json,
    )
    from tofuse.apps.calibration.depth import calibrate_depth, compose
    from tofuse.apps.calibration.lens import calibrate_lens
    from tofuse.apps.calibration.noise_estimation import estimate_noise
    from tofuse.apps.calibration.plane_views import board_planes, scene_planes

__getattr__, __dir__, __all__ = face(__name__, __file__)
