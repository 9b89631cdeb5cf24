"""A static rig whose calibration is uncertain is marked as such, not as a badly tracked camera."""

from tofuse.posegraph.accuracy import Accuracy
from tofuse.results.types import Reason
from tofuse.rigs.run import _of_calibration


def test_uncertain_poses_of_static_cameras_are_those_of_the_calibration() -> None:
    accuracy = Accuracy(0.045, 0.02, 0.01, True)
    found = _of_calibration(Reason("uncertain_poses", ((0, 3),), "The poses may be off."), accuracy)
    assert (found.code, found.ranges) == ("uncertain_rig", ((0, 3),))
    assert "45 mm" in found.text
    assert "rig.json" in found.text
    other = Reason("faulty_recording", ((0, 3),), "It has a fault.")
    assert _of_calibration(other, accuracy) is other
