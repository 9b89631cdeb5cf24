"""Reader of Apple's data set ARKitScenes (Baruch et al. 2021), recorded by iPads with LiDAR."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tofuse.engine.arrays import Float64
from tofuse.engine.cameras import Pinhole
from tofuse.engine.errors import InputError
from tofuse.engine.geometry import se3
from tofuse.engine.parts import part
from tofuse.engine.times import partners
from tofuse.formats.cameras import camera_file
from tofuse.formats.files import reading, tables
from tofuse.formats.images import first_size
from tofuse.formats.poses import associated_poses
from tofuse.formats.sources import Reader, ReaderOptions, Sniff, inputs, phones

_LIMIT_S = 0.002  # names of files of one frame may differ by a rounded millisecond


@part("reader", "arkitscenes", label="experimental")
class ArkitScenes(Reader):
    """ARKitScenes: lowres_depth/, lowres_wide/, lowres_wide_intrinsics/, confidence/ and .traj."""

    def sniff(self, path: Path) -> Sniff | None:
        """See `Reader.sniff`."""
        names = ("lowres_depth", "lowres_wide_intrinsics")
        if all(reading.is_folder(_frames(path) / name) for name in names):
            return Sniff(1.0, " and ".join(f"{name}/" for name in names))
        return None

    def open(self, path: Path, options: ReaderOptions) -> phones.PhoneSource:
        """See `Reader.open`."""
        inputs.refuse_camera(options, "arkitscenes", inputs.PER_FRAME)
        folder = _frames(path)
        files = inputs.depth_images(folder / "lowres_depth")
        times, size = _times(files), first_size(files)
        source = phones.PhoneSource(
            files,
            times,
            confidence=_of_frames(folder / "confidence", ".png", times),
            color=_of_frames(folder / "lowres_wide", ".png", times),
        )
        lenses = _of_frames(folder / "lowres_wide_intrinsics", ".pincam", times)
        pairs = zip(files, lenses, strict=True)
        source.cameras = inputs.cameras_of(pairs, lambda pair: _lens(*pair, size))
        if reading.is_file(folder / "lowres_wide.traj"):
            pose_times, poses = _read_poses(folder / "lowres_wide.traj")
            source.reference = associated_poses(times, pose_times, poses)
        return source


def _frames(path: Path) -> Path:
    """The folder of the frames, which the subset with bounding boxes has in another one."""
    inner = path / f"{path.absolute().name}_frames"
    return inner if reading.is_folder(inner) else path


def _times(files: list[Path]) -> Float64:
    """Seconds (N,) at the end of the names, as in 41048190_3418.328.png."""
    try:
        return np.array([float(file.stem.rsplit("_", 1)[-1]) for file in files])
    except ValueError as error:
        raise InputError(
            "has a file whose name doesn't end with its time in s",
            where=files[0].parent,
            remedy="remove it, or name files as the data set does",
        ) from error


def _of_frames(folder: Path, suffix: str, times: Float64) -> list[Path | None]:
    """The file of each frame; None where there is none."""
    files = inputs.files_at(folder, suffix)
    return [files[k] if k >= 0 else None for k in partners(times, _times(files), _LIMIT_S)]


def _lens(file: Path, lens: Path | None, size: tuple[int, int]) -> Pinhole:
    if lens is None:
        raise InputError("has no file in lowres_wide_intrinsics/", where=file)
    table = tables.read_numbers(lens)
    if table.shape != (1, 6):
        raise InputError("is not w h fx fy cx cy", where=lens, remedy="download it again")
    width, height, fx, fy, cx, cy = table[0]
    K = camera_file.intrinsic_matrix(fx, fy, cx, cy)
    return phones.phone_lens(K, camera_file.image_size(width, height, lens), size, lens)


def _read_poses(path: Path) -> tuple[Float64, Float64]:
    """Times (N,) and T_world_camera (N, 4, 4) of lines "t rx ry rz x y z" of T_camera_world."""
    table = tables.read_numbers(path)
    plausible = np.abs(table) < se3.MAX_COORDINATE_M  # false for NaN, too
    if not len(table) or table.shape[1] != 7 or not plausible.all():
        raise InputError(
            "is not lines of 7 plausible numbers", where=path, remedy="download it again"
        )
    rows = zip(se3.so3_exp(table[:, 1:4]), table[:, 4:], strict=True)
    return table[:, 0], np.stack([se3.inverse(se3.pose(R, t)) for R, t in rows])
