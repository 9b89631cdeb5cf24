"""The images of a result with their poses, as input for other programs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from tofuse.apps.results import read_cloud, reopening, run_json
from tofuse.engine.arrays import Float32, Float64, UInt8, UInt16
from tofuse.engine.cameras import Camera, Pinhole, ray_lengths, scaled
from tofuse.engine.errors import InputError, UnreadableFrameError
from tofuse.engine.frames import RangeFrame, Recording
from tofuse.engine.fusion import texture
from tofuse.engine.noise import noise_model_for
from tofuse.engine.sensor import CameraErrors, Corrector
from tofuse.formats.cameras import Rectifier, pinhole_of
from tofuse.formats.files import atomic
from tofuse.formats.images import write_png
from tofuse.formats.sources import FileSource

DEPTH_UNIT_M, SIGMA_UNIT_M = 1e-3, 1e-4  # m per count
IMAGES, DEPTH, SIGMA, MASKS = "images", "depth", "sigma", "masks"
_MAX_COUNT = 65535
_WHITE_PERCENTILE = 99.0  # of the first frame's amplitude
_MAX_POINTS = 200_000


@dataclass(frozen=True, eq=False)
class PosedImage:
    """One frame of a result with its pose, as its files were written.

    Attributes
    ----------
    name
        File name of the frame's images; its number is the index in `run.json`.
    timestamp
        Of the frame, s.
    camera
        Camera of the image, at its resolution, as the result calibrated it; rectified if requested.
    masked
        Whether the image has unknown pixels.
    T_world_camera
        (4, 4).
    covariance
        (6, 6) of the pose (docs/conventions.md); None where not known.
    """

    name: str
    timestamp: float
    camera: Pinhole
    masked: bool
    T_world_camera: Float64
    covariance: Float64 | None


def write_images(
    result: Path, folder: Path, every: int, is_supported: Callable[[Camera], bool]
) -> list[PosedImage]:
    """Write images, depth, sigma and masks of the main model of a result, in order.

    Frames that can't be read, or have neither colour nor amplitude, are left out. Colour that is
    registered to depth keeps its recorded resolution, which may be larger than that of depth.

    Parameters
    ----------
    result
        The result.
    folder
        Where to write.
    every
        Every n-th of the frames with a pose.
    is_supported
        Whether the target format supports a camera's lens model; others are rectified.

    Raises
    ------
    InputError
        If the recording is missing or has changed, contains clouds, no image can be read, or none
        has colour or amplitude.
    """
    with run_json.opened(result) as run:
        indices, poses = run_json.main_poses(result, run)
        selected = dict(zip(indices[::every], poses[::every], strict=True))
        covariances = {f["index"]: run_json.frame_covariance(f) for f in run["frames"]}
        parts = list(reopening.stored_recordings(result, run))
        correctors = [CameraErrors.made_with(part.config) for part in parts]
    written: list[PosedImage] = []
    unmasked: list[tuple[str, tuple[int, ...]]] = []
    skipped: list[str] = []
    for part, frame_correctors in zip(parts, correctors, strict=True):
        recording = reopening.reopen(part, result)
        noise, render = noise_model_for(recording), _Renderer()
        camera: Camera | None = None
        rectifier: Rectifier | None = None
        for frame in _frames(part, recording, selected, frame_correctors):
            image = render(frame)
            if image is None:
                skipped.append(f"{recording.path}: frame {frame.index}")
                continue
            frame = replace(frame, sigma_image=noise.sigma(frame), color_image=image)
            if rectifier is None or frame.camera != camera:
                camera = frame.camera
                is_kept = is_supported(camera) and isinstance(camera, Pinhole)
                rectifier = Rectifier(cast(Pinhole, camera) if is_kept else pinhole_of(camera))
            rectified, image_camera = rectifier(frame), rectifier.pinhole
            image, sigma = rectified.color_image, rectified.sigma_image
            assert image is not None
            assert sigma is not None
            if image_camera == camera and (full_color := _full_color(recording, frame)) is not None:
                image_camera = scaled(image_camera, full_color.shape[1], full_color.shape[0])
                image = full_color
            index = part.first + frame.index
            name = f"frame_{index:06d}.png"
            z_sigma = np.where(rectified.valid, sigma / ray_lengths(rectified.camera), 0)
            is_known = image.any(-1)
            masked = not is_known.all()
            _write(folder / IMAGES, name, image)
            _write(folder / DEPTH, name, _counts(rectified.depth, DEPTH_UNIT_M))
            _write(folder / SIGMA, name, _counts(z_sigma, SIGMA_UNIT_M))
            if masked:
                _write(folder / MASKS, name, np.where(is_known, 255, 0).astype(np.uint8))
            else:
                unmasked.append((name, is_known.shape))
            pose = selected[index], covariances.get(index)
            written.append(PosedImage(name, frame.timestamp, image_camera, masked, *pose))
    if not written:
        raise InputError(
            "has neither colour nor amplitude" if skipped else "has no readable frame with a pose",
            where=skipped[0] if skipped else result,
            remedy="record one of them: the target programs need images" if skipped else None,
        )
    # If any frame has a mask, all get one.
    for name, shape in unmasked if len(unmasked) < len(written) else ():
        _write(folder / MASKS, name, np.full(shape, 255, np.uint8))
    return written


def _frames(
    part: reopening.StoredRecording,
    recording: Recording,
    selected: dict[int, Float64],
    correctors: Sequence[Corrector],
) -> Iterator[RangeFrame]:
    """The chosen readable frames of a recording, with the camera as it was calibrated."""
    is_selected = [k + part.first in selected for k in recording.indices.tolist()]
    recording = replace(recording, indices=recording.indices[is_selected])
    for item in recording.read_all():
        if isinstance(item, UnreadableFrameError):
            continue
        if not isinstance(item, RangeFrame):
            raise InputError(
                "contains clouds", where=recording.path, remedy="choose a format for clouds"
            )
        frame: Any = item
        for corrector in correctors:
            frame = corrector.apply(frame)
        yield frame


def _full_color(recording: Recording, frame: RangeFrame) -> UInt8 | None:
    """The colour of a frame at its recorded resolution; None if that is not above that of depth."""
    source = recording.source
    if frame.color_image is None or not isinstance(source, FileSource):
        return None
    try:
        color = source.full_resolution_color(frame.index)
    except InputError:
        return None
    return None if color is None or len(color) <= len(frame.color_image) else color


class _Renderer:
    """Renders the frames of one recording with a common white level."""

    def __init__(self) -> None:
        self._white: float | None = None

    def __call__(self, frame: RangeFrame) -> UInt8 | None:
        """(H, W, 3) RGB of a frame, black where unknown; None without colour and amplitude."""
        if frame.color_image is not None and frame.color_registered:
            return frame.color_image
        intensity = texture.albedo(frame)
        if intensity is None:
            return None
        lit = intensity > 0
        if self._white is None and lit.any():
            self._white = float(np.percentile(intensity[lit], _WHITE_PERCENTILE))
        level = (np.where(lit, intensity, 0) / (self._white or 1.0)).clip(0, 1)
        # Gamma 1/2.2: albedo is linear, screens are not. Known pixels are never black.
        grey = np.where(lit, np.maximum(1, np.round(255 * level ** (1 / 2.2))), 0)
        return np.repeat(grey.astype(np.uint8)[..., None], 3, axis=2)


def _write(folder: Path, name: str, image: NDArray[Any]) -> None:
    write_png(atomic.make_folder(folder) / name, image)


def _counts(metres: Float32, unit_m: float) -> UInt16:
    """16-bit counts; 0 where they exceed the range."""
    counts = np.rint(metres.astype(float) / unit_m)
    return np.where(counts < _MAX_COUNT, counts, 0).astype(np.uint16)


def subsampled_points(folder: Path) -> tuple[Float32, UInt8]:
    """Return evenly sampled points (N, 3) of a result's cloud, and their colours (N, 3)."""
    cloud = read_cloud(folder)
    step = max(1, -(-len(cloud) // _MAX_POINTS))
    points, color = cloud.points[::step].astype(np.float32), cloud.color
    color = np.full((len(points), 3), 128, np.uint8) if color is None else color[::step]
    return points, color
