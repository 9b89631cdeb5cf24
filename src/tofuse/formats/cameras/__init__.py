"""."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.formats.cameras.camera_file import (
        AMPLITUDE_KINDS,
        LENS_COLUMNS,
        MAX_SLOPE,
        SCHEMA,
        CameraFile,
        ColorCamera,
        camera_fields,
        camera_file_of,
        check_size,
        checked_lens,
        checked_pinhole,
        image_size,
        load_camera,
        read_camera_file,
        read_rays,
        same_distortion,
    )
    from tofuse.formats.cameras.correction_file import (
        corrected_depth,
        read_correction,
        write_correction,
    )
    from tofuse.formats.cameras import lenses
    from tofuse.formats.cameras.noise_file import read_noise, write_noise
    from tofuse.formats.cameras.rectify import Rectifier, pinhole_of

__getattr__, __dir__, __all__ = face(__name__, __file__)
