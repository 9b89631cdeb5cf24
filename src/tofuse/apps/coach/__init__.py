"""What to scan next, so that the bound on the errors of the poses falls.

The next best view by information: `Known` is what is known at a moment, surfaces and the joint
covariance of keyframes; `advise` imagines views from other poses, predicts the information of their
pairs with the keyframes, and returns the `Advice` whose bound is lowest. From what is known,
`LengthErrors` says how well the distance of two points is.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.apps.coach.advice import Advice, advise, advise_on
    from tofuse.apps.coach.lengths import Length, LengthErrors

__getattr__, __dir__, __all__ = face(__name__, __file__)
