"""Image keypoints: detection, descriptors and 3D positions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from tofuse.engine.arrays import Bool, Float32, Float64, Int64, UInt8
from tofuse.engine.errors import RegistrationError
from tofuse.engine.frames import SATURATED_AMPLITUDE, RangeFrame
from tofuse.engine.views import PreparedView

Detector = Literal["sift", "orb", "fast"]
Channel = Literal["auto", "albedo", "color"]

# Min image width of the detectors, px: smaller images are enlarged.
_MIN_WIDTH = 500
# Percentage of the darkest, and of the brightest, pixels that are clipped.
_CLIPPED_PERCENT = 0.5
# Contrast threshold of SIFT; images are stretched to full contrast.
_CONTRAST_THRESHOLD = 0.01
# Threshold of FAST in grey levels.
_FAST_THRESHOLD = 5
# Diameter of a FAST corner's descriptor patch, in pixels of the enlarged image.
_PATCH_DIAMETER = 9.0
# Max relative depth difference within one surface.
_SURFACE_TOLERANCE = 0.05


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
        valid = (
            (r > 0) & (frame.amplitude_image > 0) & (frame.amplitude_image < SATURATED_AMPLITUDE)
        )
        albedo = np.where(valid, frame.amplitude_image, np.float32(1))
        if frame.amplitude_kind != "range_compensated":
            albedo = albedo * np.where(valid, r * r, np.float32(1))
        grey = np.log(albedo)
    elif has_color and channel != "albedo":
        assert frame.color_image is not None
        grey = cv2.cvtColor(np.ascontiguousarray(frame.color_image), cv2.COLOR_RGB2GRAY)
        grey = grey.astype(np.float32)
        valid = np.ones(grey.shape, bool)
    else:
        missing = {"albedo": "amplitude", "color": "colour"}.get(channel, "amplitude nor colour")
        raise RegistrationError(f"has no {missing} to find points in", where=f"frame {frame.index}")
    if not valid.any():
        raise RegistrationError("shows nothing but black", where=f"frame {frame.index}")
    low, high = np.percentile(grey[valid], [_CLIPPED_PERCENT, 100 - _CLIPPED_PERCENT])
    levels = np.clip((grey - low) / max(float(high - low), 1e-6), 0, 1) * 255
    # Holes are filled from their surroundings, or their rims would be detected.
    image: UInt8 = np.where(valid, levels, 0).astype(np.uint8)
    return np.where(valid, image, cv2.medianBlur(image, 5)).astype(np.uint8)


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
    magnification = max(1, round(_MIN_WIDTH / image.shape[1]))
    if magnification > 1:
        size = image.shape[1] * magnification, image.shape[0] * magnification
        image = np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_CUBIC), np.uint8)
    detections, descriptors = _detect(image, detector, count)
    if descriptors is None or not len(detections):
        empty = np.zeros((0, 3))
        return Keypoints(empty, np.zeros(0), np.zeros((0, 32), np.uint8), empty[:, :2])
    positions = np.array([point.pt for point in detections], np.float64)
    pixels = (positions + 0.5) / magnification - 0.5
    points, variance, valid = _back_project(surface, pixels, frame.camera.width, blur_px)
    return Keypoints(points[valid], variance[valid], descriptors[valid], pixels[valid])


def _detect(image: UInt8, detector: Detector, count: int) -> tuple[Any, NDArray[Any] | None]:
    """OpenCV's keypoints in a deterministic order, and descriptors."""
    if detector == "orb":
        orb = cv2.ORB.create(nfeatures=count, fastThreshold=_FAST_THRESHOLD)
        return orb.compute(image, _strongest(orb.detect(image, None), count))
    sift = cv2.SIFT.create(nfeatures=0, contrastThreshold=_CONTRAST_THRESHOLD)
    if detector == "sift":
        return sift.compute(image, _strongest(sift.detect(image, None), count))
    corners = cv2.FastFeatureDetector.create(_FAST_THRESHOLD).detect(
        cv2.GaussianBlur(image, (0, 0), 1.5)
    )
    upright = [
        cv2.KeyPoint(c.pt[0], c.pt[1], _PATCH_DIAMETER, 0.0, c.response)
        for c in _strongest(corners, count)
    ]
    return sift.compute(image, upright)


def _strongest(detections: Any, count: int) -> list[Any]:
    return sorted(detections, key=lambda p: (-p.response, p.pt, p.size, p.angle))[:count]


def _back_project(
    surface: PreparedView, pixels: Float64, width: int, blur_px: float
) -> tuple[Float64, Float64, Bool]:
    """Points (n, 3) of pixels (n, 2) of an image of `width` pixels, variances (n,), validity (n,).

    At an edge the nearer surface is used, as the edge belongs to it.
    """
    rows, columns = surface.z.shape
    step = max(1, width // columns)
    positions = (pixels + 0.5) / step - 0.5
    u = np.clip(np.rint(positions[:, 0]).astype(int), 0, columns - 1)
    v = np.clip(np.rint(positions[:, 1]).astype(int), 0, rows - 1)
    nearest = _nearest_known(surface.z)[v, u]
    nearest_v, nearest_u = nearest // columns, nearest % columns
    z = surface.z[nearest_v, nearest_u].astype(float)
    sigma = surface.sigma[nearest_v, nearest_u].astype(float)
    # A plane's depth is more precise than a single pixel's.
    w = surface.planes[nearest_v, nearest_u, 3].astype(float)
    has_plane = w > 0
    z = np.where(has_plane, 1 / np.where(has_plane, w, 1), z)
    plane_depth_variance = surface.plane_variance[nearest_v, nearest_u].astype(float) * z**4
    depth_variance = np.where(has_plane, plane_depth_variance, sigma**2)
    spacing = float(np.abs(np.diff(surface.rays[rows // 2, :, 0])).mean())
    rays = surface.rays[v, u] + (positions - np.stack([u, v], 1)) * spacing
    points = np.column_stack([rays * z[:, None], z])
    lateral_variance = (blur_px / step * spacing * z) ** 2
    normals = surface.normals[nearest_v, nearest_u].astype(float)
    # Lateral errors become range errors on slanted surfaces.
    cosine = np.abs(normals[:, 2])
    tan2 = np.where(has_plane & (cosine > 0.2), 1 / np.maximum(cosine, 0.2) ** 2 - 1, 0)
    variance = (depth_variance + lateral_variance * (2 + tan2)) / 3
    valid = (z > 0) & np.isfinite(points).all(1) & np.isfinite(variance) & (variance > 0)
    return points, variance, valid


def _nearest_known(z: Float32) -> Int64:
    """(H, W) index of the pixel in each 3 x 3 window that is on the nearest surface.

    Of several, the one closest to the centre.
    """
    rows, columns = z.shape
    padded = np.pad(np.where(z > 0, z, np.float32(np.inf)), 1, constant_values=np.inf)
    offsets = sorted(
        ((dv, du) for dv in (-1, 0, 1) for du in (-1, 0, 1)), key=lambda s: s[0] ** 2 + s[1] ** 2
    )
    neighbours = np.stack(
        [padded[1 + dv : 1 + dv + rows, 1 + du : 1 + du + columns] for dv, du in offsets]
    )
    min_z = neighbours.min(0)
    on_nearest = neighbours <= min_z * np.float32(1 + _SURFACE_TOLERANCE)
    first = np.argmax(on_nearest, axis=0)
    v, u = np.mgrid[:rows, :columns]
    offset_array = np.array(offsets)
    row = np.clip(v + offset_array[first, 0], 0, rows - 1)
    column = np.clip(u + offset_array[first, 1], 0, columns - 1)
    return np.asarray(row * columns + column, np.int64)
