"""The whole reconstruction: frames in; poses, model and accuracy out.

A `Mapper` takes frames one by one and reconstructs them by a `Config`, which `from_method` looks
up by name and `changed` modifies. `reconstructing` feeds it a recording, after `adaptation` of
the configuration to the recording. `texturing` paints the finished model.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.mapping import adaptation, clips, reconstructing, texturing
    from tofuse.engine.mapping.config import (
        MIN_MEMORY_MB,
        Config,
        ViewKind,
        changed,
        kind_of,
    )
    from tofuse.engine.mapping.frame_log import FrameLog
    from tofuse.engine.mapping.mapper import Mapper
    from tofuse.engine.mapping.methods import configured, default, from_method

__getattr__, __dir__, __all__ = face(__name__, __file__)
