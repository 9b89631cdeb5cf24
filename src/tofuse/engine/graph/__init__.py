"""Pose graphs: poses, measured motions between them, and their optimisation.

A `PoseGraph` is built of `Measured` motions. An `Optimiser` corrects its poses and rejects wrong
loops: `levenberg` (the default) or `castellani` (the thesis), by the `solver` of sparse systems
(`sparse`) with `robust` kernels. `graph_covariances` says how uncertain the poses are;
`external_sensors` adds gravity and odometry.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.graph import (
        castellani,
        certificate,
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
