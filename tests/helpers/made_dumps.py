"""Small recordings in the layouts of other programs: Polycam, nerfstudio, HoloLens 2 and others."""

from __future__ import annotations

import io
import json
import tarfile
from pathlib import Path

import numpy as np

import made_phones
from made_phones import ARKIT, CONFIDENCE, CX, CY, DEPTH, FX, HEIGHT, POSES, WIDTH, millimetres
from tofuse.engine.cameras.cameras import Pinhole
from tofuse.formats.images.images import write_png
from written import camera_json

IMAGE = (8 * WIDTH, 8 * HEIGHT)  # of colour
TICKS = [132_000_000_000_000_000 + 2_000_000 * k for k in range(3)]  # 0.2 s apart
T_CAMERA_RIG = np.linalg.inv(POSES[1]) @ POSES[2]
K2 = (365.5, 366.5, 255.25, 205.75)
AMPLITUDE = np.arange(3 * HEIGHT * WIDTH, dtype=np.uint16).reshape(3, HEIGHT, WIDTH)


def make_polycam(folder: Path, *, corrected: bool = True) -> None:
    """Names are microseconds; ARKit's poses differ slightly from the optimised ones."""
    keyframes = folder / "keyframes"
    for name in ("depth", "confidence", "images", "cameras", "corrected_cameras"):
        (keyframes / name).mkdir(parents=True)
    for k in range(3):
        stem = str(5_000_000 + 250_000 * k)
        write_png(keyframes / "depth" / f"{stem}.png", millimetres(DEPTH[k]))
        levels = np.array([0, 127, 255], np.uint8)[CONFIDENCE[k]]
        write_png(keyframes / "confidence" / f"{stem}.png", levels)
        image = made_phones.jpeg(made_phones.color_image(k))
        (keyframes / "images" / f"{stem}.jpg").write_bytes(image)
        facts = {"fx": FX + k, "fy": FX + k, "cx": CX, "cy": CY, "width": 1920, "height": 1440}
        facts |= {"blur_score": 100.5, "manual_keyframe": False, "timestamp": int(stem)}
        for name, off in (("cameras", 0.01), ("corrected_cameras", 0.0)):
            if name == "cameras" or corrected:
                T = POSES[k] @ ARKIT
                pose = {f"t_{i}{j}": T[i, j] + off * (j == 3) for i in range(3) for j in range(4)}
                (keyframes / name / f"{stem}.json").write_text(json.dumps(facts | pose))
    (folder / "mesh_info.json").write_text("{}")


def make_nerfstudio(folder: Path) -> None:
    """As nerfstudio writes it: millimetres, intrinsics of colour images eight times as wide."""
    frames = []
    for name in ("images", "depth"):
        (folder / name).mkdir(parents=True)
    for k in (2, 0, 1):  # in any order
        write_png(folder / "depth" / f"frame_{k}.png", millimetres(DEPTH[k]))
        image = made_phones.jpeg(made_phones.color_image(k, *IMAGE))
        (folder / "images" / f"frame_{k}.jpg").write_bytes(image)
        names = {"file_path": f"images/frame_{k}.jpg", "depth_file_path": f"depth/frame_{k}.png"}
        frames.append(names | {"transform_matrix": (POSES[k] @ ARKIT).tolist()})
    about = {"camera_model": "OPENCV", "w": IMAGE[0], "h": IMAGE[1], "fl_x": 200.0, "fl_y": 201.0}
    about |= {"cx": 130.0, "cy": 95.0, "k1": -0.05, "k2": 0.01, "p1": 0.001, "p2": 0.0}
    (folder / "transforms.json").write_text(json.dumps(about | {"frames": frames}))


def make_nerfcapture(folder: Path) -> None:
    """As NeRFCapture's script writes it: intrinsics per frame, depth as large as colour."""
    frames = []
    (folder / "images").mkdir(parents=True)
    unit = 8 / 65535
    for k in range(3):
        counts = np.round(DEPTH[k] / unit).astype(np.uint16)
        write_png(folder / "images" / f"{k}.depth.png", counts)
        write_png(folder / "images" / f"{k}.png", made_phones.color_image(k, WIDTH, HEIGHT))
        frame = {"file_path": f"images/{k}", "depth_path": f"images/{k}.depth.png"}
        frame |= {"transform_matrix": (POSES[k] @ ARKIT).tolist(), "timestamp": 7.0 + 0.1 * k}
        frame |= {"fl_x": 30.0 + k, "fl_y": 30.0 + k, "cx": 16.5, "cy": 12.5}
        frames.append(frame | {"w": WIDTH, "h": HEIGHT})
    about = {"fl_x": 1.0, "fl_y": 1.0, "cx": 320.0, "cy": 240.0, "w": WIDTH, "h": HEIGHT}
    about |= {"integer_depth_scale": unit, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(about))


def pgm_bytes(image: np.ndarray) -> bytes:
    height, width = image.shape
    return f"P5\n{width} {height}\n65535\n".encode() + image.astype(">u2").tobytes()


def hololens_rays() -> np.ndarray:
    """(H, W, 2) x/z and y/z, undefined in a corner."""
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH]
    x, y = (u - 15.8) / 20, (v - 11.7) / 20
    r2 = x * x + y * y
    rays = np.stack([x, y], -1) * (1 + 0.1 * r2)[..., None]
    rays[:3, :3] = np.nan
    return rays


def make_hololens(folder: Path, *, stream: str = "Depth Long Throw", unpacked: bool = False):
    """Radial range in mm, in an archive or unpacked from it."""
    folder.mkdir(parents=True)
    rays = hololens_rays()
    unit = np.concatenate([rays, np.ones((HEIGHT, WIDTH, 1))], -1)
    unit /= np.linalg.norm(unit, axis=2, keepdims=True)
    unit[np.isnan(rays[..., 0])] = [7.0, 7.0, 0.0]
    (folder / f"{stream}_lut.bin").write_bytes(unit.astype("<f4").tobytes())
    files = {}
    for k, tick in enumerate(TICKS):
        files[f"{tick}.pgm"] = pgm_bytes(millimetres(DEPTH[k]))
        files[f"{tick}_ab.pgm"] = pgm_bytes(AMPLITUDE[k])
    if unpacked:
        (folder / stream).mkdir()
        for name, data in files.items():
            (folder / stream / name).write_bytes(data)
    else:
        with tarfile.open(folder / f"{stream}.tar", "w") as archive:
            for name, data in files.items():
                info = tarfile.TarInfo(name)
                info.size = len(data)
                archive.addfile(info, io.BytesIO(data))

    def row(T: np.ndarray) -> str:
        return ",".join(repr(float(value)) for value in T.ravel())

    (folder / f"{stream}_extrinsics.txt").write_text(row(T_CAMERA_RIG) + "\n")
    lines = [f"{t},{row(T @ T_CAMERA_RIG)}" for t, T in zip(TICKS, POSES, strict=True)]
    (folder / f"{stream}_rig2world.txt").write_text("\n".join(lines) + "\n")


def yaml_matrix(name: str, K: tuple[float, float, float, float]) -> str:
    fx, fy, cx, cy = K
    data = f"[ {fx!r}, 0., {cx!r}, 0.,\n       {fy!r}, {cy!r}, 0., 0., 1. ]"
    head = f"{name}: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n"
    return f"{head}   data: {data}\n"


def make_kinect2(folder: Path, *, size: tuple[int, int] = (512, 424), serial: str = "") -> None:
    """As kinect2_viewer saves them by key, with the calibration of kinect2_bridge."""
    (folder / serial).mkdir(parents=True)
    width, height = size
    for k in range(3):
        depth = np.zeros((height, width), np.uint16)
        depth[10:-10] = 1000 + 100 * k
        write_png(folder / f"{k:04d}_depth.png", depth)
        write_png(folder / f"{k:04d}_depth_colored.png", np.zeros((height, width, 3), np.uint8))
        if k != 1:
            image = made_phones.jpeg(made_phones.color_image(k, width, height))
            (folder / f"{k:04d}_color.jpg").write_bytes(image)
    bent = yaml_matrix("distortionCoefficients", (9.0, 9.0, 9.0, 9.0))
    color = tuple(3 * value for value in K2)
    for name, K in (("calib_ir", K2), ("calib_color", color)):
        text = "%YAML:1.0\n---\n" + yaml_matrix("cameraMatrix", K) + bent
        (folder / serial / f"{name}.yaml").write_text(text)


def make_depth16(folder: Path) -> None:
    folder.mkdir(parents=True)
    for k in range(3):
        level = np.where(CONFIDENCE[k] == 0, 0, CONFIDENCE[k] + 4)
        samples = millimetres(DEPTH[k]) | (level.astype(np.uint16) << 13)
        (folder / f"{12 * k:08d}_depth16.bin").write_bytes(samples.astype("<u2").tobytes())
    image = made_phones.jpeg(made_phones.color_image(1, *IMAGE))
    (folder / "00000012_image.jpg").write_bytes(image)
    lens = Pinhole(WIDTH, HEIGHT, 30.0, 30.5, 15.5, 11.5)
    camera_json(folder / "camera.json", lens, frame_rate_hz=10)
