"""How a textured model looks from where images were taken that it was not made of.

Every tenth colour image, or every third of few, is left out of the texture, and the model is
rendered at its pose: PSNR and SSIM (Wang et al. 2004), after a gain and an offset per channel of
the image are fitted,

- over the pixels that the model covers, at the pose of the image,
- over the same, at the pose where model and image agree best, as the pose of an image that is left
  out has an error too,
- where also the depth image shows that surface, and no edge of it: what moved, and wrong outlines,
  are errors of the surface, which no texture mends.

The rows are the colours of the vertices, the texture, and Open3D, its colour map optimisation (Zhou
and Koltun 2014), on the same surface, where Open3D is installed. The last row has a texture of all
images: what it lacks is lost by the texture, not by the absence of the images.

    python benchmarks/appearance.py RECORDING...
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import astuple, dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from scipy.optimize import least_squares

from tofuse.apps.jobs import Options, run
from tofuse.engine.cameras import Pinhole
from tofuse.engine.frames import RangeFrame, Recording
from tofuse.engine.fusion import Mesh, Textured, drawing
from tofuse.engine.fusion.display_surface import TOLERANCE_FRACTION, TOLERANCE_M
from tofuse.engine.geometry import se3
from tofuse.engine.geometry.rays import homogeneous
from tofuse.engine.mapping import texturing
from tofuse.engine.results import Reconstruction
from tofuse.formats.recordings import open_recording

LEFT_OUT, _MANY = 10, 20  # every tenth image, or of fewer than 20 images every third
_SSIM_C1, _SSIM_C2, _SSIM_SIGMA = (0.01 * 255) ** 2, (0.03 * 255) ** 2, 1.5
_WIDTH = 960  # pixels of the compared images, or as recorded if that is less
_OPEN3D_ITERATIONS = 50
_NEAREST = 0.05  # m to the nearest rendered surface
_EDGE = 9  # pixels at edges of depth that are not compared
_ALIGNMENTS, _MAX_SHIFT = 3, 0.05  # of the pose of an image; largest shift, in widths of the image


@dataclass(frozen=True)
class Score:
    """How a rendered image compares with a recorded one."""

    psnr: float
    ssim: float
    psnr_aligned: float
    ssim_aligned: float
    psnr_surface: float
    ssim_surface: float
    covered: float


def main() -> None:
    """Print a row per recording and method."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recordings", nargs="+")
    print(
        "recording, method, images left out, PSNR (dB), SSIM, PSNR aligned, SSIM aligned, "
        "PSNR surface, SSIM surface, share of the images, CPU seconds"
    )
    for path in parser.parse_args().recordings:
        for name, scores, seconds in measured(path):
            means = np.nanmean([astuple(score) for score in scores], axis=0)
            values = ", ".join(f"{value:.3g}" for value in means)
            print(f"{Path(path).name}, {name}, {len(scores)}, {values}, {seconds:.1f}", flush=True)


def colored_by_open3d(mesh: Mesh, views: list[Any]) -> Mesh | None:
    """Return a surface in the colours of Open3D's colour map optimisation; None if it can't be.

    `views` are of (frame, image or None, pose). Needs Open3D and images of pinhole cameras.
    """
    try:
        import open3d as o3d
    except ImportError:
        return None
    if not all(isinstance(frame.camera, Pinhole) for frame, _, _ in views):
        return None
    images, cameras = [], []
    for frame, full, pose in views:
        color = np.ascontiguousarray(frame.color_image if full is None else full)
        size = color.shape[1::-1]
        depth = cv2.resize(frame.z, size, interpolation=cv2.INTER_NEAREST)
        images.append(
            o3d.geometry.RGBDImage.create_from_color_and_depth(
                *(o3d.geometry.Image(image) for image in (color, depth)),
                depth_scale=1.0,
                depth_trunc=20.0,
                convert_rgb_to_intensity=False,
            )
        )
        c, (x, y) = frame.camera, np.array(size) / [frame.camera.width, frame.camera.height]
        camera = o3d.camera.PinholeCameraParameters()
        camera.intrinsic = o3d.camera.PinholeCameraIntrinsic(
            *size, c.fx * x, c.fy * y, (c.cx + 0.5) * x - 0.5, (c.cy + 0.5) * y - 0.5
        )
        camera.extrinsic = se3.inverse(pose)
        cameras.append(camera)
    surface = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(mesh.vertices), o3d.utility.Vector3iVector(mesh.faces)
    )
    surface.compute_vertex_normals()
    trajectory = o3d.camera.PinholeCameraTrajectory()
    trajectory.parameters = cameras
    option = o3d.pipelines.color_map.RigidOptimizerOption(_OPEN3D_ITERATIONS, 20.0)
    made, _ = o3d.pipelines.color_map.run_rigid_optimizer(surface, images, trajectory, option)
    colors = np.round(np.asarray(made.vertex_colors) * 255).clip(0, 255).astype(np.uint8)
    return replace(mesh, color=colors)


def measured(path: str) -> list[tuple[str, list[Score], float]]:
    """Return name, scores and CPU seconds of each method."""
    recording = open_recording(path)
    with tempfile.TemporaryDirectory() as folder:
        options = Options(out=Path(folder) / "out", no_report=True, texture=False)
        result = run([path], options)
    colored = [
        k
        for k in np.flatnonzero(result.has_pose).tolist()
        if isinstance(frame := recording.image(k), RangeFrame) and frame.color_image is not None
    ]
    step = LEFT_OUT if len(colored) >= _MANY else 3
    left_out = colored[step // 2 :: step]
    kept = np.setdiff1d(np.arange(len(recording)), left_out)
    rest = replace(recording, indices=recording.indices[kept])
    start = time.process_time()
    texture = texturing.make_texture(rest, _of_frames(result, kept), 2048, required=True)
    seconds = time.process_time() - start
    if texture is None:
        return []
    start = time.process_time()
    known = _of_frames(result, kept)
    views: list[Any] = []
    for k in texturing.steadiest_frames(known, np.isin(kept, colored)):
        view = rest[k]
        if isinstance(view, RangeFrame) and view.color_image is not None:
            full = texturing.full_image(rest, view, 1 << 62)
            views.append((view, full, known.trajectory[k]))
    optimised = colored_by_open3d(texture.mesh, views)
    seconds_open3d = time.process_time() - start
    # The same surface and images, with a colour per vertex.
    rows: list[tuple[str, Mesh | Textured, float]] = [
        ("vertex colours", texture.charts, 0.0),
        ("texture", texture, seconds),
    ]
    if optimised is not None:
        rows.append(("Open3D's colour map optimisation", optimised, seconds_open3d))
    everything = texturing.make_texture(recording, result, 2048, required=True)
    assert everything is not None
    rows.append(("texture of these images too", everything, 0.0))
    return [
        (name, [_compared(model, recording, result, k) for k in left_out], spent)
        for name, model, spent in rows
    ]


def _of_frames(result: Reconstruction, rows: np.ndarray) -> Reconstruction:
    """Return a result that knows only some of its frames."""
    frames = tuple(result.diagnostics.frames[k] for k in rows)
    diagnostics = replace(result.diagnostics, frames=frames)
    return replace(
        result,
        trajectory=result.trajectory[rows],
        timestamps=result.timestamps[rows],
        diagnostics=diagnostics,
    )


def _compared(
    model: Mesh | Textured, recording: Recording, result: Reconstruction, k: int
) -> Score:
    """Compare a model with an image, as it is posed and at the pose where they agree best."""
    frame: Any = recording[k]
    full = texturing.full_image(recording, frame, 1 << 62)
    image = frame.color_image if full is None else full
    scale = min(1.0, _WIDTH / max(image.shape))
    size = (round(image.shape[1] * scale), round(image.shape[0] * scale))
    image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    known = image.any(-1)
    shown, z = rendered(model, frame.camera, result.trajectory[k], size)
    as_posed = _similarity(image, shown, (z > 0) & known)
    T = _aligned(model, frame.camera, result.trajectory[k], image)
    shown, z = rendered(model, frame.camera, T, size)
    seen = cv2.resize(frame.z, size, interpolation=cv2.INTER_NEAREST)
    same = (seen > 0) & (np.abs(z - seen) < TOLERANCE_M + TOLERANCE_FRACTION * z) & known
    same = cv2.erode(same.astype(np.uint8), np.ones((_EDGE, _EDGE))) > 0
    aligned = _similarity(image, shown, (z > 0) & known)
    return Score(*as_posed, *aligned, *_similarity(image, shown, same), float(same.mean()))


def _similarity(image: np.ndarray, shown: np.ndarray, mask: np.ndarray) -> tuple[float, float]:
    """Return PSNR and SSIM of a rendered image, after its channels' gain and offset are fitted."""
    if not mask.any():
        return np.nan, np.nan
    a, b = image.astype(float), shown.astype(float)
    for channel in range(3):
        gain, offset = np.polyfit(b[mask][:, channel], a[mask][:, channel], 1)
        b[..., channel] = (gain * b[..., channel] + offset).clip(0, 255)
    error = np.mean((a[mask] - b[mask]) ** 2)
    psnr = float(10 * np.log10(255**2 / max(error, 1e-9)))
    return psnr, _ssim(a.mean(-1), b.mean(-1), mask)


def _aligned(
    model: Mesh | Textured, camera: Any, T_world_camera: np.ndarray, image: np.ndarray
) -> np.ndarray:
    """Return the pose at which a model looks most like an image.

    The optical flow from the rendered to the recorded image (DIS; Kroeger et al. 2016) says where
    in the image the points of the model are seen.
    """
    height, width = image.shape[:2]
    scale = np.array([width / camera.width, height / camera.height])
    flow: Any = cv2.DISOpticalFlow.create(cv2.DISOPTICAL_FLOW_PRESET_MEDIUM)
    seen = cv2.cvtColor(image, cv2.COLOR_RGB2GRAY)
    for _ in range(_ALIGNMENTS):
        shown, z = rendered(model, camera, T_world_camera, (width, height))
        grey = cv2.cvtColor(shown.clip(0, 255).astype(np.uint8), cv2.COLOR_RGB2GRAY)
        moved = flow.calc(np.where(z > 0, grey, seen), seen, None)
        contrast = cv2.GaussianBlur(np.hypot(*np.gradient(grey.astype(np.float32))), (0, 0), 2)
        inner = cv2.erode((z > 0).astype(np.uint8), np.ones((9, 9))) > 0
        inner &= np.hypot(*moved.transpose(2, 0, 1)) < _MAX_SHIFT * width
        if np.count_nonzero(inner) < 100:
            break
        inner &= contrast >= np.median(contrast[inner])
        rows, columns = np.nonzero(inner)
        some = slice(None, None, max(1, len(rows) // 5000))
        rows, columns = rows[some], columns[some]
        pixels = (np.c_[columns, rows] + 0.5) / scale - 0.5
        at = _rays_at(camera, pixels)
        points = homogeneous(at) * z[rows, columns][:, None]
        target = pixels + moved[rows, columns] / scale

        def residuals(xi: np.ndarray, p: Any = points, target: Any = target) -> np.ndarray:
            T = se3.exp(xi)
            q = p @ T[:3, :3].T + T[:3, 3]
            return ((camera.project(q / q[:, 2:]) - target) * scale).ravel()

        found = least_squares(residuals, np.zeros(6), loss="soft_l1", x_scale=[1, 1, 1, 1, 1, 1])
        T_world_camera = T_world_camera @ se3.inverse(se3.exp(found.x))
    return T_world_camera


def _rays_at(camera: Any, pixels: np.ndarray) -> np.ndarray:
    """Interpolate the rays of a camera at pixels (N, 2)."""
    u, v = pixels.astype(np.float32).T[:, None]
    return cv2.remap(np.asarray(camera.rays(), np.float32), u, v, cv2.INTER_LINEAR)[0]


def _ssim(a: np.ndarray, b: np.ndarray, mask: np.ndarray) -> float:
    """Return the structural similarity of grey images over a mask."""

    def mean(values: np.ndarray) -> np.ndarray:
        weight = cv2.GaussianBlur(mask.astype(float), (11, 11), _SSIM_SIGMA)
        blurred = cv2.GaussianBlur(values * mask, (11, 11), _SSIM_SIGMA)
        return np.asarray(blurred / np.maximum(weight, 1e-6))

    ma, mb = mean(a), mean(b)
    va, vb, ab = mean(a * a) - ma**2, mean(b * b) - mb**2, mean(a * b) - ma * mb
    similarity = (2 * ma * mb + _SSIM_C1) * (2 * ab + _SSIM_C2)
    similarity /= (ma**2 + mb**2 + _SSIM_C1) * (va + vb + _SSIM_C2)
    return float(similarity[mask].mean())


def rendered(
    model: Mesh | Textured, camera: Any, T_world_camera: np.ndarray, size: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray]:
    """Render a model at a pose: image (H, W, 3), and z (H, W), 0 where it covers no pixel."""
    mesh = model.charts if isinstance(model, Textured) else model
    T = se3.inverse(T_world_camera)
    p = mesh.vertices.astype(float) @ T[:3, :3].T + T[:3, 3]
    z = np.maximum(p[:, 2], 1e-6)
    pixels = (camera.project(homogeneous(p[:, :2] / z[:, None])) + 0.5) * [
        size[0] / camera.width,
        size[1] / camera.height,
    ] - 0.5
    assert mesh.color is not None
    mesh = replace(mesh, color=drawing.display_colors(mesh.color))
    texture = (model.atlas.texels, model.image) if isinstance(model, Textured) else None
    shown = (p[mesh.faces, 2] > _NEAREST).all(1)
    return drawing.drawn(mesh, pixels, p[:, 2], shown, size, texture)


if __name__ == "__main__":
    main()
