"""What a run gives, in memory and in `run.json`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import numpy as np

from tofuse.arrays import Bool, Float64
from tofuse.evaluation.changes import Change
from tofuse.fusion.cloud import Cloud
from tofuse.fusion.mesh import Mesh
from tofuse.fusion.upright import T_up_world
from tofuse.odometry.base import Status
from tofuse.posegraph.accuracy import Accuracy
from tofuse.posegraph.graph import GraphPart, LoopRecord, PoseGraph
from tofuse.posegraph.joining import Join
from tofuse.posegraph.outside import OutsideRecord
from tofuse.posegraph.refinement import Refinement
from tofuse.results.ranges import Range
from tofuse.results.samples import FrameSample

Verdict = Literal["good", "degraded", "failed"]


@dataclass(frozen=True)
class Reason:
    """One reason for the verdict.

    Attributes
    ----------
    code
        From the closed list in `verdict.REASONS`.
    ranges
        (first, last) frame index of each stretch that it concerns, ascending; at least one.
    text
        What was found, one or a few sentences.
    """

    code: str
    ranges: tuple[Range, ...]
    text: str

    @property
    def frames(self) -> Range:
        """First and last frame index that it concerns."""
        return self.ranges[0][0], self.ranges[-1][1]


@dataclass(frozen=True, eq=False)
class FrameRecord:
    """What became of one frame; the fields of `run.json`, SI units.

    `component` is the position in `Reconstruction.components`; None where it is in none, or where
    nothing looked for components.
    """

    index: int
    timestamp: float
    status: Status
    reason: str = ""
    valid_share: float | None = None
    inlier_share: float | None = None
    rms_m: float | None = None
    covariance: Float64 | None = None  # (6, 6) of the final pose, relative to the first
    unobservable: Float64 = field(default_factory=lambda: np.zeros((0, 6)))
    component: int | None = None


@dataclass(frozen=True)
class SelfCalibration:
    """How the stated calibration of a camera was corrected, because its own views say so.

    Attributes
    ----------
    focal
        The true focal length is 1 / (1 + focal) of the stated one.
    offset_m
        Added to all ranges, m.
    sigmas
        Standard deviations by how much views differ in it, by name as above.
    bound_m
        95 % bounds of the poses' rms error with the calibration as stated, and as corrected; inf
        where the poses are not bounded.
    """

    focal: float
    offset_m: float
    sigmas: Mapping[str, float]
    bound_m: tuple[float, float]


@dataclass(frozen=True, eq=False)
class Diagnostics:
    """Everything that says how far the result can be trusted.

    Attributes
    ----------
    sequential
        (N, 4, 4) T_world_camera before loops were closed, NaN where lost.
    objective
        Value of the optimiser's objective at every iteration (figure 5.3).
    removed
        Share of points that each filter removed, by name.
    seconds
        Wall time of each stage.
    cloud_before
        The model as the sequential poses give it; None where nothing moved them.
    refinement
        What became of the refinement over all views.
    parts
        The connected parts of the graph, where the optimiser ran and tells them apart.
    outside
        What became of sensors beside the camera.
    samples
        Small images of some frames; none of clouds.
    accuracy
        95 % bounds of the poses' errors.
    calibrated
        How the camera's calibration was corrected; None where it was left as stated.
    joins
        What joins the components of the main model.
    """

    verdict: Verdict
    reasons: tuple[Reason, ...]
    frames: tuple[FrameRecord, ...]
    loops: tuple[LoopRecord, ...]
    sequential: Float64
    objective: tuple[float, ...]
    removed: dict[str, float]
    seconds: dict[str, float]
    cloud_before: Cloud | None = None
    refinement: Refinement | None = None
    parts: tuple[GraphPart, ...] = ()
    outside: tuple[OutsideRecord, ...] = ()
    samples: tuple[FrameSample, ...] = ()
    accuracy: Accuracy = Accuracy()  # noqa: RUF009 - immutable
    calibrated: SelfCalibration | None = None
    joins: tuple[Join, ...] = ()


@dataclass(frozen=True, eq=False)
class Component:
    """A stretch of the recording tracked without a break, or several joined with each other.

    Attributes
    ----------
    frames
        (first, last) frame index of each stretch, ascending.
    T_main_component
        (4, 4) the identity for component 0, the main one; None where it is not connected to that.
    joined
        How it was connected: by "links" between its views and others, or by the extrapolated
        "motion" over the gap alone; None for component 0 and where it is not connected.
    result
        A model of its own, where it is not part of the main one and has more than a few frames. It
        holds the frames of this component only, in a world frame of its own.
    """

    frames: tuple[Range, ...]
    T_main_component: Float64 | None
    joined: Literal["links", "motion"] | None
    result: Reconstruction | None = None

    @property
    def connected(self) -> bool:
        """Whether it is part of the main model."""
        return self.T_main_component is not None


@dataclass(frozen=True, eq=False)
class SessionRecord:
    """One of several recordings in one map.

    Attributes
    ----------
    name
        What it is called in words, unlike the others.
    result
        Folder of the result that it came from.
    opening
        How its recording was opened, as plain data.
    config
        By which its frames are corrected and filtered, as plain data.
    first, count
        Index of the first frame of its recording, and how many that has: of the merged frames,
        those from `first` to before `first + count` are of this session.
    T_main_session
        (4, 4) from the world of its own result into this one's; None where it is not part of the
        main model.
    """

    name: str
    result: str
    opening: dict[str, Any]
    config: dict[str, Any]
    first: int
    count: int
    T_main_session: Float64 | None

    def has(self, index: int) -> bool:
        """Whether a frame is of this session."""
        return self.first <= index < self.first + self.count


@dataclass(frozen=True)
class SessionPair:
    """Whether two sessions overlap, and how sure that is.

    Attributes
    ----------
    a, b
        Numbers of the sessions; a < b.
    joined
        Whether they are in one model; it may be by way of others.
    before
        Whether an earlier result had joined them.
    links
        How many registrations between their views hold in the final model.
    probability
        That those which first joined the two are right, 0 to 1; None where others did.
    overlap
        Share of the views of either that see surfaces which the other sees too, the smaller one.
    support
        Share of what these say that supports the final poses and does not contradict them; None
        where they don't overlap.
    """

    a: int
    b: int
    joined: bool
    before: bool = False
    links: int = 0
    probability: float | None = None
    overlap: float = 0.0
    support: float | None = None


@dataclass(frozen=True, eq=False)
class SessionChange:
    """A surface that is there in one of two sessions only.

    Attributes
    ----------
    a, b
        Numbers of the earlier and of the later session, as they were given.
    """

    a: int
    b: int
    change: Change


def in_main_model(record: FrameRecord, components: Sequence[Component]) -> bool:
    """Say whether a frame has a pose in the main model, and not only in one of another component.

    Without components every pose is in it.
    """
    if record.status not in ("tracked", "predicted"):
        return False
    return record.component is None or components[record.component].connected


@dataclass(frozen=True, eq=False)
class Reconstruction:
    """The result of `tofuse.reconstruct`.

    Attributes
    ----------
    trajectory
        (N, 4, 4) T_world_camera of every frame read, NaN where it has none in the main model; the
        first pose is the identity.
    timestamps
        (N,) seconds.
    graph
        Vertices are frame indices.
    cloud
        The fused model, in the world frame.
    mesh
        The fused surface, in the world frame; None for clouds without a camera.
    config
        The resolved configuration, as plain data.
    recording
        path, format, frames and the reader's warnings, as plain data.
    components
        Component 0 is the main one: trajectory, graph, cloud and mesh are of what is connected to
        it. Empty where nothing looked for them.
    sessions, session_pairs
        The recordings of several results that were merged, and what connects each two of them;
        empty for a run.
    changes
        What changed between two sessions in the main model, in its world.
    up
        (3,) unit vector against gravity in the world, as an accelerometer measured it; None without
        one.
    """

    trajectory: Float64
    timestamps: Float64
    graph: PoseGraph
    cloud: Cloud
    diagnostics: Diagnostics
    config: dict[str, Any]
    recording: dict[str, Any]
    seed: int
    threads: int
    mesh: Mesh | None = None
    components: tuple[Component, ...] = ()
    sessions: tuple[SessionRecord, ...] = ()
    session_pairs: tuple[SessionPair, ...] = ()
    changes: tuple[SessionChange, ...] = ()
    up: Float64 | None = None

    @cached_property
    def T_up_world(self) -> Float64:
        """(4, 4) from the world into axes x right, y up, z towards the viewer (`upright`)."""
        return T_up_world(self.mesh, self.trajectory, self.up)

    def __repr__(self) -> str:
        a = self.diagnostics.accuracy
        bound = f", ±{1e3 * a.position_m:.3g} mm (95 %)" if np.isfinite(a.position_m) else ""
        return (
            f"{type(self).__name__}: {self.diagnostics.verdict}{bound}, "
            f"{int(self.has_pose.sum())} of {len(self.trajectory)} frames, "
            f"{len(self.cloud):,} points"
        )

    @property
    def has_pose(self) -> Bool:
        """(N,) mask of the frames with a pose in the main model."""
        return np.isfinite(self.trajectory[:, 0, 0])
