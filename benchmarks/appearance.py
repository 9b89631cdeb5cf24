"""How a textured model looks from where images were taken that it was not made of.

Every tenth colour image is left out of the texture, and the model is rendered at its pose: PSNR and
SSIM (Wang et al. 2004) over the pixels that the model covers, after the exposure of the image is
fitted by one factor per channel, beside the colours of the vertices. Open3D's colour map
optimisation (Zhou and Koltun 2014) is compared where Open3D is installed.

    python benchmarks/appearance.py RECORDING...
"""

from __future__ import annotations

import argparse
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tofuse.apps.jobs import Options, run
from tofuse.engine.frames import RangeFrame, Recording
from tofuse.engine.fusion import Mesh, Textured, display_colors
from tofuse.engine.geometry import se3
from tofuse.engine.mapping import texturing
from tofuse.engine.results import Reconstruction
from tofuse.formats.recordings import open_recording

LEFT_OUT = 10
_SSIM_C1, _SSIM_C2, _SSIM_SIGMA = (0.01 * 255) ** 2, (0.03 * 255) ** 2, 1.5
_WIDTH = 960  # pixels of the compared images, or as recorded if that is less


@dataclass(frozen=True)
class Score:
    """How a rendered image compares with a recorded one."""

    psnr: float
    ssim: float
    covered: float


def main() -> None:
    """Print a row per recording and method."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recordings", nargs="+")
    print("recording, method, images left out, PSNR (dB), SSIM, covered, CPU seconds")
    for path in parser.parse_args().recordings:
        for name, scores, seconds in measured(path):
            means = np.mean([[s.psnr, s.ssim, s.covered] for s in scores], axis=0)
            values = ", ".join(f"{value:.3g}" for value in means)
            print(f"{Path(path).name}, {name}, {len(scores)}, {values}, {seconds:.1f}", flush=True)
    print(f"Open3D's colour map optimisation: {open3d_state()}")


def open3d_state() -> str:
    """Say why there is no row of Open3D."""
    try:
        import open3d
    except ImportError:
        return "not measured, as Open3D is not installed here"
    return f"not measured yet (Open3D {open3d.__version__})"


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
    left_out = colored[LEFT_OUT // 2 :: LEFT_OUT]
    kept = np.setdiff1d(np.arange(len(recording)), left_out)
    start = time.process_time()
    texture = texturing.make_texture(
        replace(recording, indices=recording.indices[kept]), _of_frames(result, kept), 2048
    )
    seconds = time.process_time() - start
    if texture is None:
        return []
    # The same surface and images, with a colour per vertex.
    rows: list[tuple[str, Mesh | Textured, float]] = [
        ("vertex colours", texture.charts, 0.0),
        ("texture", texture, seconds),
    ]
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
    frame: Any = recording[k]
    full = texturing.full_image(recording, frame, 1 << 62)
    image = frame.color_image if full is None else full
    scale = min(1.0, _WIDTH / max(image.shape))
    size = (round(image.shape[1] * scale), round(image.shape[0] * scale))
    image = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
    shown, mask = rendered(model, frame.camera, result.trajectory[k], size)
    mask &= image.any(-1)
    if not mask.any():
        return Score(np.nan, np.nan, 0.0)
    a, b = image.astype(float), shown.astype(float)
    gain = (a[mask] * b[mask]).sum(0) / np.maximum((b[mask] ** 2).sum(0), 1e-9)
    b = (b * gain).clip(0, 255)
    error = np.mean((a[mask] - b[mask]) ** 2)
    return Score(
        float(10 * np.log10(255**2 / max(error, 1e-9))),
        _ssim(a.mean(-1), b.mean(-1), mask),
        float(mask.mean()),
    )


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
    """Render a model at a pose: image (H, W, 3) and the mask (H, W) of what it covers.

    Triangles are cut into points as dense as the pixels; the nearest one of a pixel is seen.
    """
    width, height = size
    mesh = model.charts if isinstance(model, Textured) else model
    T = se3.inverse(T_world_camera)
    p = mesh.vertices.astype(float) @ T[:3, :3].T + T[:3, 3]
    z = np.maximum(p[:, 2], 1e-6)
    pixels = (camera.project(np.c_[p[:, :2] / z[:, None], np.ones(len(p))]) + 0.5) * [
        width / camera.width,
        height / camera.height,
    ] - 0.5
    corners, depths = pixels[mesh.faces], p[mesh.faces, 2]
    low, high = corners.min(1), corners.max(1)
    visible = (depths > 0.05).all(1) & (high >= 0).all(1) & (low < [width, height]).all(1)
    visible &= ((high - low) < [width, height]).all(1)
    faces, corners, depths = mesh.faces[visible], corners[visible], depths[visible]
    steps = np.ceil((high - low)[visible].max(1) * 1.5).astype(int).clip(1, 400)
    depth = np.full(width * height, np.inf)
    image = np.zeros((width * height, 3), np.float32)
    colors = None if mesh.color is None else display_colors(mesh.color).astype(np.float32)
    for n in np.unique(steps):
        i, j = np.meshgrid(np.arange(n + 1), np.arange(n + 1))
        inside = (i + j) <= n
        b = np.stack([n - i[inside] - j[inside], i[inside], j[inside]], -1) / n
        rows = np.flatnonzero(steps == n)
        for part in np.array_split(rows, max(1, len(rows) * len(b) // 2_000_000)):
            # Interpolated in perspective.
            weight = b[None] / depths[part][:, None]
            weight /= weight.sum(-1, keepdims=True)
            at = np.rint(b @ corners[part]).astype(int).reshape(-1, 2)
            far = (weight * depths[part][:, None]).sum(-1).ravel()
            ok = (at >= 0).all(1) & (at < [width, height]).all(1)
            cell, far = at[ok, 1] * width + at[ok, 0], far[ok]
            if isinstance(model, Textured):
                texel = (weight @ model.atlas.texels[faces[part]]).reshape(-1, 2)[ok]
                u, v = texel.astype(np.float32).T[:, None]
                value = _sampled(model.image, u, v)
            else:
                assert colors is not None
                value = (weight @ colors[faces[part]]).reshape(-1, 3)[ok]
            order = np.lexsort((-far, cell))  # the nearest one last
            cell, far, value = cell[order], far[order], value[order]
            last = np.r_[cell[1:] != cell[:-1], True]
            cell, far, value = cell[last], far[last], value[last]
            nearer = far < depth[cell]
            depth[cell[nearer]], image[cell[nearer]] = far[nearer], value[nearer]
    shape = (height, width)
    return image.reshape(*shape, 3), np.isfinite(depth).reshape(shape)


def _sampled(image: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """Interpolate an image at (1, N) positions; in rows, as OpenCV limits their length."""
    count, side = u.shape[1], 16_384
    rows = -(-count // side)
    u, v = (np.pad(x[0], (0, rows * side - count)).reshape(rows, side) for x in (u, v))
    sampled = cv2.remap(image, u, v, cv2.INTER_LINEAR).astype(np.float32)
    return np.asarray(sampled.reshape(-1, 3)[:count])


if __name__ == "__main__":
    main()
