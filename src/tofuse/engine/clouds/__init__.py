"""Registration of any two views, images or clouds, under any rotation.

`register_similar` registers clouds of unknown relative scale. `AnyPair` is the method of
`tofuse.register`, and the default of configurations. `NearOrigin` is a pair from whose map
coordinates a shift is subtracted. `fpfh` proposes poses by matching local features, and
`robust_motion` finds a motion among matches that are mostly wrong.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.clouds import fpfh, robust_motion
    from tofuse.engine.clouds.cloud_pair import scaled
    from tofuse.engine.clouds.near_origin import NearOrigin
    from tofuse.engine.clouds.pair import MIN_POINTS, AnyPair
    from tofuse.engine.clouds.similarity import register_similar

__getattr__, __dir__, __all__ = face(__name__, __file__)
