"""Points of an image that can be found again: where they are, what is around them, how far."""

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
Light = Literal["auto", "albedo", "color"]

# Detectors want images of some size: small ones are enlarged until they are this wide.
_WIDE = 500
# Share of the darkest and of the brightest pixels that are made black and white.
_TAIL = 0.5
# Contrast below which SIFT takes nothing for a point; images are stretched to full contrast.
_CONTRAST = 0.01
# Steps of brightness by which FAST wants a ring to differ.
_STEP = 5
# Diameter that a FAST corner is described over, in pixels of the enlarged image.
_PATCH = 9.0
# Depths within this share of the nearest one are of the same surface.
_SAME = 0.05


@dataclass(frozen=True, eq=False)
class Keypoints:
    """n points that were found in an image.

    Attributes
    ----------
    points
        (n, 3) m, in the frame of the view.
    variance
        (n,) of a point along each axis, m^2.
    descriptors
        (n, d) float32, or uint8 whose bits count.
    pixels
        (n, 2) u, v of the frame's image.
    """

    points: Float64
    variance: Float64
    descriptors: NDArray[Any]
    pixels: Float64

    def __len__(self) -> int:
        return len(self.points)


def light_image(frame: RangeFrame, light: Light) -> UInt8:
    """(H, W) what the surfaces reflect, as grey levels; black where nothing is known.

    The albedo is the amplitude times the squared range, unless the camera did that, on a
    logarithmic scale: exposure then only shifts it. Colour is its luminance.

    Raises RegistrationError where the frame has not what is asked for.
    """
    has_color = frame.color_image is not None and frame.color_registered
    if frame.amplitude_image is not None and light != "color":
        r = frame.radial_range
        known = (
            (r > 0) & (frame.amplitude_image > 0) & (frame.amplitude_image < SATURATED_AMPLITUDE)
        )
        albedo = np.where(known, frame.amplitude_image, np.float32(1))
        if frame.amplitude_kind != "range_compensated":
            albedo = albedo * np.where(known, r * r, np.float32(1))
        grey = np.log(albedo)
    elif has_color and light != "albedo":
        assert frame.color_image is not None
        grey = cv2.cvtColor(np.ascontiguousarray(frame.color_image), cv2.COLOR_RGB2GRAY)
        grey = grey.astype(np.float32)
        known = np.ones(grey.shape, bool)
    else:
        what = {"albedo": "amplitude", "color": "colour"}.get(light, "amplitude nor colour")
        raise RegistrationError(f"has no {what} to find points in", where=f"frame {frame.index}")
    if not known.any():
        raise RegistrationError("shows nothing but black", where=f"frame {frame.index}")
    low, high = np.percentile(grey[known], [_TAIL, 100 - _TAIL])
    levels = np.clip((grey - low) / max(float(high - low), 1e-6), 0, 1) * 255
    # Holes take the levels around them: their rims would be found otherwise.
    image: UInt8 = np.where(known, levels, 0).astype(np.uint8)
    around = cv2.medianBlur(image, 5)
    return np.where(known, image, around).astype(np.uint8)


def keypoints(
    frame: RangeFrame,
    surface: PreparedView,
    *,
    detector: Detector,
    light: Light,
    count: int,
    blur_px: float,
) -> Keypoints:
    """Find points in an image and place them in space.

    Parameters
    ----------
    surface
        Of the frame; it knows the noise, and the planes that points lie on.
    detector
        "sift" (Lowe 2004), "orb" (Rublee et al. 2011), or "fast": FAST corners (Rosten and
        Drummond 2006), upright and described as those of SIFT, all over patches of one size.
    light
        "albedo", "color", or what there is of the two ("auto"), the albedo first.
    count
        The strongest so many are kept.
    blur_px
        Standard deviation of where a point is found, in pixels of the frame.
    """
    image = light_image(frame, light)
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
    """Keypoints as OpenCV gives them, in an order that does not depend on it, and descriptors."""
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
    """Points (n, 3) of pixels (n, 2) of an image so wide, variances (n,), and which are known.

    At an edge the nearer surface is taken: it is the one that has the edge.
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
    # A plane knows the depth better than one pixel.
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
    # What the place is off across the surface is off along the ray where that is steep.
    steep = np.abs(normals[:, 2])
    slope = np.where(plane & (steep > 0.2), 1 / np.maximum(steep, 0.2) ** 2 - 1, 0)
    variance = (depth_variance + across * (2 + slope)) / 3
    known = (z > 0) & np.isfinite(points).all(1) & np.isfinite(variance) & (variance > 0)
    return points, variance, known


def _nearest_known(z: Float32) -> Int64:
    """(H, W) position of the pixel, among the nine around each, that is on the nearest surface.

    Of those on it, the one closest to the middle.
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
