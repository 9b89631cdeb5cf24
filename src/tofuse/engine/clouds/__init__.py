"""."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.clouds import fpfh, robust_motion
    from tofuse.engine.clouds.pair import AnyPair, register

__getattr__, __dir__, __all__ = face(__name__, __file__)
