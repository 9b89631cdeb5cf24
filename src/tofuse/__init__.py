"""tofuse: recordings of Time-of-Flight cameras into one consistent 3D model and a trajectory.

>>> import tofuse
>>> recording = tofuse.open("path")  # or tofuse.from_arrays(depth, K)
>>> result = tofuse.reconstruct(recording, progress=True)
>>> result.save("result")
>>> result.mesh.save("model.glb")
>>> T = tofuse.register(source, target).T_target_source
>>> tofuse.compare("result", "part.stl", tolerance_m=0.002).verdict

Names are imported on first use, so that ``import tofuse`` is fast.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from tofuse._faces import face

if TYPE_CHECKING:
    from tofuse._version import __version__
    from tofuse.apps.api.result import Mapper, Result, load, merge, reconstruct
    from tofuse.apps.certainty.lengths import Length
    from tofuse.apps.coach.advice import Advice, advise
    from tofuse.apps.compare.comparing import Comparison, compare
    from tofuse.apps.inspection.inspect import inspect_recording as inspect
    from tofuse.apps.jobs.evaluating import Evaluation, evaluate
    from tofuse.apps.jobs.judging import Judgement, judge
    from tofuse.apps.pairs.registering import register
    from tofuse.engine.alignment.base import Registration
    from tofuse.engine.cameras.cameras import BrownConrady, Fisheye, Pinhole, Rational, RayTable
    from tofuse.engine.errors import InputError, OutputError, RegistrationError, TofuseError
    from tofuse.engine.frames.frames import CloudFrame, RangeFrame
    from tofuse.engine.frames.from_arrays import from_arrays
    from tofuse.engine.frames.recording import Recording
    from tofuse.engine.fusion.cloud import Cloud
    from tofuse.engine.fusion.mesh import Mesh
    from tofuse.engine.graph.graph import LoopRecord, PoseGraph
    from tofuse.engine.mapping.config import Config
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

__getattr__, __dir__, _ = face(__name__, __file__)
# Written out, as type checkers take imports for private that are in no list.
__all__ = ["Accuracy", "Advice", "BrownConrady", "Change", "Cloud", "CloudFrame", "Comparison"]
__all__ += ["Component", "Config", "Diagnostics", "Evaluation", "Fisheye", "FrameRecord"]
__all__ += ["InputError", "Judgement", "Length", "LoopRecord", "Mapper", "Mesh", "OutputError"]
__all__ += ["Pinhole", "PoseGraph", "RangeFrame", "Rational", "RayTable", "Reason"]
__all__ += ["Reconstruction", "Recording", "Registration", "RegistrationError", "Result"]
__all__ += ["SessionChange", "SessionPair", "SessionRecord", "TofuseError", "__version__"]
__all__ += ["advise", "compare", "evaluate", "from_arrays", "inspect", "judge", "load", "merge"]
__all__ += ["open", "reconstruct", "register"]
