"""What to scan next, so that the bound on the errors of the poses falls.

The next best view by information: `advise` imagines views from other poses, predicts what their
pairs with the keyframes would tell, and returns the `Advice` whose bound is lowest.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.apps.coach.advice import Advice, advise, advise_on

__getattr__, __dir__, __all__ = face(__name__, __file__)
