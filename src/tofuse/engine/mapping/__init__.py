"""."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.mapping.adaptation import adapted, with_recording_defaults
    from tofuse.engine.mapping.config import (
        MIN_MEMORY_MB,
        Config,
        ViewKind,
        changed,
        check_views,
        from_method,
        kind_of,
    )
    from tofuse.engine.mapping.frame_log import FrameLog
    from tofuse.engine.mapping.mapper import Mapper
    from tofuse.engine.mapping.methods import default
    from tofuse.engine.mapping.priors import Prior, with_odometry, with_prior
    from tofuse.engine.mapping.reconstruction import (
        past_frames,
        push_frames,
        reconstruct,
        reconstruct_with_views,
        view_kind,
        with_recording_facts,
    )
    from tofuse.engine.mapping.texturing import TEXTURE, make_texture

__getattr__, __dir__, __all__ = face(__name__, __file__)
