"""Several cameras fixed to each other: where they are, whether one was moved, and their model.

Static cameras are placed by their common surfaces, moving ones by their trajectories; all views are
then refined jointly. A calibrated rig is reconstructed with one pose per instant.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.apps.rigs.calibrating import calibrate
    from tofuse.apps.rigs.checking import CameraMotion, compare_in_scene
    from tofuse.apps.rigs.inputs import Calibration
    from tofuse.apps.rigs.run import run_rig

__getattr__, __dir__, __all__ = face(__name__, __file__)
