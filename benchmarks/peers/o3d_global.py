"""Open3D: RANSAC over FPFH matches, then point-to-plane ICP, as in its tutorial."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.errors import RegistrationError
from tofuse.engine.frames.frames import Frame

# As in the tutorial: 5 cm for a room. Radii and distances are multiples of it.
VOXEL_M = 0.05
_ITERATIONS, _CONFIDENCE = 100_000, 0.999


def method(voxel_m: float = VOXEL_M) -> Callable[[Frame, Frame], Float64] | None:
    """The registration of two views; None where Open3D is not installed."""
    try:
        o3d = importlib.import_module("open3d")
    except ImportError:
        return None
    o3d.utility.set_verbosity_level(o3d.utility.VerbosityLevel.Error)
    pipeline = o3d.pipelines.registration

    def described(frame: Frame) -> tuple[Any, Any]:
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(frame.points.astype(float)))
        cloud = cloud.voxel_down_sample(voxel_m)
        near = o3d.geometry.KDTreeSearchParamHybrid
        cloud.estimate_normals(near(2 * voxel_m, 30))
        cloud.orient_normals_towards_camera_location()
        return cloud, pipeline.compute_fpfh_feature(cloud, near(5 * voxel_m, 100))

    def registered(source: Frame, target: Frame) -> Float64:
        o3d.utility.random.seed(0)
        (a, features_a), (b, features_b) = described(source), described(target)
        if min(len(a.points), len(b.points)) < 10:
            raise RegistrationError("has too few points", where="Open3D")
        reach = 1.5 * voxel_m
        coarse = pipeline.registration_ransac_based_on_feature_matching(
            a,
            b,
            features_a,
            features_b,
            True,
            reach,
            pipeline.TransformationEstimationPointToPoint(False),
            3,
            [
                pipeline.CorrespondenceCheckerBasedOnEdgeLength(0.9),
                pipeline.CorrespondenceCheckerBasedOnDistance(reach),
            ],
            pipeline.RANSACConvergenceCriteria(_ITERATIONS, _CONFIDENCE),
        )
        fine = pipeline.registration_icp(
            a,
            b,
            voxel_m,
            coarse.transformation,
            pipeline.TransformationEstimationPointToPlane(),
        )
        return np.asarray(fine.transformation, float)

    return registered
