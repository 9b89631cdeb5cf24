"""Recordings of any format, opened, joined, averaged where the camera stands still, and written.

`open_recording` returns a recording; an `Opening` remembers how, so that a result can be opened
again. A `RecordingWriter` writes the native folder, frame by frame.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.formats.recordings import still
    from tofuse.formats.recordings.archives import unzipped
    from tofuse.formats.recordings.joined import JoinedSource
    from tofuse.formats.recordings.native import RecordingWriter
    from tofuse.formats.recordings.open import (
        FACTORS,
        Opening,
        OpeningOptions,
        ReadingOptions,
        SingleView,
        is_recording,
        open_recording,
        open_view,
        read_reference,
        split_name,
    )

__getattr__, __dir__, __all__ = face(__name__, __file__)
