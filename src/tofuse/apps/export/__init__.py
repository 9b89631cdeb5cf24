"""."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.apps.export.exporting import export

__getattr__, __dir__, __all__ = face(__name__, __file__)
