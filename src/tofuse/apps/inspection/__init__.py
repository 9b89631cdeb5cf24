"""."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.apps.inspection.finding import Finding
    from tofuse.apps.inspection.inspect import inspect_recording

__getattr__, __dir__, __all__ = face(__name__, __file__)
