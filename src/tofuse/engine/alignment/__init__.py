"""."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.alignment import projective, step_kernels
    from tofuse.engine.alignment.base import PROBABLE, Link, Registrar, Registration
    from tofuse.engine.alignment.projective import ViewOptions
    from tofuse.engine.alignment.uncertainty import UncertaintyOptions, bounded_below, covariance

__getattr__, __dir__, __all__ = face(__name__, __file__)
