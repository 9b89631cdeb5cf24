"""The light that visible surfaces reflect onto each other, and the range bias that it makes.

The lamp sits at the camera and lights about what the camera sees, so the surfaces that reflect
light onto each other are those that it measures (Fuchs 2010; Jimenez et al. 2012). What a pixel
measures is ``M = D (1 + I / D)``: its surface's own light D, and the light I that came by way of
other surfaces, on a longer path and so with a later phase. The angle of ``1 + I / D`` is the bias
of the phase.

I is the sum over the other surfaces q of ``F L_q exp(i k d)``: the light L_q that q sends out,
delayed by the way d from q to the pixel's surface, times the form factor F. L_q is the measured
light of q less its own I ("one" bounce), or all of it, in which every further bounce is contained
("all").

The amplitude is the light but for the gain of the camera: the counts of a white wall at 1 m. It
is given, or estimated by `GainEstimator`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from tofuse.arrays import Complex128, Float32, Float64
from tofuse.kernels import multipath as kernels
from tofuse.kernels.multipath import W, X, Y
from tofuse.kernels.threads import run_chunks
from tofuse.sensor.multipath_map import OffscreenCells, ReflectorMap
from tofuse.sensor.multipath_surfaces import (
    Surfaces,
    block_nodes,
    fit_planes,
    ray_ranges,
    visible_sources,
)

Bounces = Literal["one", "all"]

# A pixel this share of its depth off a plane no longer belongs to it.
_OFF_PLANE = 0.03
# Pixels with more indirect light than direct are measured too badly to be saved.
_MAX_RATIO = 1.0


@dataclass(frozen=True, eq=False)
class ToFImage:
    """What is known of an image.

    Attributes
    ----------
    z
        (H, W) float32 z depth in m, 0 where invalid.
    rays
        (H, W, 2) float32 of the pixels, x/z and y/z; may be NaN where z is 0.
    amplitude
        (H, W) float32 raw amplitude in counts, as it fell on the sensor; 0 where there is none.
    period_m
        Range after which the phase repeats, c / (2 f).
    """

    z: Float32
    rays: Float32
    amplitude: Float32
    period_m: float


@dataclass(frozen=True, eq=False)
class MultipathEstimate:
    """What indirect light does to an image.

    Attributes
    ----------
    z
        (H, W) float32 z depth in m without it; 0 where invalid.
    factor
        (H, W) float32 by which it has raised the amplitude; 1 where nothing is known.
    surfaces
        What was found to reflect, at the nodes of a grid of blocks of `step` pixels.
    step
        Side of a block in pixels.
    """

    z: Float32
    factor: Float32
    surfaces: Surfaces
    step: int


@dataclass(frozen=True)
class MultipathModel:
    """How the indirect light of an image is computed.

    Attributes
    ----------
    columns
        Blocks of pixels along the image's width, for which the light is computed.
    iterations
        Times that the light is computed; each time from surfaces corrected by the one before.
    lamp
        Angle up to which the lamp lights, relative to that of the image's corner.
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
        known: ReflectorMap | None = None,
        T_world_camera: Float64 | None = None,
    ) -> MultipathEstimate | None:
        """Find the indirect light in an image; None where there is nothing to compute it from.

        Parameters
        ----------
        gain
            Counts of raw amplitude of a white wall (albedo 1) at 1 m on the axis.
        known
            What is known of the surfaces around the image, as seen by earlier ones.
        T_world_camera
            (4, 4) pose of the camera in the frame of `known`; without it, nothing is known.
        """
        step = self._step(image)
        nodes = block_nodes(image.z, image.rays, image.amplitude, step)
        around = OffscreenCells.of(image.rays, self.lamp)
        if known is not None and T_world_camera is not None:
            around.add_known(known, T_world_camera)
        found = self._at_nodes(nodes, image.period_m, gain, around, at_edges=True)
        if found is None:
            return None
        shift, ratio, surfaces = found
        z, factor = np.empty_like(image.z), np.empty_like(image.z)
        over = np.abs(1 + ratio)
        run_chunks(
            lambda a, b: kernels.upsample_correction(
                nodes, shift, over, image.z, image.rays, step, _OFF_PLANE, a, b, z, factor
            ),
            len(z),
        )
        return MultipathEstimate(z, factor, surfaces, step)

    def bright(self, image: ToFImage) -> float:
        """Counts at 1 m that a tenth of the surfaces exceeds, faced head-on; 0 if none is seen."""
        nodes = block_nodes(image.z, image.rays, image.amplitude, self._step(image))
        fit_planes(nodes)
        return Surfaces.of(nodes, np.ones(nodes.shape[:2])).bright()

    def flatness(self, image: ToFImage, gain: float, window: int = 4) -> float:
        """How flat the surfaces become with a gain: the number of nodes on the plane around them.

        Parameters
        ----------
        window
            Radius in nodes around which planes are fitted.
        """
        nodes = block_nodes(image.z, image.rays, image.amplitude, self._step(image))
        measured = ray_ranges(nodes)
        around = OffscreenCells.of(image.rays, self.lamp)
        found = self._at_nodes(nodes, image.period_m, gain, around, at_edges=False)
        if found is None:
            return 0.0
        _correct(nodes, measured, found[0])
        fit_planes(nodes)
        return kernels.flat_nodes(nodes, window, 0.1, 0.003)

    def _step(self, image: ToFImage) -> int:
        return max(1, round(image.z.shape[1] / self.columns))

    def _at_nodes(
        self,
        nodes: Float64,
        period_m: float,
        gain: float,
        around: OffscreenCells,
        *,
        at_edges: bool,
    ) -> tuple[Float64, Complex128, Surfaces] | None:
        """Bias of the range (Hn, Wn) in m, I / D (Hn, Wn), and the surfaces that they are of.

        Fits planes to the corrected nodes.

        `W` of the nodes is the corrected inverse depth of the last but one iteration. `at_edges`
        says whether nodes next to an edge are compared with planes as those are corrected: that
        is more exact, but makes surfaces look flat with any gain.
        """
        k = np.pi / period_m
        seen = nodes[..., W] > 0
        measured = ray_ranges(nodes)
        shift = np.zeros(seen.shape)
        ratio = np.zeros(seen.shape, complex)
        for _ in range(self.iterations):
            _correct(nodes, measured, shift)
            if at_edges:
                fit_planes(nodes, measured, shift)
            else:
                fit_planes(nodes)
            surfaces = Surfaces.of(nodes, np.abs(1 + ratio))
            if not (surfaces.good & (surfaces.albedo > 0)).any():
                return None
            # Measured there and back; on leaving towards elsewhere the way back is not yet gone.
            phase = 2 * k * measured - k * surfaces.range_m
            radiosity = surfaces.radiosity / gain * np.exp(1j * phase)
            if self.bounces == "one":
                radiosity /= 1 + ratio
            sources = np.concatenate(
                [visible_sources(surfaces, radiosity), around.sources(surfaces, gain, k)]
            )
            ratio = _indirect_ratio(surfaces, sources, k)
            shift = np.minimum(np.angle(1 + ratio) / (2 * k), measured / 2)
        return shift, ratio, surfaces


def _correct(nodes: Float64, measured: Float64, shift: Float64) -> None:
    """Set the nodes' inverse depth to what is measured less the bias of the radial range."""
    seen = measured > 0
    length = np.sqrt(1 + nodes[..., X] ** 2 + nodes[..., Y] ** 2)
    nodes[..., W] = np.where(seen, length / np.where(seen, measured - shift, 1), 0)


def _indirect_ratio(surfaces: Surfaces, sources: Float32, wave_number: float) -> Complex128:
    """I / D (Hn, Wn) at the nodes of the sources' light; 0 where no plane fits."""
    good = surfaces.good
    receivers = np.ascontiguousarray(
        np.concatenate([surfaces.points[good], surfaces.normals[good]], 1).T, np.float32
    )

    def chunk(a: int, b: int) -> Float32:
        out = np.zeros((2, receivers.shape[1]), np.float32)
        kernels.exchange(sources, a, b, receivers, 2 * np.pi / wave_number, out)
        return out

    total = np.sum(run_chunks(chunk, len(sources), chunks=4), axis=0, dtype=float)
    light = (total[0] + 1j * total[1]) * np.exp(-1j * wave_number * surfaces.range_m[good])
    ratio = np.zeros(good.shape, complex)
    ratio[good] = light / surfaces.lit[good]
    ratio /= np.maximum(1, np.abs(ratio) / _MAX_RATIO)
    return ratio


@dataclass
class GainEstimator:
    """Finds the camera's gain from the images, as there is no way to read it off one pixel.

    Indirect light bends flat surfaces towards the edges in which they meet. Each image is corrected
    with several gains, and the number of nodes that come to lie on a plane is counted for each; the
    counts of the images add up. Where nothing bends, the assumption decides that the brightest
    tenth of the surfaces has an albedo of 0.7, give or take 40 %.

    Attributes
    ----------
    reflections
        How the light is computed; the estimate uses half as many columns.
    """

    reflections: MultipathModel
    _gains: Float64 = field(default_factory=lambda: np.zeros(0))
    _flat: Float64 = field(default_factory=lambda: np.zeros(0))
    _bright: list[float] = field(default_factory=list)
    _frames: int = 0

    ALBEDO = 0.7
    SPREAD = 0.4
    # Neighbouring nodes and images of the same view don't count in full.
    TRUST = 0.05
    # So many images are all looked at, then every so manieth, up to so many.
    FIRST, EVERY, MOST = 4, 8, 40

    @property
    def gain(self) -> float | None:
        """The estimate; None before an image with surfaces."""
        if not self._bright:
            return None
        log = np.log(self._gains)
        bright = float(np.mean(np.log(self._bright)))
        prior = (bright - log - np.log(self.ALBEDO)) / self.SPREAD
        score = self.TRUST * self._flat - 0.5 * prior**2
        weight = np.exp(score - score.max())
        return float(np.exp((weight * log).sum() / weight.sum()))

    def add(self, image: ToFImage) -> None:
        """Look at the next image of a recording, or pass it over."""
        turn = self._frames
        self._frames += 1
        if len(self._bright) >= self.MOST or (turn >= self.FIRST and turn % self.EVERY):
            return
        coarse = MultipathModel(
            max(8, self.reflections.columns // 2),
            self.reflections.iterations,
            self.reflections.lamp,
            self.reflections.bounces,
        )
        bright = coarse.bright(image)
        if not bright > 0:
            return
        if not self._bright:
            # Brightest albedos of 1.4 (impossible, to be safe) down to 0.12.
            self._gains = bright / np.geomspace(1.4, 0.12, 9)
            self._flat = np.zeros(len(self._gains))
        self._bright.append(bright)
        self._flat += [coarse.flatness(image, float(g)) for g in self._gains]
