"""How accurate a range is: the noise models of depth cameras.

A `NoiseModel` predicts the standard deviation of each pixel from its amplitude, confidence or
range, by the most informative law that a frame has. `NOISE` holds the models of camera families,
and `noise_model_for` chooses one for a recording.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.noise.model import (
        NOISE,
        NOISE_MODEL,
        AmplitudeLaw,
        ConfidenceLaw,
        Law,
        NoiseModel,
        RangeLaw,
        family_of,
        noise_model_for,
    )

__getattr__, __dir__, __all__ = face(__name__, __file__)
