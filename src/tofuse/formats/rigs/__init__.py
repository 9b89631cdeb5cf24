"""Rigs: the file rig.json of rigidly connected cameras, and their recordings as one source."""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.formats.rigs.rig_file import (
        FILE_NAME,
        Disagreement,
        Rig,
        RigCamera,
        read_rig,
        recordings_of,
        rig_file_in,
        write_rig,
    )
    from tofuse.formats.rigs.rig_source import RigSource, check_one_camera

__getattr__, __dir__, __all__ = face(__name__, __file__)
