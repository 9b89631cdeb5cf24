"""Global registration of clouds by matching fast point feature histograms."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from tofuse.engine.alignment import Registrar, Registration
from tofuse.engine.arrays import Float64
from tofuse.engine.bounds import Bounded, Bounds
from tofuse.engine.clouds import fpfh
from tofuse.engine.frames import Frame
from tofuse.engine.icp import CoarseToFine
from tofuse.engine.parts import part
from tofuse.lab.methods.sample_consensus import Method, SampleOptions, registration_of


@part("registration", "fpfh")
@dataclass(frozen=True)
class Fpfh(Bounded, Registrar):
    """Fast point feature histograms (Rusu et al. 2009) with robust consensus of the matches.

    Of the poses that matches agree on (`clouds.fpfh.candidates`) the one under which most
    points of the source fit is chosen and refined. The guess is not used.

    Attributes
    ----------
    points
        Maximum number of points of each averaged view.
    reach
        Radius of the histograms' neighbourhood, in resolutions of the averaged views.
    neighbours
        Points of each plane fit.
    signed
        Whether the orientation of the normals is known. Arrays of points are assumed to be seen
        from their origin.
    method
        Consensus: "samples", RANSAC; "compatible", second-order compatibility.
    inliers
        Minimum number of inliers.
    seeds
        Number of the best-connected matches that propose motions, if "compatible".
    refine
        Whether the pose is refined by generalised ICP (`CoarseToFine`, starting at the resolution
        of the averaged views); else it is that of the matches.
    """

    points: Annotated[int, Bounds(20, 20_000)] = fpfh.POINTS
    reach: Annotated[float, Bounds(1, 100)] = fpfh.REACH
    neighbours: Annotated[int, Bounds(4, 1000)] = fpfh.FPFH_NEIGHBOURS
    signed: bool = False
    method: Method = "compatible"
    inliers: int = 6
    seeds: int = 100
    refine: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        self._consensus()

    def _consensus(self) -> SampleOptions:
        return SampleOptions(method=self.method, inliers=self.inliers, seeds=self.seeds)

    def register(
        self, source: Frame, target: Frame, guess: Float64, rng: np.random.Generator
    ) -> Registration:
        """See `Registrar.register`; without `refine` its points are the matches.

        `margin` is the lead in the fraction of the averaged points that fit.

        Raises
        ------
        RegistrationError
            If too few matches agree on a motion, or, once refined, too few points correspond.
        """
        options = self._consensus()
        found = fpfh.candidates(
            source,
            target,
            points=self.points,
            reach=self.reach,
            neighbours=self.neighbours,
            signed=self.signed,
            options=options,
            motions=options.motions(rng),
        )
        best = found.poses[0]
        rival = found.poses[1].inlier_ratio if len(found.poses) > 1 else 0.0
        coarse = registration_of(found.pair.pairs, best.consensus, best.inlier_ratio - rival)
        if not self.refine:
            return coarse
        refinement = CoarseToFine(coarsest=found.pair.size)
        refined = refinement.register(source, target, best.T_target_source, rng)
        return replace(refined, margin=coarse.margin)
