"""The Python API: one call per task."""

from __future__ import annotations

import inspect
import json
import re
import shutil
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

import tofuse
from ray_casting import rays_at, to_plane
from refused import refused
from tofuse.engine.errors import InputError, OutputError
from tofuse.engine.frames.frames import RangeFrame
from tofuse.engine.geometry import se3
from tofuse.formats.export.conversion import convert


@pytest.fixture(scope="module")
def arrays():
    """Depth images (N, H, W) in a corner with a box, K and the poses (N, 4, 4)."""
    from tofuse.engine.cameras.cameras import Pinhole

    camera = Pinhole(80, 60, 70.0, 70.0, 39.5, 29.5)
    poses = se3.exp(np.linspace(0, 1, 6)[:, None] * [0.06, 0.02, 0.05, 0.02, 0.10, 0.03])
    planes = [([0, 0, -1.0], -2.2), ([0, -1.0, 0], -0.7), ([1.0, 0, 0], -0.9)]
    planes += [([-0.6, 0, -0.8], -1.9)]
    depth = []
    for T in poses:
        rays = rays_at(T, camera)
        depth.append(np.min([to_plane(*rays, np.array(n), d) for n, d in planes], 0))
    noise = np.random.default_rng(3).normal(0, 0.001, (6, 60, 80))
    K = np.array([[70, 0, 39.5], [0, 70, 29.5], [0, 0, 1]])
    return (np.array(depth) + noise).astype(np.float32), K, poses


UPS = (0.0, -1.0, 0.0), (-1.0, 0.0, 0.0)


@pytest.fixture(scope="module")
def result(arrays):
    depth, K, poses = arrays
    return tofuse.reconstruct(tofuse.from_arrays(depth, K, reference=poses), threads=1)


def test_reconstruction_from_arrays_matches_reference(result):
    assert result.has_pose.all()
    found = result.evaluate()
    assert found.error.associated == 6
    assert found.error.ate_rms_m < 0.004
    assert found.consistency.rms_m < 0.004
    assert re.fullmatch(r"Evaluation: ATE 0\.00\d+ m, .* over 6 poses", repr(found))


def test_evaluation_notes_images_of_another_recording(result, arrays):
    depth, K, poses = arrays
    assert result.evaluate().notes == ()
    receding = 0.2 * np.arange(6, dtype=np.float32)[:, None, None]
    other = tofuse.from_arrays(depth + receding, K)
    (note,) = tofuse.evaluate(result, poses, recording=other).notes
    assert re.fullmatch(r"only \d+ % of the points .*, or .* is another recording", note)


def test_picture_in_a_notebook_is_upright(result):
    """As in the report, however the camera was held."""
    level, turned = (replace(result, up=np.array(up))._repr_html_() for up in UPS)
    assert level.startswith('<div><img src="data:image/png')
    assert level != turned


def test_equal_trajectories_have_no_notes():
    poses = np.tile(np.eye(4), (60, 1, 1))
    poses[:, 0, 3] = 50 * np.arange(60)  # aligning them leaves an error of rounding
    assert tofuse.evaluate(poses, poses).notes == ()
    scaled = poses.copy()
    scaled[:, 0, 3] *= 1.004
    assert "the reference is 1.004 times as large" in tofuse.evaluate(poses, scaled).notes[0]


def test_what_python_prints_fits_a_line(result):
    located = result.locate(result.source[1])
    length = result.distance(*result.cloud.points[:2])
    cloud = tofuse.CloudFrame(0, 0.0, result.cloud.points)
    table = tofuse.RayTable(result.source[0].camera.rays())
    for shown in (result, result.graph, result.diagnostics, located, length, cloud, table):
        assert re.match(r"\w+(: | \d)", repr(shown))
        assert len(repr(shown)) < 120
    assert repr(result.diagnostics).startswith("Diagnostics: ")
    assert "array" not in repr(result.diagnostics.frames[1])


def test_result_changed_by_hand_is_not_saved(result, tmp_path) -> None:
    changed = tofuse.load(result.save(tmp_path / "out"))
    refused(r"pass overwrite to replace it", tmp_path / "out", by=changed.save, error=OutputError)
    (tmp_path / "full").mkdir()
    (tmp_path / "full/notes.txt").touch()
    says = r"notes.txt, but no earlier result.*; pass a new or empty folder$"
    refused(says, tmp_path / "full", by=changed.save, error=OutputError)
    assert [p.name for p in (tmp_path / "full").iterdir()] == ["notes.txt"]
    changed.trajectory[:] = 0
    refused(r"trajectory\[0\]", tmp_path / "other", by=changed.save)
    assert not (tmp_path / "other").exists()


def test_saved_result_round_trips(result, tmp_path):
    assert result.save(tmp_path / "out") == tmp_path / "out"
    again = tofuse.load(tmp_path / "out")
    np.testing.assert_allclose(again.trajectory, result.trajectory, atol=1e-7)
    np.testing.assert_allclose(again.timestamps, result.timestamps, atol=1e-6)
    np.testing.assert_array_equal(again.mesh.faces, result.mesh.faces)
    np.testing.assert_allclose(again.cloud.points, result.cloud.points, atol=1e-6)
    np.testing.assert_array_equal(again.graph.edges, result.graph.edges)
    for name in ("verdict", "reasons", "accuracy", "loops", "calibrated"):
        assert getattr(again.diagnostics, name) == getattr(result.diagnostics, name), name
    for mine, theirs in zip(again.diagnostics.frames, result.diagnostics.frames, strict=True):
        for name in ("index", "status", "reason"):
            assert getattr(mine, name) == getattr(theirs, name)
        np.testing.assert_allclose(mine.covariance, theirs.covariance)
    # It measures the same, though with a usual field of view without its recording.
    a, b = result.mesh.vertices[[0, -1]]
    mine, theirs = again.distance(a, b), result.distance(a, b)
    assert mine.length_m == theirs.length_m
    assert mine.causes_m["scale"] == theirs.causes_m["scale"]
    assert theirs.causes_m["surface"] > 0
    # A loaded result can be saved; run.json is the same except for the refinement.
    again.save(tmp_path / "copy")
    texts = [(tmp_path / name / "run.json").read_text() for name in ("out", "copy")]
    first, second = map(json.loads, texts)
    assert {k for k in first if first[k] != second[k]} <= {"refinement", "sha256"}
    assert again.accuracy == result.accuracy


def test_report_names_all_recordings_that_are_joined(result, arrays, tmp_path):
    paths = [tmp_path / name for name in ("hall", "stairs")]
    for path, half in zip(paths, (arrays[0][:3], arrays[0][3:]), strict=True):
        convert(tofuse.from_arrays(half, arrays[1]), path)
    opening = {"opening": {"paths": [str(path) for path in paths]}}
    joined = replace(result, source=tofuse.open(*paths), recording={**result.recording, **opening})
    joined.save(tmp_path / "out")
    replace(joined, source=None).save(tmp_path / "again")
    for name in ("out", "again"):
        report = (tmp_path / name / "report.html").read_text()
        assert "<title>hall, stairs – tofuse report</title>" in report


@pytest.mark.parametrize("damage", ["no frames", "other poses", "no run.json", "not a folder"])
def test_load_rejects_damaged_result(result, tmp_path, damage):
    folder = tmp_path / "out"
    result.save(folder)
    run = json.loads((folder / "run.json").read_text())
    if damage == "no frames":
        run["frames"] = 7
    elif damage == "other poses":
        run["frames"] = run["frames"][:-1]
    (folder / "run.json").write_text(json.dumps(run))
    if damage == "no run.json":
        (folder / "run.json").unlink()
    if damage == "not a folder":
        folder = folder / "cloud.ply"
    with pytest.raises(tofuse.InputError) as error:
        tofuse.load(folder)
    assert "\n" not in str(error.value)
    assert error.value.remedy


def test_evaluate_accepts_files_and_arrays(result, arrays, tmp_path):
    poses = arrays[2]
    by_array = tofuse.evaluate(result.trajectory, poses).error.ate_rms_m
    assert by_array == pytest.approx(result.evaluate().error.ate_rms_m)
    result.save(tmp_path / "out")
    assert tofuse.evaluate(result, poses, recording=result.source).error.ate_rms_m == by_array
    assert tofuse.evaluate(result, result).error.ate_rms_m < 1e-6
    by_file = tofuse.evaluate(tmp_path / "out", tmp_path / "out" / "trajectory.txt")
    assert by_file.error.ate_rms_m < 1e-6
    within = tofuse.evaluate(result.trajectory, poses, reference_error_m=0.01).ate_interval_m
    assert within == (0.0, pytest.approx(by_array + 0.01))
    refused("shape", result.trajectory[:, :3], poses, by=tofuse.evaluate)
    refused(r"hold \d+ and \d+ poses", result.trajectory[:-1], poses, by=tofuse.evaluate)
    for wrong in (2 * poses, poses @ np.diag([-1, 1, 1, 1]), poses.transpose(0, 2, 1)):
        refused(r"estimate\[\d\]: ", wrong, poses, by=tofuse.evaluate)
    # Without its recording a result knows the times of its frames.
    loaded = tofuse.load(tmp_path / "out")
    shutil.copy(tmp_path / "out/trajectory.txt", tmp_path / "true.txt")
    assert loaded.evaluate(tmp_path / "true.txt").error.ate_rms_m < 1e-6
    assert loaded.evaluate(poses).error.ate_rms_m == pytest.approx(by_array)
    refused("holds 5 poses, and the recording 6 frames", poses[:5], by=loaded.evaluate)
    refused("no reference", by=loaded.evaluate)
    recording = tofuse.from_arrays(*arrays[:2], reference=poses)
    assert loaded.evaluate(recording).error.ate_rms_m == pytest.approx(by_array)
    for estimate in (loaded, result.trajectory):  # whose times are those of the recording
        assert tofuse.evaluate(estimate, recording).error.ate_rms_m == pytest.approx(by_array)
    with pytest.raises(tofuse.InputError, match="reference: has no reference poses"):
        loaded.evaluate(tofuse.from_arrays(*arrays[:2]))


def test_mapper_states_each_pose_and_its_result_is_saved(arrays, tmp_path):
    recording = tofuse.from_arrays(arrays[0], arrays[1])
    mapper = tofuse.Mapper(threads=1)
    assert mapper.last is None
    sigmas = []
    for frame in recording:
        pose = mapper.push(frame)
        last = mapper.last
        assert (last.index, last.status) == (frame.index, "tracked")
        assert pose.shape == (4, 4)
        np.testing.assert_allclose(last.covariance, last.covariance.T, atol=1e-12)
        sigmas.append(np.sqrt(np.diag(last.covariance)))
    assert not sigmas[0].any()
    assert (np.array(sigmas[1:]) > 0).all()
    # The error of tracking is of the order that it states.
    error = se3.log(se3.inverse(arrays[2][-1]) @ pose)
    assert (np.abs(error) < 10 * sigmas[-1]).all()
    assert np.abs(error[:3]).max() < 0.02
    blank = replace(recording[5], index=6, timestamp=0.2, depth=np.zeros_like(recording[5].depth))
    assert mapper.push(blank) is None
    assert (mapper.last.status, mapper.last.covariance) == ("lost", None)
    found = mapper.finish()
    assert "of 7 frames" in found.accuracy
    found.save(tmp_path / "out")
    assert (tmp_path / "out" / "report.html").exists()
    np.testing.assert_allclose(tofuse.load(tmp_path / "out").trajectory, found.trajectory)
    with pytest.raises(tofuse.InputError, match="has no recording: its frames were pushed"):
        tofuse.load(tmp_path / "out").locate(recording[0])


@pytest.mark.parametrize("kind", ["millimetres", "unit", "list", "camera"])
def test_from_arrays_accepts_depth_formats(arrays, kind):
    depth, K, _ = arrays
    camera = K
    options = {}
    if kind == "millimetres":
        given = np.round(depth * 1000).astype(np.uint16)
    elif kind == "unit":
        given, options = depth * 5000, {"depth_unit_m": 1 / 5000}
    elif kind == "list":
        given = [image.tolist() for image in depth]
    else:
        given, camera = depth, tofuse.Pinhole(80, 60, 70, 70, 39.5, 29.5)
    frame = tofuse.from_arrays(given, camera, **options)[1]
    assert isinstance(frame, RangeFrame)
    np.testing.assert_allclose(frame.depth, depth[1], atol=6e-4)
    assert frame.camera.fx == 70


def test_from_arrays_keeps_images_and_timestamps(arrays):
    depth, K, _ = arrays
    color = np.full((*depth.shape, 3), 90, np.uint8)
    amplitude = np.arange(depth.size).reshape(depth.shape)
    hole = depth.copy()
    hole[0, :2] = np.nan
    hole[0, 2] = -1
    hole = np.ma.masked_array(hole, np.arange(hole.size).reshape(hole.shape) % 80 == 79)
    recording = tofuse.from_arrays(
        hole, K, color=color, amplitude=amplitude, timestamps=[0, 1, 2, 3, 4, 7.5]
    )
    np.testing.assert_array_equal(recording[3].amplitude_image, amplitude[3])
    np.testing.assert_array_equal(recording[3].color_image, color[3])
    assert recording.timestamps[-1] == 7.5
    assert (recording[0].depth[:3] == 0).all()
    assert (recording[0].depth[:, 79] == 0).all()
    some = tofuse.from_arrays(depth, K, color=[color[0], *[None] * 5])
    assert [frame.color_image is None for frame in some] == [False, *[True] * 5]


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"depth": np.ones((60, 80))}, "depth"),
        ({"depth": []}, "depth"),
        ({"depth": np.ones((6, 60, 80), bool)}, "image 0 is of type bool; pass integers or floats"),
        ({"depth": [np.ones((60, 80)), np.ones((60, 80), np.uint16)]}, "integers and floats"),
        ({"depth": np.full((2, 60, 80), 1500.0)}, "depth_unit_m"),
        ({"depth": [np.ones((60, 80)), np.ones((60, 81))]}, "depth"),
        ({"depth_unit_m": 0.0}, "depth_unit_m"),
        ({"camera": np.eye(4)}, "camera"),
        ({"camera": [[70, 0, 40], [0, -70, 30], [0, 0, 1]]}, "fy"),
        ({"camera": tofuse.Pinhole(64, 48, 70, 70, 32, 24)}, "camera"),
        ({"color": np.ones((6, 60, 80, 3))}, "color"),
        ({"color": np.ones((5, 60, 80, 3), np.uint8)}, "color"),
        ({"amplitude": np.ones((6, 30, 40))}, "amplitude"),
        ({"timestamps": [0, 1, 1, 2, 3, 4]}, "timestamps: are not numbers that ascend: that of im"),
        ({"timestamps": [0, 1, 2, np.nan, 4, 5]}, "that of image 3 is nan"),
        ({"depth": [np.ones((60, 80)), None]}, "image 1 is None; leave out such frames"),
        ({"color": [None] * 5}, "contains 5 images, and depth 6"),
        ({"camera": {"fx": 70}}, "is a dict, neither a camera nor a matrix"),
        ({"timestamps": 30}, "timestamps: have shape (), and depth 6 images"),
        ({"reference": np.eye(4)}, "reference"),
        ({"reference": 2 * np.tile(np.eye(4), (6, 1, 1))}, "reference[0]"),
        ({"odometry": [["x"]]}, "odometry"),
        ({"depth_kind": "Z"}, "depth_kind: is 'Z'; use one of z, range"),
        ({"timestamps": list("abcdef")}, "timestamps"),
        ({"camera": [[70, 0.5, 40], [0, 70, 30], [0, 0, 1]]}, "skew"),
        (
            {"camera": [[0.9, 0, 0.5], [0, 1.2, 0.5], [0, 0, 1]]},
            "multiply normalised focal lengths",
        ),
        ({"camera": [[7e5, 0, 40], [0, 7e5, 30], [0, 0, 1]]}, "use pixels of these images"),
        ({"amplitude_kind": "x"}, "use one of raw, range_compensated, ir"),
        (
            {"camera": [[70, 0, 95], [0, 70, 30], [0, 0, 1]]},
            "(95, 30) outside of images of 80 x 60",
        ),
        ({"depth": np.ones((60, 80, 24))}, "frames come first; pass numpy.moveaxis(depth, -1, 0)"),
        (
            {"depth": np.ones((24, 80, 60))},
            "rows come before columns; pass numpy.swapaxes(depth, 1",
        ),
        ({"depth": np.ones((60, 80, 90))}, "that of images of 80 x 60 pixels, and depth"),
        (
            {"depth": np.ones((60, 80, 6)), "camera": tofuse.Pinhole(80, 60, 70, 70, 39.5, 29.5)},
            "frames come first",
        ),
        ({"timestamps": np.arange(6) * 33_333_333}, "camera in ns; divide them by 1e+09"),
        ({"timestamps": 1.7e15 + np.arange(6) * 33_333}, "camera in us"),
        (
            {"timestamps": np.array([0, 33, 67, 100, 133, 167])},
            "interval of 33, which is that of a camera in ms",
        ),
    ],
)
def test_inconsistent_arrays_are_rejected(arrays, change, named):
    given = {"depth": arrays[0], "camera": arrays[1], **change}
    with pytest.raises(tofuse.InputError) as error:
        tofuse.from_arrays(given.pop("depth"), given.pop("camera"), **given)
    assert named in str(error.value)


@pytest.mark.parametrize(
    "times",
    [
        np.array([0.0, 20, 61, 70, 130, 145]),  # triggered manually
        np.arange(6) * np.timedelta64(1, "h"),
        np.arange(6) / 30,
    ],
)
def test_slow_cameras_and_parts_of_images_are_accepted(arrays, times):
    K = arrays[1] + [[0, 0, 30], [0, 0, 0], [0, 0, 0]]  # as of an image cut at its left
    assert len(tofuse.from_arrays(arrays[0], K, timestamps=times)) == 6


@pytest.mark.parametrize(
    ("change", "named"),
    [
        ({"index": "0"}, "index"),
        ({"timestamp": np.nan}, "timestamp"),
        ({"timestamp": None}, "timestamp"),
        ({"timestamp": 1e300}, "timestamp"),
        ({"index": 2**63}, "index"),
        ({"camera": None}, "camera"),
        ({"depth_kind": np.ones(3)}, r"depth_kind: .*use one of z, range"),
        ({"ambiguity_m": "5"}, "ambiguity_m: is '5'"),
        ({"ambiguity_m": 0}, "ambiguity_m: is 0"),
        ({"sigma_image": np.full((60, 80), 3)}, "sigma_image: is int64; use floats in metres"),
        ({"depth": [[1.0]]}, "depth"),
        ({"depth": np.ones(60)}, "depth"),
        ({"amplitude_image": "x"}, "amplitude_image"),
        ({"depth": np.full((60, 80), 1500, np.uint16)}, "depth: is uint16; use floats in metres"),
        ({"color_image": np.ones((60, 80, 3))}, "color_image: is float64; use uint8"),
        (
            {"color_image": np.ones((60, 80, 4), np.uint8)},
            r"color_image: .*shape \(60, 80, 4\); .*\(H, W, 3\)",
        ),
        ({"confidence_image": np.ones((60, 80), bool)}, "confidence_image: is bool; use uint8"),
    ],
)
def test_unusable_frames_are_rejected(arrays, change, named):
    camera = tofuse.Pinhole(80, 60, 70, 70, 39.5, 29.5)
    given = {"index": 0, "timestamp": 0.0, "camera": camera, "depth": arrays[0][0], **change}
    refused(named, by=tofuse.RangeFrame, **given)


def test_masked_pixels_have_no_value(arrays) -> None:
    depth = np.ma.masked_array(arrays[0][0], np.arange(80) % 2 == np.zeros((60, 1)))
    camera = tofuse.Pinhole(80, 60, 70, 70, 39.5, 29.5)
    frame = tofuse.RangeFrame(0, 0.0, camera, depth, amplitude_image=depth)
    assert frame.valid[:, 1::2].all()
    assert not frame.valid[:, ::2].any()
    assert not frame.amplitude_image[:, ::2].any()


def test_points_that_are_masked_or_nan_are_none() -> None:
    points = np.ma.masked_array(np.random.default_rng(0).normal(size=(40, 3)))
    points[:20] += 50
    points[:20] = np.ma.masked
    points[20] = np.nan
    amplitude = np.arange(40.0, dtype=np.float32)
    for frame in (
        tofuse.CloudFrame.of(points, amplitude=amplitude),
        tofuse.CloudFrame(0, 0.0, points, amplitude=amplitude),
    ):
        assert frame.points.dtype == np.float32
        np.testing.assert_array_equal(frame.points, points.data[21:].astype(np.float32))
        np.testing.assert_array_equal(frame.amplitude, amplitude[21:])
    with pytest.raises(InputError, match="source: has 0 finite points"):
        tofuse.register(np.ma.masked_all((40, 3)), points.data)


def test_clouds_that_would_lose_values_are_rejected() -> None:
    points = np.random.default_rng(0).normal(size=(40, 3))
    far = points + np.array([5e5, 4e6, 0])
    refused(r"points: are map coordinates.*use CloudFrame\.of", 0, 0.0, far, by=tofuse.CloudFrame)
    moved = tofuse.CloudFrame.of(far)
    np.testing.assert_allclose(moved.points + moved.shift, far, atol=1e-6)
    with pytest.raises(InputError, match="color: is float64; use uint8, from 0 to 255"):
        tofuse.CloudFrame(0, 0.0, points, color=np.abs(points))


def test_numbers_of_numpy_are_options(arrays) -> None:
    options = {"fusion": {"voxel_m": np.float32(0.0625)}, "tolerance_m": np.float16(0.5)}
    mapper = tofuse.Mapper(options)
    assert (mapper.config.fusion.voxel_m, mapper.config.tolerance_m) == (0.0625, 0.5)
    recording = tofuse.from_arrays(*arrays[:2])
    assert tofuse.judge(recording, arrays[2], tolerance_m=np.float32(0.5)).verdict == "good"


def test_negative_depth_is_refused_unless_it_marks_pixels(arrays) -> None:
    depth, K, _ = arrays
    refused("depth: holds negative depth only; negate it", -depth, K, by=tofuse.from_arrays)
    covered = np.full_like(depth[:1], -1)
    assert tofuse.from_arrays(np.concatenate([depth, covered]), K)[6].depth.max() == 0


def test_negative_amplitude_is_none(arrays) -> None:
    amplitude = np.full(arrays[0].shape, 100.0)
    amplitude[:, :30] = -5
    amplitude[:, 30:32] = -np.inf
    amplitude[:, 32:34] = np.inf
    frame = tofuse.from_arrays(arrays[0], arrays[1], amplitude=amplitude)[0]
    assert np.unique(frame.amplitude_image).tolist() == [0, 100, 65535]


def test_wrong_arguments_are_named(arrays, result, tmp_path):
    recording = tofuse.from_arrays(*arrays[:2])
    far = np.full((20, 3), 1e20, np.float32)
    cloud = partial(tofuse.CloudFrame.of, np.where(np.arange(60) < 3, np.nan, 1).reshape(20, 3))
    for call, named in (
        (lambda: tofuse.open(None), "path: is a NoneType"),
        (lambda: tofuse.open([tmp_path]), "path: is a list"),
        (lambda: tofuse.open(tmp_path, camera=np.eye(3)), r"pass the path of a camera\.json"),
        (lambda: tofuse.reconstruct(recording, progress="bar"), "progress: is 'bar'"),
        (lambda: tofuse.reconstruct(recording, "fast"), "^config: is 'fast'"),
        (lambda: tofuse.reconstruct(recording, prior="arkit"), "^prior: is 'arkit'"),
        (lambda: tofuse.Mapper(threads=0), "threads: is 0"),
        (lambda: tofuse.advise(None), "source: is a NoneType"),
        (lambda: tofuse.open(tmp_path, min_depth="1m"), "min_depth: is '1m'"),
        (lambda: tofuse.open(tmp_path, min_depth=10**400), "min_depth: is 1000"),
        (lambda: tofuse.open(tmp_path, tmp_path / "."), "is given twice; pass each recording"),
        (lambda: tofuse.load(None), "folder: "),
        (lambda: result.save(None), "folder: "),
        (lambda: result.mesh.save(None), r"path: is a NoneType.*ends in one of \.glb"),
        (lambda: result.cloud.save(3), r"path: is an int.*ends in one of \.ply"),
        (lambda: tofuse.merge([result, result]), r"results: is a Result.*save\(folder\)"),
        (lambda: tofuse.merge("result"), "results: is not several paths"),
        (lambda: tofuse.merge(None), "results: is not several paths"),
        (lambda: tofuse.merge([], tolerance_m="x"), "tolerance_m: "),
        (lambda: tofuse.compare(None, result), "is a NoneType, not a path; pass a result"),
        (lambda: result.save("a\0b"), r"folder: is 'a\\x00b', not a path"),
        (lambda: result.locate(arrays[0][0]), "frame: is an ndarray, not an image"),
        (lambda: result.evaluate(arrays[2], reference_error_m=-1), "reference_error_m: is -1"),
        (lambda: tofuse.judge(recording, arrays[2], tolerance_m=-1), "tolerance_m: is -1"),
        (lambda: tofuse.judge(arrays[0], arrays[2]), "path: is an ndarray"),
        (lambda: tofuse.judge(recording, arrays[2], progress=True), "progress: is True"),
        (lambda: result.evaluate(arrays[2][:2]), "^reference: holds 2 poses"),
        (lambda: tofuse.evaluate(result, arrays[2], recording=3.0), "path: is a float"),
        (lambda: result.view(port="a", open_browser=False), "port: is 'a'"),
        (lambda: tofuse.compare(result, result, unit="feet"), "unit: is 'feet'; use one of mm"),
        (lambda: tofuse.judge(tmp_path, arrays[2]), "is an empty folder"),
        (lambda: tofuse.judge(recording, arrays[2], threads=0), "threads: is 0"),
        (lambda: tofuse.reconstruct(recording, threads=0), "threads: is 0"),
        (lambda: tofuse.reconstruct(recording, seed=-1), "seed: is -1"),
        (lambda: tofuse.register(recording[0], recording[1], seed=1.5), "seed: is 1.5"),
        (lambda: tofuse.Mapper().push(arrays[0][0]), "frame: is an ndarray"),
        (lambda: tofuse.Mapper([]), "config: is a list"),
        (lambda: tofuse.Mapper(progress=True), "progress: is True"),
        (lambda: tofuse.reconstruct(recording, None), "config: is a NoneType"),
        (lambda: tofuse.reconstruct(recording, {"method": []}), r"is \[\]; use one of"),
        (lambda: tofuse.reconstruct(recording, loops=[(0, "a")]), "loops: 0 'a'"),
        (lambda: tofuse.reconstruct(recording, loops=[(0, 6)]), "loops: there is no frame 6"),
        (lambda: tofuse.compare(result, result, tolerance_m="2mm"), "tolerance_m: is '2mm'"),
        (lambda: result.distance(None, [0, 0, 0]), "are not two different points"),
        (
            lambda: tofuse.register(*recording[:2], guess="eye"),
            "guess: is not a matrix.*; use a rigid motion",
        ),
        (lambda: tofuse.CloudFrame(0, 0.0, far.tolist()), "frame 0: points have type list"),
        (lambda: tofuse.CloudFrame(0, 0.0, far), r"coordinates up to 1e\+20"),
        (lambda: cloud(origin=np.full(3, np.nan)), "frame 0: origin"),
        (lambda: cloud(normals=np.ones((3, 3))), "frame 0: normals: has shape"),
        (lambda: cloud(amplitude=np.ones((20, 1))), "frame 0: amplitude: has shape"),
    ):
        refused(named, by=call)


def test_slice_of_recording_is_recording(arrays):
    recording = tofuse.from_arrays(*arrays[:2])
    assert recording[1:5:2].indices.tolist() == [1, 3]
    assert recording[-2:].indices.tolist() == [4, 5]
    with pytest.raises(tofuse.InputError, match="leaves none"):
        recording[3:3]


@pytest.mark.parametrize("suffix", ["glb", "gltf", "ply", "obj", "stl"])
def test_saved_mesh_is_read_by_trimesh(result, tmp_path, suffix):
    trimesh = pytest.importorskip("trimesh")
    path = tmp_path / f"model.{suffix}"
    result.mesh.save(path)
    read = trimesh.load(path, force="mesh", process=False)
    flip = 1 if suffix == "ply" else -1  # the others have y up
    mine = result.mesh.vertices
    np.testing.assert_allclose(
        np.sort(read.bounds * [1, flip, flip], axis=0), [mine.min(0), mine.max(0)], atol=1e-5
    )
    assert len(read.faces) == len(result.mesh.faces)
    assert read.area == pytest.approx(result.mesh.to_trimesh().area, rel=1e-4)


@pytest.mark.parametrize("suffix", ["ply", "pcd", "las", "e57"])
def test_cloud_format_follows_suffix(result, tmp_path, suffix):
    if suffix == "e57":
        pytest.importorskip("pye57")
    path = tmp_path / f"cloud.{suffix}"
    result.cloud.save(path)
    frame = tofuse.open(path)[0]
    assert len(frame) == len(result.cloud)
    np.testing.assert_allclose(
        np.median(frame.points, 0), np.median(result.cloud.points, 0), atol=2e-3
    )


def test_view_serves_report_and_images_until_stopped(result):
    from urllib.error import URLError
    from urllib.request import urlopen

    with result.view(open_browser=False) as server:
        with urlopen(server.address) as page:
            assert b"data-frames" in page.read()
        with urlopen(f"{server.address}frame/3.png") as image:
            assert image.read(4) == b"\x89PNG"
    with pytest.raises(URLError, match="refused"):
        urlopen(server.address)


def test_options_follow_config_file_schema(arrays) -> None:
    recording = tofuse.from_arrays(arrays[0][:2], arrays[1])
    options = {"method": "thesis", "fusion": {"voxel_m": 0.1}}
    found = tofuse.reconstruct(recording, options, threads=1)
    assert found.config["method"] == "thesis"
    assert found.config["fusion"]["voxel_m"] == 0.1
    for wrong, says in (({"fusio": {}}, "fusio"), ({"method": "thesys"}, "thesys")):
        refused(says, recording, wrong, by=tofuse.reconstruct)


def test_result_is_saved_after_recording_is_deleted(arrays, tmp_path) -> None:
    convert(tofuse.from_arrays(arrays[0][:2], arrays[1]), tmp_path / "rec")
    found = tofuse.reconstruct(tofuse.open(tmp_path / "rec"), threads=1)
    shutil.rmtree(tmp_path / "rec")
    found.save(tmp_path / "out")
    assert (tmp_path / "out/report.html").stat().st_size > 10_000


class Interrupted:
    """An argument that can't be looked at: a signal arrives in compiled code."""

    @property
    def __class__(self) -> type:
        error = SystemError("returned a result with an exception set")
        error.__cause__ = KeyboardInterrupt()
        raise error

    def __getattr__(self, name: str) -> object:
        return self.__class__

    __fspath__ = __len__ = __iter__ = __array__ = lambda self: self.__class__


@pytest.mark.parametrize(
    "name", [n for n in tofuse.__all__ if inspect.isfunction(getattr(tofuse, n))]
)
def test_interruption_in_compiled_code_is_raised_as_itself(name) -> None:
    function = getattr(tofuse, name)
    needed = [p for p in inspect.signature(function).parameters.values() if p.default is p.empty]
    with pytest.raises(KeyboardInterrupt):
        function(*[Interrupted()] * max(1, len(needed)))
