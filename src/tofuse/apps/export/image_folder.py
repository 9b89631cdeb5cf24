"""The images of a result with their poses, as input for other programs."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

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
    """One frame of a result with its pose.

    Attributes
    ----------
    index
        Frame index, as in `run.json`.
    frame
        z depth, with the camera as the result calibrated it; rectified if requested.
    camera
        Camera of the image: the same camera at the resolution of the image.
    image
        (H, W, 3) uint8 RGB: the colour, or the albedo as grey.
    sigma
        (H, W) standard deviation of the z depth in m, 0 where invalid.
    T_world_camera
        (4, 4).
    covariance
        (6, 6) of the pose (docs/conventions.md); None where not known.
    """

    index: int
    frame: RangeFrame
    camera: Pinhole
    image: UInt8
    sigma: Float32
    T_world_camera: Float64
    covariance: Float64 | None

    @property
    def name(self) -> str:
        """File name of the frame's images."""
        return f"frame_{self.index:06d}.png"


def posed_images(
    folder: Path, every: int, is_supported: Callable[[Camera], bool]
) -> Iterator[PosedImage]:
    """Yield the images of the main model of a result, in order.

    Frames that can't be read, or have neither colour nor amplitude, are left out. Colour that is
    registered to depth keeps its recorded resolution, which may be larger than that of depth.

    Parameters
    ----------
    folder
        The result.
    every
        Every n-th of the frames with a pose.
    is_supported
        Whether the target format supports a camera's lens model; others are rectified.

    Raises
    ------
    InputError
        If the recording is missing or has changed, contains clouds, or no image has colour or
        amplitude.
    """
    with run_json.opened(folder) as run:
        indices, poses = run_json.main_poses(folder, run)
        selected = dict(zip(indices[::every], poses[::every], strict=True))
        covariances = {
            f["index"]: run_json.frame_covariance(f)
            for f in run["frames"]
            if f["index"] in selected
        }
        parts = list(reopening.stored_recordings(folder, run))
        correctors = [CameraErrors.made_with(part.config) for part in parts]
    skipped: list[str] = []
    n_images = 0
    for part, frame_correctors in zip(parts, correctors, strict=True):
        recording = reopening.reopen(part, folder)
        renderer = _ImageRenderer(recording)
        camera: Camera | None = None
        rectifier: Rectifier | None = None
        for frame in _frames(part, recording, selected, frame_correctors):
            image = renderer.image(frame)
            if image is None:
                skipped.append(f"{recording.path}: frame {frame.index}")
                continue
            frame = replace(frame, sigma_image=renderer.noise.sigma(frame), color_image=image)
            if rectifier is None or frame.camera != camera:
                camera = frame.camera
                rectifier = Rectifier(_image_camera(camera, is_supported))
            rectified = rectifier(frame)
            image_camera = rectifier.pinhole
            if image_camera == camera and (full_color := _full_color(recording, frame)) is not None:
                image_camera = scaled(image_camera, full_color.shape[1], full_color.shape[0])
                image = full_color
            else:
                assert rectified.color_image is not None
                image = rectified.color_image
            index = part.first + frame.index
            assert rectified.sigma_image is not None
            yield PosedImage(
                index,
                rectified,
                image_camera,
                image,
                np.where(
                    rectified.valid,
                    rectified.sigma_image / ray_lengths(rectified.camera),
                    np.float32(0),
                ),
                selected[index],
                covariances.get(index),
            )
            n_images += 1
    if skipped and not n_images:
        raise InputError(
            "has neither colour nor amplitude",
            where=skipped[0],
            remedy="record one of them: the target programs need images",
        )


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


def _image_camera(camera: Camera, is_supported: Callable[[Camera], bool]) -> Pinhole:
    """The camera itself if it is supported, else an equivalent pinhole camera."""
    return camera if isinstance(camera, Pinhole) and is_supported(camera) else pinhole_of(camera)


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


class _ImageRenderer:
    """Renders the frames of one recording with a common white level, and has its noise model."""

    def __init__(self, recording: Recording) -> None:
        self.noise = noise_model_for(recording)
        self._white: float | None = None

    def image(self, frame: RangeFrame) -> UInt8 | None:
        """(H, W, 3) RGB of a frame, black where unknown; None without colour and amplitude."""
        if frame.color_image is not None and frame.color_registered:
            return frame.color_image
        view = texture.TextureView.of(replace(frame, color_image=None))
        if view is None:
            return None
        intensity = view.intensity[..., 0]
        lit = intensity > 0
        if self._white is None and lit.any():
            self._white = float(np.percentile(intensity[lit], _WHITE_PERCENTILE))
        level = (np.where(lit, intensity, 0) / (self._white or 1.0)).clip(0, 1)
        # Gamma 1/2.2: albedo is linear, screens are not. Known pixels are never black.
        grey = np.where(lit, np.maximum(1, np.round(255 * level ** (1 / 2.2))), 0)
        return np.repeat(grey.astype(np.uint8)[..., None], 3, axis=2)


class ImageFolder:
    """Writes images, depth, sigma and masks of posed images into a folder.

    Attributes
    ----------
    folder
        The folder.
    masked
        Whether any image so far has unknown pixels.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._unmasked: list[tuple[str, tuple[int, int]]] = []
        self.masked = False

    def write(self, posed: PosedImage) -> None:
        """Write the files of one frame."""
        self._png(IMAGES, posed.name, posed.image)
        self._png(DEPTH, posed.name, _counts(posed.frame.depth, DEPTH_UNIT_M))
        self._png(SIGMA, posed.name, _counts(posed.sigma, SIGMA_UNIT_M))
        valid = posed.image.any(-1)
        if valid.all():
            self._unmasked.append((posed.name, valid.shape))
        else:
            self.masked = True
            self._png(MASKS, posed.name, np.where(valid, 255, 0).astype(np.uint8))

    def write_all(
        self, result: Path, every: int, is_supported: Callable[[Camera], bool]
    ) -> Iterator[PosedImage]:
        """Yield the images of a result, see `posed_images`, after writing each.

        Raises
        ------
        InputError
            See `posed_images`; or if no image can be read.
        """
        posed = None
        for posed in posed_images(result, every, is_supported):
            self.write(posed)
            yield posed
        if posed is None:
            raise InputError("has no readable frame with a pose", where=result)
        # If any frame has a mask, all get one.
        for name, shape in self._unmasked if self.masked else ():
            self._png(MASKS, name, np.full(shape, 255, np.uint8))

    def _png(self, kind: str, name: str, image: NDArray[Any]) -> None:
        write_png(atomic.make_folder(self.folder / kind) / name, image)


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
