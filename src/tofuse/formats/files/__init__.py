"""."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.formats.files import atomic
    from tofuse.formats.files import json_data
    from tofuse.formats.files.locking import Claim, locked
    from tofuse.formats.files import npz
    from tofuse.formats.files import reading
    from tofuse.formats.files import staging
    from tofuse.formats.files import stamps
    from tofuse.formats.files import tables

__getattr__, __dir__, __all__ = face(__name__, __file__)
