"""What many results say about the camera that they share: `tofuse card`.

Each result states estimates of the camera's errors with their sigmas. `make_card` collects those of
one camera and tests whether they change with time; `card_files` writes a page for it.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.apps.card.job import card_files
    from tofuse.apps.card.making import Card, make_card

__getattr__, __dir__, __all__ = face(__name__, __file__)
