"""Azure Kinects at unknown poses, one image each."""

import json

import numpy as np

from pose_errors import assert_near
from tofuse.apps.rigs.calibrating import calibrate_cameras
from tofuse.apps.rigs.inputs import open_cameras
from tofuse.apps.rigs.joint import RigView, disagreements
from tofuse.engine.geometry import se3
from tofuse.engine.stored_views.view_store import SampledView


def test_surfaces_agree_better_than_under_reference_poses(shared_data) -> None:
    folder = shared_data / "azure_kinect_rig"
    # Three of the five, to save time.
    cameras = open_cameras(sorted(p for p in folder.iterdir() if p.is_dir())[:3])
    rig = calibrate_cameras(cameras).rig
    assert not rig.unplaced
    reference = json.loads((folder / "reference_T_world_camera.json").read_text())
    T = np.array([np.reshape(reference[camera.name], (4, 4)) for camera in cameras])
    T = se3.inverse(T[0]) @ T
    # COLMAP's poses are accurate to 1 or 2 cm and about a degree.
    assert_near(np.array([c.T_rig_camera for c in rig.cameras]), T, 0.04, 1.5)
    views = [
        RigView(k, 0, SampledView.of(camera.surface(camera.images(1)[0]), 4000))
        for k, camera in enumerate(cameras)
    ]
    under_reference = [median for median, _ in disagreements(views, T).values()]
    assert np.median([d.median_m for d in rig.disagreement]) < 0.25 * np.median(under_reference)
