"""tofuse: recordings of Time-of-Flight cameras into one consistent 3D model and a trajectory.

>>> import tofuse
>>> recording = tofuse.open("path")  # or tofuse.from_arrays(depth, K)
>>> result = tofuse.reconstruct(recording, progress=True)
>>> result.save("result")
>>> result.mesh.save("model.glb")
>>> T = tofuse.register(source, target).T_target_source

Names are imported on first use, so that ``import tofuse`` is fast.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from tofuse._version import __version__

if TYPE_CHECKING:
    from tofuse.apps.api.result import Result, load, merge, reconstruct
    from tofuse.apps.inspection.inspect import inspect_recording as inspect
    from tofuse.apps.jobs.evaluating import Evaluation, evaluate
    from tofuse.apps.jobs.judging import Judgement, judge
    from tofuse.apps.live.player import Player
    from tofuse.engine.alignment.base import Registration
    from tofuse.engine.cameras.cameras import BrownConrady, Fisheye, Pinhole, Rational, RayTable
    from tofuse.engine.clouds.pair import register
    from tofuse.engine.errors import InputError, OutputError, RegistrationError, TofuseError
    from tofuse.engine.frames.frames import CloudFrame, RangeFrame
    from tofuse.engine.frames.from_arrays import from_arrays
    from tofuse.engine.frames.recording import Recording
    from tofuse.engine.fusion.cloud import Cloud
    from tofuse.engine.fusion.mesh import Mesh
    from tofuse.engine.graph.graph import LoopRecord, PoseGraph
    from tofuse.engine.mapping.config import Config
    from tofuse.engine.mapping.mapper import Mapper
    from tofuse.engine.quality.change_detection import Change
    from tofuse.engine.quality.pose_accuracy import Accuracy
    from tofuse.engine.results.types import (
        Component,
        Diagnostics,
        FrameRecord,
        Reason,
        Reconstruction,
        SessionChange,
        SessionPair,
        SessionRecord,
    )
    from tofuse.formats.recordings.open import open_recording as open  # noqa: A004

_HOMES = {
    "Accuracy": "tofuse.engine.quality.pose_accuracy",
    "BrownConrady": "tofuse.engine.cameras.cameras",
    "Change": "tofuse.engine.quality.change_detection",
    "Cloud": "tofuse.engine.fusion.cloud",
    "CloudFrame": "tofuse.engine.frames.frames",
    "Component": "tofuse.engine.results.types",
    "Config": "tofuse.engine.mapping.config",
    "Diagnostics": "tofuse.engine.results.types",
    "Evaluation": "tofuse.apps.jobs.evaluating",
    "Fisheye": "tofuse.engine.cameras.cameras",
    "FrameRecord": "tofuse.engine.results.types",
    "InputError": "tofuse.engine.errors",
    "Judgement": "tofuse.apps.jobs.judging",
    "LoopRecord": "tofuse.engine.graph.graph",
    "Mapper": "tofuse.engine.mapping.mapper",
    "Mesh": "tofuse.engine.fusion.mesh",
    "OutputError": "tofuse.engine.errors",
    "Pinhole": "tofuse.engine.cameras.cameras",
    "Player": "tofuse.apps.live.player",
    "PoseGraph": "tofuse.engine.graph.graph",
    "RangeFrame": "tofuse.engine.frames.frames",
    "Rational": "tofuse.engine.cameras.cameras",
    "RayTable": "tofuse.engine.cameras.cameras",
    "Reason": "tofuse.engine.results.types",
    "Reconstruction": "tofuse.engine.results.types",
    "Recording": "tofuse.engine.frames.recording",
    "Registration": "tofuse.engine.alignment.base",
    "RegistrationError": "tofuse.engine.errors",
    "Result": "tofuse.apps.api.result",
    "SessionChange": "tofuse.engine.results.types",
    "SessionPair": "tofuse.engine.results.types",
    "SessionRecord": "tofuse.engine.results.types",
    "TofuseError": "tofuse.engine.errors",
    "evaluate": "tofuse.apps.jobs.evaluating",
    "from_arrays": "tofuse.engine.frames.from_arrays",
    "inspect": "tofuse.apps.inspection.inspect",
    "judge": "tofuse.apps.jobs.judging",
    "load": "tofuse.apps.api.result",
    "merge": "tofuse.apps.api.result",
    "open": "tofuse.formats.recordings.open",
    "reconstruct": "tofuse.apps.api.result",
    "register": "tofuse.engine.clouds.pair",
}

__all__ = [
    "Accuracy",
    "BrownConrady",
    "Change",
    "Cloud",
    "CloudFrame",
    "Component",
    "Config",
    "Diagnostics",
    "Evaluation",
    "Fisheye",
    "FrameRecord",
    "InputError",
    "Judgement",
    "LoopRecord",
    "Mapper",
    "Mesh",
    "OutputError",
    "Pinhole",
    "Player",
    "PoseGraph",
    "RangeFrame",
    "Rational",
    "RayTable",
    "Reason",
    "Reconstruction",
    "Recording",
    "Registration",
    "RegistrationError",
    "Result",
    "SessionChange",
    "SessionPair",
    "SessionRecord",
    "TofuseError",
    "__version__",
    "evaluate",
    "from_arrays",
    "inspect",
    "judge",
    "load",
    "merge",
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
