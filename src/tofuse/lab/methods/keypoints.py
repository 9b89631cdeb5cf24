"""Image keypoints: detection, descriptors and 3D positions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from tofuse.arrays import Bool, Float32, Float64, Int64, UInt8
from tofuse.errors import RegistrationError
from tofuse.recordings.frames import SATURATED_AMPLITUDE, RangeFrame
from tofuse.registration.prepared_view import PreparedView

Detector = Literal["sift", "orb", "fast"]
Channel = Literal["auto", "albedo", "color"]

# Min image width of the detectors, px: smaller images are enlarged.
_WIDE = 500
# Fractions of the darkest and of the brightest pixels that saturate.
_TAIL = 0.5
# Contrast threshold of SIFT; images are stretched to full contrast.
_CONTRAST = 0.01
# Threshold of FAST in grey levels.
_STEP = 5
# Diameter of a FAST corner's descriptor patch, in pixels of the enlarged image.
_PATCH = 9.0
# Relative depth difference within one surface.
_SAME = 0.05


@dataclass(frozen=True, eq=False)
class Keypoints:
    """n keypoints of an image.

    Attributes
    ----------
    points
        (n, 3) m, in the frame of the view.
    variance
        (n,) isotropic position variance, m^2.
    descriptors
        (n, d) float32, or binary as uint8.
    pixels
        (n, 2) u, v of the frame's image.
    """

    points: Float64
    variance: Float64
    descriptors: NDArray[Any]
    pixels: Float64

    def __len__(self) -> int:
        return len(self.points)


def channel_image(frame: RangeFrame, channel: Channel) -> UInt8:
    """(H, W) reflectance as grey levels; black where unknown.

    The albedo is the amplitude times the squared range (unless the camera compensates it), on a
    logarithmic scale, where exposure is an offset. Colour is converted to luminance.

    Raises RegistrationError if the frame lacks the requested channel.
    """
    has_color = frame.color_image is not None and frame.color_registered
    if frame.amplitude_image is not None and channel != "color":
        r = frame.radial_range
        known = (
            (r > 0) & (frame.amplitude_image > 0) & (frame.amplitude_image < SATURATED_AMPLITUDE)
        )
        albedo = np.where(known, frame.amplitude_image, np.float32(1))
        if frame.amplitude_kind != "range_compensated":
            albedo = albedo * np.where(known, r * r, np.float32(1))
        grey = np.log(albedo)
    elif has_color and channel != "albedo":
        assert frame.color_image is not None
        grey = cv2.cvtColor(np.ascontiguousarray(frame.color_image), cv2.COLOR_RGB2GRAY)
        grey = grey.astype(np.float32)
        known = np.ones(grey.shape, bool)
    else:
        what = {"albedo": "amplitude", "color": "colour"}.get(channel, "amplitude nor colour")
        raise RegistrationError(f"has no {what} to find points in", where=f"frame {frame.index}")
    if not known.any():
        raise RegistrationError("shows nothing but black", where=f"frame {frame.index}")
    low, high = np.percentile(grey[known], [_TAIL, 100 - _TAIL])
    levels = np.clip((grey - low) / max(float(high - low), 1e-6), 0, 1) * 255
    # Holes are filled from their surroundings, or their rims would be detected.
    image: UInt8 = np.where(known, levels, 0).astype(np.uint8)
    around = cv2.medianBlur(image, 5)
    return np.where(known, image, around).astype(np.uint8)


def keypoints(
    frame: RangeFrame,
    surface: PreparedView,
    *,
    detector: Detector,
    channel: Channel,
    count: int,
    blur_px: float,
) -> Keypoints:
    """Detect keypoints in an image and compute their 3D positions.

    Parameters
    ----------
    surface
        The prepared view of the frame, with noise and local planes.
    detector
        "sift" (Lowe 2004), "orb" (Rublee et al. 2011), or "fast": FAST corners (Rosten and
        Drummond 2006), upright and described as those of SIFT, all over patches of one size.
    channel
        "albedo", "color", or "auto": the albedo if available, else colour.
    count
        Number of strongest keypoints to keep.
    blur_px
        Standard deviation of the detected position, in pixels of the frame.
    """
    image = channel_image(frame, channel)
    enlarged = max(1, round(_WIDE / image.shape[1]))
    if enlarged > 1:
        size = image.shape[1] * enlarged, image.shape[0] * enlarged
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_CUBIC), np.uint8)
    found, descriptors = _detected(image, detector, count)
    if descriptors is None or not len(found):
        nothing = np.zeros((0, 3))
        return Keypoints(nothing, np.zeros(0), np.zeros((0, 32), np.uint8), nothing[:, :2])
    at = np.array([point.pt for point in found], np.float64)
    pixels = (at + 0.5) / enlarged - 0.5
    points, variance, known = _placed(surface, pixels, frame.camera.width, blur_px)
    return Keypoints(points[known], variance[known], descriptors[known], pixels[known])


def _detected(image: UInt8, detector: Detector, count: int) -> tuple[Any, NDArray[Any] | None]:
    """OpenCV's keypoints in a deterministic order, and descriptors."""
    if detector == "orb":
        orb = cv2.ORB.create(nfeatures=count, fastThreshold=_STEP)
        return orb.compute(image, _strongest(orb.detect(image, None), count))
    sift = cv2.SIFT.create(nfeatures=0, contrastThreshold=_CONTRAST)
    if detector == "sift":
        return sift.compute(image, _strongest(sift.detect(image, None), count))
    corners = cv2.FastFeatureDetector.create(_STEP).detect(cv2.GaussianBlur(image, (0, 0), 1.5))
    upright = [
        cv2.KeyPoint(c.pt[0], c.pt[1], _PATCH, 0.0, c.response) for c in _strongest(corners, count)
    ]
    return sift.compute(image, upright)


def _strongest(found: Any, count: int) -> list[Any]:
    return sorted(found, key=lambda p: (-p.response, p.pt, p.size, p.angle))[:count]


def _placed(
    surface: PreparedView, pixels: Float64, width: int, blur_px: float
) -> tuple[Float64, Float64, Bool]:
    """Points (n, 3) of pixels (n, 2) of an image `width` wide, variances (n,), validity (n,).

    At an edge the nearer surface is used, as the edge belongs to it.
    """
    rows, columns = surface.z.shape
    step = max(1, width // columns)
    at = (pixels + 0.5) / step - 0.5
    u = np.clip(np.rint(at[:, 0]).astype(int), 0, columns - 1)
    v = np.clip(np.rint(at[:, 1]).astype(int), 0, rows - 1)
    near = _nearest_known(surface.z)[v, u]
    near_v, near_u = near // columns, near % columns
    z = surface.z[near_v, near_u].astype(float)
    sigma = surface.sigma[near_v, near_u].astype(float)
    # A plane's depth is more precise than a single pixel's.
    w = surface.planes[near_v, near_u, 3].astype(float)
    plane = w > 0
    z = np.where(plane, 1 / np.where(plane, w, 1), z)
    own = surface.plane_variance[near_v, near_u].astype(float) * z**4
    depth_variance = np.where(plane, own, sigma**2)
    spacing = float(np.abs(np.diff(surface.rays[rows // 2, :, 0])).mean())
    rays = surface.rays[v, u] + (at - np.stack([u, v], 1)) * spacing
    points = np.column_stack([rays * z[:, None], z])
    across = (blur_px / step * spacing * z) ** 2
    normals = surface.normals[near_v, near_u].astype(float)
    # Lateral errors become range errors on slanted surfaces.
    steep = np.abs(normals[:, 2])
    slope = np.where(plane & (steep > 0.2), 1 / np.maximum(steep, 0.2) ** 2 - 1, 0)
    variance = (depth_variance + across * (2 + slope)) / 3
    known = (z > 0) & np.isfinite(points).all(1) & np.isfinite(variance) & (variance > 0)
    return points, variance, known


def _nearest_known(z: Float32) -> Int64:
    """(H, W) index of the pixel in each 3 x 3 window that is on the nearest surface.

    Of several, the one closest to the centre.
    """
    rows, columns = z.shape
    padded = np.pad(np.where(z > 0, z, np.float32(np.inf)), 1, constant_values=np.inf)
    steps = sorted(
        ((dv, du) for dv in (-1, 0, 1) for du in (-1, 0, 1)), key=lambda s: s[0] ** 2 + s[1] ** 2
    )
    around = np.stack(
        [padded[1 + dv : 1 + dv + rows, 1 + du : 1 + du + columns] for dv, du in steps]
    )
    least = around.min(0)
    on = around <= least * np.float32(1 + _SAME)
    first = np.argmax(on, axis=0)
    v, u = np.mgrid[:rows, :columns]
    moves = np.array(steps)
    row = np.clip(v + moves[first, 0], 0, rows - 1)
    column = np.clip(u + moves[first, 1], 0, columns - 1)
    return np.asarray(row * columns + column, np.int64)
