"""Odometry against keyframes: follows, notices what it can't follow, and finds its way back."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from tofuse.errors import InputError
from tofuse.geometry import se3
from tofuse.geometry.cameras import Pinhole
from tofuse.kernels.threads import threads
from tofuse.maps.surface_map import surface_map
from tofuse.odometry import keyframes as module
from tofuse.odometry.keyframes import Acceptance, Keyframes, Recovery
from tofuse.pipeline.config import changed, from_method
from tofuse.recordings.frames import CloudFrame, RangeFrame
from tofuse.recordings.open import open_recording
from tofuse.registration.agreement import Agreement
from tofuse.registration.projective import Target, align
from tofuse.registration.search import Candidate, Match, search
from tofuse.sensor.models import camera_model
from tofuse.simulation.effects import Effects
from tofuse.simulation.render import render
from tofuse.simulation.scene import FRAME_RATE_HZ, build

MODEL = camera_model("sr4000")
BAD = 4  # which frame is spoilt


class Sequence:
    def __init__(self, name, indices, texture=True):
        scene, path = build(name, texture=texture)
        effects = Effects.none(shot_noise=True)
        taken = [render(scene, path, MODEL, k, effects=effects).frame for k in indices]
        self.frames = [replace(frame, index=n) for n, frame in enumerate(taken)]
        rate = FRAME_RATE_HZ
        self.poses = [path.T_world_camera(k / rate, indices[0] / rate) for k in indices]


@pytest.fixture(scope="module")
def room():
    return Sequence("room", range(0, 24, 3))


@pytest.fixture(scope="module")
def corner():
    return Sequence("corner", range(0, 24, 3))


@pytest.fixture(scope="module")
def elsewhere():
    return Sequence("rail", [0, 5, 10]).frames


@pytest.fixture(scope="module")
def turning_box():
    frames = Sequence("box", range(0, 120, 10)).frames
    return [frame.keep(frame.z < 1.8) for frame in frames]


def run(frames, options=None, odometry=None):
    tracker = (options or Keyframes()).start(0)
    guesses = odometry or [None] * len(frames)
    return [tracker.push(frame, T) for frame, T in zip(frames, guesses, strict=True)]


def error(step, true):
    off = se3.inverse(true) @ step.T_world_camera
    return float(np.linalg.norm(off[:3, 3])), float(np.degrees(se3.angle(off)))


def assert_near(step, true, metres=0.015, degrees=0.6):
    assert step.T_world_camera is not None, step.reason
    off = error(step, true)
    assert off[0] < metres, off
    assert off[1] < degrees, off


def assert_marked(step):
    assert step.status == "lost"
    assert step.reason
    assert step.T_world_camera is None
    assert step.registration is None


@pytest.mark.parametrize("amplitude", [True, False])
@pytest.mark.parametrize("scene", ["room", "corner"])
def test_it_follows_the_camera(request, scene, amplitude):
    sequence = request.getfixturevalue(scene)
    frames = sequence.frames
    if not amplitude:
        frames = [replace(frame, amplitude_image=None) for frame in frames]
    steps = run(frames)
    np.testing.assert_array_equal(steps[0].T_world_camera, np.eye(4))
    assert steps[0].reference is None
    for step, true in zip(steps, sequence.poses, strict=True):
        assert step.status == "tracked"
        assert_near(step, true)
    for step in steps[1:]:
        found = step.registration
        reference = steps[step.reference].T_world_camera
        np.testing.assert_allclose(
            reference @ found.T_target_source, step.T_world_camera, atol=1e-9
        )
        assert np.linalg.eigvalsh(found.information).min() > 0


def test_a_frame_far_from_the_keyframe_becomes_one(room):
    never = run(room.frames, Keyframes(keyframe_angle=3.0, keyframe_distance=9.0))
    assert {step.reference for step in never[1:]} == {0}
    always = run(room.frames, Keyframes(keyframe_angle=0.001))
    assert [step.reference for step in always[1:]] == list(range(7))


def test_memory_does_not_grow_with_the_keyframes(room, monkeypatch):
    monkeypatch.setattr(module, "_REMEMBERED", 3)
    tracker = Keyframes(keyframe_angle=0.001).start(0)
    for frame, true in zip(room.frames, room.poses, strict=True):
        assert_near(tracker.push(frame), true)
    assert len(tracker._keyframes) == 3


def test_of_two_keyframes_that_are_near_the_later_one_goes(room, monkeypatch):
    monkeypatch.setattr(module, "_REMEMBERED", 4)
    # The camera turns back at once here, which would be a surprise.
    monkeypatch.setattr(module.Motion, "surprise", lambda *_: "")
    tracker = Keyframes(keyframe_angle=0.001).start(0)
    there_and_back = [0, 1, 2, 3, 4, 3, 2, 1]
    for n, k in enumerate(there_and_back):
        tracker.push(replace(room.frames[k], index=n))
        kept = [keyframe.view.index for keyframe in tracker._keyframes]
        assert kept[-1] == n
    # Frames 0 to 4 cover the way; what came later lies on them. The newest is always kept.
    places = {there_and_back[k] for k in kept}
    assert len(kept) == 4
    assert {0, 4} <= places
    assert sum(k > 4 for k in kept) == 1


def test_a_lost_frame_costs_only_so_many_alignments(corner, elsewhere, monkeypatch):
    tracker = Keyframes(keyframe_angle=0.001).start(0)
    for frame in corner.frames:
        tracker.push(frame)
    assert len(tracker._keyframes) == len(corner.frames)
    tried = []
    align = module.align

    def counted(view, targets, *rest, **more):
        tried.append(targets[0].view.index)
        return align(view, targets, *rest, **more)

    monkeypatch.setattr(module, "align", counted)
    assert_marked(tracker.push(replace(elsewhere[0], index=20)))
    assert len(set(tried)) <= module._TRIED + 1
    assert len(tried) < 30


def test_what_the_tracker_chose_is_told(room):
    frames = list(room.frames)
    frames[BAD] = scaled(frames[BAD], 0)
    steps = run(frames)
    assert steps[0].reason == ""
    assert "nothing predicted it" in steps[1].reason
    assert steps[2].reason == ""
    dark = [replace(f, amplitude_image=np.zeros_like(f.amplitude_image)) for f in room.frames]
    assert all("albedo took no part" in step.reason for step in run(dark)[1:3])


def test_fit_asks_the_same_of_several_targets(room):
    """What lies in none of them must not pass because it is counted for each."""
    for targets in (1, 3):
        options = Keyframes(keyframe_angle=0.001, targets=targets)
        clean = run(room.frames, options)
        assert all(step.status == "tracked" for step in clean)
        for spoil in ("noise", "mirrored"):
            frames = list(room.frames)
            frames[BAD] = SPOILT[spoil](frames[BAD])
            assert_marked(run(frames, options)[BAD])


def test_the_last_motion_goes_on(room, monkeypatch):
    """There an alignment begins; what the data leaves open goes on as it did on the mean."""
    asked = []
    align = module.align

    def watched(view, targets, predicted, options, *, start=None):
        asked.append((view.index, start, np.array(predicted)))
        return align(view, targets, predicted, options, start=start)

    monkeypatch.setattr(module, "align", watched)
    coarse = replace(Keyframes().alignment, levels=Keyframes().alignment.levels[:1])
    steps = run(room.frames[:4], Keyframes(alignment=coarse))
    T = [step.T_world_camera for step in steps]
    start, predicted = next(poses for index, *poses in asked if index == 3)
    np.testing.assert_allclose(start, T[2] @ se3.inverse(T[1]) @ T[2], atol=1e-9)
    motions = [se3.log(se3.inverse(a) @ b) for a, b in itertools.pairwise(T[:3])]
    steady = T[2] @ se3.exp(0.7 * motions[0] + 0.3 * motions[1])
    np.testing.assert_allclose(predicted, steady, atol=1e-9)


def test_odometry_is_used_where_nothing_else_tells():
    sequence = Sequence("wall", range(0, 15, 3))
    frames = [replace(frame, amplitude_image=None) for frame in sequence.frames]
    # In a frame of its own, as odometry files are.
    T_odometry = [se3.exp([3, 1, -2, 0.3, 0.7, -1]) @ T for T in sequence.poses]
    steps = run(frames, Keyframes(guess="odometry"), T_odometry)
    for step, true in zip(steps, sequence.poses, strict=True):
        assert_near(step, true, 0.004, 0.2)
    unheld = [len(step.registration.unobservable) for step in steps[1:]]
    # By chance noise may seem to hold a direction of one of the pairs.
    assert min(unheld) >= 2
    assert sum(unheld) >= 3 * len(unheld) - 1


RNG = np.random.default_rng(3)
SPARSE = RNG.random((144, 176)) < 0.01


def scaled(frame, factor):
    return replace(frame, depth=frame.depth * np.float32(factor))


def mirrored(frame):
    light = frame.amplitude_image
    return replace(
        frame,
        depth=np.ascontiguousarray(frame.depth[:, ::-1]),
        amplitude_image=None if light is None else np.ascontiguousarray(light[:, ::-1]),
    )


def turned_over(frame, order):
    light = frame.amplitude_image
    return replace(
        frame,
        depth=np.ascontiguousarray(frame.depth[order]),
        amplitude_image=None if light is None else np.ascontiguousarray(light[order]),
    )


SPOILT = {
    "blank": lambda f: scaled(f, 0),
    "sparse": lambda f: f.keep(SPARSE),
    "noise": lambda f: replace(f, depth=RNG.uniform(0.5, 8, f.depth.shape).astype(np.float32)),
    "ten times too far": lambda f: scaled(f, 10),
    "ten times too near": lambda f: scaled(f, 0.1),
    "thousand times too far": lambda f: scaled(f, 1000),
    "mirrored": mirrored,
    "upside down": lambda f: turned_over(f, np.s_[::-1]),
    "turned round": lambda f: turned_over(f, np.s_[::-1, ::-1]),
    "a tenth too far": lambda f: scaled(f, 1.1),
    "a tenth too near": lambda f: scaled(f, 0.9),
    "one depth": lambda f: replace(f, depth=np.full_like(f.depth, 2.5)),
    "salt and pepper": lambda f: replace(
        f, depth=np.where(RNG.random(f.depth.shape) < 0.6, RNG.choice([0.3, 8.0]), f.depth)
    ),
}


@pytest.mark.parametrize("amplitude", [True, False], ids=["lit", "depth alone"])
@pytest.mark.parametrize("spoil", SPOILT.values(), ids=SPOILT.keys())
@pytest.mark.parametrize("scene", ["room", "corner"])
def test_a_spoilt_frame_is_lost_and_the_next_is_found(request, scene, spoil, amplitude):
    sequence = request.getfixturevalue(scene)
    frames = list(sequence.frames)
    if not amplitude:
        frames = [replace(frame, amplitude_image=None) for frame in frames]
    frames[BAD] = spoil(frames[BAD])
    steps = run(frames)
    if amplitude or steps[BAD].T_world_camera is None:
        assert_marked(steps[BAD])
    else:  # The shape of a room may be its own mirror image: then the place is right all the same.
        assert_near(steps[BAD], sequence.poses[BAD], 0.05, 2.0)
    for k, (step, true) in enumerate(zip(steps, sequence.poses, strict=True)):
        if k != BAD:
            assert_near(step, true)


STRETCHES = {
    "mirrored": "mirrored left to right",
    "upside down": "mirrored top to bottom",
    "turned round": "turned upside down",
    "ten times too far": "times what they were",
    "ten times too near": "times what they were",
    "a tenth too far": "times what they were",
    "a tenth too near": "times what they were",
}


@pytest.mark.parametrize("amplitude", [True, False], ids=["lit", "depth alone"])
@pytest.mark.parametrize("spoil", STRETCHES)
def test_what_is_wrong_with_a_stretch_of_images_is_told(corner, spoil, amplitude):
    frames = list(corner.frames)
    if not amplitude:
        frames = [replace(frame, amplitude_image=None) for frame in frames]
    frames[3:6] = [SPOILT[spoil](frame) for frame in frames[3:6]]
    steps = run(frames)
    for step in steps[3:6]:
        assert_marked(step)
        # Of a corner alone, nearer by a tenth is what it looks like from another place.
        if amplitude or "tenth" not in spoil:
            assert STRETCHES[spoil] in step.reason
    for k in (0, 1, 2, 6, 7):
        assert_near(steps[k], corner.poses[k])
        assert steps[k].reference is None or steps[k].reference < 3 or steps[k].reference > 5


@pytest.mark.parametrize("spoil", ["a tenth too far", "a tenth too near"])
def test_a_thing_on_its_own_does_not_grow_or_shrink(turning_box, spoil):
    """At three images a second a camera could well go where it would have to be for that."""
    frames = list(turning_box)
    frames[BAD] = SPOILT[spoil](frames[BAD])
    steps = run(frames)
    assert_marked(steps[BAD])
    assert STRETCHES[spoil] in steps[BAD].reason
    assert [step.status for step in steps].count("tracked") == len(steps) - 1


@pytest.mark.parametrize("amplitude", [True, False], ids=["lit", "depth alone"])
def test_what_is_nearly_its_own_mirror_image_is_told_by_how_it_turns(turning_box, amplitude):
    frames = list(turning_box)
    if not amplitude:
        frames = [replace(frame, amplitude_image=None) for frame in frames]
    clean = run(frames)
    steps = run([*frames[:7], *map(mirrored, frames[7:])])
    assert sum("mirrored left to right" in step.reason for step in steps[7:]) >= 3
    for step, right in zip(steps, clean, strict=True):
        if step.T_world_camera is not None:
            assert_near(step, right.T_world_camera, 0.05, 3.0)


def test_images_that_stay_turned_over_are_followed_but_get_no_pose(room):
    """Also once the camera has left the last keyframe that it was believed at."""
    options = Keyframes(keyframe_angle=0.06, keyframe_distance=0.05)
    steps = run([*room.frames[:2], *[mirrored(frame) for frame in room.frames[2:]]], options)
    for step in steps[2:]:
        assert_marked(step)
        assert "mirrored left to right" in step.reason


@pytest.mark.parametrize("side", [np.s_[:, 44:], np.s_[:, :44]])
def test_a_wall_is_not_taken_for_its_own_mirror_image(side, monkeypatch):
    """It fits either way, and better so if what is measured of it then lies in the keyframe."""
    camera, rng = Pinhole(88, 72, 100.0, 100.0, 43.5, 35.5), np.random.default_rng(4)
    rays, frames = camera.rays(), []
    for k, angle in enumerate(np.radians([10, 8, 6, 4, 2, 0, -2])):
        z = 2.0 / (np.cos(angle) + np.sin(angle) * rays[..., 0])
        z = (z + 0.004 * rng.standard_normal(z.shape)).astype(np.float32)
        if k > 3:
            z[side] = 0
        frames.append(RangeFrame(k, float(k), camera, z))
    monkeypatch.setattr(module, "looks_turned_over", lambda before, now: True)
    for step in run(frames):
        assert step.status == "tracked", step.reason


@pytest.mark.parametrize("spoil", [SPOILT["blank"], SPOILT["sparse"]], ids=["blank", "sparse"])
def test_a_recording_may_begin_with_spoilt_frames(room, spoil):
    steps = run([spoil(room.frames[0]), spoil(room.frames[1]), *room.frames[2:]])
    for step in steps[:2]:
        assert_marked(step)
    np.testing.assert_array_equal(steps[2].T_world_camera, np.eye(4))
    for step, true in zip(steps[2:], room.poses[2:], strict=True):
        assert_near(step, se3.inverse(room.poses[2]) @ true)


def test_a_camera_that_stands_still_stands_still(room):
    steps = run([*room.frames[:4], *[room.frames[3]] * 4])
    for step in steps[3:]:
        assert step.status == "tracked"
        assert_near(step, room.poses[3])


def test_a_camera_that_jumps_elsewhere_is_lost_until_it_returns(corner, elsewhere):
    frames = [*corner.frames[:4], *elsewhere, *corner.frames[2:5]]
    poses = [*corner.poses[:4], *[None] * 3, *corner.poses[2:5]]
    for step, true in zip(run(frames), poses, strict=True):
        if true is None:
            assert_marked(step)
        else:
            assert_near(step, true)


def test_after_a_loss_a_view_that_could_be_anywhere_is_not_believed():
    """A flat wall without albedo fits wherever the camera may have gone meanwhile."""
    frames = [
        replace(f, amplitude_image=None) for f in Sequence("wall", range(0, 12, 3), False).frames
    ]
    before = run(frames)
    assert all(step.status == "tracked" for step in before)
    frames[1] = scaled(frames[1], 0)
    steps = run(frames)
    assert steps[0].status == "tracked"
    for step in steps[1:]:
        assert_marked(step)
    assert "in every direction" in steps[2].reason


def test_threads_change_nothing(room):
    results = []
    for count in (1, 2):
        with threads(count):
            results.append(run(room.frames[:4]))
    for one, two in zip(*results, strict=True):
        np.testing.assert_array_equal(one.T_world_camera, two.T_world_camera)


def test_where_a_recording_begins_the_motion_need_not_go_on(room):
    frames = [*room.frames[:6], *room.frames[:6]]
    poses = [*room.poses[:6], *room.poses[:6]]
    tracker = Keyframes().start(0)
    for k, (frame, true) in enumerate(zip(frames, poses, strict=True)):
        if k == 6:
            tracker.interrupt()
        assert_near(tracker.push(replace(frame, index=k)), true)
    steps = run([replace(frame, index=k) for k, frame in enumerate(frames)])
    assert_marked(steps[6])
    assert "from where the motion leads" in steps[6].reason
    # The next frame shows that it was right.
    ((index, step),) = steps[7].earlier
    assert index == 6
    assert_near(step, poses[6])
    assert "jumped" in steps[7].reason
    assert not any(s.earlier for k, s in enumerate(steps) if k != 7)


def test_at_low_frame_rates_the_motion_may_change(room):
    frames = [*room.frames[:4], *room.frames[:4]]
    poses = [*room.poses[:4], *room.poses[:4]]
    slow = [replace(f, index=k, timestamp=0.8 * k) for k, f in enumerate(frames)]
    for step, true in zip(run(slow), poses, strict=True):
        assert_near(step, true)


def test_how_far_points_may_lie_off_grows_with_the_depth(room):
    views = [surface_map(frame, Keyframes().surface) for frame in room.frames[:2]]
    aligned = align(views[1], [Target(views[0], np.eye(4))], np.eye(4), Keyframes().alignment)
    strict = Acceptance(rms_m=0.5 * aligned.rms_m, rms_share=0.01)
    assert "mm from the surfaces" in strict.objection(aligned, 60 * aligned.rms_m)
    assert not strict.objection(aligned, 120 * aligned.rms_m)


def test_clouds_are_refused():
    with pytest.raises(InputError, match="needs images"):
        Keyframes().start(0).push(CloudFrame.of(np.zeros((500, 3))))


@pytest.mark.parametrize(
    ("path", "value"),
    [
        ("surface.columns", -1),
        ("surface.columns", "wide"),
        ("surface.radii", []),
        ("surface.radii", [2, 1000000]),
        ("surface.fill", float("nan")),
        ("alignment.levels", []),
        ("alignment.levels", [{"stride": 0, "iterations": 1, "slack_m": 0, "photo_slack": 0}]),
        ("alignment.robust", 0),
        ("alignment.prior_m", -1),
        ("acceptance.inlier_share", 2),
        ("acceptance.rms_m", -1),
        ("relocated.albedo", float("nan")),
        ("targets", 0),
        ("targets", 1000000),
        ("minimum_points", -5),
        ("keyframe_angle", float("nan")),
        ("keyframe_distance", 0),
        ("guess", "luck"),
        ("speed", 9),
    ],
)
def test_options_that_make_no_sense_are_refused_with_their_name(path, value):
    options = value
    for name in reversed(path.split(".")):
        options = {name: options}
    with pytest.raises(InputError, match=path.split(".")[-1]) as refused:
        changed(from_method("default"), {"odometry": options}, where="my.toml")
    assert "my.toml: odometry" in str(refused.value)


def test_what_is_refused_is_told():
    strict = replace(Acceptance(), inliers=10**6)
    scene = Sequence("corner", [0, 3])
    options = Keyframes(acceptance=strict, relocated=strict, recovery=Recovery(keyframes=0))
    steps = run(scene.frames, options)
    assert_marked(steps[1])
    assert "1000000 are needed" in steps[1].reason
    assert "keyframe 0" in steps[1].reason


def test_a_real_camera_that_was_carried_on_is_found_again(shared_data):
    """Two positions 305 mm apart along a corridor; what is between was not recorded."""
    recording = open_recording(shared_data / "sr4000_corridor")
    steps = run([recording[k] for k in range(len(recording))])
    for step in steps[:4]:
        assert np.linalg.norm(step.T_world_camera[:3, 3]) < 0.01
    for step in steps[4:]:
        if step.T_world_camera is not None:
            assert step.T_world_camera[2, 3] == pytest.approx(0.305, abs=0.02)
    assert steps[-1].status == "tracked"


def test_a_real_camera_close_to_a_door_stays_where_it_is(shared_data):
    """A quarter of a metre from it, moved by less than 1 cm: nothing must slide along it."""
    recording = open_recording(shared_data / "iphone_record3d")
    steps = run([recording[k] for k in range(0, len(recording), 3)])
    for k, step in enumerate(steps):
        true = se3.inverse(recording.reference[0]) @ recording.reference[3 * k]
        assert step.status == "tracked"
        assert np.linalg.norm((se3.inverse(true) @ step.T_world_camera)[:3, 3]) < 0.02


def test_what_is_searched_for_in_vain_stays_lost(room, elsewhere):
    steps = run([room.frames[0], elsewhere[0]])
    assert_marked(steps[1])


def test_a_search_is_believed_only_with_a_lead_and_without_contradiction():
    def match(score, rival, violation):
        said = Agreement(0.6, score + 2 * violation, violation, 0.0, 0.01, 1000, score)
        other = Agreement(0.6, rival, 0.0, 0.0, 0.01, 1000, rival)
        return Match((Candidate(np.eye(4), said), Candidate(np.eye(4), other)), "full")

    recovery = Recovery()
    # It lies where surfaces are, which reflect otherwise, though not so much that each is told.
    shaded = Agreement(0.6, 0.55, 0.0, 0.01, 0.01, 1000, 0.05)
    unlike = Match((Candidate(np.eye(4), shaded),), "full")
    assert recovery.believes(match(0.5, 0.4, 0.0))
    assert not recovery.believes(match(0.2, 0.15, 0.0))
    assert not recovery.believes(unlike)
    assert not recovery.believes(match(0.5, 0.49, 0.0))
    assert not recovery.believes(match(0.5, 0.4, 0.1))
    # What leads clearly may be a small part of what both see.
    assert recovery.believes(match(0.2, 0.05, 0.0))
    assert not recovery.believes(match(0.14, 0.0, 0.0))
    # A camera that was lost may stand anywhere, and rooms look alike.
    assert not recovery.believes(match(0.5, 0.4, 0.0), lost=True)
    assert recovery.believes(match(0.5, 0.2, 0.0), lost=True)


def test_a_box_that_turns_by_half_a_corner_is_told_from_its_other_sides(monkeypatch):
    """At 46 degrees an alignment from where it was may as well end a quarter of a turn off."""
    scene = Sequence("box", range(0, 4 * 72, 72))
    first = se3.inverse(scene.poses[0])
    pairs = []

    def counted(source, target, options):
        pairs.append((source.index, target.index))
        return search(source, target, options)

    monkeypatch.setattr(module, "search", counted)
    for step, true in zip(run([f.keep(f.z < 1.8) for f in scene.frames]), scene.poses, strict=True):
        assert_near(step, first @ true)
    assert pairs
    assert len(set(pairs)) == len(pairs)  # a search takes long: none is made twice


def turned_box(albedos):
    """A tracker that saw a box from four sides alike, in other colours, and was lost; a view."""
    frame = Sequence("box", [0]).frames[0]
    frame = frame.keep((frame.z > 0) & (frame.z < 1.6))
    u = np.arange(frame.camera.width) / 9.0

    def painted(k):
        if not albedos:
            return replace(frame, amplitude_image=None)
        paint = np.exp(0.5 * np.sin(u * (1 + 0.3 * k) + 2 * k)).astype(np.float32)
        return replace(frame, amplitude_image=frame.amplitude_image * paint)

    tracker = Keyframes().start(0)
    centre = np.eye(4)
    centre[2, 3] = float(np.median(frame.z[frame.z > 0])) + 0.15
    poses = []
    for k in range(4):
        turn = se3.exp(np.array([0, 0, 0, 0, k * np.pi / 2, 0]))
        poses.append(centre @ turn @ se3.inverse(centre))
        if k == 0:
            tracker.push(painted(0))
        else:
            view = surface_map(replace(painted(k), index=k), tracker._options.surface)
            tracker._keep(view, poses[k])
    tracker._T = se3.exp(np.array([3.0, 0, 0, 0, 0, 0]))  # last seen elsewhere
    tracker.interrupt()
    return tracker.push(replace(painted(2), index=9)), poses


def test_a_box_that_looks_the_same_from_four_sides_is_not_guessed_at():
    step, _ = turned_box(albedos=False)
    assert_marked(step)
    assert "elsewhere" in step.reason


def test_a_box_that_is_painted_is_known_again():
    step, poses = turned_box(albedos=True)
    assert step.status == "tracked"
    away = se3.inverse(poses[2]) @ step.T_world_camera
    assert np.linalg.norm(away[:3, 3]) < 0.01
    assert se3.angle(away) < 0.02
