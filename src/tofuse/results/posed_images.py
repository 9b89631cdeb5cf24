"""The images of a result with their poses, for programs that start from both."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tofuse.arrays import Float32, Float64, UInt8, UInt16
from tofuse.corrections.camera_errors import CameraErrors
from tofuse.errors import InputError, UnreadableFrameError
from tofuse.files.atomic import make_folder
from tofuse.files.images import write_png
from tofuse.files.ply import read_ply
from tofuse.fusion.texture import LitView
from tofuse.geometry.cameras import Camera, Pinhole, ray_lengths, scaled
from tofuse.recordings.frames import RangeFrame
from tofuse.recordings.noise import noise_model_for
from tofuse.recordings.recording import Recording
from tofuse.recordings.rectify import Rectifier, pinhole_of
from tofuse.recordings.sources import FileSource
from tofuse.results.output import main_poses, read_run_json
from tofuse.results.reopening import RecordedPart, recorded_parts, reopened

DEPTH_UNIT_M, SIGMA_UNIT_M = 1e-3, 1e-4  # of a count
IMAGES, DEPTH, SIGMA, MASKS = "images", "depth", "sigma", "masks"
_MOST = 65535
_BRIGHT = 99.0  # percentile of the first frame's light that is shown as white
_MOST_POINTS = 200_000


@dataclass(frozen=True, eq=False)
class PosedImage:
    """What one frame of a result gives.

    Attributes
    ----------
    index
        Of the frame, as `run.json` counts.
    frame
        z depth, with the camera that the result believes in; rectified where asked for.
    camera
        Of the image: the same, at the resolution of the image.
    image
        (H, W, 3) uint8 RGB: the colour, or what a surface reflects as grey.
    sigma
        (H, W) standard deviation of the z depth in m, 0 where invalid.
    T_world_camera
        (4, 4).
    covariance
        (6, 6) of the pose, see docs/conventions.md; None where not known.
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
        """File name of its images."""
        return f"frame_{self.index:06d}.png"


def posed_images(folder: Path, every: int, suits: Callable[[Camera], bool]) -> Iterator[PosedImage]:
    """Give every so-many-th image of the main model of a result, in order.

    Images of a camera that does not suit are rectified. What can't be read, or has neither colour
    nor amplitude, is left out. Colour is as large as it was recorded, where it shows what depth
    shows, and so larger than depth.

    Raises
    ------
    InputError
        If the recording is gone, or another one by now; if it holds clouds, or if no image has
        colour or amplitude.
    """
    run = read_run_json(folder / "run.json")
    indices, poses = main_poses(folder, run)
    chosen = dict(zip(indices[::every], poses[::every], strict=True))
    try:
        covariances = {f["index"]: f["covariance"] for f in run["frames"]}
        parts = list(recorded_parts(folder, run))
    except (KeyError, TypeError, ValueError, AttributeError, IndexError) as error:
        raise InputError(
            "is damaged, or no run.json of tofuse", where=folder / "run.json", remedy="run again"
        ) from error
    dark: list[str] = []
    given = 0
    for part in parts:
        recording = reopened(part, folder)
        lighting = _Lighting(recording)
        camera: Camera | None = None
        rectifier: Rectifier | None = None
        for frame in _frames(part, recording, chosen):
            image = lighting.image(frame)
            if image is None:
                dark.append(f"{recording.path}: frame {frame.index}")
                continue
            frame = replace(frame, sigma_image=lighting.noise.sigma(frame), color_image=image)
            if rectifier is None or frame.camera != camera:
                camera = frame.camera
                rectifier = Rectifier(_shown_by(camera, suits))
            seen = rectifier(frame)
            image_camera = rectifier.pinhole
            if image_camera == camera and (whole := _whole_color(recording, frame)) is not None:
                image_camera = scaled(image_camera, whole.shape[1], whole.shape[0])
                image = whole
            else:
                assert seen.color_image is not None
                image = seen.color_image
            index = part.first + frame.index
            C = covariances.get(index)
            assert seen.sigma_image is not None
            yield PosedImage(
                index,
                seen,
                image_camera,
                image,
                np.where(seen.valid, seen.sigma_image / ray_lengths(seen.camera), np.float32(0)),
                chosen[index],
                None if C is None else np.array(C, float).reshape(6, 6),
            )
            given += 1
    if dark and not given:
        raise InputError(
            "has neither colour nor amplitude",
            where=dark[0],
            remedy="record one of them: these programs start from images",
        )


def _frames(
    part: RecordedPart, recording: Recording, chosen: dict[int, Float64]
) -> Iterator[RangeFrame]:
    """The chosen frames of a recording that can be read, with the camera as it was found to be."""
    wanted = [k + part.first in chosen for k in recording.indices.tolist()]
    correctors = CameraErrors.made_with(part.config)
    recording = replace(recording, indices=recording.indices[wanted])
    for item in recording.read_all():
        if isinstance(item, UnreadableFrameError):
            continue
        if not isinstance(item, RangeFrame):
            raise InputError(
                "holds clouds", where=recording.path, remedy="choose a format for clouds"
            )
        frame: Any = item
        for corrector in correctors:
            frame = corrector.apply(frame)
        yield frame


def _shown_by(camera: Camera, suits: Callable[[Camera], bool]) -> Pinhole:
    """The camera itself, or the pinhole camera in its place."""
    return camera if isinstance(camera, Pinhole) and suits(camera) else pinhole_of(camera)


def _whole_color(recording: Recording, frame: RangeFrame) -> UInt8 | None:
    """The colour of a frame as large as it was recorded; None where it is no larger than depth."""
    source = recording.source
    if frame.color_image is None or not isinstance(source, FileSource):
        return None
    try:
        whole = source.whole_color(frame.index)
    except InputError:
        return None
    return None if whole is None or len(whole) <= len(frame.color_image) else whole


class _Lighting:
    """How frames of one recording are shown, as bright in all of them, and their noise."""

    def __init__(self, recording: Recording) -> None:
        self.noise = noise_model_for(recording)
        self._white: float | None = None

    def image(self, frame: RangeFrame) -> UInt8 | None:
        """(H, W, 3) RGB of a frame, black where nothing is known; None where all is dark."""
        if frame.color_image is not None and frame.color_registered:
            return frame.color_image
        view = LitView.of(replace(frame, color_image=None))
        if view is None:
            return None
        light = view.light[..., 0]
        lit = light > 0
        if self._white is None and lit.any():
            self._white = float(np.percentile(light[lit], _BRIGHT))
        share = (np.where(lit, light, 0) / (self._white or 1.0)).clip(0, 1)
        # Gamma 1/2.2: albedo is linear, screens are not; what is known is not black.
        grey = np.where(lit, np.maximum(1, np.round(255 * share ** (1 / 2.2))), 0)
        return np.repeat(grey.astype(np.uint8)[..., None], 3, axis=2)


class ImageFolder:
    """Writes images, depth, sigma and masks, each under the name of its frame."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._whole: list[tuple[str, tuple[int, int]]] = []
        self.masked = False

    def write(self, posed: PosedImage) -> None:
        """Write what belongs to one frame."""
        self._png(IMAGES, posed.name, posed.image)
        self._png(DEPTH, posed.name, _counts(posed.frame.depth, DEPTH_UNIT_M))
        self._png(SIGMA, posed.name, _counts(posed.sigma, SIGMA_UNIT_M))
        known = posed.image.any(-1)
        if known.all():
            self._whole.append((posed.name, known.shape))
        else:
            self.masked = True
            self._png(MASKS, posed.name, np.where(known, 255, 0).astype(np.uint8))

    def finish(self) -> None:
        """Give the others masks as well, if any frame needs one."""
        for name, shape in self._whole if self.masked else ():
            self._png(MASKS, name, np.full(shape, 255, np.uint8))

    def _png(self, kind: str, name: str, image: NDArray[Any]) -> None:
        write_png(make_folder(self.folder / kind) / name, image)


def _counts(metres: Float32, unit_m: float) -> UInt16:
    """16-bit counts; 0 where they don't fit."""
    counts = np.rint(metres.astype(float) / unit_m)
    return np.where(counts < _MOST, counts, 0).astype(np.uint16)


def some_points(folder: Path) -> tuple[Float32, UInt8]:
    """Return points (N, 3) of the cloud of a result, evenly chosen, and their colours (N, 3)."""
    ply = read_ply(folder / "cloud.ply")
    step = max(1, -(-len(ply) // _MOST_POINTS))
    points = ply.points[::step].astype(np.float32)
    color = np.full((len(points), 3), 128, np.uint8) if ply.color is None else ply.color[::step]
    return points, color
