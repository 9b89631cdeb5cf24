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
    from tofuse.api.result import Result, load, merge, reconstruct
    from tofuse.errors import InputError, OutputError, RegistrationError, TofuseError
    from tofuse.evaluation.changes import Change
    from tofuse.fusion.cloud import Cloud
    from tofuse.fusion.mesh import Mesh
    from tofuse.geometry.cameras import BrownConrady, Fisheye, Pinhole, Rational, RayTable
    from tofuse.inspection.inspect import inspect_recording as inspect
    from tofuse.live.player import Player
    from tofuse.pipeline.config import Config
    from tofuse.pipeline.evaluating import Evaluation, evaluate
    from tofuse.pipeline.judging import Judgement, judge
    from tofuse.pipeline.mapper import Mapper
    from tofuse.posegraph.accuracy import Accuracy
    from tofuse.posegraph.graph import LoopRecord, PoseGraph
    from tofuse.recordings.frames import CloudFrame, RangeFrame
    from tofuse.recordings.from_arrays import from_arrays
    from tofuse.recordings.open import open_recording as open  # noqa: A004
    from tofuse.recordings.recording import Recording
    from tofuse.registration.base import Registration
    from tofuse.registration.register import register
    from tofuse.results.types import (
        Component,
        Diagnostics,
        FrameRecord,
        Reason,
        Reconstruction,
        SessionChange,
        SessionPair,
        SessionRecord,
    )

_HOMES = {
    "Accuracy": "tofuse.posegraph.accuracy",
    "BrownConrady": "tofuse.geometry.cameras",
    "Change": "tofuse.evaluation.changes",
    "Cloud": "tofuse.fusion.cloud",
    "CloudFrame": "tofuse.recordings.frames",
    "Component": "tofuse.results.types",
    "Config": "tofuse.pipeline.config",
    "Diagnostics": "tofuse.results.types",
    "Evaluation": "tofuse.pipeline.evaluating",
    "Fisheye": "tofuse.geometry.cameras",
    "FrameRecord": "tofuse.results.types",
    "InputError": "tofuse.errors",
    "Judgement": "tofuse.pipeline.judging",
    "LoopRecord": "tofuse.posegraph.graph",
    "Mapper": "tofuse.pipeline.mapper",
    "Mesh": "tofuse.fusion.mesh",
    "OutputError": "tofuse.errors",
    "Pinhole": "tofuse.geometry.cameras",
    "Player": "tofuse.live.player",
    "PoseGraph": "tofuse.posegraph.graph",
    "RangeFrame": "tofuse.recordings.frames",
    "Rational": "tofuse.geometry.cameras",
    "RayTable": "tofuse.geometry.cameras",
    "Reason": "tofuse.results.types",
    "Reconstruction": "tofuse.results.types",
    "Recording": "tofuse.recordings.recording",
    "Registration": "tofuse.registration.base",
    "RegistrationError": "tofuse.errors",
    "Result": "tofuse.api.result",
    "SessionChange": "tofuse.results.types",
    "SessionPair": "tofuse.results.types",
    "SessionRecord": "tofuse.results.types",
    "TofuseError": "tofuse.errors",
    "evaluate": "tofuse.pipeline.evaluating",
    "from_arrays": "tofuse.recordings.from_arrays",
    "inspect": "tofuse.inspection.inspect",
    "judge": "tofuse.pipeline.judging",
    "load": "tofuse.api.result",
    "merge": "tofuse.api.result",
    "open": "tofuse.recordings.open",
    "reconstruct": "tofuse.api.result",
    "register": "tofuse.registration.register",
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
