"""The noise sweep on synthetic data (sections 4.1.6 and 5.6, figure 5.12)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from tofuse.engine.arrays import Bool, Float64
from tofuse.engine.frames import ArraySource, Recording
from tofuse.engine.geometry import se3
from tofuse.engine.graph import Measured, PoseGraph, build_graph, castellani, external_sensors
from tofuse.engine.icp import CoarseToFine, algorithm_1
from tofuse.engine.mapping import default, reconstructing
from tofuse.engine.refinement import plane_refinement
from tofuse.engine.stored_views import Spacing, ViewStore
from tofuse.engine.tracking import Sequential
from tofuse.lab.experiments.bound import (
    joint_covariance,
    mean_distance,
    mean_distances,
    pose_covariances,
)
from tofuse.lab.simulation import peaks

SIGMAS_M = tuple(k / 100 for k in range(1, 11))
_EXAMPLE_SIGMA_M = 0.09
AXES = ("x", "y", "z", "yaw", "pitch", "roll")


@dataclass(frozen=True, eq=False)
class PoseErrors:
    """Errors of estimated camera poses.

    Attributes
    ----------
    position
        (N,) distances, m.
    rotation
        (N,) screw angles, rad.
    axes
        (N, 6) signed errors along x, y, z of the world (m), and in yaw, pitch, roll (rad), which
        turn the true camera into the estimated one about its own y, then x, then z axis.
    """

    position: Float64
    rotation: Float64
    axes: Float64

    @classmethod
    def of(cls, estimate: Float64, truth: Float64) -> PoseErrors:
        """Compare poses (N, 4, 4) in the same world frame, without alignment."""
        translation = estimate[:, :3, 3] - truth[:, :3, 3]
        R = np.swapaxes(truth[:, :3, :3], 1, 2) @ estimate[:, :3, :3]
        angles = np.stack(
            [
                np.arctan2(R[:, 0, 2], R[:, 2, 2]),
                np.arcsin(np.clip(-R[:, 1, 2], -1, 1)),
                np.arctan2(R[:, 1, 0], R[:, 1, 1]),
            ],
            axis=1,
        )
        return cls(
            np.linalg.norm(translation, axis=1), se3.angle(R), np.hstack([translation, angles])
        )


@dataclass(frozen=True, eq=False)
class PeaksRun:
    """One sequence at one level of noise: the 20 cameras before and after, and their errors.

    `poses_sequential`, `poses_optimised` and `truth` are (20, 4, 4) T_world_camera.
    """

    sigma: float
    seed: int
    sequential: PoseErrors
    optimised: PoseErrors
    objective: tuple[float, ...]
    poses_sequential: Float64
    poses_optimised: Float64
    truth: Float64


def chain(relative: Float64, loops: Sequence[Measured] = ()) -> PoseGraph:
    """Build the graph of a sequence of consecutive motions, and loops.

    The poses are the products of the motions (eqs 2.9-3.2); ids count from 0, and the information
    of the sequence is the identity.

    Parameters
    ----------
    relative
        (n - 1, 4, 4) motions T_(k-1)_k.
    loops
        Measurements between frames that are not consecutive.
    """
    poses = [np.eye(4)]
    for T in relative:
        # Rounding errors would accumulate over thousands of products.
        poses.append(se3.orthonormalise(poses[-1] @ T))
    sequence = [Measured(k, k + 1, T, np.eye(6)) for k, T in enumerate(relative)]
    return build_graph(range(len(poses)), np.array(poses), sequence, loops)


def run_peaks(sigma: float, seed: int) -> PeaksRun:
    """Register the 20 views in sequence, and close the loop by its true motion.

    All points are used, with a resolution of 1 m and the previous motion as guess; Algorithm 1
    stops at a change of 1e-4 over 3 iterations, or after 100. The last motion, T_1_n, is the true
    one, as in the thesis.
    """
    views, truth = peaks.peaks_views(sigma, seed)
    icp = algorithm_1(resolution=1.0, points=None, epsilon=1e-4, k=3, max_iterations=100)
    tracker = Sequential(registration=icp, guess="previous").start(seed)
    steps = [tracker.push(view) for view in views]
    relative = np.array([s.registration.T_target_source for s in steps[1:] if s.registration])
    last = len(views) - 1
    graph = chain(relative, [Measured(0, last, truth[last], np.eye(6))])
    optimisation = castellani.Castellani().optimise(graph)
    return PeaksRun(
        sigma,
        seed,
        PoseErrors.of(graph.poses, truth),
        PoseErrors.of(optimisation.graph.poses, truth),
        optimisation.objective,
        graph.poses,
        optimisation.graph.poses,
        truth,
    )


def refine_peaks(sigma: float, seed: int) -> tuple[PoseErrors, PoseErrors]:
    """Errors after coarse-to-fine registration, and after the joint refinement of all views.

    The closing motion is not given.
    """
    views, truth = peaks.peaks_views(sigma, seed)
    tracker = Sequential(registration=CoarseToFine(), guess="previous").start(seed)
    refiner = plane_refinement.Planes().start(ViewStore(Spacing()))
    poses: list[Float64] = []
    for view in views:
        T = tracker.push(view).T_component_camera
        poses.append(poses[-1] if T is None else T)
        refiner.push(view, poses[-1])
    start = np.array(poses)
    graph = build_graph([view.index for view in views], start, [], [])
    refined = refiner.finish(graph, external_sensors.SensorPriors()).poses
    return PoseErrors.of(start, truth), PoseErrors.of(refined, truth)


def reconstruct_peaks(sigma: float, seed: int) -> tuple[PoseErrors, int]:
    """Errors of `tofuse run` on a folder of the views, and the number of views with a pose.

    Relative to the first of these, whose pose is set to the true one.
    """
    views, truth = peaks.peaks_views(sigma, seed)
    recording = Recording.of(ArraySource(views, truth), "peaks", "simulated")
    result = reconstructing.reconstruct(recording, default("cloud"), seed=seed)
    has_pose = result.has_pose
    T_world_result = truth[has_pose][0] @ se3.inverse(result.trajectory[has_pose][0])
    return PoseErrors.of(T_world_result @ result.trajectory[has_pose], truth[has_pose]), int(
        has_pose.sum()
    )


def peaks_bound(sigma: float) -> float:
    """Lower bound of the mean error (m) of the 20 positions from the surface only; see `bound`."""
    C = pose_covariances(
        peaks.peaks_points(), peaks.peaks_normals(), _visibility(), peaks.peaks_cameras(), sigma
    )
    return mean_distance(C[:, :3, :3])


def peaks_bound_quantiles(sigma: float, quantiles: Sequence[float]) -> Float64:
    """Quantiles (m) of the mean error of a single recording, for a method at the bound."""
    C = joint_covariance(
        peaks.peaks_points(), peaks.peaks_normals(), _visibility(), peaks.peaks_cameras(), sigma
    )
    return np.asarray(np.quantile(mean_distances(C), quantiles), np.float64)


def _visibility() -> Bool:
    """(points, cameras) visibility mask."""
    visible = np.zeros((len(peaks.peaks_points()), len(peaks.peaks_cameras())), bool)
    for k, rows in enumerate(peaks.peaks_visible()):
        visible[rows, k] = True
    return visible


@dataclass(frozen=True, eq=False)
class PeaksSweep:
    """Mean errors over all cameras and seeds, one row per sigma.

    Attributes
    ----------
    sigmas
        (S,) standard deviations of the noise, m.
    position
        (S, 2) mean distance of the cameras from the truth, sequential and optimised, m.
    rotation
        (S, 2) mean angle, rad.
    axes
        (S, 2, 6) mean absolute error for each of `AXES`, m and rad: the panels of figure 5.12.
    axes_std
        (S, 2, 6) standard deviation over the seeds of the values averaged in `axes`.
    runs
        Every run.
    """

    sigmas: Float64
    position: Float64
    rotation: Float64
    axes: Float64
    axes_std: Float64
    runs: tuple[PeaksRun, ...]

    @property
    def example(self) -> list[PeaksRun]:
        """Runs of the sigma nearest to that of figure 5.11, for every seed."""
        sigma = self.sigmas[np.abs(self.sigmas - _EXAMPLE_SIGMA_M).argmin()]
        return [run for run in self.runs if run.sigma == sigma]


def sweep_peaks(
    seeds: Sequence[int],
    sigmas: Sequence[float] = SIGMAS_M,
    on_finished: Callable[[], None] = lambda: None,
) -> PeaksSweep:
    """Run every sigma with every seed, and average; calls `on_finished` after each run."""
    runs = []
    for sigma in sigmas:
        for seed in seeds:
            runs.append(run_peaks(sigma, seed))
            on_finished()
    position, rotation, axes = (
        _by_seed(runs, len(sigmas), name) for name in ("position", "rotation", "axes")
    )
    return PeaksSweep(
        np.array(sigmas, float),
        position.mean(1),
        rotation.mean(1),
        axes.mean(1),
        axes.std(1),
        tuple(runs),
    )


def _by_seed(runs: Sequence[PeaksRun], sigmas: int, name: str) -> Float64:
    """Mean absolute error over the cameras, (sigmas, seeds, 2, ...)."""
    means = np.array(
        [
            [np.abs(getattr(errors, name)).mean(0) for errors in (run.sequential, run.optimised)]
            for run in runs
        ]
    )
    return means.reshape(sigmas, -1, *means.shape[1:])
