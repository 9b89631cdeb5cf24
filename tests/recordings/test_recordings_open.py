from __future__ import annotations

import json
import pickle
import re
import shutil
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pytest

from made_phones import exr_bytes, make_scanner_app
from refused import refused
from tofuse.engine.cameras.cameras import BrownConrady, Pinhole
from tofuse.engine.errors import InputError, UnreadableFrameError, on_command_line
from tofuse.engine.frames.frames import CloudFrame, Frame, RangeFrame
from tofuse.engine.frames.recording import ArraySource, Recording
from tofuse.engine.fusion.geometry_record import GeometryRecord
from tofuse.engine.geometry import se3
from tofuse.engine.noise import NOISE, noise_model_for
from tofuse.formats.cameras import write_noise
from tofuse.formats.export.conversion import convert
from tofuse.formats.geometry.ply import write_ply
from tofuse.formats.images import write_png
from tofuse.formats.recordings.joined import JoinedSource
from tofuse.formats.recordings.native import RecordingWriter
from tofuse.formats.recordings.open import (
    Opening,
    ReadingOptions,
    open_recording,
    open_view,
    readers,
)

CAMERA = Pinhole(40, 30, 35.0, 36.0, 19.5, 14.5)


def write(folder: Path, depths: list[float], *, poses: bool = False) -> Path:
    writer = RecordingWriter(folder, CAMERA, frame_rate_hz=10.0)
    for k, depth in enumerate(depths):
        writer.add(RangeFrame(k, k / 10, CAMERA, np.full((30, 40), depth, np.float32)))
    return writer.finish(groundtruth=np.tile(np.eye(4), (len(depths), 1, 1)) if poses else None)


def depths(recording: Recording) -> list[float]:
    return [round(float(f.points[0, 2]), 3) for f in recording]


def test_several_paths_are_joined_in_given_order(tmp_path: Path) -> None:
    write(tmp_path / "a", [1, 2])
    write(tmp_path / "b", [3, 4, 5], poses=True)
    recording = open_recording(tmp_path / "b", tmp_path / "a")
    assert depths(recording) == [3, 4, 5, 1, 2]
    assert [f.index for f in recording] == [0, 1, 2, 3, 4]
    np.testing.assert_allclose(recording.timestamps, [0, 0.1, 0.2, 0.3, 0.4])
    assert [f.timestamp for f in recording] == recording.timestamps.tolist()
    assert np.isfinite(recording.reference[:, 0, 0]).tolist() == [True] * 3 + [False] * 2
    assert recording.metadata["parts"] == [{"name": "b", "frames": 3}, {"name": "a", "frames": 2}]
    twice = JoinedSource([recording.source, open_recording(tmp_path / "a").source], ["c", "d"])
    found = [(part["name"], part["frames"]) for part in twice.metadata["parts"]]
    assert found == [("c, b", 3), ("c, a", 2), ("d", 2)]
    assert twice.read(6).points[0, 2] == 2


def test_topic_is_refused_where_nothing_selects_by_it(tmp_path: Path) -> None:
    refused(r"^topic: does not apply to the format 'native'", write(tmp_path, [1]), topic="/depth")


def test_noise_model_of_all_parts_is_that_of_the_whole(tmp_path: Path) -> None:
    for name in "ab":
        write(tmp_path / name, [1])
        write_noise(tmp_path / name / "noise.json", NOISE["sr4000"])
    joined = open_recording(tmp_path / "a", tmp_path / "b")
    assert noise_model_for(joined) == noise_model_for(open_recording(tmp_path)) == NOISE["sr4000"]
    copy = convert(joined, tmp_path / "copy").folder
    assert noise_model_for(open_recording(copy)) == NOISE["sr4000"]
    (tmp_path / "b" / "noise.json").unlink()
    assert noise_model_for(open_recording(tmp_path / "a", tmp_path / "b")) == NOISE["unknown"]


def test_folder_of_recordings_is_joined_in_name_order(tmp_path: Path) -> None:
    for name, depth in (("part10", 3), ("part2", 2), ("part1", 1)):
        write(tmp_path / name, [depth])
    (tmp_path / "notes.txt").write_text("")
    assert depths(open_recording(tmp_path)) == [1, 2, 3]
    assert depths(open_recording(tmp_path, format="native")) == [1, 2, 3]
    assert depths(open_recording(tmp_path).select(1)) == [2, 3]


def test_folder_with_single_recording_stands_for_it(tmp_path: Path) -> None:
    """An app's folder in one of the user, with notes beside it."""
    make_scanner_app(tmp_path / "Küche 1" / "2026_11_28")
    (tmp_path / "Küche 1" / "notes.txt").write_text("")
    recording = open_recording(tmp_path / "Küche 1")
    assert (recording.format, len(recording)) == ("3dscannerapp", 3)
    (tmp_path / "one" / "in").mkdir(parents=True)
    (tmp_path / "Küche 1").rename(tmp_path / "one" / "in" / "another")
    assert len(open_recording(tmp_path / "one")) == 3
    (tmp_path / "one" / "in" / "another").rename(tmp_path / "Küche 1")
    make_scanner_app(tmp_path / "Küche 1" / "2026_11_29")
    refused("several recordings: 2026_11_28", tmp_path / "Küche 1")
    write(tmp_path / "native" / "part1", [1])
    (tmp_path / "native" / "part1" / "noise.json").write_text("{}")
    refused(r"noise\.json", tmp_path / "native")
    # A mesh of the scene beside the folder of its frames, as in 3RScan and 12-Scenes.
    (tmp_path / "3rscan").mkdir()
    write_ply(tmp_path / "3rscan" / "mesh.ply", GeometryRecord(np.ones((3, 3))))
    make_scanner_app(tmp_path / "3rscan" / "sequence")
    refused(r"and a recording in sequence/; pass .*format ply", tmp_path / "3rscan")
    assert open_recording(tmp_path / "3rscan", format="ply").format == "ply"
    assert len(open_recording(tmp_path / "3rscan", format="3dscannerapp")) == 3
    # Clouds in a folder may as well be a model beside images of an unknown format.
    (tmp_path / "unknown" / "mesh").mkdir(parents=True)
    write_ply(tmp_path / "unknown" / "mesh" / "0.ply", GeometryRecord(np.ones((3, 3))))
    refused(r"contains only mesh \(ply\)", tmp_path / "unknown")


def test_recordings_of_different_formats_are_not_joined_by_default(tmp_path: Path) -> None:
    write(tmp_path / "a", [1])
    (tmp_path / "b").mkdir()
    write_ply(tmp_path / "b" / "0.ply", GeometryRecord(np.ones((3, 3))))
    refused(r"several recordings: a \(native\), b \(ply\)", tmp_path)
    assert open_recording(tmp_path / "a", tmp_path / "b").format == "native+ply"


def test_ambiguous_format_is_refused(tmp_path: Path) -> None:
    write_ply(tmp_path / "0.ply", GeometryRecord(np.ones((3, 3))))
    (tmp_path / "0.xyz").write_text("1 2 3\n")
    refused("format ply or xyz", tmp_path)
    assert open_recording(tmp_path, format="xyz").format == "xyz"


def test_cloud_beside_native_recording_is_ignored(tmp_path: Path) -> None:
    folder = write(tmp_path / "a", [1])
    write_ply(folder / "model.ply", GeometryRecord(np.ones((3, 3))))
    assert open_recording(folder).format == "native"
    assert open_recording(tmp_path).format == "native"


def test_images_without_a_camera(tmp_path: Path) -> None:
    folder = write(tmp_path / "a", [1])
    (folder / "camera.json").rename(tmp_path / "camera.json")
    refused(r"depth/ but no camera\.json.*camera=camera\.json", folder)
    camera = tmp_path / "camera.json"
    assert depths(open_recording(folder, format="native", camera=camera)) == [1]


def test_folder_of_images_needs_only_a_camera(tmp_path: Path) -> None:
    """Bare images of a camera of which there is a calibration file of another program."""
    folder = write(tmp_path / "a", [1, 3])
    unit = json.loads((folder / "camera.json").read_text())["depth_unit_m"]
    (folder / "camera.json").unlink()
    lens = tmp_path / "K.txt"
    lens.write_text("35 0 19.5\n0 35 14.5\n0 0 1\n")
    recording = open_recording(folder, camera=lens)
    assert recording.format == "native"
    assert recording[0].camera == BrownConrady(40, 30, 35.0, 35.0, 19.5, 14.5)
    assert any("are mm (depth_unit_m) and depth is z" in text for text in recording.warnings)
    # The file may say so, in whatever it is written.
    lens.write_text(lens.read_text() + f"depth_unit_m: {unit}\ndepth_kind: z\n")
    recording = open_recording(folder, camera=lens)
    assert depths(recording) == [1, 3]
    assert not recording.warnings
    # The images alone, wherever they lie, with times beside them.
    bare = (folder / "depth").rename(tmp_path / "scan")
    (bare / "timestamps.txt").write_text("5.0\n5.5\n")
    recording = open_recording(bare, camera=lens)
    assert recording.format == "depth-png"
    assert depths(recording) == [1, 3]
    assert recording.timestamps.tolist() == [5.0, 5.5]
    says = r"has 2 PNGs, of depth among them; .* use camera=camera\.json"
    refused(says, bare)
    # Colour in between is left out, and a folder with them may be passed.
    for k in range(2):
        write_png(bare / f"{k:06d}-c.png", np.full((60, 80, 3), 9, np.uint8))
    (bare / "000001.png").write_bytes(b"cut off")
    (tmp_path / "all" / "rgb").mkdir(parents=True)
    bare = bare.rename(tmp_path / "all" / "scan")
    recording = open_recording(tmp_path / "all", camera=lens)
    assert recording.format == "depth-png"
    assert len(recording) == 2
    assert depths(recording[:1]) == [1]
    assert any("2 images without 16-bit depth left out" in text for text in recording.warnings)
    refused(r"if the depth images are in scan/, use camera=", tmp_path / "all")
    # A format with names of its own comes first.
    (bare / "000000.png").rename(bare / "depth0.png")
    assert open_recording(bare, camera=lens).format == "pairs"


def test_folder_of_depth_arrays_of_another_name_can_be_renamed(tmp_path: Path) -> None:
    """As TartanAir's."""
    (tmp_path / "P000" / "depth_left").mkdir(parents=True)
    (tmp_path / "P000" / "image_left").mkdir()
    np.save(tmp_path / "P000" / "depth_left" / "000000_left_depth.npy", np.ones((30, 40), "f4"))
    refused(r"name depth_left/ depth/, and add a camera\.json", tmp_path / "P000")


def test_colour_of_another_size_is_for_display_if_no_camera_is_known(tmp_path: Path) -> None:
    folder = write(tmp_path / "a", [1, 2])
    (folder / "camera.json").unlink()
    (folder / "color").mkdir()
    for k in range(2):
        write_png(folder / "color" / f"{k:06d}.png", np.full((60, 80, 3), 9, np.uint8))
    lens = tmp_path / "K.txt"
    lens.write_text("35 35 19.5 14.5\n")
    recording = open_recording(folder, camera=lens)
    assert any("another size than depth" in text for text in recording.warnings)
    frame = recording[0]
    assert frame.color_image is not None
    assert not frame.color_registered


def test_depth_in_openexr_is_in_metres(tmp_path: Path) -> None:
    folder = write(tmp_path / "a", [1])
    (folder / "depth" / "000000.png").unlink()
    depth = np.full((30, 40), 1.25, np.float32)
    depth[0, :2] = np.nan, np.inf
    (folder / "depth" / "000000.exr").write_bytes(exr_bytes(depth))
    frame = open_recording(folder)[0]
    assert (frame.depth[1:] == 1.25).all()
    assert not frame.depth[0, :2].any()


@pytest.mark.parametrize(
    ("names", "says"),
    [
        (["scan.glb"], r"is a model, not a recording; .*`tofuse register` and"),
        (["a.obj", "a.mtl", "a.jpg"], "is a model, not a recording"),
        (["IMG_1.MOV"], "is a video, without depth"),
        (["1.jpg", "2.HEIC"], "is of photos, without depth"),
    ],
)
def test_exports_without_depth_are_named(tmp_path: Path, names: list[str], says: str) -> None:
    """What people get who choose the wrong entry in the menu of their app."""
    for name in names:
        (tmp_path / name).write_bytes(b"abc")
    for path in [tmp_path, tmp_path / names[0]]:
        if len(names) == 1 or path == tmp_path:
            refused(says, path)
    # Colour of a recording leads to its folder.
    folder = write(tmp_path / "r", [1])
    (folder / "0.jpg").write_bytes(b"abc")
    refused("pass the recording's folder", folder / "0.jpg")
    # So do its images, of depth or not.
    shutil.copytree(folder / "depth", folder / "amplitude")
    for part in (folder / "depth", folder / "amplitude"):
        refused(f"pass the recording's folder, {folder}(,|$)", part)
    shutil.rmtree(folder)
    (tmp_path / "unknown").mkdir()
    refused(r"known format: it contains .* folder", tmp_path)


def test_file_passed_for_a_format_may_have_any_suffix(tmp_path: Path) -> None:
    table = tmp_path / "points.csv"
    table.write_text("x,y,z\n" + "1,2,3\n" * 12)
    refused("or use format xyz for a single one", table)
    assert len(open_recording(table, format="xyz")[0]) == 12
    write_ply(tmp_path / "a.ply", GeometryRecord(np.ones((3, 3))))
    (tmp_path / "a.ply").rename(tmp_path / "a.dat")
    assert len(open_recording(tmp_path / "a.dat", format="ply")[0]) == 3
    refused("is not a PLY file", table, format="ply")


def test_limits_of_depth(tmp_path: Path) -> None:
    folder = write(tmp_path / "a", [1, 2, 3])
    recording = open_recording(folder, min_depth=1.5, max_depth=2.5)
    assert [len(f) for f in recording] == [0, 1200, 0]
    for limits in ({"min_depth": -1.0}, {"max_depth": float("nan")}):
        refused("depth", folder, **limits)
    refused("smaller one first", folder, min_depth=2.0, max_depth=1.0)


def test_factor_of_images_is_that_of_depth(tmp_path: Path) -> None:
    folder = write(tmp_path / "a", [1, 2, 3])
    (folder / "frames.csv").write_text("temperature_c\n20\n21\n22\n")
    recording = Opening((folder,), factor=0.5).open()
    converted = open_recording(convert(recording, tmp_path / "b").folder)
    assert depths(converted) == [0.5, 1.0, 1.5]
    assert converted.source.frame_columns["temperature_c"].tolist() == [20, 21, 22]
    assert depths(recording) == [0.5, 1.0, 1.5]
    assert recording.metadata["depth_unit_m"] == open_recording(folder).metadata["depth_unit_m"] / 2
    assert [len(f) for f in open_recording(folder, factor=0.5, max_depth=1.2)] == [1200, 1200, 0]
    for factor in (0.0, -1.0, float("nan"), "mm"):
        refused("factor", folder, factor=factor)


def test_factor_of_clouds_is_that_of_all_lengths(tmp_path: Path) -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (50, 3)) + np.array([9, 0, 0])
    for k in range(2):
        np.savetxt(tmp_path / f"{k}.xyz", 1000 * points)
    (tmp_path / "groundtruth.txt").write_text("0 0 0 0 0 0 0 1\n1 1000 0 0 0 0 0 1\n")
    recording = open_recording(tmp_path, factor=0.001)
    # In mm their coordinates are as large as those of a map, in m they are not.
    assert open_recording(tmp_path)[0].shift.any()
    assert not recording[0].shift.any()
    np.testing.assert_allclose(recording[1].points, points, atol=1e-4)
    np.testing.assert_allclose(recording.reference[1], se3.translation([1, 0, 0]))
    opening = Opening((tmp_path,), factor=0.001)
    assert Opening.from_dict(opening.to_dict(), tmp_path).factor == 0.001
    view = open_view(f"{tmp_path}#1", ReadingOptions(factor=0.001))
    np.testing.assert_allclose(view.frame.points, points, atol=1e-4)


def test_result_is_no_recording(tmp_path: Path) -> None:
    write_ply(tmp_path / "cloud.ply", GeometryRecord(np.ones((3, 3))))
    (tmp_path / "run.json").write_text("{}")
    refused("a result of tofuse", tmp_path)


def test_paths_that_are_no_recordings(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    (tmp_path / "inside").mkdir()
    (tmp_path / "inside" / "again").symlink_to(tmp_path / "inside")
    (tmp_path / "file.mkv").write_bytes(bytes(10))
    (tmp_path / "file").mkdir()
    (tmp_path / "file" / "a.docx").touch()
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "a.PNG").touch()
    for name, words in (
        ("missing", "doesn't exist"),
        ("empty", "empty folder"),
        ("loop", "leads back to itself"),
        ("inside", "not a recording of a known format"),
        ("file.mkv", "a '.mkv' file"),
        ("file", r"1 \.docx"),
        ("images", r"1 \.PNG; if .* move them to depth/ .* camera\.json"),
        ("file.mkv/x", "not a folder"),
        ("a\0b", "not a path"),
        ("n" * 300, "too long"),
    ):
        refused(words, tmp_path / name)
    refused("no recording was given")
    refused("is '', not a path", "")
    refused("no format 'mp3'", tmp_path / "file", format="mp3")


@pytest.mark.parametrize("name", sorted(readers()))
def test_requested_format_that_does_not_match(tmp_path: Path, name: str) -> None:
    (tmp_path / "a.docx").touch()
    for path in (tmp_path, tmp_path / "a.docx"):
        with pytest.raises(InputError):
            open_recording(path, format=name)


def test_all_images_truncated(tmp_path: Path) -> None:
    folder = write(tmp_path / "a", [1, 2, 3])
    for path in (folder / "depth").iterdir():
        path.write_bytes(path.read_bytes()[:60])
    with pytest.raises(InputError, match="none of 3 frames can be read") as caught:
        open_recording(folder)
    assert not isinstance(caught.value, UnreadableFrameError)
    assert "000000.png" in str(caught.value)
    assert "\n" not in str(caught.value)


def test_unreadable_first_frame(tmp_path: Path) -> None:
    folder = write(tmp_path / "a", [1, 2, 3])
    (folder / "depth" / "000000.png").write_bytes(b"")
    recording = open_recording(folder)
    bad = [isinstance(item, UnreadableFrameError) for item in recording.read_all()]
    assert bad == [True, False, False]


def test_permission_denied_is_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As above, for users to whom permissions do not apply."""
    folder = write(tmp_path / "a", [1, 2])

    def deny(self: Path) -> bytes:
        raise PermissionError(13, "Permission denied", str(self))

    monkeypatch.setattr(Path, "read_bytes", deny)
    refused(r"camera\.json: may not be read \(permission denied\)", folder)


class Counting(ArraySource):
    """Counts reads; the frames in `bad` can't be read."""

    def __init__(self, count: int, *bad: int) -> None:
        super().__init__([CloudFrame.of(np.ones((3, 3)), index=k) for k in range(count)])
        self.bad, self.reads = bad, 0

    def read(self, index: int) -> Frame:
        self.reads += 1
        if index in self.bad:
            raise UnreadableFrameError("is bad", where=f"frame {index}")
        return super().read(index)

    def recording(self) -> Recording:
        return Recording.of(self, "memory", "array")


def reader_threads() -> list[threading.Thread]:
    return [t for t in threading.enumerate() if t.name.startswith("tofuse-reader")]


def test_frames_come_in_order_with_errors_in_place() -> None:
    items = list(Counting(50, 3, 49).recording().select(1, None, 2).read_all(ahead=3))
    found = [item.index if isinstance(item, CloudFrame) else str(item) for item in items]
    assert found == [1, "frame 3: is bad", *range(5, 49, 2), "frame 49: is bad"]
    assert reader_threads() == []


def test_iteration_raises_at_unreadable_frame() -> None:
    iterator = iter(Counting(5, 3).recording())
    assert [next(iterator).index for _ in range(3)] == [0, 1, 2]
    refused("frame 3", iterator, by=next, error=UnreadableFrameError)


def test_read_ahead_is_bounded_and_stops_early() -> None:
    source = Counting(1000)
    iterator = source.recording().read_all(ahead=4)
    next(iterator)
    iterator.close()
    assert source.reads <= 7
    assert reader_threads() == []


def test_other_errors_are_raised_from_thread() -> None:
    class Broken(Counting):
        def read(self, index: int) -> Frame:
            raise InputError("breaks down")

    refused("breaks down", Broken(1).recording().read_all(), by=list)
    assert reader_threads() == []


def test_two_readers_keep_the_order() -> None:
    class Uneven(Counting):
        concurrent = True
        names: ClassVar[set[str]] = set()

        def read(self, index: int) -> Frame:
            self.names.add(threading.current_thread().name)
            time.sleep(0.003 if index % 2 == 0 else 0.0)
            return super().read(index)

    source = Uneven(40)
    assert [item.index for item in source.recording().read_all()] == list(range(40))
    assert len(source.names) == 2
    assert reader_threads() == []


def test_scans_that_are_not_read_are_named_with_a_remedy(tmp_path) -> None:
    (tmp_path / "0.txt").write_text("1 2 3\n")
    for path in (tmp_path, tmp_path / "0.txt"):
        refused(r"rename the files to \.xyz", path)


def test_recording_pickled_for_another_process_is_opened_there(tmp_path: Path) -> None:
    selected = open_recording(write(tmp_path / "a", [1, 2, 3, 4]), max_depth=3.5)[1::2]
    copy = pickle.loads(pickle.dumps(selected))
    assert str(copy) == str(selected)
    assert [f.index for f in copy] == [1, 3]
    assert [len(f) for f in copy] == [1200, 0]
    # One of another source than was opened, or in memory, takes its frames along.
    in_memory = ArraySource(list(selected))
    for recording in (replace(selected, source=in_memory), Recording.of(in_memory, "it", "memory")):
        found = pickle.loads(pickle.dumps(replace(recording, indices=np.array([0]))))
        assert [f.index for f in found] == [1]


def test_messages_name_arguments_in_python_and_options_on_the_command_line(tmp_path: Path) -> None:
    folder = write(tmp_path / "a --format", [1])
    for arguments, option in (
        ({"format": "magic"}, "--format"),
        ({"min_depth": 2.0, "max_depth": 1.0}, "--min-depth, --max-depth"),
    ):
        with pytest.raises(InputError) as python:
            open_recording(folder, **arguments)
        assert python.value.where == ", ".join(arguments)
        with on_command_line(), pytest.raises(InputError) as typed:
            open_recording(folder, **arguments)
        assert typed.value.where == option
    (folder / "depth" / "000000.png").rename(folder / "0.bin")
    (folder / "depth").rmdir()
    (folder / "camera.json").unlink()
    refused(f"{re.escape(str(folder))}: .* or use format ", folder)
