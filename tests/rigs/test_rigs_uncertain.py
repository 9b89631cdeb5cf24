"""A static rig whose calibration is uncertain is marked as such, not as a badly tracked camera."""

from tofuse.apps.rigs.run import _calibration_reason
from tofuse.engine.results.types import Reason


def test_uncertain_poses_of_static_cameras_are_attributed_to_rig() -> None:
    text = "Poses may be off by 45 mm. Frame 2 is the least certain: 60 mm."
    found = _calibration_reason(Reason("uncertain_poses", ((0, 3),), text), 2, "left")
    assert (found.code, found.ranges) == ("uncertain_rig", ((0, 3),))
    assert "45 mm. Camera 'left' is the least certain: 60 mm." in found.text
    assert "rig.json" in found.text
    other = Reason("faulty_recording", ((0, 3),), "It has a fault.")
    assert _calibration_reason(other, 2, "left") is other
