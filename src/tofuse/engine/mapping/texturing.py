"""The texture of a finished model, from reread frames."""

from __future__ import annotations

import numpy as np
from threadpoolctl import threadpool_limits

from tofuse.engine.compute import threads as use_threads
from tofuse.engine.errors import UnreadableFrameError
from tofuse.engine.frames import RangeFrame, Recording
from tofuse.engine.fusion import texture
from tofuse.engine.geometry import se3
from tofuse.engine.progress import Progress, Silent
from tofuse.engine.results import Reconstruction
from tofuse.engine.sensor import CameraErrors

# Maximum number of views and of textured triangles: more improve little, and unwrap slowly.
_VIEWS, _FACES = 60, 60_000
# Metres of motion that blur as much as one radian.
_METRES_PER_RADIAN = 1.0
TEXTURE = 2048  # default size in texels


def make_texture(
    recording: Recording,
    result: Reconstruction,
    size: int,
    threads: int | None = None,
    progress: Progress | None = None,
) -> texture.Textured | None:
    """Make the texture of a model's surface; None without a surface, colour and amplitude.

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
    """
    mesh = result.mesh
    if mesh is None or not len(mesh.faces):
        return None
    frame_positions = steadiest_frames(result)
    correctors = CameraErrors.made_with(result.config)
    progress = progress or Silent()
    progress.stage("painting", len(frame_positions))
    views: list[texture.TextureView] = []
    poses = []
    for k in frame_positions:
        progress.advance()
        try:
            frame = recording[int(k)]
        except UnreadableFrameError:
            continue
        for corrector in correctors:
            frame = corrector.apply(frame)
        if not isinstance(frame, RangeFrame):
            continue
        view = texture.TextureView.of(frame, _full_image(recording, frame))
        if view is not None:
            views.append(view)
            poses.append(result.trajectory[k])
    if not views:
        return None
    # BLAS results depend on its number of threads; those of our kernels don't.
    with use_threads(threads), threadpool_limits(1):
        return texture.textured(mesh.decimated(_FACES), views, np.array(poses), size)


def steadiest_frames(result: Reconstruction) -> list[int]:
    """Return positions of tracked frames: the one with the least motion blur of each segment.

    The trajectory is divided into at most `_VIEWS` segments of equal numbers of frames.
    """
    tracked = [k for k, f in enumerate(result.diagnostics.frames) if f.status == "tracked"]
    posed = np.array([k for k in tracked if result.has_pose[k]], np.intp)
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
