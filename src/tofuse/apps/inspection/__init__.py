"""Checks of a recording before it is used: `tofuse inspect`, and the start of a run.

A small sample of the frames is read and aligned once; each check looks at it for one kind of fault,
such as a wrong unit, lens or clock, and yields findings with their evidence and a remedy.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.apps.inspection.finding import Finding
    from tofuse.apps.inspection.inspect import inspect_recording
    from tofuse.apps.inspection.pose_convention import convention_of, difference

__getattr__, __dir__, __all__ = face(__name__, __file__)
