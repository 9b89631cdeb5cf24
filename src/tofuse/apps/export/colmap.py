"""A result as a model of COLMAP, in its text form: images, depth, poses and points."""

from __future__ import annotations

from pathlib import Path

from tofuse.apps.export.image_folder import subsampled_points, write_images
from tofuse.engine.arrays import Float32, UInt8
from tofuse.engine.cameras import BrownConrady, Fisheye, Pinhole, Rational
from tofuse.engine.geometry import quaternion, se3
from tofuse.formats.files import atomic, tables

# COLMAP's name of a lens model, and its parameters after fx, fy, cx, cy.
_MODELS: dict[type, tuple[str, tuple[str, ...]]] = {
    Pinhole: ("PINHOLE", ()),
    BrownConrady: ("FULL_OPENCV", ("k1", "k2", "p1", "p2", "k3", "", "", "")),
    Rational: ("FULL_OPENCV", ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
    Fisheye: ("OPENCV_FISHEYE", ("k1", "k2", "k3", "k4")),
}
# COLMAP's value for an error that was not computed.
_NO_ERROR = -1


def write_colmap(result: Path, folder: Path, every: int, pinhole: bool = False) -> None:
    """Write the main model of a result as a COLMAP model.

    Parameters
    ----------
    result
        The result.
    folder
        A new folder.
    every
        Every n-th of the frames with a pose.
    pinhole
        Whether to rectify all images.

    Raises
    ------
    InputError
        See `write_images`.
    """
    supported = {Pinhole} if pinhole else set(_MODELS)
    cameras: dict[str, int] = {}
    lines: list[str] = []
    written = write_images(result, folder, every, lambda camera: type(camera) in supported)
    for number, posed in enumerate(written, 1):
        camera = cameras.setdefault(lens(posed.camera), len(cameras) + 1)
        T = se3.inverse(posed.T_world_camera)
        x, y, z, w = quaternion.from_matrix(T[:3, :3])
        row = " ".join(tables.exact(value) for value in (w, x, y, z, *T[:3, 3]))
        # The second line of an image, its 2D points, is empty.
        lines += [f"{number} {row} {camera} {posed.name}", ""]
    sparse = atomic.make_folder(folder / "sparse" / "0")
    table = [f"{number} {camera}" for camera, number in cameras.items()]
    _write(sparse / "cameras.txt", "CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]", table)
    _write(
        sparse / "images.txt",
        "IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME, and a line of POINTS2D[]",
        lines,
    )
    _write(
        sparse / "points3D.txt",
        "POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[]",
        _points(*subsampled_points(result)),
    )


def lens(camera: Pinhole) -> str:
    """Return a camera as in `cameras.txt`, where (0, 0) is the corner of the first pixel."""
    model, names = _MODELS[type(camera)]
    if isinstance(camera, BrownConrady) and not isinstance(camera, Rational) and not camera.k3:
        model, names = "OPENCV", names[:4]  # supported by more programs
    numbers = [camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5]
    numbers += [getattr(camera, name) if name else 0.0 for name in names]
    return f"{model} {camera.width} {camera.height} " + " ".join(tables.exact(n) for n in numbers)


def _points(points: Float32, color: UInt8) -> list[str]:
    rows = zip(points.tolist(), color.tolist(), strict=True)
    return [
        f"{number} {x:.7g} {y:.7g} {z:.7g} {r} {g} {b} {_NO_ERROR}"
        for number, ((x, y, z), (r, g, b)) in enumerate(rows, 1)
    ]


def _write(path: Path, columns: str, lines: list[str]) -> None:
    atomic.write_text(path, "\n".join([f"# {columns}", *lines]) + "\n")
