"""The five camera cases of chapter 4: every stride, method, guess and draw."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from time import perf_counter
from types import MappingProxyType
from typing import Any

import numpy as np

from tofuse.engine.arrays import Bool, Float32, Float64
from tofuse.engine.frames import Frame, RangeFrame, Recording
from tofuse.engine.geometry import se3
from tofuse.engine.loops import PriorLoop
from tofuse.engine.mapping import Config, changed, from_method, reconstructing
from tofuse.engine.progress import Progress
from tofuse.lab.experiments import measures
from tofuse.lab.experiments.measures import BoxFit, PathScore
from tofuse.lab.experiments.recorded import RecordedScene, record_scene
from tofuse.lab.scenes import box
from tofuse.lab.simulation import Effects
from tofuse.lab.world import SCENES

METHODS = ("thesis", "default")
GUESSES = ("identity", "previous")
# Results vary strongly with the 1000 points drawn, so that one draw is not significant.
DRAWS = 3
_MODEL_POINTS = 200_000
CHEST = (0.88, 0.94)  # heights of a band around the torso, m above the floor


@dataclass(frozen=True)
class Case:
    """One case of section 4.1.

    Attributes
    ----------
    scene
        Of the simulator.
    section
        Section of the thesis with its result.
    strides
        Strides over the raw frames.
    """

    scene: str
    title: str
    section: str
    text: str
    strides: tuple[int, ...]

    @property
    def stride(self) -> int:
        """The stride of the thesis."""
        return SCENES[self.scene].stride


CASES = (
    Case(
        "rail",
        "Translation of the camera",
        "5.1",
        "The camera slides 0.90 m to its right along a rail, facing an office desk, a chair and a "
        "plastic plant, and more slowly back again.",
        (3, 5, 7),
    ),
    Case(
        "room",
        "Room with reference objects",
        "5.2",
        "The camera turns once on its stand in the middle of a room of 6.0 x 3.2 m, in which seven "
        "office chairs stand evenly spaced.",
        (2, 3, 4),
    ),
    Case(
        "empty-room",
        "Empty room",
        "5.3",
        "The same turn in the same room without the chairs.",
        (2, 3, 4),
    ),
    Case(
        "torso",
        "Rotating torso",
        "5.4",
        "A person on a rotating chair turns once in front of a still camera; everything beyond the "
        "person is cut off by distance. The world is the person, whom the camera seems to orbit.",
        (3, 6, 9),
    ),
    Case(
        "box",
        "Rotating box",
        "5.5",
        "A box of 300 x 300 x 400 mm turns once on its stand in front of a still camera that sees "
        "its top as well; everything beyond is cut off by distance.",
        (5, 10, 15),
    ),
)


@dataclass(frozen=True, eq=False)
class Model:
    """Points of all frames merged by a set of poses, and measurements on them.

    Attributes
    ----------
    points
        (N, 3) float32 in the frame of the true surface, m; thinned.
    sizes
        By name, m and degrees.
    box
        The fit, where the case is the box.
    """

    points: Float32
    sizes: dict[str, float]
    box: BoxFit | None = None


@dataclass(frozen=True, eq=False)
class Estimate:
    """Poses (N, 4, 4) T_world_camera, NaN where lost, their errors, and their model."""

    poses: Float64
    score: PathScore
    model: Model


@dataclass(frozen=True, eq=False)
class Run:
    """One reconstruction.

    Attributes
    ----------
    draw
        Index of the draw of the random points: its seed minus that of the scene.
    truth
        (N, 4, 4) true T_world_camera.
    before, after
        The chained and the optimised estimate; points are stored for the first draw only.
    loop
        Whether the manually given loop was confirmed, and why.
    """

    case: str
    method: str
    guess: str
    stride: int
    draw: int
    truth: Float64
    before: Estimate
    after: Estimate
    loop: tuple[bool, str]
    objective: tuple[float, ...]
    verdict: str
    seconds: float

    @property
    def posed(self) -> int:
        """Number of frames with a pose."""
        return int(np.isfinite(self.before.poses[:, 0, 0]).sum())


@dataclass(frozen=True, eq=False)
class CaseResult:
    """All results of one case.

    Attributes
    ----------
    perfect
        The filtered frames of the thesis's stride merged by the true poses: the result of a perfect
        registration.
    samples
        Three of the frames, for display.
    T_truth_world
        (4, 4) from the world to the frame of the true surface.
    surface
        (K, 3) points on the true surface.
    facts
        Numbers of the case that don't depend on the run.
    """

    case: Case
    runs: tuple[Run, ...]
    perfect: Model
    samples: tuple[RangeFrame, ...]
    T_truth_world: Float64
    surface: Float64
    facts: dict[str, Any]
    seconds: dict[str, float] = field(default_factory=dict)

    def select(
        self, method: str, guess: str = "previous", stride: int | None = None
    ) -> tuple[Run, ...]:
        """Return all draws of one method, guess and stride (that of the thesis if not given)."""
        stride = self.case.stride if stride is None else stride
        return tuple(
            r for r in self.runs if (r.method, r.guess, r.stride) == (method, guess, stride)
        )


def run_case(
    case: Case,
    seed: int,
    progress: Progress,
    *,
    limit: int | None = None,
    draws: int = DRAWS,
    methods: Sequence[str] = METHODS,
    effects: Effects | None = None,
    changes: Mapping[str, Any] = MappingProxyType({}),
) -> CaseResult:
    """Simulate a case once and reconstruct it with every configuration.

    Parameters
    ----------
    seed
        Of the simulation, and of the first draw.
    limit
        Maximum number of raw frames.
    draws
        Number of repetitions with other random points of each run with the previous guess, and of
        each at the thesis's stride.
    methods
        Some of `METHODS`, "thesis" among them.
    effects
        Errors of the simulated camera; all of them by default.
    changes
        Of the configurations of the methods.
    """
    start = perf_counter()

    def report(done: int, total: int) -> None:
        if done == 1:
            progress.stage(f"{case.scene}: simulating", total)
        progress.advance()

    recorded = record_scene(
        case.scene, case.strides, seed, limit=limit, effects=effects, progress=report
    )
    simulation_end = perf_counter()
    plans = [
        (method, stride, guess, draw)
        for method in methods
        for stride in case.strides
        for guess in GUESSES
        for draw in range(draws if guess == "previous" or stride == case.stride else 1)
    ]
    progress.stage(f"{case.scene}: registering", len(plans))
    configs = {
        method: changed(configuration(method, recorded), changes, where="experiments")
        for method in methods
    }
    filtered = {method: recorded.filtered(config) for method, config in configs.items()}
    runs = []
    for method, stride, guess, draw in plans:
        source, config = filtered[method]
        config = changed(config, {"odometry": {"guess": guess}}, where="experiments")
        runs.append(_run(case, source, config, stride, seed, draw))
        progress.advance()
    thesis, _ = filtered["thesis"]
    recording = thesis.every(case.stride)
    facts = _facts(case, thesis, recording, {m: c.to_dict() for m, c in configs.items()})
    sample_indices = [round(k * (len(recording) - 1)) for k in (0.0, 1 / 3, 2 / 3)]
    samples = [recorded.every(case.stride)[k] for k in sample_indices]
    return CaseResult(
        case,
        tuple(runs),
        build_model(case, thesis, list(recording), recording.reference, keep_points=True),
        tuple(f for f in samples if isinstance(f, RangeFrame)),
        thesis.T_truth_world,
        thesis.surface,
        facts,
        {"simulation": simulation_end - start, "registration": perf_counter() - simulation_end},
    )


def configuration(method: str, recorded: RecordedScene) -> Config:
    """Return a method with the settings of chapter 4: loops by hand, background cut off."""
    config = from_method(method)
    filters = config.to_dict()["filters"]
    depth = recorded.plan.scene.max_depth_m
    if depth is not None:
        filters = [{"part": "distance", "maximum": depth}, *filters]
    changes = {
        "filters": filters,
        "loops": {"per_frame" if method == "thesis" else "per_view": 0},
        # The fused cloud is unused; a coarse one is cheap.
        "fusion": {"voxel_m": 0.1},
    }
    return changed(config, changes, where="experiments")


def _run(
    case: Case, recorded: RecordedScene, config: Config, stride: int, seed: int, draw: int
) -> Run:
    recording = recorded.every(stride)
    first, last = int(recording.indices[0]), int(recording.indices[-1])
    loops = [PriorLoop(first, last)] if last > first else []
    start = perf_counter()
    result = reconstructing.reconstruct(recording, config, seed=seed + draw, loops=loops)
    seconds = perf_counter() - start
    assert recording.reference is not None
    truth = recording.reference
    frames = list(recording)
    keep_points = draw == 0 and stride == case.stride
    before, after = (
        Estimate(
            poses,
            measures.score_path(poses, truth),
            build_model(case, recorded, frames, poses, keep_points=keep_points),
        )
        for poses in (result.diagnostics.sequential, result.trajectory)
    )
    record = next(iter(result.diagnostics.loops), None)
    return Run(
        case.scene,
        result.config["method"],
        result.config["odometry"]["guess"],
        stride,
        draw,
        truth,
        before,
        after,
        (False, "too short") if record is None else (record.accepted, record.reason),
        result.diagnostics.objective,
        result.diagnostics.verdict,
        seconds,
    )


def build_model(
    case: Case,
    recorded: RecordedScene,
    frames: list[Frame],
    poses: Float64 | None,
    *,
    keep_points: bool,
) -> Model:
    """Merge frames by poses (N, 4, 4), NaN where lost, and measure the model."""
    assert poses is not None
    step = max(1, -(-sum(len(f) for f in frames) // _MODEL_POINTS))
    parts = [
        se3.transform(recorded.T_truth_world @ T, frame.points[::step])
        for frame, T in zip(frames, poses, strict=True)
        if np.isfinite(T[0, 0])
    ]
    points = np.concatenate(parts)
    sizes = {"surface_error_m": measures.surface_error_m(points, recorded.surface_tree)}
    fit = None
    if case.scene in ("room", "empty-room"):
        extent = measures.extent_m(points)
        sizes |= {"length_m": float(extent[0]), "width_m": float(extent[1])}
    elif case.scene == "torso":
        sizes["girth_m"] = measures.girth_m(points, *CHEST)
    elif case.scene == "box" and len(points) > 100:
        fit = measures.fit_box(points, box.BOTTOM, box.HEIGHT, box.WIDTH)
        sizes |= {
            "width_a_m": float(fit.widths_m[0]),
            "width_b_m": float(fit.widths_m[1]),
            "height_m": fit.height_m,
            "worst_angle_deg": float(np.abs(fit.angles_deg - 90).max()),
        }
    return Model(
        points.astype(np.float32) if keep_points else np.zeros((0, 3), np.float32), sizes, fit
    )


_Facts = Callable[[RecordedScene, Recording], dict[str, Any]]


def _facts(
    case: Case, recorded: RecordedScene, recording: Recording, configs: dict[str, Any]
) -> dict[str, Any]:
    facts: dict[str, Any] = {
        "frames": {stride: len(recorded.every(stride)) for stride in case.strides},
        "configurations": configs,
    }
    extra: dict[str, _Facts] = {
        "room": lambda a, b: {"door": _door(a, b)},
        "empty-room": lambda a, b: {"corners": {s: corner_in_view(a, s) for s in case.strides}},
        "torso": lambda a, b: {"girth_m": measures.girth_m(a.surface, *CHEST)},
    }
    return facts | (extra[case.scene](recorded, recording) if case.scene in extra else {})


def corner_in_view(recorded: RecordedScene, stride: int) -> Bool:
    """(N,) mask of the frames of a stride with a visible corner of the room, by the true poses."""
    from tofuse.lab.scenes import room

    recording = recorded.every(stride)
    frame = recording[0]
    assert isinstance(frame, RangeFrame)
    assert recording.reference is not None
    T = recorded.T_truth_world @ recording.reference
    half_fov = np.arctan(np.nanmax(np.abs(frame.camera.rays()[..., 0])))
    x, y = room.LENGTH / 2, room.WIDTH / 2
    visible = np.zeros(len(T), bool)
    for corner in ((x, y), (-x, y), (-x, -y), (x, -y)):
        towards = np.array(corner) - T[:, :2, 3]
        forward = T[:, :2, 2]
        cosine = (towards * forward).sum(1) / (
            np.linalg.norm(towards, axis=1) * np.linalg.norm(forward, axis=1)
        )
        # A few degrees inside the image, so that both walls are visible.
        visible |= np.arccos(np.clip(cosine, -1, 1)) < half_fov - np.radians(4)
    return visible


def _door(recorded: RecordedScene, recording: Recording) -> dict[str, float]:
    """Points per frame on the glossy door, and on the section of that wall at -x."""
    from tofuse.lab.scenes import room

    counts = {"door": 0, "wall": 0}
    frames = list(recording)
    for frame in frames:
        p = se3.transform(recorded.T_truth_world @ recorded.poses[frame.index], frame.points)
        on_wall = (np.abs(p[:, 1] + room.WIDTH / 2) < 0.15) & (p[:, 2] < 2.0)
        for name, side in (("door", 1), ("wall", -1)):
            x = side * p[:, 0]
            counts[name] += int((on_wall & (x > 1.4) & (x < 2.2)).sum())
    return {name: count / len(frames) for name, count in counts.items()}
