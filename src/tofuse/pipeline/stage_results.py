"""The input of the back end, and the results of its stages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from tofuse.arrays import Float64
from tofuse.fusion.cloud import Cloud
from tofuse.fusion.model import Model, ModelBuilder
from tofuse.posegraph.external_sensors import SensorPriors
from tofuse.posegraph.graph import Optimisation, PoseGraph
from tofuse.posegraph.loops import ClosedLoop, Loops
from tofuse.posegraph.refinement import Refinement, Refiner
from tofuse.posegraph.view_store import Spilled, ViewStore
from tofuse.recordings.frames import RangeFrame
from tofuse.registration.prepared_view import PreparedView


@dataclass(frozen=True, eq=False)
class VisualEvidence:
    """The evidence of the images alone: a graph without external sensors.

    `sequential` are the poses before loop closure, with external sensors.
    """

    sequential: Float64
    optimisation: Optimisation


@dataclass(frozen=True, eq=False)
class Optimised:
    """The result of closing loops and optimising.

    `confirmed` are frames whose registrations fit unusually badly, but are confirmed by the loops.
    """

    loops: list[ClosedLoop]
    sequential: Float64
    optimisation: Optimisation
    sensors: SensorPriors
    visual: VisualEvidence
    confirmed: frozenset[int]


@dataclass(frozen=True, eq=False)
class Refined:
    """The result of refining all views."""

    graph: PoseGraph
    refinement: Refinement


@dataclass(frozen=True, eq=False)
class Fused:
    """The model, and a cloud at the poses before optimisation; None if that changed no pose."""

    model: Model
    cloud_before: Cloud | None


@dataclass(frozen=True, eq=False)
class BackEndInput:
    """Stored observations of all frames.

    Attributes
    ----------
    loops
        The loop detector, which received every frame.
    refiner
        The refinement, which received every frame.
    model
        Stored views of the model.
    checks
        Images that are compared with each other at the final poses.
    depths
        Typical radial range of each posed frame, m, by index.
    ambiguity_m
        Ambiguity range of the camera, if known.
    has_covariances
        Whether covariances of registrations are realistic; those of ICP are too small.
    views
        Prepared views, spaced by motion.
    """

    loops: Loops
    refiner: Refiner
    model: ModelBuilder
    checks: Sequence[Spilled[RangeFrame]]
    depths: dict[int, float]
    ambiguity_m: float | None
    has_covariances: bool
    views: ViewStore[PreparedView]
