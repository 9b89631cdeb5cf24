"""."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.noise.model import (
        NOISE,
        AmplitudeLaw,
        ConfidenceLaw,
        Law,
        NoiseModel,
        RangeLaw,
        family_of,
        noise_model_for,
    )

__getattr__, __dir__, __all__ = face(__name__, __file__)
