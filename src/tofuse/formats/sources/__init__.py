"""What readers of formats share: the interface of a `Reader`, and sources of frames to derive from.

A reader detects its format (`Sniff`) and opens a `FileSource`, or one of the more specific sources
in `bags`, `phones` and `cloud_files`. `inputs` finds the files of a recording, and reads what
belongs to each frame (pose, time, camera); `pixels` makes images, and `organised` finds the camera
of clouds that were images.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.formats.sources import bags, cloud_files, inputs, organised, phones, pixels
    from tofuse.formats.sources.file_source import DepthImageSource, FileSource
    from tofuse.formats.sources.imu import ACCELERATION, GRAVITY, gravity_at
    from tofuse.formats.sources.reader import Reader, ReaderOptions, Sniff

__getattr__, __dir__, __all__ = face(__name__, __file__)
