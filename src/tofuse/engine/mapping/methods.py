"""The named configurations, each readable from top to bottom."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any

from tofuse.engine.clouds import AnyPair
from tofuse.engine.errors import InputError
from tofuse.engine.filters import Confidence, NeighbourFraction, NeighbourhoodAngle
from tofuse.engine.fusion import Fusion
from tofuse.engine.graph import castellani, external_sensors, levenberg
from tofuse.engine.icp import algorithm_1
from tofuse.engine.loops import Confirmation, Nearby, Overlapping, revisits
from tofuse.engine.mapping.config import Config, ViewKind, changed, checked
from tofuse.engine.refinement import Joint, plane_refinement
from tofuse.engine.sensor import Multipath, Noise, Wrapped
from tofuse.engine.tracking import Keyframes, Pairwise, Sequential


def thesis(kind: ViewKind) -> Config:
    """Return the method of the thesis: chapter 3, with the settings of chapter 4.

    Sequential point-to-point ICP on 1000 random points of each frame, started from the previous
    motion; loops by distance and yaw; Castellani's optimisation.
    """
    icp = algorithm_1(resolution=0.01, points=1000)
    return Config(
        method="thesis",
        filters=(Confidence(minimum=7), NeighbourFraction(fraction=0.5, k=3)),
        odometry=Sequential(registration=icp, guess="previous"),
        # A wide search, as the trajectory has drifted when a loop closes; a strict verification, as
        # a wrong loop does more harm than a missing one.
        loops=Nearby(
            max_distance_m=1.5,
            max_yaw_rad=0.8,
            min_gap=30,
            per_frame=6,
            confirmation=Confirmation(min_fraction=0.45),
        ),
        optimiser=castellani.Castellani(),
        fusion=Fusion(),
    )


def default(kind: ViewKind) -> Config:
    """Return the default method of `tofuse run`.

    Range images get a noise model, multipath is compensated if views show it, and images are
    aligned with keyframes by planes and albedo; views of the model are filtered further. Revisited
    places close loops, and all views are refined jointly. Clouds are registered in pairs, as far as
    their poses are accepted, and refined by common planes.
    """
    base = replace(thesis(kind), method="default")
    if kind == "cloud":
        return replace(
            base,
            filters=(),  # the density of a cloud's points shows its viewpoint
            odometry=Pairwise(),
            loops=Overlapping(confirmation=Confirmation(registrations=(AnyPair(),))),
            refinement=plane_refinement.Planes(),
        )
    return replace(
        base,
        corrections=(Noise(), Multipath()),
        # Pixels of zero confidence are no measurements: phones fill gaps by interpolation.
        filters=(Confidence(minimum=1),),
        model_filters=(Wrapped(), Confidence(minimum=3), NeighbourhoodAngle()),
        odometry=Keyframes(),
        loops=revisits.Revisits(),
        # Not for clouds: it relies on the covariance of registrations, and ICP's is too small.
        optimiser=levenberg.LevenbergMarquardt(),
        refinement=Joint(),
        # Odometry only on request: a file next to the images may be of any quality.
        priors=(external_sensors.GravityEdges(),),
    )


def methods() -> dict[str, Callable[[ViewKind], Config]]:
    """Return the named configurations, `default` first."""
    return {"default": default, "thesis": thesis}


def configured(config: Config | str | Mapping[str, Any], kind: ViewKind = "range") -> Config:
    """Return a configuration for a kind of view.

    Parameters
    ----------
    config
        The configuration, or its name; or options that differ from the default, as in a TOML file.
    kind
        The kind of view.

    Raises
    ------
    InputError
        If it is nothing of these, or an option does not exist.
    """
    if isinstance(config, str):
        return from_method(config, kind)
    if isinstance(config, Mapping):
        options = {name: value for name, value in config.items() if name != "method"}
        return changed(from_method(config.get("method", "default"), kind), options, where="config")
    return checked(config)


def from_method(name: str, kind: ViewKind = "range", *, where: str = "config") -> Config:
    """Return the configuration of that name for a kind of view; InputError if there is none."""
    available = methods()
    if not isinstance(name, str) or name not in available:
        raise InputError(f"is {name!r}", where=where, remedy=f"use one of {', '.join(available)}")
    return available[name](kind)
