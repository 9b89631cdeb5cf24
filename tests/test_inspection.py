"""What `inspect` says of a recording, and what it warns of."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import tofuse
from tofuse.cli import main
from tofuse.errors import InputError
from tofuse.files.ply import write_ply
from tofuse.geometry.cameras import Pinhole
from tofuse.inspection.inspect import inspect_recording
from tofuse.recordings.frames import CloudFrame, RangeFrame
from tofuse.recordings.recording import ArraySource, Recording

CAMERA = Pinhole(40, 30, 40.0, 40.0, 19.5, 14.5)


def of(frames, **options) -> Recording:
    return Recording.of(ArraySource(frames, **options), "somewhere", "frames")


def image(z: float, index: int = 0, valid: int | None = None, **channels) -> RangeFrame:
    depth = np.full((30, 40), z, np.float32)
    if valid is not None:
        depth.ravel()[valid:] = 0
    return RangeFrame(index, index / 10, CAMERA, depth, **channels)


@pytest.fixture
def copy(room_recording, tmp_path) -> Path:
    return shutil.copytree(room_recording, tmp_path / "rec")


def test_facts_of_a_simulated_recording(room_recording) -> None:
    found = inspect_recording(tofuse.open(room_recording))
    facts = found.facts
    assert facts["recording"] == str(room_recording)
    assert (facts["format"], facts["frames"]) == ("native", "8")
    assert facts["images"].startswith("176 x 144, ")
    assert "amplitude, confidence" in facts["with"]
    assert facts["reference poses"] == "for 8 frames"
    assert facts["odometry"] == "none"
    assert facts["valid points"].endswith("%")
    assert float(facts["confidence_max"]) == 7
    assert found.warnings == ()
    low, high = (float(w) for w in facts["depth"].split(" m,")[0].split(" to "))
    assert 0.3 < low < high < 8


def test_numbers_of_a_made_recording() -> None:
    frames = [image(2.0, k, valid=600) for k in range(11)]
    facts = inspect_recording(of(frames)).facts
    assert facts["time"] == "1.00 s, 10.0 frames a second"
    assert facts["depth"] == "2.00 to 2.00 m, median 2.00 m"
    assert facts["valid points"] == "50%"
    assert facts["images"].startswith("40 x 30, 52 x 40 degrees")
    assert facts["depth is"] == "z"
    assert facts["with"] == "nothing but depth"
    one = inspect_recording(of([image(2.0, depth_kind="range")])).facts
    assert (one["time"], one["depth is"]) == ("a single moment", "radial range")


def test_poses_that_are_known() -> None:
    poses = np.stack([np.eye(4)] * 3)
    poses[1] = np.nan
    facts = inspect_recording(
        of([image(2.0, k) for k in range(3)], odometry=poses, reference=poses[:, :, :] + 0)
    ).facts
    assert facts["odometry"] == facts["reference poses"] == "for 2 frames"


def test_facts_of_clouds(tmp_path) -> None:
    rng = np.random.default_rng(0)
    for k in range(3):
        write_ply(tmp_path / f"{k}.ply", rng.uniform(1, 2, (500, 3)).astype(np.float32))
    facts = inspect_recording(tofuse.open(tmp_path)).facts
    assert facts["views"] == "clouds of about 500 points"
    assert facts["format"] == "ply"
    assert facts["valid points"] == "100%"
    assert "images" not in facts


@pytest.mark.parametrize("z", [2000.0, 0.002])
def test_a_wrong_unit_is_noticed(z) -> None:
    for frame in (image(z), CloudFrame.of(image(z).points)):
        (warning,) = inspect_recording(of([frame])).warnings
        assert "depth_unit_m" in warning
        assert f"{z:.2g}"[:1] in warning


def test_millimetres_read_as_metres(copy, capsys) -> None:
    camera = json.loads((copy / "camera.json").read_text())
    (copy / "camera.json").write_text(json.dumps(camera | {"depth_unit_m": 1.0}))
    assert main(["inspect", str(copy)]) == 0
    said = capsys.readouterr().out
    assert "warning:" in said
    assert "check depth_unit_m" in said


def test_few_and_no_valid_points_are_noticed() -> None:
    (few,) = inspect_recording(of([image(2.0, valid=60)])).warnings
    assert few == "only 5.0% of the pixels are valid"
    found = inspect_recording(of([image(0.0)]))
    assert found.warnings == ("no valid point in the frames looked at: is the depth unit right?",)
    assert "no valid point" in found.facts["depth"]
    (empty,) = inspect_recording(of([CloudFrame.of(np.zeros((0, 3)))])).warnings
    assert "no valid point" in empty


def test_unreadable_frames_are_warned_of(copy) -> None:
    (copy / "depth/000002.png").write_bytes(b"")
    found = inspect_recording(tofuse.open(copy))
    assert len(found.warnings) == 1
    assert "000002.png" in found.warnings[0]
    assert found.facts["frames"] == "8"


def test_what_the_reader_warns_of_is_passed_on(copy, capsys) -> None:
    camera = json.loads((copy / "camera.json").read_text())
    (copy / "camera.json").write_text(json.dumps(camera | {"colour[x]": "grey"}))
    assert main(["inspect", str(copy), "--json"]) == 0
    data = json.loads(capsys.readouterr().out)
    assert set(data) == {"facts", "warnings"}
    assert any("colour[x]" in w for w in data["warnings"])
    assert main(["inspect", str(copy)]) == 0
    said = capsys.readouterr().out
    assert "colour[x]" in said  # brackets are no markup
    assert "\\" not in said


def test_a_long_recording_is_only_sampled() -> None:
    class Counting(ArraySource):
        def read(self, index):
            asked.append(index)
            return super().read(index)

    asked: list[int] = []
    frames = [image(2.0, k) for k in range(1000)]
    inspect_recording(Recording.of(Counting(frames), "x", "frames"))
    assert len(asked) <= 9
    assert (asked[0], asked[-1]) == (0, 999)


def test_nothing_readable() -> None:
    class Broken(ArraySource):
        def read(self, index):
            raise tofuse.errors.UnreadableFrameError("is broken", where=f"file {index}")

    recording = Recording.of(Broken([image(2.0)]), "somewhere", "frames")
    with pytest.raises(InputError, match="somewhere: no frame can be read; file 0: is broken"):
        inspect_recording(recording)


def test_channels_are_listed() -> None:
    colour = np.zeros((30, 40, 3), np.uint8)
    frame = replace(image(2.0), color_image=colour, amplitude_image=np.ones((30, 40), np.float32))
    assert inspect_recording(of([frame])).facts["with"] == "amplitude, colour"
