"""The image and the numbers of the README, from the result of ``tofuse demo``.

    python benchmarks/readme_picture.py [DIR of the demo [DIR of another result]]

The other result is that of another method on the demo's recording, for its numbers only. Prints the
verdict and the errors against the simulator's exact poses, and draws docs/images/room.png: one
frame of the recording, and an oblique view of the cloud from above, with the camera trajectory.
"""

from __future__ import annotations

import sys
from pathlib import Path

import cv2
import numpy as np

from tofuse.apps.results.run_json import read_run_json
from tofuse.engine.arrays import Float64, UInt8
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.geometry import se3
from tofuse.engine.quality.trajectory_errors import evaluate_trajectory
from tofuse.formats.geometry.ply import read_ply
from tofuse.formats.poses.trajectory import read_tum
from tofuse.formats.recordings.open import open_recording

ROOT = Path(__file__).resolve().parents[1]
PICTURE = ROOT / "docs" / "images" / "room.png"

SIZE = (940, 420)  # pixels
PIXEL_M = 0.0125
CEILING_M = 0.75  # points higher above the camera than this would hide the room
TILT = np.radians(52.0)  # from the horizon
TURN = np.radians(62.0)
PATH_BGR = (40, 90, 255)
BACKGROUND_BGR = (96, 78, 66)
LEVELS = np.uint8(0xF8)  # invisible noise in the lowest bits would double the file size


def print_figures(folder: Path, recording: Path) -> None:
    run = read_run_json(folder / "run.json")
    closed = sum(loop["accepted"] for loop in run["loops"])
    tracked = sum(frame["status"] == "tracked" for frame in run["frames"])
    print(f"method: {run['config']['method']}")
    print(f"verdict: {run['verdict']} ({', '.join(r['code'] for r in run['reasons']) or 'none'})")
    for reason in run["reasons"]:
        print(f"  {reason['code']}: {reason['text']}")
    print(f"frames tracked: {tracked} of {len(run['frames'])}, loops closed: {closed}")
    error = evaluate_trajectory(
        *read_tum(folder / "trajectory.txt"), *read_tum(recording / "groundtruth.txt")
    )
    print(f"ATE rms: {error.ate_rms_m:.3f} m, {np.degrees(error.rotation_rms_rad):.2f} deg")
    for r in error.relative:
        angle = np.degrees(r.rotation_rms_rad)
        print(f"RPE over {r.frames} frames: {r.translation_rms_m:.3f} m, {angle:.2f} deg")


def from_above() -> Float64:
    """Rotation (3, 3) from the world (x right, y down) to the view (z away from the viewer)."""
    turn = se3.so3_exp([0.0, TURN, 0.0])
    tilt = se3.so3_exp([TILT, 0.0, 0.0])
    return tilt @ turn


def canvas(size: tuple[int, int]) -> UInt8:
    image = np.empty((size[1], size[0], 3), np.uint8)
    image[:] = BACKGROUND_BGR
    return image


def draw_cloud(points: Float64, color: UInt8, size: tuple[int, int]) -> tuple[UInt8, Float64]:
    """Draw points in orthographic projection; returns the BGR image and its central point."""
    R = from_above()
    low, high = np.percentile(points, [1, 99], axis=0)
    centre = (low + high) / 2
    seen = (points - centre) @ R.T
    u = np.round(seen[:, 0] / PIXEL_M + size[0] / 2).astype(int)
    v = np.round(seen[:, 1] / PIXEL_M + size[1] / 2).astype(int)
    order = np.argsort(
        -seen[:, 2], kind="stable"
    )  # far to near, so that near points cover far ones
    image = canvas(size)
    inside = (u[order] >= 0) & (u[order] < size[0] - 1) & (v[order] >= 0) & (v[order] < size[1] - 1)
    order = order[inside]
    for du, dv in ((0, 0), (1, 0), (0, 1), (1, 1)):  # each point covers two by two pixels
        image[v[order] + dv, u[order] + du] = color[order, ::-1]
    return image, centre


def draw_path(image: UInt8, poses: Float64, centre: Float64) -> None:
    seen = (poses[:, :3, 3] - centre) @ from_above().T / PIXEL_M
    line = np.round((seen[:, :2] + np.array(image.shape[1::-1]) / 2) * 16).astype(np.int32)
    cv2.polylines(image, [line], False, PATH_BGR, 2, cv2.LINE_AA, shift=4)


def draw_frame(frame: RangeFrame, width: int) -> UInt8:
    """Draw the amplitude, and below it the depth in false colours (near is bright)."""
    height = round(width * frame.camera.height / frame.camera.width)
    grey = np.zeros(frame.depth.shape, np.uint8)
    if frame.amplitude_image is not None:
        high = np.percentile(frame.amplitude_image, 99)
        grey = (255 * (frame.amplitude_image / high).clip(0, 1) ** 0.5).astype(np.uint8)
    near, far = np.percentile(frame.z[frame.valid], [1, 99])
    depth = (255 * ((far - frame.z) / (far - near)).clip(0, 1)).astype(np.uint8)
    colored = cv2.applyColorMap(depth, cv2.COLORMAP_VIRIDIS)
    colored[~frame.valid] = BACKGROUND_BGR
    images = [cv2.cvtColor(grey, cv2.COLOR_GRAY2BGR), colored]
    return np.concatenate(
        [cv2.resize(i, (width, height), interpolation=cv2.INTER_NEAREST) for i in images]
    )


def picture(folder: Path) -> UInt8:
    cloud = read_ply(folder / "cloud.ply")
    points = cloud.points.astype(float)
    keep = points[:, 1] > -CEILING_M
    color = cloud.color if cloud.color is not None else np.full((len(points), 3), 90, np.uint8)
    left = draw_frame(open_recording(folder / "recording")[0], 230)
    room = (SIZE[0] - left.shape[1] - 10, SIZE[1])
    image, centre = draw_cloud(points[keep], color[keep], room)
    draw_path(image, read_tum(folder / "trajectory.txt")[1], centre)
    out = canvas(SIZE)
    top = (SIZE[1] - left.shape[0]) // 2
    out[top : top + left.shape[0], : left.shape[1]] = left
    out[:, -room[0] :] = image
    return out


def main() -> None:
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "demo"
    for result in (folder, *map(Path, sys.argv[2:])):
        print_figures(result, folder / "recording")
    PICTURE.parent.mkdir(parents=True, exist_ok=True)
    image = picture(folder) & LEVELS
    cv2.imwrite(str(PICTURE), image, [cv2.IMWRITE_PNG_COMPRESSION, 9])
    print(f"{PICTURE.relative_to(ROOT)}: {PICTURE.stat().st_size / 1000:.0f} KB")


if __name__ == "__main__":
    main()
