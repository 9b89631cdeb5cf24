"""Local plane fits and albedo of range images, in constant time per pixel.

In a range image a plane is linear in inverse depth: on the plane with normal (a, b, c), a pixel
with ray (x, y, 1) has 1/z = a x + b y + c. Weighted sums over any window come from integral images,
so windows can be as wide as the noise requires and the surface permits.
"""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Bool, Float32, Float64, Int32, Int64
from tofuse.engine.compute import kernel

_SUMS = 12
_MAX_SIGMAS = 3.0  # standard deviations of a pixel from a plane that it belongs to


@kernel
def halve(
    z: Float32,
    value: Float32,
    variance: Float32,
    jump: float,
    z_out: Float32,
    value_out: Float32,
    variance_out: Float32,
    start: int,
    stop: int,
) -> None:
    """Downsample an image by 2 without mixing surfaces, to rows start..stop of the output.

    Of each 2 x 2 pixels, those whose depth is within `jump` (relative) of the second nearest are
    averaged: their inverse depths and their `value`. Pixels with depth 0 are invalid. `variance`,
    that of z, becomes the variance of the mean of independent values. Unknown values and variances
    are taken for the mean of the others.

    Parameters
    ----------
    z, value, variance
        (H, W) depth in m, any other channel, variance in m^2; the last two are 0 where unknown.
    z_out, value_out, variance_out
        (H // 2, W // 2), written.
    """
    columns = z_out.shape[1]
    d = np.empty(4)
    a = np.empty(4)
    s = np.empty(4)
    for i in range(start, stop):
        for j in range(columns):
            p, q = z[2 * i, 2 * j], z[2 * i, 2 * j + 1]
            r, t = z[2 * i + 1, 2 * j], z[2 * i + 1, 2 * j + 1]
            low = min(min(p, q), min(r, t))
            u, v = 2 * i, 2 * j
            known = (
                min(min(value[u, v], value[u, v + 1]), min(value[u + 1, v], value[u + 1, v + 1]))
                > 0
                and variance[u, v] > 0
                and variance[u, v + 1] > 0
                and variance[u + 1, v] > 0
                and variance[u + 1, v + 1] > 0
            )
            # The common case.
            if low > 0 and known and max(max(p, q), max(r, t)) - low <= jump * low:
                z_out[i, j] = 4 / (1.0 / p + 1.0 / q + 1.0 / r + 1.0 / t)
                value_out[i, j] = 0.25 * (
                    (value[u, v] + value[u, v + 1]) + (value[u + 1, v] + value[u + 1, v + 1])
                )
                variance_out[i, j] = 0.0625 * (
                    (variance[u, v] + variance[u, v + 1])
                    + (variance[u + 1, v] + variance[u + 1, v + 1])
                )
                continue
            n = 0
            for k in range(4):
                x = z[2 * i + (k >> 1), 2 * j + (k & 1)]
                if x > 0:
                    # Insertion sort.
                    m = n
                    while m > 0 and d[m - 1] > x:
                        d[m] = d[m - 1]
                        a[m] = a[m - 1]
                        s[m] = s[m - 1]
                        m -= 1
                    d[m] = x
                    a[m] = value[2 * i + (k >> 1), 2 * j + (k & 1)]
                    s[m] = variance[2 * i + (k >> 1), 2 * j + (k & 1)]
                    n += 1
            if n == 0:
                z_out[i, j] = 0
                value_out[i, j] = 0
                variance_out[i, j] = 0
                continue
            reference = d[1] if n > 1 else d[0]
            w_sum = 0.0
            value_sum = 0.0
            variance_sum = 0.0
            count = 0
            values = 0
            variances = 0
            for k in range(n):
                if abs(d[k] - reference) <= jump * reference:
                    w_sum += 1.0 / d[k]
                    count += 1
                    if a[k] > 0:
                        value_sum += a[k]
                        values += 1
                    if s[k] > 0:
                        variance_sum += s[k]
                        variances += 1
            z_out[i, j] = count / w_sum
            value_out[i, j] = value_sum / max(values, 1)
            variance_out[i, j] = variance_sum / (max(variances, 1) * count)


@kernel
def fit_planes(
    w: Float32,
    rays: Float32,
    weight: Float32,
    wanted: Bool,
    radii: Int64,
    limit: float,
    min_fill: float,
    max_offset2: float,
    planes: Float32,
    quality: Float32,
    start: int,
    stop: int,
) -> None:
    """Fit a plane at each `wanted` pixel of rows start..stop.

    The slope is fitted over the widest window that contains one surface, the depth over the
    smallest window. The slope needs many pixels, as its noise propagates to the motion; the depth
    does not, and a wide window would bias it on curved surfaces, differently from view to view.

    A window contains one surface if its mean weighted squared residual is within three standard
    deviations of that of noise with variance `limit`, the pixel itself is within 5 sigmas, enough
    of the window is valid, and the valid pixels surround the pixel, unlike at an occluding edge.

    Parameters
    ----------
    w, rays, weight
        (H, W) inverse depth in 1/m, (H, W, 2) x/z and y/z, (H, W) weight (0: invalid).
    wanted
        (H, W) pixels to fit.
    radii
        Half widths of the windows in pixels, ascending.
    limit
        Expected mean weighted squared residual.
    min_fill
        Smallest valid fraction of a window.
    max_offset2
        Largest squared offset of the valid pixels' centroid, relative to their variance.
    planes
        (H, W, 4) written: coefficients a, b, c of 1/z = a x + b y + c, and 1/z at the pixel; 0
        where no window fits.
    quality
        (H, W, 2) written: mean squared weighted residual of the smallest window (NaN with too few
        pixels), and variance of the fitted 1/z at the pixel, in units in which weights are inverse
        variances.
    start, stop
        Rows to fit.
    """
    rows, columns = w.shape
    # Ring buffer of those rows of the integral image that a window needs.
    max_radius = radii[-1]
    buffer_rows = 2 * max_radius + 2
    sums = np.empty((buffer_rows, columns + 1, _SUMS))
    summed = max(start - max_radius, 0)
    sums[summed % buffer_rows] = 0.0
    s = np.empty(_SUMS)
    inv_dof, max_residual = _tabulate_by_count(radii, limit)
    above, below = np.empty_like(radii), np.empty_like(radii)
    for i in range(start, stop):
        while summed < min(i + max_radius + 1, rows):
            _add_row(
                w[summed],
                rays[summed],
                weight[summed],
                sums[summed % buffer_rows],
                sums[(summed + 1) % buffer_rows],
            )
            summed += 1
        for q in range(len(radii)):
            above[q] = max(i - radii[q], 0) % buffer_rows
            below[q] = min(i + radii[q] + 1, rows) % buffer_rows
        for j in range(columns):
            planes[i, j, 0] = 0
            planes[i, j, 1] = 0
            planes[i, j, 2] = 0
            planes[i, j, 3] = 0
            quality[i, j, 0] = np.nan
            quality[i, j, 1] = 0
            if weight[i, j] <= 0 or not wanted[i, j]:
                continue
            x0 = np.float64(rays[i, j, 0])
            y0 = np.float64(rays[i, j, 1])
            # From the smallest window up to the first one that fails, so that a wide window never
            # bridges a gap that a smaller one has detected.
            for q in range(len(radii)):
                r = radii[q]
                upper, lower = sums[above[q]], sums[below[q]]
                left = max(j - r, 0)
                right = min(j + r + 1, columns)
                for k in range(_SUMS):
                    s[k] = lower[right, k] - upper[right, k] - lower[left, k] + upper[left, k]
                n = s[10]
                side = 2 * r + 1
                if n < min_fill * side * side or n < 6:
                    break
                inv_weight = 1.0 / s[0]
                mx = s[1] * inv_weight
                my = s[2] * inv_weight
                mw = s[3] * inv_weight
                cxx = s[4] * inv_weight - mx * mx
                cxy = s[5] * inv_weight - mx * my
                cyy = s[6] * inv_weight - my * my
                cxw = s[7] * inv_weight - mx * mw
                cyw = s[8] * inv_weight - my * mw
                cww = s[9] * inv_weight - mw * mw
                det = cxx * cyy - cxy * cxy
                if not det > 1e-6 * cxx * cyy:
                    break
                dx = x0 - mx
                dy = y0 - my
                if dx * dx > max_offset2 * cxx or dy * dy > max_offset2 * cyy:
                    break
                inv_det = 1.0 / det
                a = (cyy * cxw - cxy * cyw) * inv_det
                b = (cxx * cyw - cxy * cxw) * inv_det
                residual = max(cww - a * cxw - b * cyw, 0.0) * s[0] * inv_dof[q, int(n)]
                if q == 0:
                    quality[i, j, 0] = residual
                value = mw + a * dx + b * dy
                deviation = np.float64(w[i, j]) - value
                if residual > max_residual[q, int(n)]:
                    break
                if deviation * deviation * weight[i, j] > 25 * limit or value <= 0:
                    break
                if q == 0:
                    leverage = (cyy * dx * dx - 2 * cxy * dx * dy + cxx * dy * dy) * inv_det
                    quality[i, j, 1] = inv_weight * (1.0 + leverage)
                    planes[i, j, 3] = value
                planes[i, j, 0] = a
                planes[i, j, 1] = b
                planes[i, j, 2] = planes[i, j, 3] - a * x0 - b * y0


@kernel
def _tabulate_by_count(radii: Int64, limit: float) -> tuple[Float64, Float64]:
    """Tabulate 1 / (n - 3) and the largest mean squared residual by the number n of valid pixels.

    Each is (len(radii), largest n + 1).
    """
    max_count = (2 * radii[-1] + 1) ** 2
    inv_dof = np.zeros((len(radii), max_count + 1))
    max_residual = np.zeros((len(radii), max_count + 1))
    for q in range(len(radii)):
        for n in range(4, (2 * radii[q] + 1) ** 2 + 1):
            inv_dof[q, n] = 1.0 / (n - 3)
            # The mean of n - 3 squared normal deviates has a standard deviation of
            # sqrt(2 / (n - 3)).
            max_residual[q, n] = limit * (1.0 + 3.0 * np.sqrt(2.0 / (n - 3)))
    return inv_dof, max_residual


@kernel
def _add_row(w: Float32, rays: Float32, weight: Float32, above: Float64, below: Float64) -> None:
    """Write a row of the integral image of the weighted moments, `below`, given the row `above`.

    Both are (W + 1, _SUMS). Pixels with weight 0 are ignored, whatever their values.
    """
    t = np.zeros(_SUMS)
    for q in range(_SUMS):
        below[0, q] = above[0, q]
    for j in range(len(w)):
        g = np.float64(weight[j])
        if g > 0:
            x = np.float64(rays[j, 0])
            y = np.float64(rays[j, 1])
            v = np.float64(w[j])
            gx = g * x
            gy = g * y
            gv = g * v
            t[0] += g
            t[1] += gx
            t[2] += gy
            t[3] += gv
            t[4] += gx * x
            t[5] += gx * y
            t[6] += gy * y
            t[7] += gv * x
            t[8] += gv * y
            t[9] += gv * v
            t[10] += 1.0
        for k in range(_SUMS):
            below[j + 1, k] = above[j + 1, k] + t[k]


@kernel
def albedo_image(
    planes: Float32,
    rays: Float32,
    amplitude: Float32,
    inverse_square: bool,
    active_illumination: bool,
    falloff: float,
    out: Float32,
) -> None:
    """Write the log albedo up to a constant: log(amplitude * range^2 / cos(incidence)).

    Parameters
    ----------
    planes, rays, amplitude
        (H, W, 4) of `fit_planes`, (H, W, 2), and (H, W) amplitude.
    inverse_square
        Whether the amplitude falls with the squared range; not if it is range-compensated.
    active_illumination
        Whether the camera illuminates the scene. Otherwise the cosine of incidence is left out, as
        for a Lambertian surface in ambient light.
    falloff
        Exponent of the cosine to the optical axis by which amplitude falls off.
    out
        (H, W) written; NaN without plane or amplitude, and at grazing incidence.
    """
    rows, columns = amplitude.shape
    one = np.float32(1)
    for i in range(rows):
        for j in range(columns):
            out[i, j] = np.nan
            v = planes[i, j, 3]
            if v <= 0 or not amplitude[i, j] > 0:
                continue
            x = rays[i, j, 0]
            y = rays[i, j, 1]
            a = planes[i, j, 0]
            b = planes[i, j, 1]
            c = planes[i, j, 2]
            length2 = x * x + y * y + one
            # The normal is (a, b, c), and (a, b, c) . (x, y, 1) = 1/z.
            cosine = v / np.sqrt((a * a + b * b + c * c) * length2)
            if cosine < np.float32(0.15):
                continue
            shading = cosine if active_illumination else one
            range2 = length2 / (v * v)  # the squared range
            out[i, j] = np.log(amplitude[i, j] / shading * (range2 if inverse_square else one))
            if falloff != 0:
                out[i, j] += np.float32(0.5 * falloff) * np.log(length2)


@kernel
def smooth_and_slope(
    image: Float32,
    planes: Float32,
    rays: Float32,
    radius: int,
    jump: float,
    out: Float32,
    start: int,
    stop: int,
) -> None:
    """Box-filter an image with NaN holes and compute its gradient, except across depth edges.

    Parameters
    ----------
    image, planes, rays
        (H, W), (H, W, 4) of `fit_planes`, and (H, W, 2).
    radius
        Boxes have (2 radius + 1)^2 pixels. A partial box is assigned to the centroid of its pixels.
    jump
        The gradient requires four neighbours whose inverse depths agree with the centre's plane to
        within this fraction.
    out
        (H, W, 3) written in rows start..stop: mean, and its derivatives by the ray coordinates x
        and y; NaN where they are not defined.
    """
    rows, columns = image.shape
    h = radius + 1
    first_row = max(start - h, 0)
    mean = np.empty((min(stop + h, rows) - first_row, columns, 3), np.float32)
    _box_means(image, rays, radius, first_row, mean)
    inner = columns - 2 * h
    for i in range(start, stop):
        out[i] = np.nan
        if i < h or i >= rows - h or inner <= 0:
            continue
        # Pixels with four neighbours at distance h, and these neighbours.
        interior, k = slice(h, h + inner), i - first_row
        m, p, r = mean[k, interior], planes[i, interior], rays[i, interior]
        m0, p0, r0 = mean[k, :inner], planes[i, :inner], rays[i, :inner]
        m1, p1, r1 = mean[k, 2 * h :], planes[i, 2 * h :], rays[i, 2 * h :]
        m2, p2, r2 = mean[k - h, interior], planes[i - h, interior], rays[i - h, interior]
        m3, p3, r3 = mean[k + h, interior], planes[i + h, interior], rays[i + h, interior]
        image_row, out_row = image[i, interior], out[i, interior]
        for j in range(inner):
            v = p[j, 3]
            if v <= 0 or np.isnan(image_row[j]):
                continue
            tolerance = np.float32(jump) * v
            if not (
                _continues(p[j], p0[j], r0[j], tolerance)
                and _continues(p[j], p1[j], r1[j], tolerance)
                and _continues(p[j], p2[j], r2[j], tolerance)
                and _continues(p[j], p3[j], r3[j], tolerance)
            ):
                continue
            # Chain rule from pixel to ray coordinates, for any lens. Missing means are NaN and
            # propagate.
            du, dv = m1[j, 0] - m0[j, 0], m3[j, 0] - m2[j, 0]
            xu, xv = m1[j, 1] - m0[j, 1], m3[j, 1] - m2[j, 1]
            yu, yv = m1[j, 2] - m0[j, 2], m3[j, 2] - m2[j, 2]
            inv_det = np.float32(1) / (xu * yv - yu * xv)
            sx = (yv * du - yu * dv) * inv_det
            sy = (xu * dv - xv * du) * inv_det
            out_row[j, 0] = m[j, 0] + sx * (r[j, 0] - m[j, 1]) + sy * (r[j, 1] - m[j, 2])
            out_row[j, 1] = sx
            out_row[j, 2] = sy


@kernel
def _continues(plane: Float32, other: Float32, ray: Float32, tolerance: np.float32) -> bool:
    """Whether a plane continues at another pixel, to within `tolerance` in inverse depth."""
    expected = plane[0] * ray[0] + plane[1] * ray[1] + plane[2]
    return other[3] > 0 and abs(other[3] - expected) <= tolerance


@kernel
def _box_means(image: Float32, rays: Float32, radius: int, first_row: int, out: Float32) -> None:
    """Write mean and centroid (x, y) of each pixel's box, from row `first_row` on, to `out`.

    `out` is (rows, W, 3); NaN where the box is empty.
    """
    rows, columns = image.shape
    full = np.float32((2 * radius + 1) * (2 * radius + 1))
    inv_full = np.float32(1) / full
    known = np.empty(columns, np.float32)
    one, zero = np.float32(1), np.float32(0)
    # Sums over the rows of a box, padded by zeros, and sums over the whole box.
    column_sums = np.zeros((4, columns + 2 * radius), np.float32)
    box_sums = np.empty((4, columns), np.float32)
    for k in range(out.shape[0]):
        i = first_row + k
        column_sums[:, radius : radius + columns] = 0.0
        for a in range(max(i - radius, 0), min(i + radius + 1, rows)):
            row = image[a]
            for j in range(columns):
                known[j] = zero if np.isnan(row[j]) else one
            _add_known(column_sums[0, radius:], row, known)
            _add_known(column_sums[1, radius:], known, known)
            _add_known(column_sums[2, radius:], rays[a, :, 0], known)
            _add_known(column_sums[3, radius:], rays[a, :, 1], known)
        box_sums[:] = 0.0
        for c in range(4):
            for b in range(2 * radius + 1):
                total, column_part = box_sums[c], column_sums[c, b : b + columns]
                for j in range(columns):
                    total[j] += column_part[j]
        for j in range(columns):
            if box_sums[1, j] == full:
                out[k, j, 0] = box_sums[0, j] * inv_full
                out[k, j, 1], out[k, j, 2] = rays[i, j, 0], rays[i, j, 1]
            else:
                for c in range(3):
                    out[k, j, c] = box_sums[c if c == 0 else c + 1, j] / box_sums[1, j]


@kernel
def _add_known(total: Float32, values: Float32, known: Float32) -> None:
    zero = np.float32(0)
    for j in range(len(known)):
        total[j] += values[j] if known[j] > zero else zero


@kernel
def extend_planes(
    w: Float32,
    sigma: Float32,
    rays: Float32,
    wanted: Bool,
    planes: Float32,
    variance: Float32,
    offsets: Int32,
    variance_growth: Float32,
    jump: float,
    planes_out: Float32,
    variance_out: Float32,
) -> None:
    """Assign to each `wanted` pixel the nearest plane that its depth agrees with.

    Parameters
    ----------
    w, sigma
        (H, W) measured 1/z and its standard deviation, 1/m.
    rays
        (H, W, 2) x/z and y/z.
    planes, variance
        (H, W, 4) of `fit_planes`, 0 where there is none, and (H, W) the variance of their 1/z.
    offsets, variance_growth
        (K, 2) rows and columns of the candidates relative to the pixel, in order of preference, and
        (K,) the factor by which the variance of their planes grows up to the pixel.
    jump
        The pixel agrees with a plane if 1/z differs by at most `_MAX_SIGMAS`, 1/z of the plane
        changes by at most the fraction `jump` between the two pixels, and the pixel's sigma is at
        most twice the other one's, as a change of noise indicates another surface.
    planes_out, variance_out
        (H, W, 4) and (H, W), written: planes, and the variances of their 1/z.
    """
    rows, columns = w.shape
    limit = np.float32(_MAX_SIGMAS * _MAX_SIGMAS)
    tolerance = np.float32(jump)
    for i in range(rows):
        for j in range(columns):
            if not wanted[i, j]:
                continue
            x = rays[i, j, 0]
            y = rays[i, j, 1]
            measured = w[i, j]
            noise = sigma[i, j] * sigma[i, j]
            for k in range(len(offsets)):
                p = i + offsets[k, 0]
                q = j + offsets[k, 1]
                if p < 0 or q < 0 or p >= rows or q >= columns or not planes[p, q, 3] > 0:
                    continue
                predicted = planes[p, q, 0] * x + planes[p, q, 1] * y + planes[p, q, 2]
                if not abs(predicted - planes[p, q, 3]) <= tolerance * predicted:
                    continue
                difference = measured - predicted
                plane_variance = variance_growth[k] * variance[p, q]
                max_noise = np.float32(4) * sigma[p, q] * sigma[p, q]
                if noise > max_noise or difference * difference > limit * (noise + plane_variance):
                    continue
                variance_out[i, j] = plane_variance
                for c in range(3):
                    planes_out[i, j, c] = planes[p, q, c]
                planes_out[i, j, 3] = predicted
                break
