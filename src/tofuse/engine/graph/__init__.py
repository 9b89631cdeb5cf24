"""."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.graph import (
        bridges,
        castellani,
        external_sensors,
        graph_covariances,
        levenberg,
        measured_graph,
        minimisation,
        robust,
        solver,
        sparse,
    )
    from tofuse.engine.graph.graph import GraphPart, LoopRecord, Optimisation, Optimiser, PoseGraph

__getattr__, __dir__, __all__ = face(__name__, __file__)
