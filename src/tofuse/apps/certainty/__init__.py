"""What is known of a scan: its surfaces, and how certain its poses are, together.

`Known` has the joint covariance of keyframes, at a moment of a scan or of a finished result, and
predicts what views of the known `surfaces` would add. Of it, `LengthErrors` says how well the
distance of two points is known.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.apps.certainty import surfaces
    from tofuse.apps.certainty.known import Known
    from tofuse.apps.certainty.lengths import Length, LengthErrors

__getattr__, __dir__, __all__ = face(__name__, __file__)
