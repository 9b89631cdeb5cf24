"""Cameras that are connected: streams of frames, and their recording.

A maker's camera is a device in `devices`, a part with options; opened it is a stream of frames that
can be recorded as a native folder, or pushed into a `Mapper`.
"""

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse.apps.live.device import (
        Device,
        DeviceError,
        Settings,
        Stream,
        device_named,
        is_installed,
        known_devices,
    )
    from tofuse.apps.live.recorder import record

__getattr__, __dir__, __all__ = face(__name__, __file__)
