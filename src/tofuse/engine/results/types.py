"""The result of a run, as it is in memory and in `run.json`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Literal

import numpy as np

from tofuse.engine import quantities
from tofuse.engine.arrays import Bool, Float32, Float64
from tofuse.engine.frames import frame_ranges
from tofuse.engine.fusion import Cloud, Mesh, T_up_world
from tofuse.engine.graph import GraphPart, LoopRecord, PoseGraph, certificate, external_sensors
from tofuse.engine.loops import Join
from tofuse.engine.quality import Change, frame_samples, pose_accuracy
from tofuse.engine.refinement import Refinement
from tofuse.engine.tracking import Status

Verdict = Literal["good", "degraded", "failed"]


@dataclass(frozen=True)
class Reason:
    """One reason for the verdict.

    Attributes
    ----------
    code
        From the closed list `REASONS` of `tofuse.engine.results.verdicts`.
    ranges
        (first, last) frame index of each range that it concerns, ascending; at least one.
    text
        What was found, in one or a few sentences.
    remedy
        What to do about it, in one or a few sentences; empty if nothing is known.
    """

    code: str
    ranges: tuple[frame_ranges.Range, ...]
    text: str
    remedy: str = ""

    @property
    def frames(self) -> frame_ranges.Range:
        """First and last frame index that it concerns."""
        return self.ranges[0][0], self.ranges[-1][1]


@dataclass(frozen=True, eq=False)
class FrameRecord:
    """The outcome of one frame, as in `run.json`.

    Attributes
    ----------
    index, timestamp
        Frame index in the recording, and s.
    status
        "tracked", "predicted", "lost" (no pose) or "skipped" (unreadable).
    reason
        Why it was not tracked; may be empty.
    valid_share
        Fraction of its pixels that are valid after filtering, 0 to 1.
    inlier_share
        Fraction of its points with a correspondence, 0 to 1.
    rms_m
        Rms residual of the correspondences, m.
    covariance
        (6, 6) of the final pose relative to the first, m and rad; None where not known.
    unobservable
        (K, 6) orthonormal directions of the right perturbation that the data does not constrain.
    component
        Position in `Reconstruction.components`; None where the frame is in none.
    mean_depth_m
        Of the frame as read, by which its recording is recognised.
    """

    index: int
    timestamp: float
    status: Status
    reason: str = ""
    valid_share: float | None = None
    inlier_share: float | None = None
    rms_m: float | None = None
    covariance: Float64 | None = field(default=None, repr=False)
    unobservable: Float64 = field(default_factory=lambda: np.zeros((0, 6)), repr=False)
    component: int | None = None
    mean_depth_m: float | None = None


@dataclass(frozen=True)
class SelfCalibration:
    """A correction of the stated calibration, estimated from the recording itself.

    Attributes
    ----------
    focal
        The true focal length is 1 / (1 + focal) of the stated one.
    offset_m
        Added to all ranges, m.
    center_x, center_y
        Added to the ray coordinates x / z and y / z.
    distortion
        Radial distortion, as in `CameraErrors`.
    sigmas
        Standard deviations of the corrected ones, from the scatter between views.
    bound_m
        95 % bounds of the rms pose error with the stated and with the corrected calibration, m;
        inf where the poses are not bounded.
    """

    focal: float
    offset_m: float
    center_x: float
    center_y: float
    distortion: float
    sigmas: Mapping[str, float]
    bound_m: tuple[float, float]


@dataclass(frozen=True, eq=False)
class Diagnostics:
    """The verdict of a result, and its evidence.

    Attributes
    ----------
    verdict, reasons
        "good", "degraded" or "failed", and why; the most severe reason first.
    frames
        The outcome of every frame, in the order in which they were read.
    loops
        All candidates for loop closures, accepted or rejected.
    sequential
        (N, 4, 4) T_world_camera before loop closure, NaN where lost.
    objective
        Value of the optimiser's objective at every iteration (figure 5.3).
    removed
        Fraction of the points that each filter removed, by name.
    seconds, cpu_seconds
        Wall time of each stage by name, and the CPU time of all threads.
    cloud_before
        The model under the sequential poses; None where optimisation changed none of them.
    refinement
        Outcome of the global refinement; None where there was none.
    parts
        The connected parts of the pose graph, where the optimiser treats them separately.
    certified
        What is certified of the final poses, None where nothing is.
    priors
        Outcome of the external sensors.
    samples
        Small images of some frames; empty for clouds.
    accuracy
        95 % bounds of the pose errors.
    calibrated
        The self-calibration; None if the stated calibration was kept.
    joins
        The links that join the components of the main model.
    """

    verdict: Verdict
    reasons: tuple[Reason, ...]
    frames: tuple[FrameRecord, ...]
    loops: tuple[LoopRecord, ...]
    sequential: Float64
    objective: tuple[float, ...]
    removed: dict[str, float]
    seconds: dict[str, float]
    cpu_seconds: dict[str, float] = field(default_factory=dict)
    cloud_before: Cloud | None = None
    refinement: Refinement | None = None
    parts: tuple[GraphPart, ...] = ()
    certified: certificate.Certificate | None = None
    priors: tuple[external_sensors.SensorRecord, ...] = ()
    samples: tuple[frame_samples.FrameSample, ...] = ()
    accuracy: pose_accuracy.Accuracy = pose_accuracy.Accuracy()  # noqa: RUF009 - immutable
    calibrated: SelfCalibration | None = None
    joins: tuple[Join, ...] = ()

    def __repr__(self) -> str:
        codes = [reason.code for reason in self.reasons]
        return ", ".join(
            (f"Diagnostics: {self.verdict}", quantities.count(len(self.frames), "frame"), *codes)
        )


@dataclass(frozen=True, eq=False)
class Component:
    """A part of the recording that was tracked without interruption, or several joined ones.

    Attributes
    ----------
    frames
        (first, last) frame index of each range, ascending.
    T_main_component
        (4, 4), the identity for component 0, the main one; None where it is not connected to it.
    joined
        How it was connected: by "links" between its views and others, or over the gap only by
        recorded "odometry" or extrapolated "motion"; None for component 0 and where it is not
        connected.
    result
        Its own model, where it is not part of the main one and has more than a few frames: that of
        its frames only, in its own world frame.
    reached
        Largest probability of a pose relative to component 0, if it did not suffice; 0 without any.
    """

    frames: tuple[frame_ranges.Range, ...]
    T_main_component: Float64 | None
    joined: Literal["links", "motion", "odometry"] | None
    result: Reconstruction | None = None
    reached: float = 0.0

    @property
    def connected(self) -> bool:
        """Whether it is part of the main model."""
        return self.T_main_component is not None


@dataclass(frozen=True, eq=False)
class SessionRecord:
    """One of the recordings of a merged map.

    Attributes
    ----------
    name
        A unique name for display.
    result
        Folder of the result that it came from.
    opening
        How its recording was opened, as plain data.
    config
        The configuration that corrects and filters its frames, as plain data.
    first, count
        Its frames have the indices `first` to `first + count - 1` in the merged result.
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
        """Whether the frame with this index in the merged result is of this session."""
        return self.first <= index < self.first + self.count


@dataclass(frozen=True)
class SessionPair:
    """Whether two sessions overlap, and the evidence for it.

    Attributes
    ----------
    a, b
        Numbers of the sessions; a < b.
    joined
        Whether both are in the main model, directly or through other sessions.
    before
        Whether an earlier result had joined them.
    links
        Number of registrations between their views in the final model.
    probability
        Probability that the links which first joined the two are correct, 0 to 1; None where they
        were joined through others.
    overlap
        Fraction of a session's views that observe surfaces which the other one also observes; the
        smaller of the two values.
    support
        Fraction of their overlapping measurements that support the final poses, as opposed to
        contradicting them; None where they don't overlap.
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
    """A surface that exists in only one of two sessions.

    Attributes
    ----------
    a, b
        Numbers of the earlier and of the later session, in the order in which they were given.
    change
        The surface.
    """

    a: int
    b: int
    change: Change


@dataclass(frozen=True, eq=False)
class Mirror:
    """A mirror that was found, and what is seen in it cut out of the model.

    Attributes
    ----------
    normal, offset_m
        Its plane ``normal . p = offset_m``, in the world frame; the (3,) unit normal points to the
        cameras.
    corners
        (K, 3) of its convex outline, m.
    area_m2
        Of the outline.
    agreement
        Share of the ranges measured in it that agree with the reflection of the model.
    log_ratio
        Logarithm of the likelihood ratio of a mirror to chance.
    points
        (N, 3) of the model that were seen in it.
    """

    normal: Float64
    offset_m: float
    corners: Float64
    area_m2: float
    agreement: float
    log_ratio: float
    points: Float32


def in_main_model(record: FrameRecord, components: Sequence[Component]) -> bool:
    """Whether a frame has a pose in the main model, not only in that of another component.

    Without components every pose is in the main model.
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
        (N, 4, 4) T_world_camera of every frame, NaN where it has none in the main model; the first
        pose is the identity.
    timestamps
        (N,) seconds.
    graph
        Vertices are frame indices.
    cloud
        The fused point cloud, in the world frame.
    diagnostics
        The verdict and its evidence.
    mesh
        The fused surface, in the world frame; None for clouds without a camera.
    config
        The resolved configuration, as plain data.
    recording
        Its path, format, frames and the reader's warnings, as plain data.
    seed
        The random seed.
    threads
        The number of threads used.
    components
        Component 0 is the main one: trajectory, graph, cloud and mesh contain what is connected
        to it. Empty where the method does not separate components.
    sessions, session_pairs
        The recordings of a merged map, and the evidence that connects each two of them; empty for
        a run.
    changes
        Surfaces of the main model that changed between two sessions, in its world frame.
    mirrors
        Mirrors in the main model, if they were looked for.
    up
        (3,) unit vector against gravity in the world frame, measured by an accelerometer; None
        without one.
    shift
        (3,) m, of the clouds (`CloudFrame.shift`): everything here is relative to it. Files are
        written in the coordinates of the input's files.
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
    mirrors: tuple[Mirror, ...] = ()
    up: Float64 | None = None
    shift: Float64 = field(default_factory=lambda: np.zeros(3))

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
