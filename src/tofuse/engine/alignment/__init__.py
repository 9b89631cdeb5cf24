"""Alignment of a view with others from a nearby pose, and how certain the result is.

`projective.align` minimises distances from planes and differences of albedo; `covariance` states
the uncertainty of its result, including degenerate directions. A `Registration` is the pose of one
view in the frame of another by any method, a `Registrar` such a method, and a `Link` a registration
that joins two components.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.alignment import projective, step_kernels
    from tofuse.engine.alignment.base import PROBABLE, Link, Registrar, Registration
    from tofuse.engine.alignment.projective import ViewOptions
    from tofuse.engine.alignment.uncertainty import UncertaintyOptions, bounded_below, covariance

__getattr__, __dir__, __all__ = face(__name__, __file__)
