"""Interrupted runs go on after tracking, with the bytes of an uninterrupted run."""

from __future__ import annotations

import gc
import json
import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import tofuse
from made_rooms import BOXES, at, seen
from tofuse.apps.cli.program import main
from tofuse.apps.jobs import running as run
from tofuse.apps.jobs import tracked_file
from tofuse.apps.jobs.tracked_file import LoggingTracker, ReplayingTracker, TrackedFile
from tofuse.apps.results.folders import TRACKED
from tofuse.engine.errors import Ended
from tofuse.engine.frames.recording import ArraySource, Recording
from tofuse.engine.fusion.options import Fusion
from tofuse.engine.loops.joining import Joining
from tofuse.engine.mapping import reconstructing as reconstruct
from tofuse.engine.mapping.frame_log import FrameLog
from tofuse.engine.mapping.methods import from_method
from tofuse.engine.progress import Silent
from tofuse.engine.results.types import FrameRecord
from tofuse.engine.search.search_grid import SearchOptions
from tofuse.engine.tracking.base import Step, Tracker
from tofuse.engine.tracking.keyframe_map import Keyframe
from written_run_json import run_json

SAME = ("trajectory.txt", "pose_graph.g2o", "cloud.ply", "mesh.ply", "mesh.glb")
DEFAULT = from_method("default")
# Coarse and fast.
CONFIG = replace(
    DEFAULT,
    corrections=(),
    fusion=Fusion(voxel_m=0.05),
    loops=replace(DEFAULT.loops, searches=0, similar_pairs=0),
    search=SearchOptions("full", full_candidates=15, photometric_candidates=5),
    joining=Joining(searches=2),
    self_calibration=False,
)


@pytest.fixture(autouse=True)
def always_stored(monkeypatch: pytest.MonkeyPatch) -> None:
    """Short runs store their tracked frames as long ones do, and write no report."""
    monkeypatch.setattr(tracked_file, "_MIN_TRACKING_S", 0.0)

    def write_report(*args: Any, **_: object) -> None:
        (args[-1] / "report.html").write_text("report")

    monkeypatch.setattr(run, "write_report_files", write_report)


def moving_scene() -> Recording:
    """A box moves through a room; the camera then jumps, and an image is blank."""
    frames = []
    for k in range(14):
        box = ((-0.5 + 0.08 * k, 0.5, 1.0), (0.25, 0.3, 0.2), 0.3)
        T = at(0.0, 0.02 * k - 0.6, 0.02 * k) if k < 9 else at(0.4, 0.3, 2.4 + 0.05 * k)
        frames.append(seen(T, k, boxes=(*BOXES, box)))
    frames[8] = replace(frames[8], depth=np.zeros_like(frames[8].depth))
    return Recording.of(ArraySource(frames), "made", "test")


def comparable(result: tofuse.Reconstruction) -> list[object]:
    """What must be identical."""
    data = run_json(result)
    del data["seconds"], data["cpu_seconds"], data["sha256"]  # of the file, which has the times
    arrays = [result.trajectory, result.graph.information, result.cloud.points, result.cloud.sigma]
    return [json.dumps(data), *(a.tobytes() for a in arrays)]


@pytest.mark.nightly
def test_reconstruction_is_repeated_exactly(tmp_path: Path, monkeypatch) -> None:
    """Also with moving objects, lost frames, components and their links."""
    recording = moving_scene()
    kept: list[FrameLog] = []
    finish = TrackedFile.finish
    monkeypatch.setattr(
        TrackedFile, "finish", lambda self, t, log: kept.append(log) or finish(self, t, log)
    )
    trackers: list[Tracker] = []
    start = TrackedFile.tracker
    monkeypatch.setattr(
        TrackedFile, "tracker", lambda self, t: trackers.append(start(self, t)) or trackers[-1]
    )
    results = []
    for threads in (2, 1):
        file = TrackedFile(tmp_path / TRACKED, "key", lambda _text: None)
        results.append(
            reconstruct.reconstruct(recording, CONFIG, threads=threads, tracked_frames=file)
        )
    assert [type(t) for t in trackers] == [LoggingTracker, ReplayingTracker]
    whole, again = (replace(result, threads=1) for result in results)
    assert comparable(again) == comparable(whole)
    first = [e.step for e in kept[0].entries]
    # The recording has all that.
    assert any(e.moving_fraction > 0 for e in kept[0].entries)
    assert {step.status for step in first} >= {"tracked", "lost"}
    assert len({step.component for step in first}) > 1


class StopsAfterTracking(Silent):
    """Counts the tracker's keyframes in memory when loops are closed, and stops."""

    keyframes = -1

    def stage(self, name: str, total: int | None = None) -> None:
        if name == "closing loops":
            self.keyframes = sum(isinstance(x, Keyframe) for x in gc.get_objects())
            raise KeyboardInterrupt


def test_keyframes_are_released_after_tracking(tmp_path: Path) -> None:
    """They are large; without reference cycles they don't wait for the garbage collector."""
    file = TrackedFile(tmp_path / TRACKED, "key", lambda _text: None)
    progress = StopsAfterTracking()
    gc.collect()
    gc.disable()
    try:
        with pytest.raises(KeyboardInterrupt):
            reconstruct.reconstruct(moving_scene(), CONFIG, tracked_frames=file, progress=progress)
    finally:
        gc.enable()
    assert progress.keyframes == 0


def interrupted_at(stage: str, error: BaseException, words: Sequence[str]) -> int:
    """Exit status of a run with an error at the beginning of a stage."""

    def begin(_self, name: str, total: int | None = None) -> None:
        if name == stage:
            raise error

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tofuse.apps.cli.progress.QuietProgress.stage", begin)
        return main(words)


@pytest.mark.nightly_part
def test_interrupted_run_gives_same_bytes(room_recording: Path, tmp_path: Path, capfd) -> None:
    options = [str(room_recording), "--every", "2", "--voxel", "5cm", "--out"]
    whole, out = tmp_path / "whole", tmp_path / "out"
    assert main(["run", *options, str(whole)]) == 0
    words = ["run", *options, str(out)]

    assert interrupted_at("tracking", KeyboardInterrupt(), words) == 130
    assert capfd.readouterr().err.endswith("; the same command starts again from the beginning\n")
    assert not out.exists()
    assert interrupted_at("closing loops", KeyboardInterrupt(), words) == 130
    assert capfd.readouterr().err.endswith("; the same command goes on after tracking\n")
    assert interrupted_at("fusing", Ended(15), words) == 143
    assert capfd.readouterr().err.endswith("; the same command goes on after tracking\n")
    assert os.listdir(out) == [TRACKED]

    assert main(words) == 0
    assert "goes on after the tracking of an interrupted run" in capfd.readouterr().err
    assert {p.name for p in out.iterdir()} == {p.name for p in whole.iterdir()}
    for name in SAME:
        assert (out / name).read_bytes() == (whole / name).read_bytes(), name
    one, other = (json.loads((folder / "run.json").read_text()) for folder in (whole, out))
    changed = {key for key in one if one[key] != other[key]}
    assert changed <= {"seconds", "cpu_seconds", "sha256"}
    for name in SAME:
        assert one["sha256"][name] == other["sha256"][name]


@pytest.mark.parametrize("change", ["options", "input", "damage"])
def test_other_or_damaged_file_is_not_used(change, room_recording, tmp_path, capfd) -> None:
    out = tmp_path / "out"
    words = ["run", str(room_recording), "--every", "4", "--method", "thesis", "--out", str(out)]
    assert interrupted_at("fusing", KeyboardInterrupt(), words) == 130
    image = sorted((room_recording / "depth").iterdir())[0]
    data = bytearray((out / TRACKED).read_bytes())
    status = image.stat()
    if change == "options":
        words += ["--seed", "1"]
    elif change == "input":
        os.utime(image, ns=(status.st_atime_ns, status.st_mtime_ns + 1))
    else:
        data[len(data) // 2] ^= 1
        (out / TRACKED).write_bytes(data)
    capfd.readouterr()
    assert main(words) == 0
    os.utime(image, ns=(status.st_atime_ns, status.st_mtime_ns))
    message = capfd.readouterr().err
    expected = "are damaged" if change == "damage" else "belong to another input, other options"
    assert expected in message
    assert "it starts again from the beginning" in message
    assert not (out / TRACKED).exists()


class Still(Tracker):
    def push(self, frame, T_odometry=None, surface=None) -> Step:
        return Step("tracked", "", np.eye(4))


def stored(path: Path, notes: list[str], count: int = 3) -> TrackedFile:
    """The file of some frames at one place."""
    file, log = TrackedFile(path, "key", notes.append), FrameLog()
    tracker = file.tracker(Still())
    for k in range(count):
        log.add(FrameRecord(k, 0.1 * k, "tracked"), tracker.push(seen(np.eye(4), k)))
    file.finish(tracker, log)
    return file


@pytest.mark.parametrize(
    "data", [b"", b"\x00" * 100, b"x", "empty", "no steps", "other steps", "short", "objects"]
)
def test_invalid_file_is_never_fatal(data: bytes | str, tmp_path: Path) -> None:
    path, notes = tmp_path / TRACKED, []
    stored(path, notes)
    arrays = dict(np.load(path))
    made = {
        "empty": {},
        "no steps": {name: a for name, a in arrays.items() if name != "steps"},
        "other steps": arrays | {"steps": np.frombuffer(b"[[1, 2], null, 3]", np.uint8)},
        "short": arrays | {"steps": arrays["steps"][:-9]},
        "objects": arrays | {"steps": np.array([{}], object)},
    }
    if isinstance(data, bytes):
        path.write_bytes(data)
    else:
        with path.open("wb") as file:
            np.savez(file, **made[data])
    assert isinstance(TrackedFile(path, "key", notes.append).tracker(Still()), LoggingTracker)
    (note,) = notes
    assert "are damaged" in note
    assert not path.exists()


def test_full_disk_does_not_stop_run(tmp_path: Path, monkeypatch) -> None:
    def full(*_args: object, **_options: object) -> None:
        raise OSError(28, "No space left on device")

    notes: list[str] = []
    monkeypatch.setattr(np, "savez_compressed", full)
    stored(tmp_path / TRACKED, notes)
    assert "no space left" in notes[0].lower()
    assert os.listdir(tmp_path) == []


def test_folder_in_place_of_the_file_is_left(tmp_path: Path) -> None:
    (tmp_path / "a.npz").mkdir()
    TrackedFile(tmp_path / "a.npz", "key", print).remove()
    assert (tmp_path / "a.npz").is_dir()
