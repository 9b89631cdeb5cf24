"""Results of the stages of the back end."""

from __future__ import annotations

from dataclasses import dataclass

from tofuse.engine.arrays import Float64
from tofuse.engine.graph import Optimisation, PoseGraph, external_sensors
from tofuse.engine.loops import ClosedLoop
from tofuse.engine.refinement import Refinement


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
    sensors: external_sensors.SensorPriors
    visual: VisualEvidence
    confirmed: frozenset[int]


@dataclass(frozen=True, eq=False)
class Refined:
    """The result of refining all views."""

    graph: PoseGraph
    refinement: Refinement
