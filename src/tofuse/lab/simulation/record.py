"""Simulated recordings: in memory, or as a native folder with the ground truth."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, TypedDict, Unpack

import numpy as np

from tofuse.engine.arrays import Float64, Intp
from tofuse.engine.frames import ArraySource, RangeFrame, Recording
from tofuse.engine.fusion import GeometryRecord
from tofuse.engine.geometry import se3
from tofuse.engine.sensor import DepthCorrection
from tofuse.formats.cameras import corrected_depth
from tofuse.formats.files import atomic
from tofuse.formats.geometry import write_ply
from tofuse.formats.images import write_png
from tofuse.formats.recordings import RecordingWriter
from tofuse.lab.simulation import sensor
from tofuse.lab.simulation.accelerometer import accelerations
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.mirrors import hang_mirror
from tofuse.lab.simulation.models import CameraModel, camera_model
from tofuse.lab.simulation.passing import Passing, add_distractor
from tofuse.lab.simulation.peaks import peaks_cameras, peaks_points, peaks_views
from tofuse.lab.simulation.render import RenderedFrame, render
from tofuse.lab.simulation.truth import write_surface
from tofuse.lab.world import scene as scenes

# Called with the number of frames done and the total.
Progress = Callable[[int, int], None]

_DEFAULT = Effects()


@dataclass(frozen=True, eq=False)
class RecordingPlan:
    """A planned recording.

    Attributes
    ----------
    raw
        (N,) indices of the raw frames to render.
    """

    scene: scenes.Scene
    sequence: scenes.Sequence
    model: CameraModel
    effects: Effects
    seed: int
    raw: Intp

    @property
    def poses(self) -> Float64:
        """(N, 4, 4) true T_world_camera."""
        rate = self.sequence.frame_rate_hz
        poses = [self.sequence.T_world_camera(k / rate, self.raw[0] / rate) for k in self.raw]
        # Exactly the identity, despite rounding.
        poses[0] = np.eye(4)
        return np.stack(poses)

    @property
    def correction(self) -> DepthCorrection:
        """The factory correction of the camera."""
        return sensor.factory_correction(self.model, self.effects)

    def frames(self, progress: Progress | None) -> Iterator[RenderedFrame]:
        """Render the frames, numbered from 0."""
        for k, raw in enumerate(self.raw):
            rendered = render(
                self.scene,
                self.sequence,
                self.model,
                int(raw),
                effects=self.effects,
                seed=self.seed,
            )
            yield replace(rendered, frame=replace(rendered.frame, index=k))
            if progress is not None:
                progress(k + 1, len(self.raw))

    def corrected_frames(self, progress: Progress | None = None) -> Iterator[RangeFrame]:
        """Render the frames, and apply the factory correction."""
        correction = self.correction
        for rendered in self.frames(progress):
            yield corrected(rendered.frame, correction)

    @property
    def facts(self) -> dict[str, Any]:
        """What camera.json says of the images."""
        model = self.model
        return {
            "sensor": f"{model.name} (simulated)",
            "frame_rate_hz": self.sequence.frame_rate_hz,
            "ambiguity_m": model.ambiguity_m,
            "confidence_max": model.confidence_max,
            "amplitude_kind": model.amplitude_kind,
            "depth_unit_m": model.depth_unit_m,
            "depth_kind": model.depth_kind,
        }

    def recording(self, *, correction: bool = True, progress: Progress | None = None) -> Recording:
        """Render it in memory, with the true poses as its reference; see `simulate`."""
        images = (
            [*self.corrected_frames(progress)]
            if correction
            else [rendered.frame for rendered in self.frames(progress)]
        )
        known = {name: value for name, value in self.facts.items() if value is not None}
        source = ArraySource(images, self.poses, metadata=known | {"corrected": correction})
        return Recording.of(source, f"simulated {self.scene.name}", "simulated")


def corrected(frame: RangeFrame, correction: DepthCorrection) -> RangeFrame:
    """Return a frame with the depth that a factory correction gives."""
    depth = corrected_depth(correction, frame.camera, frame.depth, frame.depth_kind)
    return replace(frame, depth=depth)


def plan(
    scene: str,
    *,
    camera: str = "sr4000",
    seed: int = 0,
    effects: Effects = _DEFAULT,
    every: int | None = None,
    frames: int | None = None,
    first: int = 0,
    texture: bool = True,
    passing: Passing | None = None,
    mirror: tuple[float, float] | None = None,
) -> RecordingPlan:
    """Plan a recording; see `simulate` for the parameters.

    Raises
    ------
    InputError
        For an unknown scene or camera, a stride or number of frames below 1, or a first frame out
        of range.
    """
    model = camera_model(camera)
    built, sequence = scenes.build(scene, seed=seed, texture=texture)
    raw = sequence.selected(every, frames, first)
    if mirror is not None:
        times = raw / sequence.frame_rate_hz
        built, _ = hang_mirror(built, sequence, model, mirror, times=times, seed=seed)
    if passing is not None:
        times = raw[[0, -1]] / sequence.frame_rate_hz
        built, sequence = add_distractor(
            built, sequence, model, passing, first=times[0], last=times[1], seed=seed,
            texture=texture,
        )  # fmt: skip
    return RecordingPlan(built, sequence, model, effects, seed, raw)


class PlanOptions(TypedDict, total=False):
    """The options of `plan`."""

    camera: str
    seed: int
    effects: Effects
    every: int | None
    frames: int | None
    first: int
    texture: bool
    passing: Passing | None
    mirror: tuple[float, float] | None


def simulate_recording(
    scene: str,
    *,
    correction: bool = True,
    sigma_m: float = 0.05,
    progress: Progress | None = None,
    **options: Unpack[PlanOptions],
) -> Recording:
    """Simulate a recording in memory, equal to one read from the output of `simulate`.

    The true poses are its reference. See `simulate` for the parameters.
    """
    if scene != "peaks":
        return plan(scene, **options).recording(correction=correction, progress=progress)
    views, poses = peaks_views(sigma_m, options.get("seed", 0))
    every, frames = options.get("every"), options.get("frames")
    selection = slice(None, frames and frames * (every or 1), every)
    selected = [replace(view, index=k) for k, view in enumerate(views[selection])]
    return Recording.of(ArraySource(selected, poses[selection]), "simulated peaks", "simulated")


def simulate(
    scene: str,
    out: str | Path,
    *,
    correction: bool = True,
    imu: bool = False,
    sigma_m: float = 0.05,
    progress: Progress | None = None,
    **options: Unpack[PlanOptions],
) -> Path:
    """Simulate a recording as a native folder, with the truth in groundtruth.txt and truth/.

    Parameters
    ----------
    scene
        One of `scene.SCENES`, or "peaks", which consists of clouds and has no camera.
    out
        The folder; created if missing, must be empty.
    camera
        One of `simulation.models.CAMERAS`.
    seed
        Of scene and noise.
    effects
        Simulated errors of the camera.
    every
        Stride over raw frames; that of the thesis if not given. A raw frame does not depend on it.
    frames
        Maximum number of frames.
    first
        First raw frame; its camera frame is the world.
    correction
        Whether the factory correction is written along with the (uncorrected) depth.
    texture
        False gives every surface the same albedo.
    passing
        A distractor that passes through the view; its pixels are flagged in truth/flags. It is not
        part of the surface in truth/.
    mirror
        Width and height in m of a mirror on a wall that the camera sees; its pixels are flagged.
    imu
        Whether an accelerometer on the camera is recorded as well.
    sigma_m
        Noise of "peaks" in m.
    progress
        Called with the number of frames done and the total.

    Returns
    -------
    The folder.

    Raises
    ------
    InputError
        For an unknown scene or camera, or an invalid number.
    OutputError
        If the folder can't be written or isn't empty.
    """
    if scene == "peaks":
        return _write_peaks(Path(out), simulate_recording(scene, sigma_m=sigma_m, **options))
    return write(plan(scene, **options), out, correction=correction, imu=imu, progress=progress)


def write(
    planned: RecordingPlan,
    out: str | Path,
    *,
    correction: bool = True,
    imu: bool = False,
    progress: Progress | None = None,
) -> Path:
    """Render a planned recording and write it as a native folder; see `simulate`."""
    model, effects, seed = planned.model, planned.effects, planned.seed
    writer = RecordingWriter(out, model.camera, **planned.facts)
    truth = writer.folder / "truth"
    flags, depths = atomic.make_folder(truth / "flags"), atomic.make_folder(truth / "depth")
    for k, rendered in enumerate(planned.frames(progress)):
        writer.add(rendered.frame)
        write_png(flags / f"{k:06d}.png", rendered.flags)
        counts = np.round(rendered.depth.astype(float) / model.depth_unit_m)
        write_png(depths / f"{k:06d}.png", np.where(counts < 65535, counts, 0).astype(np.uint16))
    times = planned.raw / planned.sequence.frame_rate_hz
    write_surface(truth, planned.scene, planned.sequence, times[0])
    return writer.finish(
        groundtruth=planned.poses,
        correction=planned.correction if correction else None,
        imu=accelerations(planned.sequence, times[0], times[-1], seed) if imu else None,
        frames={
            "integration_us": np.full(len(times), round(model.integration_s * 1e6)),
            "drift_m": np.array([sensor.drift(model, t) for t in times]) * effects.thermal_drift,
        },
    )


def _write_peaks(out: Path, recording: Recording) -> Path:
    writer = RecordingWriter(out, None, sensor="peaks (simulated)")
    for frame in recording:
        writer.add(frame)
    T_camera_object = se3.inverse(peaks_cameras()[0])
    truth = atomic.make_folder(writer.folder / "truth")
    write_ply(truth / "surface.ply", GeometryRecord(se3.transform(T_camera_object, peaks_points())))
    return writer.finish(groundtruth=recording.reference)
