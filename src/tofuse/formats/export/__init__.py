"""Export: recordings in the layouts of other programs, clouds and meshes in their file formats.

`convert` and `convert_to` write folders; `exchange` chooses a file format by the suffix;
`write_octomap` writes free and occupied space.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.formats.export import exchange
    from tofuse.formats.export.conversion import convert, convert_to
    from tofuse.formats.export.octomap import write_octomap

__getattr__, __dir__, __all__ = face(__name__, __file__)
