"""Small pictures as data URIs: depth, amplitude and colour images, and splatted clouds."""

from __future__ import annotations

import base64
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from tofuse.apps.results import viridis
from tofuse.engine.arrays import Bool, Float32, Float64, UInt8
from tofuse.engine.frames import SATURATED_AMPLITUDE, Frame, RangeFrame
from tofuse.engine.geometry import se3

# A grey that differs from both ends of the colour map.
NO_MEASUREMENT = (128, 128, 132)
REMOVED = (225, 40, 135)  # removed by the filter shown; not in the colour map
BACKGROUND = (29, 33, 40)  # that of the stage of the 3D view, #1d2128
_SPLATS = 60_000  # points of a cloud that are drawn, at least
_MIN_DEPTH = 0.02  # of the eye's distance; nearer points are not drawn


def css(color: Sequence[int]) -> str:
    """Return an RGB colour as in a style sheet."""
    return f"rgb{tuple(color)}"


def encode(image: UInt8, *, jpeg: bool = False) -> bytes:
    """Encode an (H, W, 3) RGB or (H, W, 4) RGBA image as PNG (or JPEG, for photographs)."""
    import cv2

    code = cv2.COLOR_RGBA2BGRA if image.shape[2] == 4 else cv2.COLOR_RGB2BGR
    flipped = cv2.cvtColor(np.ascontiguousarray(image), code)
    if jpeg:
        _, data = cv2.imencode(".jpg", flipped, [cv2.IMWRITE_JPEG_QUALITY, 82])
    else:
        _, data = cv2.imencode(".png", flipped, [cv2.IMWRITE_PNG_COMPRESSION, 7])
    return bytes(data.tobytes())


def data_uri(image: UInt8, *, jpeg: bool = False) -> str:
    """Encode an image as `encode` does, for a page."""
    kind = "jpeg" if jpeg else "png"
    return f"data:image/{kind};base64,{base64.b64encode(encode(image, jpeg=jpeg)).decode()}"


def subsample(image: UInt8, width: int) -> UInt8:
    """Take every n-th pixel until the image is at most `width` wide.

    Averaging would invent depths between an edge and what is behind it.
    """
    step = -(-image.shape[1] // width)
    return np.ascontiguousarray(image[::step, ::step])


def depth_limits(frame: Frame) -> tuple[float, float]:
    """Return the depths in m at the ends of the colour map: the 2nd and 98th percentile."""
    if isinstance(frame, RangeFrame):
        values = frame.z[frame.valid].astype(float)
    else:
        values = np.linalg.norm(frame.points - frame.origin, axis=1)
    return percentile_range(values, min_width=1e-3)


def percentile_range(values: NDArray[np.floating], min_width: float = 0.0) -> tuple[float, float]:
    """Return values that bound the middle 96 % of the finite ones, (K,); 0 and 1 if there are none.

    Parameters
    ----------
    values
        The values.
    min_width
        Minimum difference between the bounds.
    """
    values = values[np.isfinite(values)]
    if not len(values):
        return 0.0, 1.0
    low, high = np.percentile(values.astype(float), [2, 98])
    return float(low), float(max(high, low + min_width))


def depth_image(
    frame: RangeFrame,
    limits: tuple[float, float] | None = None,
    removed: Bool | None = None,
    width: int | None = None,
) -> UInt8:
    """Return the z depth in colours (H, W, 3); pixels without a measurement are grey.

    Parameters
    ----------
    frame
        The frame.
    limits
        Depths at the ends of the colour map, m; by default those of `depth_limits`.
    removed
        (H, W) pixels to be marked.
    width
        Maximum width; wider images are subsampled.
    """
    step = 1 if width is None else -(-frame.z.shape[1] // width)
    image = depth_colors(
        frame.z[::step, ::step], frame.valid[::step, ::step], limits or depth_limits(frame)
    )
    if removed is not None:
        image[removed[::step, ::step]] = REMOVED
    return image


def depth_colors(z: NDArray[np.floating], valid: Bool, limits: tuple[float, float]) -> UInt8:
    """Return the colours (H, W, 3) of depths (H, W) in m, grey where they are not valid."""
    low, high = limits
    image = viridis((z.astype(float) - low) / (high - low))
    image[~valid] = NO_MEASUREMENT
    return image


def grey(amplitude: Float32) -> UInt8:
    """Stretch amplitude (H, W) to grey (H, W, 3), with the gamma of a screen."""
    valid = (amplitude > 0) & (amplitude < SATURATED_AMPLITUDE)
    low, high = np.percentile(amplitude[valid], [1, 99]) if valid.any() else (0.0, 1.0)
    level = ((amplitude - low) / max(high - low, 1e-9)).clip(0, 1) ** (1 / 2.2)
    return np.repeat(np.round(255 * level).astype(np.uint8)[..., None], 3, axis=2)


def splat(
    points: Float64,
    colors: UInt8,
    T_view_world: Float64,
    size: tuple[int, int],
    *,
    scale: float,
    distance: float | None = None,
    radius: int = 1,
) -> UInt8:
    """Render points as squares, with occlusion.

    Parameters
    ----------
    points, colors
        (N, 3) m, and (N, 3) RGB.
    T_view_world
        (4, 4) into a view whose axes are x right, y down, z into the picture.
    size
        Width and height in pixels.
    scale
        Pixels per metre (at the centre, where there is a perspective).
    distance
        Of the eye from the view's origin in m; None for a parallel projection.
    radius
        Pixels along the side of a square, whose upper left one contains the point.

    Returns
    -------
    (H, W, 4) RGBA, transparent where there is no point. Of equally near points the last is seen.
    """
    width, height = size
    pixels, z = project(points, T_view_world, size, scale=scale, distance=distance)
    u, v = np.rint(pixels).T
    rows = np.flatnonzero((u >= 0) & (v >= 0) & (u < width) & (v < height) & (z > -np.inf))
    rows = rows[np.argsort(-z[rows], kind="stable")]
    # Squares may reach beyond the image, to the right and below.
    order = np.full((height + radius, width + radius), -1)
    down, right = np.divmod(np.arange(radius**2), radius)
    squares = v[rows, None].astype(int) + down, u[rows, None].astype(int) + right
    np.maximum.at(order, squares, np.arange(len(rows))[:, None])
    order = order[:height, :width]
    image = np.zeros((height, width, 4), np.uint8)
    image[order >= 0, :3] = colors[rows[order[order >= 0]]]
    image[order >= 0, 3] = 255
    return image


def project(
    points: Float64,
    T_view_world: Float64,
    size: tuple[int, int],
    *,
    scale: float,
    distance: float | None,
) -> tuple[Float64, Float64]:
    """Return pixels (N, 2) of points (N, 3) and their depths (N,), which are -inf behind the eye.

    Parameters as for `splat`.
    """
    x, y, z = se3.transform(T_view_world, points).T
    if distance is not None:
        z = z + distance
        nearest = _MIN_DEPTH * distance
        scale = scale * distance / np.maximum(z, nearest)
        z = np.where(z > nearest, z, -np.inf)
    return np.stack([0.5 * size[0] + scale * x, 0.5 * size[1] + scale * y], 1), z


def view_rotation(yaw: float, pitch: float) -> Float64:
    """Return the rotation (3, 3) into a view rotated by `yaw` and tilted down by `pitch` (rad)."""
    cy, sy, cp, sp = np.cos(yaw), np.sin(yaw), np.cos(pitch), np.sin(pitch)
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_x = np.array([[1, 0, 0], [0, cp, -sp], [0, sp, cp]])
    return about_x @ about_y


def framing(
    points: Float64, size: tuple[int, int], *, yaw: float = 0.7, pitch: float = 0.45
) -> tuple[Float64, float]:
    """Return a parallel projection that shows all but the outermost points.

    Parameters
    ----------
    points
        (N, 3) m.
    size
        Width and height of the picture in pixels.
    yaw, pitch
        Direction of the view, from above and to the side, rad.

    Returns
    -------
    T_view_world (4, 4), and pixels per metre.
    """
    T = se3.pose(view_rotation(yaw, pitch))
    if len(points) == 0:
        return T, 1.0
    low, high = np.percentile(points @ T[:3, :3].T, [0.2, 99.8], axis=0)
    T[:3, 3] = -(low + high) / 2
    extent = np.maximum(high - low, 1e-6)
    return T, float(0.9 * min(size[0] / extent[0], size[1] / extent[1]))


def cloud_image(
    frame: Frame,
    limits: tuple[float, float],
    size: tuple[int, int],
    view: tuple[Float64, float] | None = None,
) -> UInt8:
    """Render a view's points in the colours of `depth_image`, (H, W, 4) RGBA.

    `view` is the `framing`; None: its own.
    """
    points = frame.points[:: max(1, len(frame) // _SPLATS)].astype(float)
    is_range = isinstance(frame, RangeFrame)
    depth = points[:, 2] if is_range else np.linalg.norm(points - frame.origin, axis=1)
    low, high = limits
    T, scale = view or framing(points, size)
    return splat(points, viridis((depth - low) / (high - low)), T, size, scale=scale, radius=2)
