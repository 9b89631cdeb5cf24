"""The named configurations, each readable from top to bottom."""

from __future__ import annotations

from dataclasses import replace

from tofuse.corrections.multipath import Multipath
from tofuse.corrections.noise import Noise
from tofuse.filters.angle import NeighbourhoodAngle
from tofuse.filters.confidence import Confidence
from tofuse.filters.neighbours import NeighbourShare
from tofuse.filters.wrapped import Wrapped
from tofuse.fusion.options import Fusion
from tofuse.odometry.keyframes import Keyframes
from tofuse.odometry.pairwise import Pairwise
from tofuse.odometry.sequential import Sequential
from tofuse.pipeline.config import Config, ViewKind
from tofuse.posegraph.castellani import Castellani
from tofuse.posegraph.external_sensors import GravityEdges
from tofuse.posegraph.levenberg import LevenbergMarquardt
from tofuse.posegraph.loops import Confirmation
from tofuse.posegraph.nearby import Nearby
from tofuse.posegraph.plane_refinement import Planes
from tofuse.posegraph.refinement import Joint
from tofuse.posegraph.revisits import Revisits
from tofuse.registration.any_pair import AnyPair
from tofuse.registration.icp import algorithm_1


def thesis(kind: ViewKind) -> Config:
    """Return the method of the thesis: chapter 3, with the settings of chapter 4.

    Sequential point-to-point ICP on 1000 random points of each frame, started from the previous
    motion; loops by distance and yaw; Castellani's optimisation.
    """
    icp = algorithm_1(resolution=0.01, points=1000)
    return Config(
        method="thesis",
        filters=(Confidence(minimum=7), NeighbourShare(fraction=0.5, k=3)),
        odometry=Sequential(registration=icp, guess="previous"),
        # Wide, because the trajectory has drifted when a loop closes; strict in what is accepted,
        # because a wrong loop does more harm than a missing one.
        loops=Nearby(
            max_distance_m=1.5,
            max_yaw_rad=0.8,
            min_gap=30,
            per_frame=6,
            confirmation=Confirmation(min_share=0.45),
        ),
        optimiser=Castellani(normalisation="thesis"),
        fusion=Fusion(),
    )


def default(kind: ViewKind) -> Config:
    """Return what `tofuse run` does unless another method is asked for.

    Range images get their noise model and lose multipath, as far as that helps, and are aligned
    with keyframes by planes and albedo; only what goes into the model is filtered further. Places
    that are seen again close loops, and all views are refined together. Clouds are registered in
    pairs, as far as their poses are believed, and moved to the planes that all of them share.
    """
    base = replace(thesis(kind), method="default")
    if kind == "cloud":
        return replace(
            base,
            filters=(),  # where a cloud was seen from shows in how its points are spread
            odometry=Pairwise(),
            loops=Nearby(
                max_distance_m=1.5,
                max_yaw_rad=0.8,
                min_gap=30,
                per_frame=6,
                confirmation=Confirmation(registrations=(AnyPair(),)),
            ),
            refinement=Planes(),
        )
    return replace(
        base,
        corrections=(Noise(), Multipath()),
        # What the camera itself takes for no measurement is none: phones fill gaps in with guesses.
        filters=(Confidence(minimum=1),),
        model_filters=(Wrapped(), Confidence(minimum=3), NeighbourhoodAngle()),
        odometry=Keyframes(),
        loops=Revisits(),
        # Not for clouds: it believes what a registration says of its errors, and ICP's is too good.
        optimiser=LevenbergMarquardt(),
        refinement=Joint(),
        # Odometry only when asked for: a file beside the images may be of anything.
        outside=(GravityEdges(),),
    )
