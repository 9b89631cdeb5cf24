"""Interreflections between surfaces (multipath), on a coarse grid of an image.

A grid node stands for a block of pixels. The columns of `nodes` are x and y of the mean ray, mean
inverse depth w, mean amplitude per pixel, area of the block in the plane z = 1, and the
coefficients a, b, c of the plane 1/z = a x + b y + c through it (all 0 where no plane fits).
"""

from __future__ import annotations

import numpy as np

from tofuse.engine.arrays import Bool, Complex128, Float32, Float64
from tofuse.engine.compute import kernel

X, Y, W, AMPLITUDE, AREA, A, B, C, COLUMNS = range(9)

# Columns of a mapped surface patch: point, unit normal, albedo in counts, and weight.
PATCH = 8

# Exponent of the cosine to the optical axis by which amplitude falls off: half of it is due to the
# lens, half of it due to the lamp.
FALLOFF = 4.0
# Lower limit of the cosine of incidence; the direct light of more oblique surfaces is too
# uncertain.
_MIN_COSINE = 0.12
# Limits of the ratio of inverse depths within which a plane is extrapolated.
_MIN_RATIO, _MAX_RATIO = 0.3, 3.0

# Polynomial coefficients of cos(2 pi t) in t^2, and of sin(2 pi t) in odd powers of t, for
# |t| <= 1/2; accurate to 1e-6.
_C0, _C1, _C2, _C3, _C4, _C5 = (
    np.float32(c)
    for c in (0.99999921, -19.73898031, 64.92865571, -85.27159959, 58.79037925, -21.07090497)
)
_S0, _S1, _S2, _S3, _S4, _S5 = (
    np.float32(c)
    for c in (6.28318279, -41.34141933, 81.59613741, -76.579674, 41.20368208, -12.26876145)
)


@kernel
def ray_bounds(rays: Float32) -> Float64:
    """Return min x, max x, min y, max y of the known rays (H, W, 2); NaN if there are none."""
    out = np.full(4, np.nan)
    for i in range(rays.shape[0]):
        for j in range(rays.shape[1]):
            x, y = np.float64(rays[i, j, 0]), np.float64(rays[i, j, 1])
            if np.isfinite(x) and np.isfinite(y):
                out[0] = x if not out[0] <= x else out[0]
                out[1] = x if not out[1] >= x else out[1]
                out[2] = y if not out[2] <= y else out[2]
                out[3] = y if not out[3] >= y else out[3]
    return out


@kernel
def block_means(
    z: Float32, rays: Float32, amplitude: Float32, step: int, jump: float, nodes: Float64
) -> None:
    """Average blocks of step x step pixels over the pixels of the block's dominant surface.

    Parameters
    ----------
    z, rays, amplitude
        (H, W) depth in m, (H, W, 2) x/z and y/z, and (H, W) raw amplitude; 0 where unknown.
    jump
        Pixels within this fraction of the block's median depth are averaged.
    nodes
        (Hn, Wn, COLUMNS); the first five columns are written. w is 0 where less than a quarter of
        the block is valid.
    """
    rows, columns = z.shape
    d = np.empty(step * step)
    for bi in range(nodes.shape[0]):
        for bj in range(nodes.shape[1]):
            top, left = bi * step, bj * step
            bottom, right = min(top + step, rows), min(left + step, columns)
            n = 0
            for i in range(top, bottom):
                for j in range(left, right):
                    if z[i, j] > 0:
                        # Insertion sort: fastest for so few values.
                        m = n
                        while m > 0 and d[m - 1] > z[i, j]:
                            d[m] = d[m - 1]
                            m -= 1
                        d[m] = z[i, j]
                        n += 1
            for c in range(COLUMNS):
                nodes[bi, bj, c] = 0.0
            if 4 * n < (bottom - top) * (right - left):
                continue
            median = d[n // 2]
            count = 0
            amplitude_count = 0
            area_count = 0
            x = y = w = amplitude_sum = area = 0.0
            for i in range(top, bottom):
                for j in range(left, right):
                    if z[i, j] > 0 and abs(z[i, j] - median) <= jump * median:
                        count += 1
                        x += rays[i, j, 0]
                        y += rays[i, j, 1]
                        w += 1.0 / z[i, j]
                        if amplitude[i, j] > 0:
                            amplitude_count += 1
                            amplitude_sum += amplitude[i, j]
                        i2 = i + 1 if i + 1 < rows else i - 1
                        j2 = j + 1 if j + 1 < columns else j - 1
                        ux = rays[i, j2, 0] - rays[i, j, 0]
                        uy = rays[i, j2, 1] - rays[i, j, 1]
                        vx = rays[i2, j, 0] - rays[i, j, 0]
                        vy = rays[i2, j, 1] - rays[i, j, 1]
                        pixel_area = abs(ux * vy - uy * vx)
                        if np.isfinite(pixel_area):
                            area_count += 1
                            area += pixel_area
            if area_count == 0:
                continue
            nodes[bi, bj, X] = x / count
            nodes[bi, bj, Y] = y / count
            nodes[bi, bj, W] = w / count
            nodes[bi, bj, AMPLITUDE] = (
                amplitude_sum / amplitude_count if amplitude_count > 0 else 0.0
            )
            nodes[bi, bj, AREA] = area / area_count * count


@kernel
def window_planes(nodes: Float64, radius: int, planes: Float64) -> None:
    """Fit 1/z = a x + b y + c to each window of (2 radius + 1)^2 nodes.

    Writes `planes` (Hn, Wn, 4): a, b, c and the rms residual relative to 1/z, infinite where less
    than two thirds of the window are valid.
    """
    rows, columns = nodes.shape[:2]
    for i in range(rows):
        for j in range(columns):
            planes[i, j, 3] = np.inf
            n = 0
            mx = my = mw = 0.0
            top, bottom = max(i - radius, 0), min(i + radius + 1, rows)
            left, right = max(j - radius, 0), min(j + radius + 1, columns)
            for p in range(top, bottom):
                for q in range(left, right):
                    if nodes[p, q, W] > 0:
                        n += 1
                        mx += nodes[p, q, X]
                        my += nodes[p, q, Y]
                        mw += nodes[p, q, W]
            if n < 6 or 3 * n < 2 * (2 * radius + 1) ** 2:
                continue
            mx, my, mw = mx / n, my / n, mw / n
            xx = xy = yy = xw = yw = ww = 0.0
            for p in range(top, bottom):
                for q in range(left, right):
                    if nodes[p, q, W] > 0:
                        x = nodes[p, q, X] - mx
                        y = nodes[p, q, Y] - my
                        w = nodes[p, q, W] - mw
                        xx += x * x
                        xy += x * y
                        yy += y * y
                        xw += x * w
                        yw += y * w
                        ww += w * w
            det = xx * yy - xy * xy
            if not det > 1e-6 * xx * yy:
                continue
            a = (yy * xw - xy * yw) / det
            b = (xx * yw - xy * xw) / det
            planes[i, j, 0] = a
            planes[i, j, 1] = b
            planes[i, j, 2] = mw - a * mx - b * my
            planes[i, j, 3] = np.sqrt(max(ww - a * xw - b * yw, 0.0) / (n - 3)) / mw


@kernel
def choose_planes(
    nodes: Float64, planes: Float64, radius: int, limit: float, measured: Float64, bias: Float64
) -> None:
    """Assign to each node without a plane the best-fitting plane of the windows around it.

    As in the filter of Kuwahara (1976), planes thus extend up to an edge without smoothing it. Next
    to an edge the bias of a node depends on the surface that it belongs to, so the node is compared
    with each plane after correction by that window's bias.

    Parameters
    ----------
    nodes
        (Hn, Wn, COLUMNS), updated.
    planes
        (Hn, Wn, 4) of `window_planes`.
    radius
        In nodes.
    limit
        Largest relative misfit of a plane; the node may deviate from it by twice as much.
    measured, bias
        (Hn, Wn) uncorrected radial range in m, and current estimate of its bias.
    """
    rows, columns = nodes.shape[:2]
    for i in range(rows):
        for j in range(columns):
            if nodes[i, j, W] <= 0 or nodes[i, j, C] != 0.0 or nodes[i, j, A] != 0.0:
                continue
            best = np.inf
            length = np.sqrt(1.0 + nodes[i, j, X] ** 2 + nodes[i, j, Y] ** 2)
            for p in range(max(i - radius, 0), min(i + radius + 1, rows)):
                for q in range(max(j - radius, 0), min(j + radius + 1, columns)):
                    misfit = planes[p, q, 3]
                    if not misfit < limit:
                        continue
                    fitted = (
                        planes[p, q, 0] * nodes[i, j, X]
                        + planes[p, q, 1] * nodes[i, j, Y]
                        + planes[p, q, 2]
                    )
                    w = length / (measured[i, j] - bias[p, q])
                    deviation = abs(fitted - w) / w
                    if not w > 0 or deviation > 2 * limit:
                        continue
                    distance2 = (p - i) ** 2 + (q - j) ** 2
                    cost = misfit + deviation + 0.1 * limit * distance2
                    if cost < best:
                        best = cost
                        nodes[i, j, A] = planes[p, q, 0]
                        nodes[i, j, B] = planes[p, q, 1]
                        nodes[i, j, C] = planes[p, q, 2]


@kernel
def surface_radiometry(
    nodes: Float64,
    amplitude_factor: Float64,
    has_plane: Bool,
    points: Float64,
    normals: Float64,
    values: Float64,
) -> None:
    """Compute geometry and radiometry of the nodes (Hn, Wn, COLUMNS) that have a plane.

    Parameters
    ----------
    amplitude_factor
        (Hn, Wn) by which indirect light has raised the amplitude.
    has_plane, points, normals
        Written: (Hn, Wn) whether there is a plane; (Hn, Wn, 3) in m; unit, towards the camera.
    values
        Written: (5, Hn, Wn) radial range in m, area in m^2, direct irradiance, radiosity, and
        albedo in counts, see `Surfaces`; 0 without a plane.
    """
    for i in range(nodes.shape[0]):
        for j in range(nodes.shape[1]):
            a, b, c = nodes[i, j, A], nodes[i, j, B], nodes[i, j, C]
            x, y = nodes[i, j, X], nodes[i, j, Y]
            slope = np.sqrt(a * a + b * b + c * c)
            w = a * x + b * y + c
            fits = nodes[i, j, W] > 0 and slope > 0 and w > 0
            has_plane[i, j] = fits
            if not fits:
                for n in range(3):
                    points[i, j, n] = normals[i, j, n] = 0.0
                for n in range(5):
                    values[n, i, j] = 0.0
                continue
            length = np.sqrt(1.0 + x * x + y * y)
            cosine = min(max(w / (slope * length), _MIN_COSINE), 1.0)
            r = length / w
            lens_falloff = length ** (-FALLOFF / 2)
            points[i, j, 0], points[i, j, 1], points[i, j, 2] = x / w, y / w, 1.0 / w
            normals[i, j, 0], normals[i, j, 1] = -a / slope, -b / slope
            normals[i, j, 2] = -c / slope
            values[0, i, j] = r
            values[1, i, j] = nodes[i, j, AREA] / (w * w * length * cosine)
            values[2, i, j] = lens_falloff * cosine / (r * r)
            values[3, i, j] = nodes[i, j, AMPLITUDE] / lens_falloff
            values[4, i, j] = values[3, i, j] / values[2, i, j] / amplitude_factor[i, j]


@kernel
def visible_sources(
    has_plane: Bool,
    points: Float64,
    normals: Float64,
    area: Float64,
    radiosity: Complex128,
    out: Float32,
) -> int:
    """Make light sources of the nodes (Hn, Wn), merging similar nodes of each 2 x 2 into one.

    Nodes are merged with the strongest of the four if their normals are within 14 degrees, and the
    node is off the strongest one's plane by less than 2 % of the latter's range.

    Parameters
    ----------
    has_plane, points, normals, area
        (Hn, Wn), (Hn, Wn, 3), (Hn, Wn, 3) and (Hn, Wn) of `surface_radiometry`.
    radiosity
        (Hn, Wn) complex, with the phase of the modulation at the surface.
    out
        (S, 9) written, as in `add_irradiance`; S is at least the number of nodes.

    Returns
    -------
    The number of sources.
    """
    rows, columns = has_plane.shape
    count = 0
    power = np.empty(4)
    for top in range(0, rows, 2):
        for left in range(0, columns, 2):
            best = -1
            for n in range(4):
                i, j = top + n // 2, left + n % 2
                power[n] = 0.0
                if i < rows and j < columns and has_plane[i, j]:
                    power[n] = area[i, j] * abs(radiosity[i, j])
                if power[n] > 0 and (best < 0 or power[n] > power[best]):
                    best = n
            if best < 0:
                continue
            p, q = top + best // 2, left + best % 2
            strongest, strongest_normal = points[p, q], normals[p, q]
            strongest_range = np.sqrt(strongest[0] ** 2 + strongest[1] ** 2 + strongest[2] ** 2)
            weight = total = real = imaginary = 0.0
            x = y = z = u = v = w = 0.0
            for n in range(4):
                if not power[n] > 0:
                    continue
                i, j = top + n // 2, left + n % 2
                point, normal = points[i, j], normals[i, j]
                cosine = (
                    normal[0] * strongest_normal[0]
                    + normal[1] * strongest_normal[1]
                    + normal[2] * strongest_normal[2]
                )
                plane_distance = (
                    (point[0] - strongest[0]) * strongest_normal[0]
                    + (point[1] - strongest[1]) * strongest_normal[1]
                    + (point[2] - strongest[2]) * strongest_normal[2]
                )
                if cosine > 0.97 and abs(plane_distance) < 0.02 * strongest_range:
                    weight += power[n]
                    total += area[i, j]
                    real += area[i, j] * radiosity[i, j].real
                    imaginary += area[i, j] * radiosity[i, j].imag
                    x += power[n] * point[0]
                    y += power[n] * point[1]
                    z += power[n] * point[2]
                    u += power[n] * normal[0]
                    v += power[n] * normal[1]
                    w += power[n] * normal[2]
                    continue
                for m in range(3):
                    out[count, m], out[count, 3 + m] = point[m], normal[m]
                out[count, 6] = area[i, j]
                out[count, 7], out[count, 8] = radiosity[i, j].real, radiosity[i, j].imag
                count += 1
            length = np.sqrt(u * u + v * v + w * w)
            out[count, 0], out[count, 1], out[count, 2] = x / weight, y / weight, z / weight
            out[count, 3], out[count, 4], out[count, 5] = u / length, v / length, w / length
            out[count, 6] = total
            out[count, 7], out[count, 8] = real / total, imaginary / total
            count += 1
    return count


@kernel
def offscreen_sources(
    rays: Float64,
    areas: Float64,
    planes: Float64,
    albedo: Float64,
    border: Float64,
    border_albedo: Float64,
    wave_number: float,
    out: Float32,
) -> int:
    """Make light sources of illuminated surfaces outside the image.

    Parameters
    ----------
    rays, areas
        (M, 2) centres of cells around the image in the plane z = 1, and (M,) their illuminated area
        in that plane.
    planes, albedo
        (M, 3) planes of mapped surfaces in the cells, and (M,) their albedo relative to white;
        where it is 0, the plane of the nearest border node is extrapolated.
    border, border_albedo
        (N, COLUMNS) nodes at the image's border that have planes, and (N,) their albedo.
    wave_number
        Phase in rad per m of path.
    out
        (S, 9) written, as in `add_irradiance`; S is at least M.

    Returns
    -------
    The number of sources.
    """
    count = 0
    for m in range(len(rays)):
        x, y = rays[m, 0], rays[m, 1]
        a, b, c, cell_albedo = planes[m, 0], planes[m, 1], planes[m, 2], albedo[m]
        if not cell_albedo > 0:
            nearest_distance2 = np.inf
            nearest = -1
            for n in range(len(border)):
                distance2 = (x - border[n, X]) ** 2 + (y - border[n, Y]) ** 2
                if distance2 < nearest_distance2:
                    nearest_distance2 = distance2
                    nearest = n
            if nearest < 0:
                continue
            a, b, c = border[nearest, A], border[nearest, B], border[nearest, C]
            cell_albedo = border_albedo[nearest]
            ratio = (a * x + b * y + c) / border[nearest, W]
            if ratio < _MIN_RATIO or ratio > _MAX_RATIO:
                continue
        w = a * x + b * y + c
        if not w > 0:
            continue
        slope = np.sqrt(a * a + b * b + c * c)
        length = np.sqrt(1.0 + x * x + y * y)
        r = length / w
        cosine = min(max(w / (slope * length), _MIN_COSINE), 1.0)
        radiosity = cell_albedo * length ** (-FALLOFF / 2) * cosine / (r * r)
        out[count, 0], out[count, 1], out[count, 2] = x / w, y / w, 1.0 / w
        out[count, 3], out[count, 4], out[count, 5] = -a / slope, -b / slope, -c / slope
        out[count, 6] = areas[m] / (w * w * length * cosine)
        out[count, 7] = radiosity * np.cos(wave_number * r)
        out[count, 8] = radiosity * np.sin(wave_number * r)
        count += 1
    return count


@kernel
def project_patches(
    patches: Float32,
    T_camera_world: Float64,
    rays: Float64,
    pitch: Float64,
    planes: Float64,
    albedo: Float64,
) -> None:
    """Project mapped surface patches into cells of the plane z = 1.

    A cell gets the weighted mean of those patches in it that face the camera and are not occluded
    by nearer ones.

    Parameters
    ----------
    patches
        (N, PATCH) in the world frame.
    T_camera_world
        (4, 4).
    rays, pitch
        (M, 2) centres of the cells, on a lattice of this pitch (2,).
    planes, albedo
        (M, 3) a, b, c of 1/z = a x + b y + c, and (M,) in counts; written where there is a patch.
    """
    T = T_camera_world
    left, top = rays[0, 0], rays[0, 1]
    right, bottom = left, top
    for m in range(len(rays)):
        left, right = min(left, rays[m, 0]), max(right, rays[m, 0])
        top, bottom = min(top, rays[m, 1]), max(bottom, rays[m, 1])
    columns = int(np.floor((right - left) / pitch[0] + 0.5)) + 1
    rows = int(np.floor((bottom - top) / pitch[1] + 0.5)) + 1
    cell = np.full((rows, columns), -1)
    for m in range(len(rays)):
        i = int(np.floor((rays[m, 1] - top) / pitch[1] + 0.5))
        cell[i, int(np.floor((rays[m, 0] - left) / pitch[0] + 0.5))] = m
    nearest = np.zeros(len(rays))
    sums = np.zeros((len(rays), 5))
    patch_cell = np.empty(len(patches), np.int64)
    depth = np.empty(len(patches))
    for n in range(len(patches)):
        patch_cell[n] = -1
        px, py, pz = patches[n, 0], patches[n, 1], patches[n, 2]
        z = T[2, 0] * px + T[2, 1] * py + T[2, 2] * pz + T[2, 3]
        if z < 0.05:
            continue
        x = (T[0, 0] * px + T[0, 1] * py + T[0, 2] * pz + T[0, 3]) / z
        y = (T[1, 0] * px + T[1, 1] * py + T[1, 2] * pz + T[1, 3]) / z
        j = int(np.floor((x - left) / pitch[0] + 0.5))
        i = int(np.floor((y - top) / pitch[1] + 0.5))
        if i < 0 or i >= rows or j < 0 or j >= columns or cell[i, j] < 0:
            continue
        u, v, w = patches[n, 3], patches[n, 4], patches[n, 5]
        a = T[0, 0] * u + T[0, 1] * v + T[0, 2] * w
        b = T[1, 0] * u + T[1, 1] * v + T[1, 2] * w
        c = T[2, 0] * u + T[2, 1] * v + T[2, 2] * w
        facing = a * x + b * y + c
        if facing > -0.05 * np.sqrt(x * x + y * y + 1.0):
            continue
        patch_cell[n], depth[n] = cell[i, j], z
        nearest[patch_cell[n]] = max(nearest[patch_cell[n]], 1.0 / z)
    for n in range(len(patches)):
        m = patch_cell[n]
        if m < 0 or 1.0 / depth[n] < 0.8 * nearest[m]:
            continue
        u, v, w = patches[n, 3], patches[n, 4], patches[n, 5]
        weight = patches[n, 7]
        sums[m, 0] += weight * (T[0, 0] * u + T[0, 1] * v + T[0, 2] * w)
        sums[m, 1] += weight * (T[1, 0] * u + T[1, 1] * v + T[1, 2] * w)
        sums[m, 2] += weight * (T[2, 0] * u + T[2, 1] * v + T[2, 2] * w)
        sums[m, 3] += weight / depth[n]
        sums[m, 4] += weight * patches[n, 6]
        planes[m, 0] += weight
    for m in range(len(rays)):
        weight = planes[m, 0]
        if weight == 0.0:
            continue
        a, b, c = sums[m, 0], sums[m, 1], sums[m, 2]
        # Plane with the mean normal, and the mean inverse depth at the cell's centre.
        facing = a * rays[m, 0] + b * rays[m, 1] + c
        if facing >= 0.0:
            planes[m, 0] = 0.0
            continue
        scale = sums[m, 3] / weight / facing
        planes[m, 0], planes[m, 1], planes[m, 2] = a * scale, b * scale, c * scale
        albedo[m] = sums[m, 4] / weight


@kernel
def add_irradiance(
    sources: Float32, start: int, stop: int, receivers: Float32, wavelength: float, out: Float32
) -> None:
    """Add to `out` the irradiance of the receivers by the sources start..stop.

    Parameters
    ----------
    sources
        (S, 9): point, unit normal, area in m^2, real and imaginary part of the radiosity.
    receivers
        (6, R): point and unit normal.
    wavelength
        Of the modulation, m.
    out
        (2, R) real and imaginary part of the irradiance, with the phase at the receiver.

    Notes
    -----
    The form factor of a disc to a point, cos cos area / (pi d^2 + area), stays below 1 at any
    distance. Occlusion is ignored. The inner loop runs over independent receivers, so that it is
    vectorised without reordering a sum.
    """
    inv_wavelength = np.float32(1.0 / wavelength)
    pi = np.float32(np.pi)
    half, zero = np.float32(0.5), np.float32(0.0)
    x, y, z = receivers[0], receivers[1], receivers[2]
    u, v, w = receivers[3], receivers[4], receivers[5]
    real, imaginary = out[0], out[1]
    for s in range(start, stop):
        sx, sy, sz = sources[s, 0], sources[s, 1], sources[s, 2]
        su, sv, sw = sources[s, 3], sources[s, 4], sources[s, 5]
        area = sources[s, 6]
        a = sources[s, 7] * area
        b = sources[s, 8] * area
        for r in range(x.size):
            dx = x[r] - sx
            dy = y[r] - sy
            dz = z[r] - sz
            d2 = dx * dx + dy * dy + dz * dz + np.float32(1e-12)
            leaving = su * dx + sv * dy + sw * dz
            arriving = -(u[r] * dx + v[r] * dy + w[r] * dz)
            leaving = leaving if leaving > zero else zero
            arriving = arriving if arriving > zero else zero
            factor = leaving * arriving / (d2 * (pi * d2 + area))
            t = np.sqrt(d2) * inv_wavelength
            t = t - np.floor(t + half)
            t2 = t * t
            cosine = _C0 + t2 * (_C1 + t2 * (_C2 + t2 * (_C3 + t2 * (_C4 + t2 * _C5))))
            sine = t * (_S0 + t2 * (_S1 + t2 * (_S2 + t2 * (_S3 + t2 * (_S4 + t2 * _S5)))))
            real[r] += factor * (a * cosine - b * sine)
            imaginary[r] += factor * (a * sine + b * cosine)


@kernel
def upsample_correction(
    nodes: Float64,
    bias: Float64,
    amplitude_factor: Float64,
    z: Float32,
    rays: Float32,
    step: int,
    tolerance: float,
    start: int,
    stop: int,
    z_out: Float32,
    factor_out: Float32,
) -> None:
    """Upsample the nodes' correction to the pixels of rows start..stop, preserving edges.

    A pixel gets the mean of the four surrounding nodes, weighted by their distance in the image and
    by the distance of the pixel, corrected like the node, from the node's plane.

    Parameters
    ----------
    nodes, bias, amplitude_factor
        (Hn, Wn, COLUMNS); (Hn, Wn) bias of the radial range in m; (Hn, Wn) factor by which indirect
        light has raised the amplitude.
    z, rays
        (H, W) measured depth in m, (H, W, 2) x/z and y/z.
    step
        Pixels between nodes.
    tolerance
        Scale of the distance from a plane, as a fraction of the depth.
    z_out, factor_out
        (H, W) written: corrected z in m (0 where invalid), and factor.
    """
    rows, columns = nodes.shape[:2]
    for i in range(start, stop):
        fi = (i + 0.5) / step - 0.5
        for j in range(z.shape[1]):
            d = z[i, j]
            z_out[i, j] = d
            factor_out[i, j] = 1.0
            if not d > 0:
                continue
            fj = (j + 0.5) / step - 0.5
            i0 = int(np.floor(fi))
            j0 = int(np.floor(fj))
            x = np.float64(rays[i, j, 0])
            y = np.float64(rays[i, j, 1])
            length = np.sqrt(1.0 + x * x + y * y)
            weight_sum = bias_sum = factor_sum = 0.0
            for p in range(max(i0, 0), min(i0 + 2, rows)):
                for q in range(max(j0, 0), min(j0 + 2, columns)):
                    if nodes[p, q, W] <= 0:
                        continue
                    # Depth of the pixel if it belongs to this node's surface.
                    corrected_z = d - bias[p, q] / length
                    deviation = (
                        nodes[p, q, A] * x + nodes[p, q, B] * y + nodes[p, q, C]
                    ) * corrected_z - 1.0
                    deviation = deviation / tolerance
                    similarity = 1.0 / (1.0 + deviation * deviation)
                    bilinear = (1.0 - abs(p - fi)) * (1.0 - abs(q - fj)) + 1e-3
                    weight = bilinear * similarity * similarity
                    weight_sum += weight
                    bias_sum += weight * bias[p, q]
                    factor_sum += weight * amplitude_factor[p, q]
            if weight_sum > 0:
                z_out[i, j] = d - bias_sum / weight_sum / length
                factor_out[i, j] = factor_sum / weight_sum


@kernel
def flat_nodes(nodes: Float64, radius: int, limit: float, tolerance: float) -> float:
    """Return a robust count of the nodes that lie on a common plane with their surroundings.

    The surroundings of every other node are the nodes of the window whose normal is within 25
    degrees of its own, and whose distance from its plane is below `limit` times the depth. A node
    whose distance from the plane fitted to all of them is x, in units of `tolerance` times the
    depth, counts ``1 / (1 + x^2)``.
    """
    rows, columns = nodes.shape[:2]
    size = (2 * radius + 1) ** 2
    members = np.empty((size, 2), np.int64)
    count = 0.0
    for i in range(0, rows, 2):
        for j in range(0, columns, 2):
            a, b, c = nodes[i, j, A], nodes[i, j, B], nodes[i, j, C]
            length2 = a * a + b * b + c * c
            if length2 == 0.0:
                continue
            n = 0
            mx = my = mw = 0.0
            for p in range(max(i - radius, 0), min(i + radius + 1, rows)):
                for q in range(max(j - radius, 0), min(j + radius + 1, columns)):
                    e, f, g = nodes[p, q, A], nodes[p, q, B], nodes[p, q, C]
                    other2 = e * e + f * f + g * g
                    dot = a * e + b * f + c * g
                    if dot <= 0 or dot * dot < 0.82 * length2 * other2:
                        continue
                    w = nodes[p, q, W]
                    if abs(a * nodes[p, q, X] + b * nodes[p, q, Y] + c - w) > limit * w:
                        continue
                    members[n, 0], members[n, 1] = p, q
                    n += 1
                    mx += nodes[p, q, X]
                    my += nodes[p, q, Y]
                    mw += w
            if 3 * n < size:
                continue
            mx, my, mw = mx / n, my / n, mw / n
            xx = xy = yy = xw = yw = 0.0
            for m in range(n):
                p, q = members[m, 0], members[m, 1]
                x, y, w = nodes[p, q, X] - mx, nodes[p, q, Y] - my, nodes[p, q, W] - mw
                xx += x * x
                xy += x * y
                yy += y * y
                xw += x * w
                yw += y * w
            det = xx * yy - xy * xy
            if not det > 1e-6 * xx * yy:
                continue
            aw, bw = (yy * xw - xy * yw) / det, (xx * yw - xy * xw) / det
            for m in range(n):
                p, q = members[m, 0], members[m, 1]
                x, y, w = nodes[p, q, X] - mx, nodes[p, q, Y] - my, nodes[p, q, W] - mw
                deviation = (w - aw * x - bw * y) / (mw * tolerance)
                count += 1.0 / (1.0 + deviation * deviation)
    return count
