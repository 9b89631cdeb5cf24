"""Readers, one module for each recording format; `open_recording` finds them by their registration.

Only what other parts of the program know about single formats is imported from here.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.formats.readers.ifm_o3r import head_camera, head_frame, read_info
    from tofuse.formats.readers.native import NativeSource
    from tofuse.formats.readers.scans import read_las

__getattr__, __dir__, __all__ = face(__name__, __file__)
