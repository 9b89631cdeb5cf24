"""The texture of a finished model, from reread frames."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from threadpoolctl import threadpool_limits

from tofuse.engine.arrays import Bool
from tofuse.engine.compute import job_pool
from tofuse.engine.compute import threads as use_threads
from tofuse.engine.frames import Frame, RangeFrame, Recording, evenly_spaced
from tofuse.engine.fusion import display_surface, texture
from tofuse.engine.geometry import se3
from tofuse.engine.mapping.color_frames import full_image
from tofuse.engine.progress import Progress, Silent
from tofuse.engine.results import Reconstruction
from tofuse.engine.sensor import CameraErrors

# Maximum number of views and of textured triangles: more improve little. Images are reduced to at
# most so many pixels together.
_VIEWS, _FACES, _PIXELS = 60, 100_000, 60_000_000
_AHEAD = 4  # whole images that are in memory
# If none of so many frames that may have colour has it, the recording has none.
_PROBED = 4
# Unless a texture is required: minimum fraction of the surface that the images show, and of their
# pixels per vertex. With less, vertices hold as many colours, and their images show more of it.
_MIN_COVERAGE, _MIN_DETAIL = 0.5, 2.0
# Metres of motion that blur as much as one radian.
_METRES_PER_RADIAN = 1.0


def make_texture(
    recording: Recording,
    result: Reconstruction,
    size: int,
    threads: int | None = None,
    progress: Progress | None = None,
    *,
    required: bool = False,
) -> texture.Textured | None:
    """Make the texture of a model's surface; None without a size, a surface, or colour.

    Unless a texture is required, also None if the images show too little of the surface, or are
    too small, to look better than the colours of the vertices.

    Parameters
    ----------
    recording, result
        The recording and its reconstruction.
    size
        Edge of the texture, in texels.
    threads
        Number of threads; None: all cores. The result does not depend on it.
    progress
        Receives the stage.
    required
        Whether to make one of any images, and of amplitudes where there is no colour.
    """
    mesh = result.mesh
    if not size or mesh is None or not len(mesh.faces):
        return None
    colored = steadiest_frames(result, _colored(recording))
    if not required and not any(_has_color(recording, k) for k in evenly_spaced(colored, _PROBED)):
        return None
    all_frames = steadiest_frames(result) if len(colored) < _VIEWS else []
    frame_positions = sorted({*colored, *all_frames})
    most_pixels = _PIXELS // max(len(colored), 1)
    correctors = CameraErrors.made_with(result.config)
    progress = progress or Silent()
    progress.stage("painting", len(frame_positions))

    def prepared(frame: Frame) -> tuple[RangeFrame, texture.TextureView | None] | None:
        for corrector in correctors:
            frame = corrector.apply(frame)
        if not isinstance(frame, RangeFrame):
            return None
        if frame.color_image is None and not required:
            return frame, None
        return frame, texture.TextureView.of(frame, full_image(recording, frame, most_pixels))

    views: list[texture.TextureView] = []
    poses = []
    witnesses: list[display_surface.Witness] = []
    selected = replace(recording, indices=recording.indices[frame_positions])
    # The surface is reduced while images are read.
    with job_pool(1, "tofuse-texture") as background:
        reduced = background.submit(mesh.clustered, _FACES)
        poses_of_frames = result.trajectory[frame_positions]
        read_frames = selected.read_with(prepared, _AHEAD)
        for (_, read), T in zip(read_frames, poses_of_frames, strict=True):
            progress.advance()
            if read is None:
                continue
            frame, view = read
            if view is None:
                witnesses.append(display_surface.Witness.of(frame, T))
                continue
            witnesses.append(display_surface.Witness(view.z, frame.camera, T))
            views.append(view)
            poses.append(T)
    if not views:
        return None
    # BLAS results depend on its number of threads; those of our kernels don't.
    with use_threads(threads), threadpool_limits(1):
        shown, filled = display_surface.displayed(reduced.result(), witnesses)
        made = replace(texture.textured(shown, views, np.array(poses), size), filled=filled)
    worthwhile = made.coverage >= _MIN_COVERAGE and made.detail >= _MIN_DETAIL
    return made if worthwhile or required else None


def _colored(recording: Recording) -> Bool:
    """Return which frames (M,) may have colour: phones record it less often than depth."""
    origins = (recording.origin(k) for k in recording.indices.tolist())
    return np.array([getattr(s, "has_color", lambda _: True)(k) for s, k in origins], bool)


def _has_color(recording: Recording, k: int) -> bool:
    frame = recording.image(k)
    return frame is not None and frame.color_image is not None


def steadiest_frames(result: Reconstruction, usable: Bool | None = None) -> list[int]:
    """Return positions of tracked frames: the one with the least motion blur of each segment.

    The trajectory is divided into at most `_VIEWS` segments of equal numbers of frames, of those
    that are `usable` (M,), if there are any.
    """
    chosen = result.has_pose.copy()
    chosen &= [frame.status == "tracked" for frame in result.diagnostics.frames]
    if usable is not None and (chosen & usable).any():
        chosen &= usable
    posed = np.flatnonzero(chosen)
    if len(posed) <= _VIEWS:
        return [int(k) for k in posed]
    motion = se3.log(se3.inverse(result.trajectory[posed[:-1]]) @ result.trajectory[posed[1:]])
    step = np.linalg.norm(motion[:, :3], axis=1)
    step += _METRES_PER_RADIAN * np.linalg.norm(motion[:, 3:], axis=1)
    speed = np.maximum(np.r_[step[:1], step], np.r_[step, step[-1:]])
    return [
        int(part[np.argmin(speed[np.searchsorted(posed, part)])])
        for part in np.array_split(posed, _VIEWS)
    ]
