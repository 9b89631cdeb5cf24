"""."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.graph import (
        castellani,
        external_sensors,
        graph_covariances,
        levenberg,
        robust,
        solver,
        sparse,
    )
    from tofuse.engine.graph.graph import (
        GraphPart,
        LoopRecord,
        Measured,
        Optimisation,
        Optimiser,
        PoseGraph,
        build_graph,
    )

__getattr__, __dir__, __all__ = face(__name__, __file__)
