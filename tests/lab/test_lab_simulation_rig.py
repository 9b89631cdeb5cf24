"""Simulated rigs: every camera has a clock of its own."""

from __future__ import annotations

import numpy as np

from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.rig import Mount, simulate_rig
from tofuse.lab.world.scene import build


def test_cameras_see_same_motion_by_their_own_clocks() -> None:
    scene, sequence = build("room")
    mounts = [Mount(time_offset_s=offset, frame_rate_hz=10.0) for offset in (0.0, 0.25, -0.25)]
    recordings = simulate_rig(
        scene, sequence, mounts, first_s=0.1, frames=2, effects=Effects.none()
    )
    for mount, recording in zip(mounts, recordings, strict=True):
        assert recording.timestamps[0] >= 0
        rig_times = recording.timestamps + mount.time_offset_s
        assert rig_times[0] >= 0.1
        expected = [sequence.camera_path(t) for t in rig_times]
        motion = [np.linalg.inv(expected[0]) @ T for T in expected]
        seen = [np.linalg.inv(recording.reference[0]) @ T for T in recording.reference]
        np.testing.assert_allclose(seen, motion, atol=1e-9)
