"""A ToF camera simulator: the package's source of ground truth."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.lab.simulation import optics, peaks, phone
    from tofuse.lab.simulation.effects import Effects
    from tofuse.lab.simulation.models import CAMERAS, CameraModel, camera_model, check_camera
    from tofuse.lab.simulation.passing import Passing
    from tofuse.lab.simulation.record import RecordingPlan, plan, simulate

__getattr__, __dir__, __all__ = face(__name__, __file__)
