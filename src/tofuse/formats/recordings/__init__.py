"""."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.formats.recordings.joined import JoinedSource
    from tofuse.formats.recordings.native import RecordingWriter
    from tofuse.formats.recordings.open import (
        Opening,
        OpeningOptions,
        SingleView,
        is_recording,
        open_recording,
        open_view,
        read_reference,
    )
    from tofuse.formats.recordings import still

__getattr__, __dir__, __all__ = face(__name__, __file__)
