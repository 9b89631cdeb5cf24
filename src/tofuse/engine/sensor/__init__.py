"""Systematic errors of time-of-flight cameras, and their corrections.

A `Correction` changes measurements before they are filtered; its `Corrector` does so for one
recording. `Multipath`, `Unwrap`, `CameraErrors` and `Noise` are corrections; `Wrapped` is a filter,
and a `DepthCorrection` is applied when a recording is read.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.engine.sensor.base import Correction, Corrector, Noise
    from tofuse.engine.sensor.camera_errors import ERROR_OPTIONS, CameraErrors, DepthCorrection
    from tofuse.engine.sensor.multipath_correction import Multipath
    from tofuse.engine.sensor.raw_amplitude import range_and_amplitude
    from tofuse.engine.sensor.unwrap import Unwrap, on_surface
    from tofuse.engine.sensor.wrapped import Wrapped

__getattr__, __dir__, __all__ = face(__name__, __file__)
