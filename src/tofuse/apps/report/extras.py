"""Content of a report beyond the result itself."""

from __future__ import annotations

from dataclasses import dataclass

from tofuse.engine.arrays import Float32, Float64
from tofuse.engine.frames import CloudFrame, Frame
from tofuse.engine.fusion import Textured
from tofuse.formats.rigs import Rig


@dataclass(frozen=True, eq=False)
class ReportExtras:
    """Samples of the recording, and the ground truth where known.

    Attributes
    ----------
    title
        Title of the report, for example the name of the input.
    filter_steps
        ("raw", frame), then (name, frame) after each filter in order, for one sample frame.
    reference
        (N, 4, 4) reference T_world_camera in the world of the result (its first pose is the
        identity), NaN where there is none; rows as `Reconstruction.trajectory`. Or None.
    truth_points
        (K, 3) points in m on the true surfaces, in the world frame; None if not known.
    clouds
        About a dozen evenly spaced, unfiltered views, if views are clouds.
    headline
        Text above everything else; may be empty.
    rig
        The rig, with the distances between overlapping surfaces of its cameras in this recording.
    texture
        The surface with a texture, if there is one.
    share
        Whether to write a small page with the model alone as well.
    """

    title: str
    filter_steps: tuple[tuple[str, Frame], ...] = ()
    reference: Float64 | None = None
    truth_points: Float32 | None = None
    clouds: tuple[CloudFrame, ...] = ()
    headline: str = ""
    rig: Rig | None = None
    texture: Textured | None = None
    share: bool = False
