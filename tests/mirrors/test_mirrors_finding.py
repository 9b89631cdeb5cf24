"""Mirrors of reconstructed rooms: found and cut out; a doorway is none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cli_calls import call
from tofuse.apps.mirrors import find_mirrors, sentences
from tofuse.apps.results import run_json
from tofuse.engine.cameras import Pinhole
from tofuse.engine.frames import ArraySource, Recording
from tofuse.engine.geometry import se3
from tofuse.engine.mapping import reconstructing
from tofuse.engine.results import Reconstruction
from tofuse.lab.simulation import Effects, RecordingPlan
from tofuse.lab.simulation.mirrors import Mirror, hang_mirror
from tofuse.lab.simulation.models import camera_model
from tofuse.lab.world import paths
from tofuse.lab.world import scene as scenes


def _recording(
    name: str, frames: int, rate: float, path: paths.Path, size: tuple[float, float] | None
) -> tuple[Recording, Mirror | None, np.ndarray]:
    camera = Pinhole(80, 60, 69.3, 69.3, 39.5, 29.5)
    model = replace(camera_model("ifm-o3r"), camera=camera, frame_rate_hz=rate)
    scene = scenes.build(name, seed=0)[0]
    sequence = scenes.Sequence(frames, 1, rate, path)
    mirror = None
    if size:
        times = np.arange(frames) / rate
        scene, mirror = hang_mirror(scene, sequence, model, size, times=times, seed=0)
    effects = Effects().without("multipath", "smear", "wiggling", "pixel_offsets", "thermal_drift")
    plan = RecordingPlan(scene, sequence, model, effects, 0, np.arange(frames))
    metadata = {"ambiguity_m": model.ambiguity_m, "amplitude_kind": model.amplitude_kind}
    source = ArraySource([r.frame for r in plan.frames(None)], plan.poses, metadata=metadata)
    return Recording.of(source, "simulated", "simulated"), mirror, sequence.T_world_truth()


@pytest.fixture(scope="module")
def mirrored() -> tuple[Reconstruction, Reconstruction, Mirror, np.ndarray]:
    turn = paths.camera_turn(paths.look_at((0, 0, 1.2), (1, 0.2, 1.1)), 12.0)
    recording, mirror, T = _recording("empty-room", 60, 5.0, turn, (1.2, 1.0))
    assert mirror is not None
    result = reconstructing.reconstruct(recording)
    return result, find_mirrors(recording, result), mirror, T


def test_mirror_is_found(
    mirrored: tuple[Reconstruction, Reconstruction, Mirror, np.ndarray],
) -> None:
    _, found, mirror, T = mirrored
    best, *others = found.mirrors
    assert not others
    assert best.area_m2 == pytest.approx(mirror.area, rel=0.15)
    assert best.normal @ T[:3, :3] @ mirror.normal > 0.999
    centre = se3.transform(T, mirror.centre[None])[0]
    assert abs(best.normal @ centre - best.offset_m) < 0.03
    assert np.linalg.norm(best.corners.mean(0) - centre) < 0.15
    assert any("cut out of the model" in sentence for sentence in sentences(found))
    (written, *_) = run_json._content(found)["mirrors"]
    assert written["points"] == len(best.points)


def test_no_point_is_left_behind_it(
    mirrored: tuple[Reconstruction, Reconstruction, Mirror, np.ndarray],
) -> None:
    before, found, mirror, T = mirrored
    assert found.mesh is not None
    assert before.mesh is not None

    def behind(points: np.ndarray) -> int:
        p = se3.transform(se3.inverse(T), points.astype(float)) - mirror.centre
        inside = (np.abs(p @ mirror.half_edges.T) < (mirror.half_edges**2).sum(1)).all(1)
        return int((inside & (p @ mirror.normal < -0.15)).sum())

    assert behind(before.cloud.points) > 100
    assert behind(found.cloud.points) == 0
    assert behind(found.mesh.vertices) == 0
    # What is in front of the mirror stays.
    in_front = before.cloud.points @ found.mirrors[0].normal > found.mirrors[0].offset_m
    assert len(found.cloud) >= in_front.sum()


@pytest.mark.nightly
def test_doorway_is_no_mirror() -> None:
    walk = scenes.build("flat", seed=0)[1].camera_path
    recording, _, _ = _recording("flat", 50, 10.0, lambda t: walk(20.0 + t), None)
    result = reconstructing.reconstruct(recording)
    found = find_mirrors(recording, result)
    assert not found.mirrors
    assert len(found.cloud) == len(result.cloud)


def test_run_json_without_mirrors_is_as_before(
    mirrored: tuple[Reconstruction, Reconstruction, Mirror, np.ndarray],
) -> None:
    assert "mirrors" not in run_json._content(mirrored[0])


def test_run_says_that_there_is_none(room_recording, tmp_path, capfd) -> None:
    words = ("--end", 3, "--out", tmp_path / "out", "--no-report", "--mirrors")
    assert call("run", room_recording, *words) == 0
    assert "no mirror was found" in "".join(capfd.readouterr())
