"""."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.formats.images.exr import parse_exr
    from tofuse.formats.images.images import (
        as_color,
        check_first_size,
        first_size,
        jpeg_bytes,
        parse_image,
        png_bytes,
        read_color,
        read_header,
        read_image,
        read_raw,
        write_png,
    )
    from tofuse.formats.images.lzfse import lzfse_decompress
    from tofuse.formats.images.matroska import MAGIC, Block, Matroska, Track
    from tofuse.formats.images.pcic import BEGIN, Chunk, chunk_image, pcic_frames
    from tofuse.formats.images.pgm import parse_pgm
    from tofuse.formats.images.tiff import read_tiff
    from tofuse.formats.images.video import Video

__getattr__, __dir__, __all__ = face(__name__, __file__)
