"""The frames of a result with their poses: corrected, rectified and rendered."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from tofuse.apps.results import reopening, run_json
from tofuse.engine.arrays import Float64, UInt8
from tofuse.engine.cameras import Camera, Pinhole, scaled
from tofuse.engine.errors import InputError, UnreadableFrameError
from tofuse.engine.frames import CloudFrame, RangeFrame, Recording
from tofuse.engine.fusion import albedo
from tofuse.engine.noise import noise_model_for
from tofuse.engine.sensor import CameraErrors, Corrector
from tofuse.formats.cameras import Rectifier, pinhole_of

_WHITE_PERCENTILE = 99.0  # of the first frame's amplitude


@dataclass(frozen=True, eq=False)
class PosedFrame:
    """One frame of a result with its pose.

    Attributes
    ----------
    index
        Of the frame in `run.json`.
    where
        Its recording and its number there, for errors.
    frame
        With z depth and sigma; its camera as the result calibrated it, rectified if requested; at
        the time in `run.json`, which in a merged result is not that of its recording.
    image
        (H, W, 3) RGB, black where unknown; None without colour and amplitude. Colour that is
        registered to depth has its recorded resolution, which may be larger than that of depth.
    image_camera
        Camera of the image.
    T_world_camera
        (4, 4).
    covariance
        (6, 6) of the pose (docs/conventions.md); None where not known.
    """

    index: int
    where: str
    frame: RangeFrame
    image: UInt8 | None
    image_camera: Pinhole
    T_world_camera: Float64
    covariance: Float64 | None

    @property
    def camera(self) -> Pinhole:
        """Camera of the depth image."""
        return cast(Pinhole, self.frame.camera)


def posed_frames(
    result: Path, every: int, is_supported: Callable[[Camera], bool], *, clouds: bool = False
) -> Iterator[PosedFrame]:
    """Yield the readable frames of the main model of a result, in order.

    Parameters
    ----------
    result
        The result.
    every
        Every n-th of the frames with a pose.
    is_supported
        Whether the target format supports a camera's lens model; others are rectified.
    clouds
        Whether clouds, which are no images, are left out instead of an error.

    Raises
    ------
    InputError
        If the recording is missing or has changed, or contains clouds.
    """
    with run_json.opened(result) as run:
        indices, poses = run_json.main_poses(result, run)
        selected = dict(zip(indices[::every], poses[::every], strict=True))
        covariances = {f["index"]: run_json.frame_covariance(f) for f in run["frames"]}
        times = {f["index"]: float(f["timestamp"]) for f in run["frames"]}
        parts = list(reopening.stored_recordings(result, run))
        correctors = [CameraErrors.made_with(part.config) for part in parts]
    for part, frame_correctors in zip(parts, correctors, strict=True):
        recording = reopening.reopen(part, result)
        noise, render = noise_model_for(recording), _Renderer()
        camera: Camera | None = None
        rectifier: Rectifier | None = None
        for frame in _frames(part, recording, selected, frame_correctors, clouds):
            image = render(frame)
            frame = replace(frame, sigma_image=noise.sigma(frame), color_image=image)
            if rectifier is None or frame.camera != camera:
                camera = frame.camera
                is_kept = is_supported(camera) and isinstance(camera, Pinhole)
                rectifier = Rectifier(cast(Pinhole, camera) if is_kept else pinhole_of(camera))
            rectified, image_camera = rectifier(frame), rectifier.pinhole
            full_color = recording.full_color(frame) if image_camera == camera else None
            if full_color is not None:
                image_camera = scaled(image_camera, full_color.shape[1], full_color.shape[0])
            index = part.first + frame.index
            yield PosedFrame(
                index,
                f"{recording.path}: frame {frame.index}",
                replace(rectified, timestamp=times[index]),
                rectified.color_image if full_color is None else full_color,
                image_camera,
                selected[index],
                covariances.get(index),
            )


def _frames(
    part: reopening.StoredRecording,
    recording: Recording,
    selected: dict[int, Float64],
    correctors: Sequence[Corrector],
    clouds: bool,
) -> Iterator[RangeFrame]:
    """The chosen readable frames of a recording, with the camera as it was calibrated."""
    is_selected = [k + part.first in selected for k in recording.indices.tolist()]
    recording = replace(recording, indices=recording.indices[is_selected])
    for item in recording.read_all():
        if isinstance(item, UnreadableFrameError) or (clouds and isinstance(item, CloudFrame)):
            continue
        if not isinstance(item, RangeFrame):
            raise InputError(
                "contains clouds", where=recording.path, remedy="choose a format for clouds"
            )
        frame: Any = item
        for corrector in correctors:
            frame = corrector.apply(frame)
        yield frame


class _Renderer:
    """Renders the frames of one recording with a common white level."""

    def __init__(self) -> None:
        self._white: float | None = None

    def __call__(self, frame: RangeFrame) -> UInt8 | None:
        """(H, W, 3) RGB of a frame, black where unknown; None without colour and amplitude."""
        if frame.color_image is not None and frame.color_registered:
            return frame.color_image
        intensity = albedo(frame)
        if intensity is None:
            return None
        lit = intensity > 0
        if self._white is None and lit.any():
            self._white = float(np.percentile(intensity[lit], _WHITE_PERCENTILE))
        level = (np.where(lit, intensity, 0) / (self._white or 1.0)).clip(0, 1)
        # Gamma 1/2.2: albedo is linear, screens are not. Known pixels are never black.
        grey = np.where(lit, np.maximum(1, np.round(255 * level ** (1 / 2.2))), 0)
        return np.repeat(grey.astype(np.uint8)[..., None], 3, axis=2)
