"""The light that visible surfaces reflect onto each other, and the range bias that it makes.

The lamp sits at the camera and lights about what the camera sees, so the surfaces that reflect
light onto each other are those that it measures (Fuchs 2010; Jimenez et al. 2012). A pixel's
measured light is ``M = D (1 + I / D)``: its own, D, and what came by way of other surfaces, I,
with a longer path and so a later phase. The angle of ``1 + I / D`` is the bias of its phase.

I is the sum over all other surfaces q of ``F M_q exp(i k d)``: what q was measured to send out,
delayed by the way from q to p, times the form factor F. As M_q holds all light that q sends out,
its share of indirect light included, bounces of every order are in I.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tofuse.kernels import multipath as kernels
from tofuse.kernels.multipath import AREA, COLUMNS, LIGHT, A, B, C, W, X, Y
from tofuse.kernels.threads import run_chunks

Float32 = NDArray[np.float32]
Float64 = NDArray[np.float64]
Complex = NDArray[np.complex128]
Bool = NDArray[np.bool_]

# Depths of a block further than this share from its median are another surface.
_JUMP = 0.03
# A plane fits where the misfit is below this share of the depth.
_FLAT = 0.006
# Slanter surfaces' own light is too weak and too uncertain to divide by.
_LEAST_COSINE = 0.12
# No pixel gets more indirect light than this share of its direct light.
_MOST = 1.0
_BRIGHT_ALBEDO, _ALBEDO_SPREAD = 0.7, 0.4
_LEAST_SCALE, _MOST_SCALE = 0.1, 1.6


@dataclass(frozen=True, eq=False)
class Interference:
    """What indirect light does to an image.

    Attributes
    ----------
    z
        (H, W) float32 z depth in m without it, 0 where invalid.
    factor
        (H, W) float32 by which the amplitude is too strong.
    gain
        Counts of raw amplitude of a white wall (albedo 1) at 1 m, as given or as estimated.
    """

    z: Float32
    factor: Float32
    gain: float


@dataclass(frozen=True)
class Reflections:
    """How the indirect light of an image is computed.

    Attributes
    ----------
    gain
        Counts of raw amplitude (falloff divided out) of a white wall at 1 m; None: estimated in
        each image.
    step
        Pixels along a side of a block.
    iterations
        Times the geometry is corrected and the light computed again.
    lamp
        Angle up to which the lamp lights, relative to that of the image's corner. Surfaces beyond
        the image's border are taken to go on as planes.
    falloff
        Light in a pixel falls as the cosine of its angle to the axis to this power, lens and lamp
        half each.
    """

    gain: float | None = None
    step: int = 4
    iterations: int = 2
    lamp: float = 1.2
    falloff: float = 4.0

    def solve(
        self, z: Float32, rays: Float32, light: Float32, period_m: float
    ) -> Interference | None:
        """Find the indirect light in an image.

        Parameters
        ----------
        z
            (H, W) z depth in m, 0 where invalid.
        rays
            (H, W, 2) of the pixels, x/z and y/z.
        light
            (H, W) raw amplitude in counts; 0 where there is none.
        period_m
            Range after which the phase repeats, c / (2 f).

        Returns
        -------
        None where there is nothing to compute with: no light, no surfaces.
        """
        nodes = self._nodes(z, rays, light)
        seen = nodes[..., W] > 0
        length = np.sqrt(1 + nodes[..., X] ** 2 + nodes[..., Y] ** 2)
        w_measured = nodes[..., W].copy()
        r_measured = np.where(seen, length / np.where(seen, w_measured, 1), 0)
        shift = np.zeros(seen.shape)
        ratio = np.zeros(seen.shape, complex)
        gain = self.gain
        for _ in range(self.iterations):
            nodes[..., W] = np.where(seen, length / np.where(seen, r_measured - shift, 1), 0)
            self._fit(nodes)
            surfaces = _Surfaces.of(nodes, self.falloff)
            if not surfaces.good.any() or not (surfaces.albedo[surfaces.good] > 0).any():
                return None
            bright = self.gain or surfaces.bright() / _BRIGHT_ALBEDO
            unit = self._ratio(surfaces, r_measured, period_m, bright)
            scale = 1.0
            if self.gain is None:
                scale = _unbending(nodes, w_measured, r_measured, length, unit, period_m)
            ratio = scale * unit
            gain = bright / scale
            shift = _bias(ratio, period_m)
        assert gain is not None
        nodes[..., W] = w_measured
        z_out, factor = np.empty_like(z), np.empty_like(z)
        over = np.abs(1 + ratio)
        # Pixels are compared with planes as measured, which the correction moves.
        run_chunks(
            lambda a, b: kernels.spread(
                nodes, shift, over, z, rays, self.step, 0.03, a, b, z_out, factor
            ),
            len(z),
        )
        return Interference(z_out, factor, gain)

    def _nodes(self, z: Float32, rays: Float32, light: Float32) -> Float64:
        size = -(-z.shape[0] // self.step), -(-z.shape[1] // self.step)
        nodes = np.empty((*size, COLUMNS))
        kernels.block_means(z, rays, light, self.step, _JUMP, nodes)
        return nodes

    def _fit(self, nodes: Float64) -> None:
        nodes[..., A:] = 0
        planes = np.zeros((*nodes.shape[:2], 4))
        for radius in (2, 1):
            kernels.window_planes(nodes, radius, planes)
            kernels.choose_planes(nodes, planes, radius, _FLAT)

    def _ratio(
        self, surfaces: _Surfaces, r_measured: Float64, period_m: float, gain: float
    ) -> Complex:
        """I / D (Hn, Wn) at the nodes, 0 where no plane fits."""
        k = np.pi / period_m
        phase = 2 * k * r_measured - k * surfaces.range_m
        sources = np.concatenate(
            [merged(surfaces, phase, gain), beyond(surfaces, self.lamp, gain, k)]
        )
        good = surfaces.good
        receivers = np.ascontiguousarray(
            np.concatenate([surfaces.points[good], surfaces.normals[good]], 1).T, np.float32
        )
        parts = run_chunks(
            lambda a, b: _arriving(sources, a, b, receivers, 2 * period_m), len(sources), chunks=4
        )
        total = np.sum(parts, axis=0, dtype=float)
        arriving = (total[0] + 1j * total[1]) * np.exp(-1j * k * surfaces.range_m[good])
        ratio = np.zeros(good.shape, complex)
        ratio[good] = arriving / surfaces.lit[good]
        return ratio


@dataclass(frozen=True, eq=False)
class _Surfaces:
    """Geometry and light at the nodes, all (Hn, Wn, ...); `good` where a plane fits.

    `lit` is the lamp's light on the surface, relative to that head-on at 1 m on the axis;
    `radiosity` what the surface sends out and `albedo` their quotient, both in counts.
    """

    nodes: Float64
    good: Bool
    points: Float64
    normals: Float64
    range_m: Float64
    area: Float64
    lit: Float64
    radiosity: Float64
    albedo: Float64

    @classmethod
    def of(cls, nodes: Float64, falloff: float) -> _Surfaces:
        x, y = nodes[..., X], nodes[..., Y]
        slope = np.sqrt((nodes[..., A:] ** 2).sum(-1))
        w = nodes[..., A] * x + nodes[..., B] * y + nodes[..., C]
        good = (nodes[..., W] > 0) & (slope > 0) & (w > 0)
        w, slope = np.where(good, w, 1), np.where(good, slope, 1)
        length = np.sqrt(1 + x * x + y * y)
        cosine = np.clip(w / (slope * length), _LEAST_COSINE, 1)
        r = length / w
        points = np.stack([x / w, y / w, 1 / w], -1)
        normals = -nodes[..., A:] / slope[..., None]
        half = length ** (-falloff / 2)
        radiosity = nodes[..., LIGHT] / half
        lit = half * cosine / r**2
        area = nodes[..., AREA] / (w * w * length * cosine)
        return cls(nodes, good, points, normals, r, area, lit, radiosity, radiosity / lit)

    def bright(self) -> float:
        """Albedo in counts of the brightest tenth of the surface, weighted by its area."""
        pick = self.good & (self.albedo > 0)
        albedo, area = self.albedo[pick], self.area[pick]
        order = np.argsort(albedo, kind="stable")
        share = np.cumsum(area[order])
        return float(albedo[order][np.searchsorted(share, 0.9 * share[-1])])


def _arriving(
    sources: Float32, start: int, stop: int, receivers: Float32, wavelength: float
) -> Float32:
    out = np.zeros((2, receivers.shape[1]), np.float32)
    kernels.exchange(sources, start, stop, receivers, wavelength, out)
    return out


def merged(surfaces: _Surfaces, phase: Float64, gain: float) -> Float32:
    """Sources (S, 9) as `kernels.exchange` takes them: four nodes as one where they are alike."""
    rows, columns = (n // 2 * 2 for n in surfaces.good.shape)

    def fours(array: NDArray[np.generic]) -> NDArray[np.generic]:
        rest = array.shape[2:]
        blocks = array[:rows, :columns].reshape(rows // 2, 2, columns // 2, 2, *rest)
        return np.moveaxis(blocks, 2, 1).reshape(-1, 4, *rest)

    size = surfaces.good.shape
    weight = np.where(surfaces.good, surfaces.area * surfaces.radiosity / gain, 0)
    table = np.concatenate(
        [
            surfaces.points,
            surfaces.normals,
            np.where(surfaces.good, surfaces.area, 0)[..., None],
            (weight * np.cos(phase))[..., None],
            (weight * np.sin(phase))[..., None],
            weight[..., None],
        ],
        -1,
    )
    groups = np.asarray(fours(table), float)
    lead = groups[np.arange(len(groups)), groups[..., 9].argmax(1)]
    step = groups[..., :3] - lead[:, None, :3]
    alike = np.einsum("gmc,gc->gm", groups[..., 3:6], lead[:, 3:6]) > 0.97
    off = np.abs(np.einsum("gmc,gc->gm", step, lead[:, 3:6]))
    alike &= off < 0.02 * np.linalg.norm(lead[:, :3], axis=1)[:, None]
    alike &= groups[..., 9] > 0
    w = np.where(alike, groups[..., 9], 0)
    total = w.sum(1)
    whole = total > 0
    safe = np.where(whole, total, 1)[:, None]
    ones = np.concatenate(
        [
            np.einsum("gm,gmc->gc", w, groups[..., :6]) / safe,
            np.where(alike[..., None], groups[..., 6:9], 0).sum(1),
        ],
        1,
    )[whole]
    rest = groups[(groups[..., 9] > 0) & ~alike][:, :9]
    edge = np.zeros(size, bool)
    edge[rows:], edge[:, columns:] = True, True
    last = table[edge & (weight > 0)][:, :9]
    out = np.concatenate([ones, rest, last])
    out[:, 3:6] /= np.linalg.norm(out[:, 3:6], axis=1, keepdims=True)
    out[:, 7:9] /= out[:, 6:7]
    return out.astype(np.float32)


def beyond(surfaces: _Surfaces, lamp: float, gain: float, k: float) -> Float32:
    """Sources (S, 9) outside the image that the lamp still lights.

    The plane of the nearest node inside is taken to go on there, with its albedo.
    """
    x, y = surfaces.nodes[..., X], surfaces.nodes[..., Y]
    inside = surfaces.nodes[..., W] > 0
    box = x[inside].min(), x[inside].max(), y[inside].min(), y[inside].max()
    corner = np.arctan(np.sqrt((x[inside] ** 2 + y[inside] ** 2).max()))
    limit = np.tan(min(lamp * corner, np.pi / 3))
    # A fixed number of blocks along the image's width.
    pitch = (box[1] - box[0]) / 12
    ring = surfaces.good & (surfaces.albedo > 0)
    if pitch <= 0 or limit <= np.tan(corner) * 0.5 or not ring.any():
        return np.zeros((0, 9), np.float32)
    grid = np.arange(-limit, limit + pitch, pitch)
    gx, gy = (g.ravel() for g in np.meshgrid(grid, grid))
    outside = (gx < box[0] - pitch / 2) | (gx > box[1] + pitch / 2)
    outside |= (gy < box[2] - pitch / 2) | (gy > box[3] + pitch / 2)
    outside &= gx**2 + gy**2 < limit**2
    gx, gy = gx[outside], gy[outside]
    border = np.zeros(ring.shape, bool)
    border[:3], border[-3:], border[:, :3], border[:, -3:] = True, True, True, True
    chosen = np.flatnonzero(ring & border)
    if len(chosen) == 0:
        return np.zeros((0, 9), np.float32)
    nodes = surfaces.nodes.reshape(-1, COLUMNS)[chosen]
    away = (gx[:, None] - nodes[:, X]) ** 2 + (gy[:, None] - nodes[:, Y]) ** 2
    near = away.argmin(1)
    node = nodes[near]
    w = node[:, A] * gx + node[:, B] * gy + node[:, C]
    here = node[:, A] * node[:, X] + node[:, B] * node[:, Y] + node[:, C]
    fine = (w > 0.3 * here) & (w < 3 * here)
    w, gx, gy = w[fine], gx[fine], gy[fine]
    chosen = chosen[near[fine]]
    normals = surfaces.normals.reshape(-1, 3)[chosen]
    points = np.stack([gx, gy, np.ones_like(gx)], -1) / w[:, None]
    r = np.linalg.norm(points, axis=1)
    cosine = np.clip(-(normals * points).sum(1) / r, _LEAST_COSINE, 1)
    length = r * w
    albedo = surfaces.albedo.reshape(-1)[chosen] / gain
    radiosity = albedo * cosine / (r * length) ** 2
    area = pitch**2 / (w * w * length * cosine)
    out = np.concatenate(
        [
            points,
            normals,
            np.stack([area, radiosity * np.cos(k * r), radiosity * np.sin(k * r)], -1),
        ],
        1,
    )
    return out.astype(np.float32)


def _bias(ratio: Complex, period_m: float) -> Float64:
    """Bias of the radial range in m of a ratio of indirect to direct light."""
    return np.angle(1 + ratio) / (2 * np.pi) * period_m


def _unbending(
    nodes: Float64,
    w: Float64,
    r: Float64,
    length: Float64,
    ratio: Complex,
    period_m: float,
) -> float:
    """Find the factor on the ratio that makes surfaces flattest.

    Indirect light bends flat surfaces towards edges. The factor that unbends them is found by
    least squares with heavy tails, together with the expectation that the brightest tenth of the
    surface has an albedo of 0.7, good to 40 %.
    """
    measured = nodes.copy()
    measured[..., W] = w
    rows = np.empty((30_000, 2))
    scale = 1.0
    for _ in range(2):
        shift = _bias(scale * ratio, period_m)
        change = np.where(w > 0, length / np.where(w > 0, r - shift, 1) - w, 0) / scale
        count = kernels.bends(measured, change, 5, 4, 0.06, rows)
        if count < 500:
            return 1.0
        e, h = rows[:count, 0], rows[:count, 1]
        for _ in range(3):
            left = e + scale * h
            sigma = max(1.5 * float(np.median(np.abs(left))), 1e-5)
            weight = 1 / (1 + (left / (2 * sigma)) ** 2) ** 2
            # Each node is in about seven windows.
            information = (weight * h * h).sum() / sigma**2 / 7
            wanted = -(weight * e * h).sum() / sigma**2 / 7
            prior = 1 / _ALBEDO_SPREAD**2
            scale = float((wanted + prior) / (information + prior))
            scale = min(max(scale, _LEAST_SCALE), _MOST_SCALE)
    return scale
