"""."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.graph import bridges, external_sensors, graph_covariances, levenberg, measured_graph, minimisation, robust, solver, sparse
    from tofuse.engine.graph.castellani import Castellani, free_vertices
    from tofuse.engine.graph.graph import GraphPart, Gravity, LoopRecord, Optimisation, Optimiser, PoseGraph, ROUNDING

__getattr__, __dir__, __all__ = face(__name__, __file__)
