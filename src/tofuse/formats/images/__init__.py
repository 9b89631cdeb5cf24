"""Image files: sizes and checksums are checked before anything is decoded or allocated.

PNG and JPEG are read and written by functions here, which give (H, W) or (H, W, 3) arrays; the
other functions and classes are for the formats of single cameras and apps.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.formats.images import matroska
    from tofuse.formats.images.exr import read_exr_depth
    from tofuse.formats.images.images import (
        as_color,
        check_first_size,
        first_size,
        jpeg_bytes,
        parse_image,
        read_color,
        read_header,
        read_image,
        read_raw,
        read_tiff,
        write_png,
    )
    from tofuse.formats.images.video import Video

__getattr__, __dir__, __all__ = face(__name__, __file__)
