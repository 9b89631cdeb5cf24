"""Properties and findings that `inspect` reports."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
import pytest

import made_rooms
import tofuse
from cli_calls import printed
from ray_casting import rays_at, to_room, to_walls
from tofuse.apps.inspection.channels import (
    _correlations,
    _delay,
    _log_depth,
    _repeats,
    check_mirrored,
)
from tofuse.apps.inspection.finding import CODES, Finding
from tofuse.apps.inspection.inspect import inspect_recording
from tofuse.apps.inspection.planar import Distortion
from tofuse.apps.inspection.sample import Pair, Sample, prepare
from tofuse.apps.jobs.running import with_findings
from tofuse.engine.cameras.cameras import BrownConrady, Pinhole
from tofuse.engine.frames.frames import CloudFrame, RangeFrame
from tofuse.engine.frames.recording import ArraySource, Recording
from tofuse.engine.geometry import se3
from tofuse.engine.quality.pose_accuracy import Accuracy, WorstFrame
from tofuse.engine.results.types import Reason, SelfCalibration
from tofuse.lab.simulation.effects import Effects
from tofuse.lab.simulation.record import plan
from wrapped_depth import wrapping
from written import change_camera, record

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


def written(folder: Path, frames, **changes) -> Path:
    """A native recording of the frames, with changed entries of its camera.json."""
    record(folder, frames, frame_rate_hz=10.0)
    change_camera(folder, **changes)
    return folder


@pytest.fixture(scope="module")
def result(room_recording) -> tofuse.Result:
    found = tofuse.reconstruct(tofuse.open(room_recording).select(end=3))
    return replace(found, recording={**found.recording, "warnings": []})


def test_facts_of_simulated_recording(room_recording) -> None:
    found = inspect_recording(tofuse.open(room_recording))
    facts = found.facts
    assert facts["recording"] == str(room_recording)
    assert (facts["format"], facts["frames"]) == ("native", "8")
    assert facts["images"].startswith("176 x 144, ")
    assert "amplitude, confidence" in facts["other images"]
    assert facts["reference poses"] == "for 8 frames"
    assert facts["odometry"] == "none"
    assert facts["valid points"].endswith("%")
    assert float(facts["confidence_max"]) == 7
    assert found.warnings == ()
    low, high = (float(w) for w in facts["depth"].split(" m,")[0].split(" to "))
    assert 0.3 < low < high < 8


def test_facts_of_synthetic_frames() -> None:
    frames = [image(2.0, k, valid=600) for k in range(11)]
    facts = inspect_recording(of(frames)).facts
    assert facts["duration"] == "1.00 s, 10.0 frames per second"
    assert facts["depth"] == "2.00 to 2.00 m, median 2.00 m"
    assert facts["valid points"] == "50 %"
    assert facts["images"].startswith("40 x 30, 53 x 41 degrees")
    assert facts["kind of depth"] == "z"
    assert facts["other images"] == "none"
    one = inspect_recording(of([image(2.0, depth_kind="range")])).facts
    assert (one["duration"], one["kind of depth"]) == ("a single frame", "radial range")
    numbered = [replace(frame, timestamp=float(frame.index)) for frame in frames]
    assert inspect_recording(of(numbered)).facts["duration"].startswith("unknown")


@pytest.mark.parametrize("z", [2000.0, 0.002])
def test_wrong_unit_is_detected(z) -> None:
    remedies = "Check depth_unit_m", f"multiply those in the files by {2 / z:g}"
    for frame, remedy in zip((image(z), CloudFrame.of(image(z).points)), remedies, strict=True):
        found = inspect_recording(of([frame])).findings
        (warning,) = (str(f) for f in found if f.code == "depth_unit")
        assert remedy in warning
        assert f"{z:.2g}"[:1] in warning


def test_scans_of_small_objects_are_plausible() -> None:
    """A scanner's object has 0.1 m about the origin; no ToF camera measures as near."""
    for frame, codes in ((CloudFrame.of(image(0.05).points), []), (image(0.05), ["depth_unit"])):
        found = inspect_recording(of([frame])).findings
        assert [f.code for f in found if f.code == "depth_unit"] == codes


def test_clouds_in_different_units_are_detected() -> None:
    def clouds(*factors: float) -> Recording:
        points = image(2.0).points
        return of([CloudFrame.of(f * points, index=k) for k, f in enumerate(factors)])

    found = inspect_recording(clouds(1, 1000, 1)).findings
    finding = next(f for f in found if f.code == "depth_unit")
    assert "median distance of frame 1 is" in finding.text
    assert finding.remedy.endswith("these frames by 0.001.")
    # Of two, either may be meant; near and far scans of one place differ less.
    assert any("of frame 1 is" in f.text for f in inspect_recording(clouds(1, 100)).findings)
    assert "depth_unit" not in {f.code for f in inspect_recording(clouds(1, 5, 1)).findings}


def test_few_and_no_valid_points_are_detected() -> None:
    (few,) = inspect_recording(of([image(2.0, valid=60)])).warnings
    assert few.startswith("Only 5 % of the pixels are valid.")
    found = inspect_recording(of([image(0.0)]))
    assert [f.code for f in found.findings] == ["few_valid"]
    assert repr(found).endswith(": warning few_valid")
    assert "is the depth unit right?" in found.warnings[0]
    assert "no valid point" in found.facts["depth"]
    (empty,) = inspect_recording(of([CloudFrame.of(np.zeros((0, 3)))])).warnings
    assert "no valid point" in empty


def test_unreadable_frames_give_warning(copy) -> None:
    (copy / "depth/000002.png").write_bytes(b"")
    found = inspect_recording(tofuse.open(copy))
    assert len(found.warnings) == 1
    assert "000002.png" in found.warnings[0]
    assert found.facts["frames"] == "8"
    # One line for all that have the same fault.
    for k in (3, 5):
        (copy / f"depth/{k:06d}.png").write_bytes(b"")
    (warning,) = inspect_recording(tofuse.open(copy)).warnings
    assert "000002.png" in warning
    assert warning.endswith("(2 more sampled frames are alike)")


def test_warnings_of_the_reader_are_reported(tmp_path, capsys) -> None:
    folder = written(tmp_path / "rec", [image(2.0), image(2.0, 1)], **{"colour[x]": "grey"})
    data = json.loads(printed(capsys, "inspect", folder, "--json"))
    assert set(data) == {"facts", "findings", "warnings"}
    assert any("colour[x]" in w for w in data["warnings"])
    reported = printed(capsys, "inspect", folder)
    assert "colour[x]" in reported  # brackets are not interpreted as markup
    assert "\\" not in reported


# What follows: each check has a recording that triggers it, and one that must not.

ROOM = BrownConrady(96, 72, 70.0, 70.0, 47.0, 36.0, k1=-0.2, k2=0.05)


def room_depth(camera, T: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """z and light of a room of 5 x 2.6 x 4 m with two boxes, from a camera at T_room_camera."""
    o, d = rays_at(T, camera)
    walls = np.array([[-2.5, -1.3, -2.0], [2.5, 1.3, 2.0]])
    boxes = [[-0.6, 0.2, 1.0], [0.1, 1.3, 1.5]], [[1.2, -0.2, -0.6], [1.7, 1.3, 0.1]]
    z, axis = to_room(o, d, walls, boxes)
    axis = axis + 3 * (z < to_walls(o, d, *walls)[0])  # boxes are lighter
    p = o + d * z[..., None]
    waves = np.sin(7 * p[..., 0]) + np.sin(6 * p[..., 1]) + np.sin(5 * p[..., 2] + 1)
    light = (1 + 0.15 * waves) * (0.6 + 0.1 * axis) * 4000 / z**2
    return z * (1 + rng.normal(0, 0.002, z.shape)), light * (1 + rng.normal(0, 0.01, z.shape))


def turning(count: int = 16, degrees: float = 8.0, camera=ROOM, seed: int = 0):
    """Frames of a camera that rotates and translates slightly, with timestamps at 10 Hz."""
    rng = np.random.default_rng([seed, 7])
    frames = []
    for k in range(count):
        T = se3.exp(np.array([0, 0, 0, 0, np.radians(degrees * k + 20), 0]))
        T[:3, 3] = 0.01 * k * (degrees > 0), -0.1, 0.0
        z, light = room_depth(camera, T @ se3.exp(np.array([0, 0, 0, 0.12, 0, 0.05])), rng)
        frames.append(
            RangeFrame(k, k / 10, camera, z.astype(np.float32), "z", light.astype(np.float32))
        )
    return frames


@pytest.fixture(scope="module")
def turn():
    return turning()


@pytest.fixture(scope="module")
def few():
    """As few frames as show every fault, of faster motion."""
    return turning(8, 14.0)


def codes(frames, quick=True, **options) -> set[str]:
    return {f.code for f in tofuse.inspect(of(frames, **options), quick=quick).findings}


def seen_by(frames, camera):
    return [replace(f, camera=camera) for f in frames]


def stamped(frames, times):
    return [replace(f, timestamp=float(t)) for f, t in zip(frames, times, strict=True)]


def colored(frames, shift):
    light = [np.log(f.amplitude_image) for f in frames]
    low, high = np.min(light), np.max(light)
    grey = [((np.roll(a, shift, 1) - low) / (high - low) * 255).astype(np.uint8) for a in light]
    return [
        replace(f, color_image=np.repeat(g[..., None], 3, -1))
        for f, g in zip(frames, grey, strict=True)
    ]


def saturating(frames):
    out = []
    for f in frames:
        full = f.amplitude_image > np.percentile(f.amplitude_image, 85)
        light = np.where(full, np.float32(65535), f.amplitude_image)
        out.append(replace(f, depth=np.where(full, 0, f.depth), amplitude_image=light))
    return out


BROWN = Pinhole(96, 72, 70.0, 70.0, 47.0, 36.0)
TIMES = np.arange(8) / 10
FAULTS = {
    "depth_unit": lambda f: [replace(a, depth=a.depth * 1000) for a in f],
    "range_taken_for_z": lambda f: [replace(a, depth=a.radial_range) for a in f],
    "z_taken_for_range": lambda f: [replace(a, depth_kind="range") for a in f],
    "lens_distortion": lambda f: seen_by(f, BROWN),
    "other_intrinsics": lambda f: seen_by(f, Pinhole(96, 72, 500.0, 500.0, 480.0, 270.0)),
    "mirrored": lambda f: [replace(a, amplitude_image=a.amplitude_image[:, ::-1]) for a in f],
    "color_unregistered": lambda f: colored(f, 7),
    "delayed": lambda f: [replace(b, amplitude_image=a.amplitude_image) for a, b in pairwise(f)],
    "time_unsorted": lambda f: stamped(f, TIMES[[0, 2, 1, *range(3, 8)]]),
    "time_repeated": lambda f: stamped(f, TIMES[[0, 1, 1, *range(3, 8)]]),
    "frames_missing": lambda f: stamped(f, TIMES + 0.4 * (TIMES > 0.3)),
    "frames_repeated": lambda f: [*f[:4], replace(f[3], index=4, timestamp=0.4), *f[5:]],
    "phase_wrap": lambda f: wrapping(f, 2.5),
    "saturated": saturating,
    "flying_pixels": lambda f: [replace(a, depth=cv2.GaussianBlur(a.depth, (0, 0), 2)) for a in f],
    "few_valid": lambda f: [a.keep(np.arange(96 * 72).reshape(72, 96) % 15 == 0) for a in f],
}


def test_clock_that_was_set_has_not_lost_a_billion_frames() -> None:
    times = np.arange(20) / 10 + 1.7e9 * (np.arange(20) > 7)
    found = inspect_recording(of(stamped([image(2.0, k) for k in range(20)], times))).findings
    (gap,) = (f for f in found if f.code == "frames_missing")
    assert gap.text.startswith("The timestamps have 1 gap of up to 1.7e+09 s")
    assert gap.remedy.startswith("Correct the times if a clock was set there")


@pytest.mark.nightly_part
def test_good_recording_has_no_findings(turn) -> None:
    assert codes(turn) == set()
    assert codes(colored(turn, 0), quick=False) == set()
    assert codes([replace(f, depth=f.radial_range, depth_kind="range") for f in turn]) == set()


@pytest.mark.nightly_part
@pytest.mark.parametrize("code", FAULTS)
def test_faults_are_detected(code, few, turn) -> None:
    if code in ("color_unregistered", "delayed"):  # needs more edges, or slower motion
        found = tofuse.inspect(of(FAULTS[code](turn)))
    else:
        found = tofuse.inspect(of(FAULTS[code](few)), quick=True)
    (named,) = [f for f in found.findings if f.code == code]
    assert named.severity == CODES[code]
    assert named.text.endswith((".", "?"))
    assert named.remedy.endswith(".")
    assert named.evidence
    assert all(np.isfinite(v) for v in named.evidence.values())
    assert found.severe == any(f.severity == "severe" for f in found.findings)
    assert str(named) in found.warnings


@pytest.mark.nightly_part
@pytest.mark.parametrize(
    ("scene", "every", "code"), [("hall", 90, "phase_wrap"), ("flat", 60, "some_phase_wrap")]
)
def test_wraps_are_severe_where_they_may_be_the_majority(scene, every, code) -> None:
    """Most of a hall of 8 x 8 m is beyond 5 m, and of a flat only what the doors let through."""
    made = plan(scene, every=every, seed=3, effects=Effects().without("multipath"))
    frames = [rendered.frame for rendered in made.frames(None)]
    (found,) = (f for f in tofuse.inspect(of(frames), quick=True).findings if "wrap" in f.code)
    assert found.code == code
    assert (found.evidence["wrapped_fraction"] > 0.5) == (code == "phase_wrap")
    # Without amplitude nothing tells the majority, and seams are left.
    dark = [replace(frame, amplitude_image=None) for frame in frames]
    assert "phase_wrap" in codes(dark)
    assert "some_phase_wrap" not in codes(dark)


def test_swapped_bytes_are_detected() -> None:
    v, u = np.mgrid[:72, :96]
    counts = [(1500 + 3 * u + 2 * v + 40 * k).astype(np.uint16) for k in range(4)]
    right, swapped = (
        [RangeFrame(k, k / 10, BROWN, c.astype(np.float32) / 1000) for k, c in enumerate(images)]
        for images in (counts, [c.byteswap() for c in counts])
    )
    found = {f.code: f for f in tofuse.inspect(of(swapped)).findings}
    assert "bytes" in found["depth_unit"].text
    assert "depth_unit" not in codes(right)
    noisy = np.random.default_rng(0).integers(1, 65535, (4, 72, 96))
    unreadable = [
        replace(f, depth=n.astype(np.float32) / 1000) for f, n in zip(right, noisy, strict=True)
    ]
    assert "bytes" not in str(tofuse.inspect(of(unreadable)).findings)
    assert "depth_unit" not in codes([f.keep((v % 3 == 0) & (u % 3 == 0)) for f in right])


@pytest.mark.parametrize(
    ("flip", "words"),
    [
        (np.s_[:, ::-1], "left to right"),
        (np.s_[::-1], "upside down"),
        (np.s_[::-1, ::-1], "rotated by 180"),
        (np.s_[:], None),
    ],
)
def test_mirrored_color_is_detected(turn, flip, words) -> None:
    """Colour of another camera: black at pixels without depth, and edges a bit apart."""
    rng = np.random.default_rng(3)
    frames = []
    for frame in colored(turn, 2):
        seen = rng.random((72, 96)) < np.abs(np.linspace(-2, 2, 96)) + 0.3
        color = np.where(seen[..., None], frame.color_image, 0)[flip]
        kept = replace(frame.keep(seen), amplitude_image=None)
        frames.append(replace(kept, color_image=np.ascontiguousarray(color)))
    found = [f.text for f in check_mirrored(Sample.of(of(frames), 8))]
    assert len(found) == (words is not None)
    assert all(words in text for text in found)


def test_nothing_around_an_object_has_no_edges() -> None:
    """Its outline is no edge of depth, nor is anything outside it, however far."""
    depth = np.zeros((72, 96), np.float32)
    depth[20:50, 30:60] = 0.7
    frame = RangeFrame(0, 0.0, Pinhole(96, 72, 80.0, 80.0, 47.5, 35.5), depth, "z")
    assert np.ptp(_log_depth(frame)) < 1e-6


def test_outline_of_a_turntable_before_nothing_is_not_mirrored() -> None:
    """Its amplitude has an outline, which depth hasn't: turned, that lies at edges of depth."""
    camera = Pinhole(96, 72, 80.0, 80.0, 47.5, 35.5)
    y, x = np.mgrid[:72, :96]
    plate = np.hypot((x - 48) / 24.4, (y - 49.8) / 11.3) < 1
    frames = []
    for k in range(8):
        depth_noise, amplitude_noise = np.random.default_rng(k).standard_normal((2, 72, 96))
        body = np.hypot((x - 46.8 - k) / 9.1, (y - 33.6) / 15.5) < 1
        depth = np.where(body, 0.7, 0.85 - 0.004 * (y - 49.8)) + 0.002 * depth_noise
        depth = np.where(plate | body, depth, 0).astype(np.float32)
        light = np.where(body, 700, np.where(plate, 400, 1)) * (1 + 0.02 * amplitude_noise)
        frames.append(RangeFrame(k, k / 10, camera, depth, "z", light.astype(np.float32)))
    assert not list(check_mirrored(Sample.of(of(frames), 8)))


def test_room_with_a_dark_floor_is_not_mirrored() -> None:
    """Depth is nearly the same upside down, so the floor's edge decides what fits better."""
    camera = Pinhole(128, 96, 60.0, 60.0, 63.5, 47.5)
    y, frames = -0.05, []
    for k in range(16):
        T = made_rooms.at(0.1, 0.0, k * np.pi / 8, pitch=0, y=y)
        frame = made_rooms.seen(T, k, boxes=(), spots=0, noise=0.002, camera=camera)
        height = frame.camera.rays()[..., 1] * frame.z + y
        albedo = np.select([height > 1.07, height < -1.07], [0.15, 1.6], 1.0)
        light = (albedo * frame.amplitude_image / frame.radial_range**2).astype(np.float32)
        frames.append(replace(frame, amplitude_image=light, amplitude_kind="raw"))
    assert not list(check_mirrored(Sample.of(of(frames), 8)))


def test_depth_beyond_a_wrong_ambiguity_range_is_not_of_a_wrong_unit() -> None:
    inspected = tofuse.inspect(of([image(2.5)], metadata={"ambiguity_m": 0.5}))
    (found,) = [f for f in inspected.findings if f.code == "depth_unit"]
    assert found.remedy.startswith("Check ambiguity_m")


def test_flat_images_are_inspected(turn) -> None:
    """Those of a spinning scanner, too flat for shifts of a fraction of the width."""
    camera = turn[0].camera
    flat = Pinhole(camera.width, 16, camera.fx, camera.fy, camera.cx, camera.cy - 30)
    frames = []
    for f in colored(turn, 0):
        names = ("amplitude_image", "color_image")
        images = {name: np.ascontiguousarray(getattr(f, name)[30:46]) for name in names}
        frames.append(RangeFrame(f.index, f.timestamp, flat, f.depth[30:46], **images))
    assert not codes(frames) & {"mirrored", "color_unregistered", "delayed"}


def test_colors_of_other_frames_are_not_mirrored(turn) -> None:
    """Their edges are in the same parts of the images."""
    images = [f.color_image for f in colored(turn, 0)]
    for shift in (4, 7, 9):
        for flip in (np.s_[:], np.s_[:, ::-1], np.s_[::-1]):
            others = [np.ascontiguousarray(image[flip]) for image in np.roll(images, -shift, 0)]
            pairs = zip(turn, others, strict=True)
            frames = [replace(f, amplitude_image=None, color_image=c) for f, c in pairs]
            assert not list(check_mirrored(Sample.of(of(frames), 8)))


def test_shift_that_does_not_follow_the_motion_is_no_delay() -> None:
    noise = 0.2 * np.random.default_rng(4).standard_normal((16, 2))
    varied, steady = np.zeros((2, 16, 2))
    varied[:, 1], steady[:, 1] = np.linspace(1.3, 2.8, 16), 2.0
    constant = np.array([0.0, 2.0]) + noise
    assert _delay(constant, varied) is None
    assert _delay(-2 * varied + noise, varied) == pytest.approx(2, abs=0.1)
    # Both explain that.
    assert _delay(constant, steady) == pytest.approx(-1, abs=0.1)


def test_edges_that_repeat_along_the_motion_show_no_delay() -> None:
    y, x = np.mgrid[:72, :96]
    stairs, floor = (y % 12 < 2).astype(np.float32), (y // 2 == 20).astype(np.float32)
    corner = np.maximum(floor, x // 2 == 20).astype(np.float32)
    down, right = np.array([[0.3, 2.0], [2.0, 0.3]])
    for edges, repeats in (
        (stairs, (True, True)),
        (floor, (False, True)),
        (corner, (False, False)),
    ):
        shifted = np.roll(edges, 3, 0)
        scores = _correlations([(edges, shifted)], 15)[0]
        assert (_repeats(scores, down), _repeats(scores, right)) == repeats


@pytest.mark.nightly_part
def test_amplitude_that_does_not_change_is_detected(turn) -> None:
    held = [replace(f, amplitude_image=turn[0].amplitude_image) for f in turn]
    (found,) = [f for f in tofuse.inspect(of(held), quick=True).findings if f.code == "delayed"]
    assert "same image" in found.text
    uniform = [replace(f, amplitude_image=np.full_like(f.amplitude_image, 100)) for f in turn]
    assert "delayed" not in codes(uniform)


@pytest.mark.nightly
@pytest.mark.parametrize("factor", [0.8, 1.25])
def test_wrong_focal_length_is_estimated_from_range(factor) -> None:
    frames = turning(8, 14.0, BROWN)
    frames = [replace(f, depth=f.radial_range, depth_kind="range") for f in frames]
    wrong = replace(BROWN, fx=70 * factor, fy=70 * factor)
    reported = tofuse.inspect(of(seen_by(frames, wrong)), quick=True).findings
    (found,) = [f for f in reported if f.code == "focal_length"]
    assert f"(sigma {found.evidence['sigma']:.2f})" in found.text  # elsewhere ± is of 95 %
    assert found.evidence["factor"] == pytest.approx(1 / factor, abs=0.09)


def test_folding_distortion_is_rejected() -> None:
    def distortion(t1: float, t2: float) -> Distortion:
        return Distortion(np.array([0.0, t1, t2]), 1e-4 * np.eye(3), 8, 0.007, 0.0067)

    assert distortion(-0.571, -0.274).folds  # as estimated for a round object
    assert distortion(-0.5, 0.1).folds
    assert not distortion(-0.25, 0.05).folds
    assert not distortion(0.4, -0.2).folds


def test_the_image_hardly_moves_around_an_object() -> None:
    view = prepare(image(1.0))
    pair = Pair.of(view, view)
    turn = se3.exp(np.array([0, 0, 0, 0, np.radians(15), 0]))
    to_object = se3.exp(np.array([0, 0, 1.0, 0, 0, 0]))
    around = to_object @ turn @ se3.inverse(to_object)
    poses = [replace(pair.alignment, T_world_source=T) for T in (turn, around)]
    first, second = (replace(pair, alignment=pose).shift for pose in poses)
    assert first == pytest.approx(np.tan(np.radians(15)) / 0.75, rel=0.15)
    assert second < 0.1


def test_camera_motion_is_classified() -> None:
    still = turning(6, 0.0)
    assert codes(still) == {"static"}
    assert codes(turning(6, 13.0)) == {"fast_motion"}
    fast = tofuse.inspect(of(turning(6, 40.0)), quick=True)
    # Consequences of little overlap are reported by the run.
    assert ("little_overlap", "warning") in {(f.code, f.severity) for f in fast.findings}
    found = tofuse.inspect(of(still), turning=True, quick=True)
    assert "static" not in {f.code for f in found.findings}


def test_gravity_that_points_up_is_reported() -> None:
    turn = turning(6, 3.0)
    down = np.tile([0.0, 1, 0, 0.01], (6, 1))
    down[2] = np.nan
    aside, up = down[:, [1, 0, 2, 3]], down * [1, -1, 1, 1]
    assert codes(turn, gravity=down) == codes(turn, gravity=aside) == set()
    assert codes(turn, gravity=up) == {"upside_down"}


def test_bare_wall_is_detected_and_curved_scene_gives_no_lens_findings() -> None:
    rng = np.random.default_rng(3)
    wall = [image(2.0, k) for k in range(4)]
    noisy = [replace(f, depth=f.depth + rng.normal(0, 0.004, f.depth.shape)) for f in wall]
    assert "wall_only" in codes(noisy)
    v, u = np.mgrid[:72, :96]
    hills = [
        RangeFrame(k, k / 10, BROWN, 2 + 0.3 * np.sin((u + 3 * k) / 9) * np.cos(v / 7))
        for k in range(8)
    ]
    reported = codes([replace(f, depth=f.depth.astype(np.float32)) for f in hills])
    assert not reported & {"range_taken_for_z", "lens_distortion", "focal_length", "wall_only"}


@pytest.mark.nightly
def test_real_recordings_have_only_true_findings(shared_data) -> None:
    explained = {
        "sr4000_corridor": {"phase_wrap", "flying_pixels"},  # longer than 5 m; a shiny floor
        # Steps of 23 degrees; -6 % at the corners, as the lens of a Kinect v2 has.
        "kinectv2_loop/recording": {"fast_motion", "little_overlap", "lens_distortion"},
        "iphone_record3d": {"wall_only"},  # a door
        "pcl_pairwise": {"fast_motion", "little_overlap", "time_repeated"},  # far apart as well
    }
    # One of each sensor; `benchmarks/inspection.py` prints those of all recordings.
    for name in (
        "sevenscenes_kitchen", "iphone_stray", "ifm_o3r/O3RBuffer.data", "pico_zense_static",
        "slam6d_scans", *explained,
    ):  # fmt: skip
        reported = {f.code for f in tofuse.inspect(shared_data / name, quick=True).findings}
        assert reported <= explained.get(name, set()) | {"static"}, name


def test_wraps_behind_rotating_object_do_not_affect_verdict(result: tofuse.Result) -> None:
    wrap = Finding("phase_wrap", "Far surfaces look near.", "Drop them.", {})
    moving = with_findings(result, [wrap])
    turning = with_findings(result, [wrap], turning=True)
    assert "faulty_recording" in {r.code for r in moving.diagnostics.reasons}
    assert "faulty_recording" not in {r.code for r in turning.diagnostics.reasons}
    assert turning.recording["findings"] == moving.recording["findings"]


def test_object_that_does_not_turn_is_no_good_result(result: tofuse.Result) -> None:
    """Otherwise a model of the table would be good, with a bound on poses of the table."""
    bounded = replace(
        result.diagnostics,
        verdict="good",
        accuracy=Accuracy(0.002, 0.001, 0.003, True, WorstFrame(1, 0.03, 0.01)),
        reasons=(Reason("stood_still", ((0, 2),), "The camera never moved."),),
    )
    still = replace(result, diagnostics=bounded)
    assert with_findings(still, []).diagnostics.verdict == "good"  # a camera on a tripod
    found = with_findings(still, [], turning=True).diagnostics
    assert found.verdict == "failed"
    assert [r.code for r in found.reasons] == ["object_still", "stood_still"]
    assert "--max-depth" in found.reasons[0].remedy
    assert not np.isfinite(found.accuracy.position_m)


@pytest.mark.parametrize(
    ("code", "harmless", "severe"),
    [
        ("focal_length", (0.05, 0.0, 0.0, 0.0, 0.0), (0.0, 0.03, 0.0, 0.0, 0.0)),
        ("other_intrinsics", (0.0, 0.0, 0.0, 0.02, 0.0), (0.05, 0.0, 0.0, 0.0, 0.0)),
        ("lens_distortion", (0.0, 0.0, 0.0, 0.0, 0.03), (0.0, 0.0, 0.02, 0.0, 0.0)),
    ],
)
def test_corrected_intrinsics_do_not_affect_verdict(result, code, harmless, severe) -> None:
    wrong = Finding(code, "It is that of another camera.", "Use the right one.", {})

    def faults(errors: tuple[float, ...]) -> list[str]:
        corrected = SelfCalibration(*errors, {}, (0.1, 0.01))
        diagnostics = replace(result.diagnostics, calibrated=corrected)
        found = with_findings(replace(result, diagnostics=diagnostics), [wrong])
        assert found.recording["findings"] == [wrong.to_dict()]
        return [r.code for r in found.diagnostics.reasons if r.code == "faulty_recording"]

    assert not faults(harmless)
    assert faults(severe)


@pytest.mark.parametrize(
    ("factor", "corrected"), [(0.95, True), (0.97, True), (0.83, False), (1.05, False)]
)
def test_focal_length_is_corrected_only_as_finding_says(result, factor, corrected) -> None:
    """A focal length and an offset trade off: the correction may be of another amount."""
    wrong = Finding("focal_length", "Wrong.", "Use it.", {"factor": factor, "sigma": 0.01})
    calibrated = SelfCalibration(0.05, 0.1, 0.0, 0.0, 0.0, {"focal": 0.002}, (0.1, 0.01))
    diagnostics = replace(result.diagnostics, calibrated=calibrated)
    found = with_findings(replace(result, diagnostics=diagnostics), [wrong])
    codes = {reason.code for reason in found.diagnostics.reasons}
    assert ("faulty_recording" not in codes) == corrected


def test_no_bound_is_stated_with_a_severe_fault(result: tofuse.Result) -> None:
    bounded = replace(
        result.diagnostics,
        accuracy=Accuracy(0.02, 0.01, 0.003, True, WorstFrame(1, 0.03, 0.01)),
        reasons=(Reason("uncertain_poses", ((0, 2),), "Pose errors may reach 20 mm."),),
    )
    sound = replace(result, diagnostics=bounded)
    fault = Finding("z_taken_for_range", "Walls are concave.", "Declare z.", {})
    found = with_findings(sound, [fault])
    assert not np.isfinite(found.diagnostics.accuracy.position_m)
    assert found.diagnostics.accuracy.assessed
    assert [r.code for r in found.diagnostics.reasons] == ["faulty_recording"]
    note = Finding("static", "It stands still.", "Move.", {})
    assert with_findings(sound, [note]).diagnostics.accuracy == bounded.accuracy


@pytest.mark.parametrize(
    ("unit", "found"),
    [(1.0, []), (30.0, []), (1e3, [1e3]), (1e6, [1e6]), (1e9, [1e9]), (1e-9, [1.0])],
)
def test_timestamps_in_another_unit_are_reported(unit, found) -> None:
    """Numbers of frames as timestamps, 30 times 1/30 s, are none."""
    frames = [replace(image(1.0, k), timestamp=unit * k / 30) for k in range(8)]
    reported = tofuse.inspect(of(frames), quick=True).findings
    assert [f.evidence["factor"] for f in reported if f.code == "time_unit"] == found
