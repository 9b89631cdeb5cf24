"""Files and folders of any content: read with one-line errors, replaced as a whole or not at all.

`reading` turns every way in which a file can fail into an InputError that names it and a remedy;
`atomic` writes files, `staging` folders; `tables` and `npz` check numbers as they read
them. The modules are used by name: ``reading.read_text(path)``.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.formats.files import atomic, npz, reading, staging, stamps, tables
    from tofuse.formats.files.locking import Claim, locked

__getattr__, __dir__, __all__ = face(__name__, __file__)
