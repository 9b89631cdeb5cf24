"""tofuse: recordings of Time-of-Flight cameras into one consistent 3D model and a trajectory.

>>> import tofuse
>>> recording = tofuse.open("path")
>>> result = tofuse.reconstruct(recording)
>>> T = tofuse.register(source, target).T_target_source

Names are imported when they are first used, so that ``import tofuse`` is quick.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from tofuse._version import __version__

if TYPE_CHECKING:
    from tofuse.errors import InputError, OutputError, RegistrationError, TofuseError
    from tofuse.inspection.inspect import inspect_recording as inspect
    from tofuse.live.player import Player
    from tofuse.pipeline.config import Config
    from tofuse.pipeline.judging import Judgement, judge
    from tofuse.pipeline.mapper import Mapper
    from tofuse.pipeline.reconstruct import reconstruct
    from tofuse.recordings.frames import CloudFrame, RangeFrame
    from tofuse.recordings.open import open_recording as open  # noqa: A004
    from tofuse.recordings.recording import Recording
    from tofuse.registration.base import Registration
    from tofuse.registration.register import register
    from tofuse.results.types import Reconstruction

_HOMES = {
    "CloudFrame": "tofuse.recordings.frames",
    "Config": "tofuse.pipeline.config",
    "InputError": "tofuse.errors",
    "Judgement": "tofuse.pipeline.judging",
    "Mapper": "tofuse.pipeline.mapper",
    "OutputError": "tofuse.errors",
    "Player": "tofuse.live.player",
    "RangeFrame": "tofuse.recordings.frames",
    "Reconstruction": "tofuse.results.types",
    "Recording": "tofuse.recordings.recording",
    "Registration": "tofuse.registration.base",
    "RegistrationError": "tofuse.errors",
    "TofuseError": "tofuse.errors",
    "inspect": "tofuse.inspection.inspect",
    "judge": "tofuse.pipeline.judging",
    "open": "tofuse.recordings.open",
    "reconstruct": "tofuse.pipeline.reconstruct",
    "register": "tofuse.registration.register",
}

__all__ = [
    "CloudFrame",
    "Config",
    "InputError",
    "Judgement",
    "Mapper",
    "OutputError",
    "Player",
    "RangeFrame",
    "Reconstruction",
    "Recording",
    "Registration",
    "RegistrationError",
    "TofuseError",
    "__version__",
    "inspect",
    "judge",
    "open",
    "reconstruct",
    "register",
]


def __getattr__(name: str) -> Any:
    if name not in _HOMES:
        raise AttributeError(f"module 'tofuse' has no attribute {name!r}")
    attribute = f"{name}_recording" if name in ("inspect", "open") else name
    value = getattr(importlib.import_module(_HOMES[name]), attribute)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted(__all__)
