"""Multipath: the light that surfaces reflect onto each other, and the range bias it causes.

The lamp is at the camera and illuminates about its field of view, so the reflecting surfaces are
the measured ones (Fuchs 2010; Jimenez et al. 2012). A pixel measures ``M = D (1 + I / D)``: the
direct light D, and the indirect light I, which arrives on longer paths with a larger phase. The
angle of ``1 + I / D`` is the bias of the phase.

I is the sum over the other surfaces q of ``F L_q exp(i k d)``, with the form factor F, the
radiosity L_q of q, and the distance d from q to the pixel's surface. L_q is the measured light of q
without its own I ("one" bounce), or all of it, which includes all further bounces ("all").

Amplitude is light times the gain of the camera: the counts of a white wall at 1 m. The gain is
given, or estimated by `GainEstimator`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial
from typing import Literal

import numpy as np

from tofuse.engine.arrays import Complex128, Float32, Float64
from tofuse.engine.compute import run_all, run_chunks
from tofuse.engine.sensor import multipath_kernels as kernels
from tofuse.engine.sensor.multipath_kernels import W, X, Y
from tofuse.engine.sensor.multipath_surfaces import (
    OffscreenCells,
    ReflectorMap,
    Surfaces,
    block_nodes,
    fit_planes,
    ray_ranges,
    visible_sources,
)

Bounces = Literal["one", "all"]

# Relative distance from a plane at which a pixel no longer belongs to it.
_PLANE_TOLERANCE = 0.03
# Upper limit of the ratio of indirect to direct light.
_MAX_RATIO = 1.0


@dataclass(frozen=True, eq=False)
class ToFImage:
    """Depth and raw amplitude of a camera with one modulation frequency.

    Attributes
    ----------
    z
        (H, W) float32 z depth in m, 0 where invalid.
    rays
        (H, W, 2) float32 x/z and y/z of the pixels; may be NaN where z is 0.
    amplitude
        (H, W) float32 raw amplitude in counts, not range-compensated; 0 where invalid.
    period_m
        Ambiguity range, c / (2 f).
    """

    z: Float32
    rays: Float32
    amplitude: Float32
    period_m: float


@dataclass(frozen=True, eq=False)
class MultipathEstimate:
    """Effect of multipath on an image.

    Attributes
    ----------
    z
        (H, W) float32 corrected z depth in m; 0 where invalid.
    factor
        (H, W) float32 by which multipath has raised the amplitude; 1 where unknown.
    surfaces
        The reflecting surfaces, at the nodes of a grid of blocks of `step` pixels.
    step
        Side of a block in pixels.
    """

    z: Float32
    factor: Float32
    surfaces: Surfaces
    step: int


@dataclass(frozen=True)
class MultipathModel:
    """Computation of multipath in an image.

    Attributes
    ----------
    columns
        Blocks of pixels along the image's width for which multipath is computed.
    iterations
        Number of fixed-point iterations of multipath and surfaces.
    lamp
        Illumination angle relative to that of the image's corner.
    bounces
        "one" or "all", see above.
    """

    columns: int = 44
    iterations: int = 3
    lamp: float = 1.2
    bounces: Bounces = "one"

    def solve(
        self,
        image: ToFImage,
        gain: float,
        reflectors: ReflectorMap | None = None,
        T_world_camera: Float64 | None = None,
    ) -> MultipathEstimate | None:
        """Compute the multipath in an image; None without surfaces.

        Parameters
        ----------
        image
            Depth and raw amplitude.
        gain
            Raw amplitude, in counts, of a white wall (albedo 1) at 1 m on the optical axis.
        reflectors
            Surfaces outside the image, measured by earlier views.
        T_world_camera
            (4, 4) pose of the camera in the frame of `reflectors`, which are unused without it.
        """
        step = self._step(image)
        nodes = block_nodes(image.z, image.rays, image.amplitude, step)
        offscreen = OffscreenCells.of(image.rays, self.lamp)
        if reflectors is not None and T_world_camera is not None:
            offscreen.add_reflectors(reflectors, T_world_camera)
        solution = self._at_nodes(nodes, image.period_m, gain, offscreen, at_edges=True)
        if solution is None:
            return None
        shift, ratio, surfaces = solution
        z, factor = np.empty_like(image.z), np.empty_like(image.z)
        factors = np.abs(1 + ratio)
        run_chunks(
            lambda a, b: kernels.upsample_correction(
                nodes, shift, factors, image.z, image.rays, step, _PLANE_TOLERANCE, a, b, z, factor
            ),
            len(z),
        )
        return MultipathEstimate(z, factor, surfaces, step)

    def bright_albedo(self, image: ToFImage) -> float:
        """Return the 90 % quantile of albedo in counts (facing the camera at 1 m); 0 if unknown."""
        nodes = block_nodes(image.z, image.rays, image.amplitude, self._step(image))
        fit_planes(nodes)
        return Surfaces.of(nodes, np.ones(nodes.shape[:2])).bright_albedo()

    def flatness(self, image: ToFImage, gain: float) -> float:
        """Return the number of coplanar nodes after correction with a gain.

        Parameters
        ----------
        image
            Depth and raw amplitude.
        gain
            See `solve`.
        """
        nodes = block_nodes(image.z, image.rays, image.amplitude, self._step(image))
        measured = ray_ranges(nodes)
        offscreen = OffscreenCells.of(image.rays, self.lamp)
        solution = self._at_nodes(nodes, image.period_m, gain, offscreen, at_edges=False)
        if solution is None:
            return 0.0
        _correct(nodes, measured, solution[0])
        fit_planes(nodes)
        return kernels.flat_nodes(nodes, 4, 0.1, 0.003)

    def _step(self, image: ToFImage) -> int:
        return max(1, round(image.z.shape[1] / self.columns))

    def _at_nodes(
        self,
        nodes: Float64,
        period_m: float,
        gain: float,
        offscreen: OffscreenCells,
        *,
        at_edges: bool,
    ) -> tuple[Float64, Complex128, Surfaces] | None:
        """Return bias of the range (Hn, Wn) in m, I / D (Hn, Wn), and the surfaces.

        Fits planes to the corrected nodes, and sets their `W` to the corrected inverse depth of the
        last iteration but one. `at_edges`: nodes next to an edge are compared with planes after
        correction by the bias of these planes, which is more accurate, but makes surfaces flat with
        any gain.
        """
        k = np.pi / period_m
        valid = nodes[..., W] > 0
        measured = ray_ranges(nodes)
        shift = np.zeros(valid.shape)
        ratio = np.zeros(valid.shape, complex)
        for _ in range(self.iterations):
            _correct(nodes, measured, shift)
            if at_edges:
                fit_planes(nodes, measured, shift)
            else:
                fit_planes(nodes)
            surfaces = Surfaces.of(nodes, np.abs(1 + ratio))
            if not (surfaces.has_plane & (surfaces.albedo > 0)).any():
                return None
            # The measured phase is that of the round trip; light leaves the surface halfway.
            phase = 2 * k * measured - k * surfaces.range_m
            radiosity = surfaces.radiosity / gain * np.exp(1j * phase)
            if self.bounces == "one":
                radiosity /= 1 + ratio
            sources = np.concatenate(
                [visible_sources(surfaces, radiosity), offscreen.sources(surfaces, gain, k)]
            )
            ratio = _indirect_ratio(surfaces, sources, k)
            shift = np.minimum(np.angle(1 + ratio) / (2 * k), measured / 2)
        return shift, ratio, surfaces


def _correct(nodes: Float64, measured: Float64, shift: Float64) -> None:
    """Set the nodes' inverse depth to that of the measured radial range minus its bias."""
    valid = measured > 0
    length = np.sqrt(1 + nodes[..., X] ** 2 + nodes[..., Y] ** 2)
    nodes[..., W] = np.where(valid, length / np.where(valid, measured - shift, 1), 0)


def _indirect_ratio(surfaces: Surfaces, sources: Float32, wave_number: float) -> Complex128:
    """Return I / D (Hn, Wn) at the nodes due to the sources (S, 9); 0 where no plane fits."""
    has_plane = surfaces.has_plane
    receivers = np.ascontiguousarray(
        np.concatenate([surfaces.points[has_plane], surfaces.normals[has_plane]], 1).T, np.float32
    )

    def chunk(a: int, b: int) -> Float32:
        out = np.zeros((2, receivers.shape[1]), np.float32)
        kernels.add_irradiance(sources, a, b, receivers, 2 * np.pi / wave_number, out)
        return out

    total = np.sum(run_chunks(chunk, len(sources), chunks=4), axis=0, dtype=float)
    light = (total[0] + 1j * total[1]) * np.exp(-1j * wave_number * surfaces.range_m[has_plane])
    ratio = np.zeros(has_plane.shape, complex)
    ratio[has_plane] = light / surfaces.irradiance[has_plane]
    ratio /= np.maximum(1, np.abs(ratio) / _MAX_RATIO)
    return ratio


@dataclass
class GainEstimator:
    """Estimates the gain of the camera from its images.

    Multipath bends flat surfaces near concave edges. Each image is corrected with several gains,
    and the coplanar nodes are counted for each; counts are summed over images. The prior albedo of
    the brightest tenth of the surfaces is 0.7, with a standard deviation of 40 %.

    Attributes
    ----------
    model
        The multipath model; the estimate uses half as many columns.
    """

    model: MultipathModel
    _gains: Float64 = field(default_factory=lambda: np.zeros(0))
    _flat: Float64 = field(default_factory=lambda: np.zeros(0))
    _bright: list[float] = field(default_factory=list)
    _frames: int = 0

    ALBEDO = 0.7
    SPREAD = 0.4
    # Weight of a coplanar node, below 1 as neighbouring nodes and similar images are correlated.
    TRUST = 0.05
    # The first images are all used, then every n-th one, up to a maximum number.
    FIRST, EVERY, MAX_IMAGES = 4, 8, 40

    @property
    def gain(self) -> float | None:
        """Current estimate; None before the first image with surfaces."""
        if not self._bright:
            return None
        log = np.log(self._gains)
        bright = float(np.mean(np.log(self._bright)))
        prior = (bright - log - np.log(self.ALBEDO)) / self.SPREAD
        score = self.TRUST * self._flat - 0.5 * prior**2
        weight = np.exp(score - score.max())
        return float(np.exp((weight * log).sum() / weight.sum()))

    def add(self, image: ToFImage) -> None:
        """Use the next image of a recording, or skip it."""
        index = self._frames
        self._frames += 1
        if len(self._bright) >= self.MAX_IMAGES or (index >= self.FIRST and index % self.EVERY):
            return
        coarse = replace(self.model, columns=max(8, self.model.columns // 2))
        bright = coarse.bright_albedo(image)
        if not bright > 0:
            return
        if not self._bright:
            # For albedos of the brightest surfaces from 1.4 (beyond the physical limit) to 0.12.
            self._gains = bright / np.geomspace(1.4, 0.12, 9)
            self._flat = np.zeros(len(self._gains))
        self._bright.append(bright)
        self._flat += run_all([partial(coarse.flatness, image, float(g)) for g in self._gains])
