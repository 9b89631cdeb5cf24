"""Open3D's offline reconstruction system, assembled from its library as documented.

Fragments of a hundred frames from RGB-D odometry with loop closures; registration of fragments by
features and ICP, and again at finer scales; a pose graph with a line process after each step; one
volume of all frames. Options are the published defaults of the system (Choi et al. 2015;
open3d.org, "Reconstruction system").

Without registered colour there are no image features to initialise loop closures within a fragment,
and no coloured ICP: loop closures then start from the odometry, and ICP is point-to-plane.
"""

from __future__ import annotations

import importlib
import os
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import combinations
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from peers import PinholeImages
from tofuse.engine.arrays import Float64, UInt8, UInt16
from tofuse.engine.frames.frames import RangeFrame
from tofuse.formats.recordings.open import open_recording

_SCALE = 5000.0  # counts per metre
_LEAST_WEIGHT = 1.0  # extract surfaces seen by a single frame
# Initial number of blocks: with few, its allocator fails as the volume grows.
_BLOCKS, _BLOCKS_OF_SCENE = 20_000, 50_000
_GREY = 128  # of images without colour: their mean must not be 0


@dataclass(frozen=True)
class System:
    """Options of the system, in m."""

    frames_per_fragment: int = 100
    keyframe_step: int = 5
    least_depth: float = 0.3
    most_depth: float = 3.0
    depth_difference: float = 0.07
    voxel: float = 0.05
    prune: float = 0.25
    loops_in_fragments: float = 0.1
    loops_of_fragments: float = 5.0
    least_overlap: float = 0.3
    cube: float = 3.0
    truncation: float = 0.04

    @property
    def near(self) -> float:
        """Maximum correspondence distance."""
        return 1.4 * self.voxel


@dataclass(frozen=True)
class Selected:
    """Frames of a recording, which every process opens itself."""

    source: str
    start: int
    end: int | None
    every: int

    def frames(self, first: int, stop: int) -> list[RangeFrame]:
        recording = open_recording(self.source).select(self.start, self.end, self.every)
        found = (recording[k] for k in range(first, min(stop, len(recording))))
        return [frame for frame in found if isinstance(frame, RangeFrame)]

    def __len__(self) -> int:
        return len(open_recording(self.source).select(self.start, self.end, self.every))


@dataclass
class Made:
    """Reconstruction of a recording."""

    poses: Float64
    seconds: dict[str, float] = field(default_factory=dict)
    fragments: int = 0
    loops: int = 0
    triangles: int = 0


@dataclass(frozen=True)
class _Fragment:
    poses: Float64  # (N, 4, 4) of its frames, relative to the first
    points: Float64
    normals: Float64
    colors: Float64 | None

    def cloud(self) -> Any:
        o3d = _open3d()
        cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(self.points))
        cloud.normals = o3d.utility.Vector3dVector(self.normals)
        if self.colors is not None:
            cloud.colors = o3d.utility.Vector3dVector(self.colors)
        return cloud


@dataclass(frozen=True)
class _Edge:
    source: int
    target: int
    T: Float64  # of points of the source into the target
    information: Float64
    uncertain: bool


def _open3d() -> Any:
    o3d = importlib.import_module("open3d")
    o3d.utility.set_verbosity_level(o3d.utility.VerbosityLevel.Error)
    return o3d


class _Images:
    """Images of one camera in Open3D's types."""

    def __init__(self, options: System, frame: RangeFrame) -> None:
        self.o3d = _open3d()
        self.options = options
        self.pinhole = PinholeImages(frame.camera)
        p = self.pinhole.pinhole
        self.intrinsic = self.o3d.camera.PinholeCameraIntrinsic(
            p.width, p.height, p.fx, p.fy, p.cx, p.cy
        )
        self.colored = frame.color_image is not None and frame.color_registered

    def rgbd(self, frame: RangeFrame) -> Any:
        """Intensity and depth, for odometry."""
        image = self.o3d.geometry.Image
        return self.o3d.geometry.RGBDImage.create_from_color_and_depth(
            image(self._colors(frame)),
            image(self._counts(frame)),
            _SCALE,
            self.options.most_depth,
            convert_rgb_to_intensity=True,
        )

    def volume(self, blocks: int) -> Any:
        """Create a volume; that of the system's own scripts stays empty in version 0.20."""
        o3d = self.o3d
        color = self.colored
        kinds = (o3d.core.float32, o3d.core.float32, o3d.core.float32)
        voxel = self.options.cube / 512
        return o3d.t.geometry.VoxelBlockGrid(
            ("tsdf", "weight", "color")[: 2 + color],
            kinds[: 2 + color],
            ((1), (1), (3))[: 2 + color],
            voxel,
            16,
            blocks,
            o3d.core.Device("CPU:0"),
        )

    def integrate(self, volume: Any, frames: Sequence[RangeFrame], poses: Float64) -> None:
        tensor, image = self.o3d.core.Tensor, self.o3d.t.geometry.Image
        K = tensor(self.intrinsic.intrinsic_matrix)
        reach = 512 * self.options.truncation / self.options.cube
        for frame, T in zip(frames, poses, strict=True):
            depth = image(self._counts(frame))
            images = [depth]
            if self.colored:
                rgb = self._colors(frame).astype(np.float32) / 255
                images.append(image(np.ascontiguousarray(rgb)))
            seen_from = (K, tensor(np.linalg.inv(T)), _SCALE, self.options.most_depth, reach)
            blocks = volume.compute_unique_block_coordinates(depth, *seen_from)
            volume.integrate(blocks, *images, *seen_from)

    def _counts(self, frame: RangeFrame) -> UInt16:
        z = np.round(self.pinhole.take(frame.z) * _SCALE)
        return np.where(z < 65535, z, 0).astype(np.uint16)

    def _colors(self, frame: RangeFrame) -> UInt8:
        if not self.colored:
            return np.full((*frame.depth.shape, 3), _GREY, np.uint8)
        assert frame.color_image is not None
        return np.ascontiguousarray(self.pinhole.take(frame.color_image))


def _optimised(poses: Float64, edges: Sequence[_Edge], near: float, loops: float) -> Float64:
    """Optimised poses (N, 4, 4) of the pose graph, with the first one fixed."""
    r = _open3d().pipelines.registration
    graph = r.PoseGraph()
    for T in poses:
        graph.nodes.append(r.PoseGraphNode(T))
    for e in edges:
        graph.edges.append(r.PoseGraphEdge(e.source, e.target, e.T, e.information, e.uncertain))
    r.global_optimization(
        graph,
        r.GlobalOptimizationLevenbergMarquardt(),
        r.GlobalOptimizationConvergenceCriteria(),
        r.GlobalOptimizationOption(
            max_correspondence_distance=near,
            edge_prune_threshold=System.prune,
            preference_loop_closure=loops,
            reference_node=0,
        ),
    )
    return np.array([node.pose for node in graph.nodes])


def make_fragment(options: System, selected: Selected, first: int) -> _Fragment | None:
    """Step 1: poses and points of a fragment; None if it has no frames."""
    frames = selected.frames(first, first + options.frames_per_fragment)
    if not frames:
        return None
    images = _Images(options, frames[0])
    o = images.o3d.pipelines.odometry
    rgbd = [images.rgbd(frame) for frame in frames]
    settings = o.OdometryOption(depth_diff_max=options.depth_difference)
    settings.depth_min = options.least_depth

    def aligned(s: int, t: int, start: Float64) -> tuple[bool, Float64, Float64]:
        return o.compute_rgbd_odometry(  # type: ignore[no-any-return]
            rgbd[s],
            rgbd[t],
            images.intrinsic,
            start,
            o.RGBDOdometryJacobianFromHybridTerm(),
            settings,
        )

    poses, edges = [np.eye(4)], []
    for t in range(1, len(frames)):
        found, T, information = aligned(t - 1, t, np.eye(4))
        T = T if found else np.eye(4)
        poses.append(poses[-1] @ np.linalg.inv(T))
        edges.append(_Edge(t - 1, t, T, information if found else np.eye(6), uncertain=False))
    for s, t in combinations(range(0, len(frames), options.keyframe_step), 2):
        if t == s + 1:
            continue
        found, T, information = aligned(s, t, np.linalg.inv(poses[t]) @ poses[s])
        if found:
            edges.append(_Edge(s, t, T, information, uncertain=True))
    optimised = _optimised(
        np.array(poses), edges, options.depth_difference, options.loops_in_fragments
    )
    volume = images.volume(_BLOCKS)
    images.integrate(volume, frames, optimised)
    mesh = volume.extract_triangle_mesh(_LEAST_WEIGHT).to_legacy()
    mesh.compute_vertex_normals()
    return _Fragment(
        optimised,
        np.asarray(mesh.vertices),
        np.asarray(mesh.vertex_normals),
        np.asarray(mesh.vertex_colors) if images.colored else None,
    )


def _thinned(options: System, cloud: Any) -> tuple[Any, Any]:
    o3d = _open3d()
    search = o3d.geometry.KDTreeSearchParamHybrid
    thin = cloud.voxel_down_sample(options.voxel)
    thin.estimate_normals(search(radius=2 * options.voxel, max_nn=30))
    features = o3d.pipelines.registration.compute_fpfh_feature(
        thin, search(radius=5 * options.voxel, max_nn=100)
    )
    return thin, features


def _icp(
    options: System,
    source: Any,
    target: Any,
    scales: Sequence[float],
    iterations: Sequence[int],
    T: Float64,
) -> tuple[Float64, Float64]:
    """Multi-scale ICP: transform and information matrix."""
    o3d = _open3d()
    r = o3d.pipelines.registration
    for scale, max_iterations in zip(scales, iterations, strict=True):
        a, b = source.voxel_down_sample(scale), target.voxel_down_sample(scale)
        for cloud in (a, b):
            cloud.estimate_normals(
                o3d.geometry.KDTreeSearchParamHybrid(radius=2 * scale, max_nn=30)
            )
        if a.has_colors():
            criteria = r.ICPConvergenceCriteria(1e-6, 1e-6, max_iterations)
            kind = r.TransformationEstimationForColoredICP()
            found = r.registration_colored_icp(a, b, options.near, T, kind, criteria)
        else:
            criteria = r.ICPConvergenceCriteria(max_iteration=max_iterations)
            kind = r.TransformationEstimationPointToPlane()
            found = r.registration_icp(a, b, options.near, T, kind, criteria)
        T = found.transformation
        information = r.get_information_matrix_from_point_clouds(a, b, 1.4 * scale, T)
    return T, information


def register_pair(
    options: System, s: int, t: int, source: _Fragment, target: _Fragment
) -> _Edge | None:
    """Step 2: register two fragments; None if they overlap too little."""
    r = _open3d().pipelines.registration
    (a, features_a), (b, features_b) = (_thinned(options, f.cloud()) for f in (source, target))
    if t == s + 1:
        start = np.linalg.inv(source.poses[-1])
        T, information = _icp(options, a, b, [options.voxel], [50], start)
        return _Edge(s, t, T, information, uncertain=False)
    r_found = r.registration_ransac_based_on_feature_matching(
        a,
        b,
        features_a,
        features_b,
        False,
        options.near,
        r.TransformationEstimationPointToPoint(False),
        4,
        [
            r.CorrespondenceCheckerBasedOnEdgeLength(0.9),
            r.CorrespondenceCheckerBasedOnDistance(options.near),
        ],
        r.RANSACConvergenceCriteria(1000000, 0.999),
    )
    T = r_found.transformation
    if np.trace(T) == 4:  # no match found
        return None
    information = r.get_information_matrix_from_point_clouds(a, b, options.near, T)
    if information[5, 5] < options.least_overlap * min(len(a.points), len(b.points)):
        return None
    return _Edge(s, t, T, information, uncertain=True)


def refine_pair(options: System, edge: _Edge, source: _Fragment, target: _Fragment) -> _Edge:
    """Step 3: refine a pair, down to a quarter of the voxel size."""
    scales = [options.voxel / k for k in (1, 2, 4)]
    T, information = _icp(options, source.cloud(), target.cloud(), scales, [50, 30, 14], edge.T)
    return _Edge(edge.source, edge.target, T, information, edge.uncertain)


def _chained(count: int, edges: Sequence[_Edge]) -> Float64:
    """Poses of fragments, chained along consecutive ones."""
    steps = {e.source: e.T for e in edges if e.target == e.source + 1}
    poses = [np.eye(4)]
    for k in range(count - 1):
        poses.append(poses[-1] @ np.linalg.inv(steps[k]))
    return np.array(poses)


def reconstruct(options: System, selected: Selected, out: Path, workers: int) -> Made:
    """Run all steps, parallel where the system is, and write the mesh to `out`."""
    seconds: dict[str, float] = {}

    @contextmanager
    def timed(name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        seconds[name] = time.perf_counter() - start

    # One thread each.
    os.environ["OMP_NUM_THREADS"] = "1"
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:

        def shared(work: Callable[..., Any], *columns: Sequence[Any]) -> list[Any]:
            return list(pool.map(work, [options] * len(columns[0]), *columns))

        with timed("fragments"):
            firsts = range(0, len(selected), options.frames_per_fragment)
            made = shared(make_fragment, [selected] * len(firsts), firsts)
            fragments = [fragment for fragment in made if fragment is not None]
        with timed("registration"):
            pairs = list(combinations(range(len(fragments)), 2))
            edges: list[_Edge] = []
            if pairs:
                s, t = zip(*pairs, strict=True)
                clouds = ([fragments[k] for k in column] for column in (s, t))
                edges = [e for e in shared(register_pair, s, t, *clouds) if e is not None]
            poses = _chained(len(fragments), edges)
            poses = _optimised(poses, edges, options.near, options.loops_of_fragments)
        with timed("refinement"):
            if edges:
                moved = [
                    _Edge(
                        e.source,
                        e.target,
                        np.linalg.inv(poses[e.target]) @ poses[e.source],
                        e.information,
                        e.uncertain,
                    )
                    for e in edges
                ]
                sides = (
                    [fragments[k] for k in (e.source for e in edges)],
                    [fragments[k] for k in (e.target for e in edges)],
                )
                edges = shared(refine_pair, moved, *sides)
                poses = _chained(len(fragments), edges)
                poses = _optimised(poses, edges, options.near, options.loops_of_fragments)
    with timed("integration"):
        T = np.concatenate([P @ f.poses for P, f in zip(poses, fragments, strict=True)])
        images, volume = None, None
        for first in range(0, len(T), options.frames_per_fragment):
            frames = selected.frames(first, first + options.frames_per_fragment)
            images = images or _Images(options, frames[0])
            volume = volume or images.volume(_BLOCKS_OF_SCENE)
            images.integrate(volume, frames, T[first : first + len(frames)])
        assert volume is not None
        mesh = volume.extract_triangle_mesh(_LEAST_WEIGHT).to_legacy()
        mesh.compute_vertex_normals()
        _open3d().io.write_triangle_mesh(str(out), mesh)
    loops = sum(e.uncertain for e in edges)
    return Made(T, seconds, len(fragments), loops, len(mesh.triangles))
