"""Open3D: RANSAC over matches of FPFH, then point-to-plane ICP, as its tutorial does."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofuse.errors import RegistrationError
from tofuse.recordings.frames import RangeFrame

Float64 = NDArray[np.float64]

# Of the tutorial: 5 cm for a room. Radii and distances are multiples of it.
_VOXEL_M = 0.05
_ITERATIONS, _CONFIDENCE = 100_000, 0.999


def method() -> Callable[[RangeFrame, RangeFrame], Float64] | None:
    """The registration of two frames; None where Open3D is not installed."""
    try:
        o3d = importlib.import_module("open3d")
    except ImportError:
        return None
    o3d.utility.set_verbosity_level(o3d.utility.VerbosityLevel.Error)
    pipeline = o3d.pipelines.registration

    def described(frame: RangeFrame) -> tuple[Any, Any]:
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(frame.points.astype(float)))
        cloud = cloud.voxel_down_sample(_VOXEL_M)
        near = o3d.geometry.KDTreeSearchParamHybrid
        cloud.estimate_normals(near(2 * _VOXEL_M, 30))
        cloud.orient_normals_towards_camera_location()
        return cloud, pipeline.compute_fpfh_feature(cloud, near(5 * _VOXEL_M, 100))

    def registered(source: RangeFrame, target: RangeFrame) -> Float64:
        o3d.utility.random.seed(0)
        (a, features_a), (b, features_b) = described(source), described(target)
        if min(len(a.points), len(b.points)) < 10:
            raise RegistrationError("has too few points", where="Open3D")
        reach = 1.5 * _VOXEL_M
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
            _VOXEL_M,
            coarse.transformation,
            pipeline.TransformationEstimationPointToPlane(),
        )
        return np.asarray(fine.transformation, float)

    return registered
