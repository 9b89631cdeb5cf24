"""."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.formats.sources import bags
    from tofuse.formats.sources import cloud_frames
    from tofuse.formats.sources import cloud_sequence
    from tofuse.formats.sources.file_source import DepthImageSource, FileSource
    from tofuse.formats.sources.imu import gravity_at
    from tofuse.formats.sources import inputs
    from tofuse.formats.sources import organised
    from tofuse.formats.sources import per_frame
    from tofuse.formats.sources import phones
    from tofuse.formats.sources import pixels
    from tofuse.formats.sources.reader import Reader, ReaderOptions, Sniff

__getattr__, __dir__, __all__ = face(__name__, __file__)
