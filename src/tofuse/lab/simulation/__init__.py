"""A ToF camera simulator: the package's source of ground truth."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.lab.simulation import mesh, optics, paths
    from tofuse.lab.simulation.effects import Effects
    from tofuse.lab.simulation.mesh import Mesh
    from tofuse.lab.simulation.models import CameraModel
    from tofuse.lab.simulation.passing import Passing
    from tofuse.lab.simulation.paths import Path
    from tofuse.lab.simulation.peaks import (
        RADIUS_M,
        peaks_cameras,
        peaks_normals,
        peaks_points,
        peaks_views,
        peaks_visible,
    )
    from tofuse.lab.simulation.record import RecordingPlan, plan, simulate
    from tofuse.lab.simulation.scene import SCENES, SceneOptions, ScenePlan
    from tofuse.lab.simulation.texture import Material

__getattr__, __dir__, __all__ = face(__name__, __file__)
