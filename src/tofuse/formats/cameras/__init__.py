"""Files that describe a camera: its lens, its depth correction and its noise.

`camera_file` is the camera.json that all readers accept, with the checks of lenses from any file;
`lenses` converts makers' models, and a `Rectifier` images to the pinhole camera of `pinhole_of`.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.formats.cameras import camera_file, lenses
    from tofuse.formats.cameras.calibration_files import (
        corrected_depth,
        read_correction,
        read_noise,
        write_correction,
        write_noise,
    )
    from tofuse.formats.cameras.rectify import Rectifier, pinhole_of

__getattr__, __dir__, __all__ = face(__name__, __file__)
