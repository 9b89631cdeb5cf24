"""Algorithm 1 on views of a real camera."""

from __future__ import annotations

import cv2
import numpy as np

from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.filters.outliers import NeighbourFraction
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.geometry import se3
from tofuse.engine.icp.icp import algorithm_1


def test_neighbours_of_real_recording(shared_data):
    """Steps of 3 to 5 cm, compared with reference poses accurate to about 1 cm."""
    files = sorted((shared_data / "sevenscenes_kitchen").glob("*.depth.png"))[20:44:2]
    camera = Pinhole(width=160, height=120, fx=585 / 4, fy=585 / 4, cx=80, cy=60)
    frames, poses = [], []
    for k, file in enumerate(files):
        depth = cv2.imread(str(file), cv2.IMREAD_UNCHANGED)[::4, ::4]
        frame = RangeFrame(k, k / 7.5, camera, np.where(depth == 65535, 0, depth / 1000))
        frames.append(frame.keep(NeighbourFraction(0.5).mask(frame, ())))
        poses.append(np.loadtxt(file.with_name(file.name.replace("depth.png", "pose.txt"))))
    motions, errors = [], []
    for k in range(1, len(frames)):
        rng = np.random.default_rng([0, k])
        found = algorithm_1(0.02).register(frames[k], frames[k - 1], np.eye(4), rng)
        assert found.converged
        assert found.inlier_ratio > 0.3
        truth = se3.inverse(poses[k - 1]) @ poses[k]
        motions.append(np.linalg.norm(truth[:3, 3]))
        errors.append(np.linalg.norm((se3.inverse(truth) @ found.T_target_source)[:3, 3]))
    assert np.median(motions) > 0.03
    assert np.median(errors) < 0.015
