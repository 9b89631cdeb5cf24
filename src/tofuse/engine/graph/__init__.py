"""."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.graph import robust
    from tofuse.engine.graph.bridges import cut_edges, sides_without
    from tofuse.engine.graph.build import Measured, build_graph
    from tofuse.engine.graph.castellani import Castellani, free_vertices
    from tofuse.engine.graph.covariances import (
        MIN_WEIGHT,
        GraphCovariances,
        accepted_only,
        loop_errors,
        relative_covariance,
    )
    from tofuse.engine.graph.descent import Descent, Problem, vertical
    from tofuse.engine.graph.external_sensors import (
        ExternalSensor,
        GravityEdges,
        OdometryEdges,
        SensorData,
        SensorPriors,
        SensorRecord,
        measure_all,
        with_sensors,
    )
    from tofuse.engine.graph.graph import (
        ROUNDING,
        GraphPart,
        Gravity,
        LoopRecord,
        Optimisation,
        Optimiser,
        PoseGraph,
    )
    from tofuse.engine.graph.levenberg import LevenbergMarquardt, check_graph
    from tofuse.engine.graph.robust import Settings
    from tofuse.engine.graph.solver import Solution, solve
    from tofuse.engine.graph.sparse import Factor, PairSystem, first_of_parts, parts_of

__getattr__, __dir__, __all__ = face(__name__, __file__)
