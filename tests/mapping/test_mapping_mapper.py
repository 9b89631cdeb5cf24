"""The mapper: online and whole runs agree, and invalid frames are rejected."""

from __future__ import annotations

import re
import shutil
import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from time import sleep
from typing import ClassVar

import numpy as np
import pytest

import tofuse
from tofuse.engine.errors import InputError, InputWarning
from tofuse.engine.filters.base import Filter
from tofuse.engine.frames.frames import CloudFrame, RangeFrame
from tofuse.engine.frames.recording import ArraySource, Recording
from tofuse.engine.geometry import se3
from tofuse.engine.graph.graph import Optimisation, Optimiser
from tofuse.engine.loops.loops import PriorLoop
from tofuse.engine.mapping.config import changed
from tofuse.engine.mapping.frame_log import FrameSequence
from tofuse.engine.mapping.mapper import Mapper
from tofuse.engine.mapping.methods import from_method
from tofuse.engine.mapping.preparation import Preparation
from tofuse.engine.mapping.reconstructing import reconstruct
from tofuse.engine.parts import part
from tofuse.engine.tracking.base import Step, Tracker
from tofuse.lab.methods.filters_temporal import TemporalDeviation

# Fine enough for few frames, and fast.
CONFIG = changed(
    from_method("thesis"), {"odometry": {"registration": {"resolution": 0.03}}}, where="tests"
)


@pytest.fixture(scope="module")
def recording(room_recording) -> Recording:
    return tofuse.open(room_recording)


@pytest.fixture(scope="module")
def frames(recording):
    return list(recording)


@pytest.fixture(scope="module")
def whole(recording):
    return reconstruct(recording, CONFIG)


def in_memory(frames, **options) -> Recording:
    return Recording.of(ArraySource(frames, **options), "memory", "frames")


def blank(frame: RangeFrame) -> RangeFrame:
    return replace(frame, depth=np.zeros_like(frame.depth))


def test_frames_pushed_one_by_one_give_same_bytes(frames, whole) -> None:
    mapper = Mapper(CONFIG)
    poses = [mapper.push(frame) for frame in frames]
    result = mapper.finish()
    np.testing.assert_array_equal(poses, whole.diagnostics.sequential)
    assert result.trajectory.tobytes() == whole.trajectory.tobytes()
    assert result.cloud.points.tobytes() == whole.cloud.points.tobytes()
    assert result.cloud.normals.tobytes() == whole.cloud.normals.tobytes()
    assert result.graph.information.tobytes() == whole.graph.information.tobytes()
    assert result.recording == {"path": None, "format": "frames", "frames": 8}


def test_camera_may_reuse_its_arrays(frames) -> None:
    """As drivers do: the next image is written into the same memory."""
    colors = [np.full((*frame.depth.shape, 3), 20 * k, np.uint8) for k, frame in enumerate(frames)]
    buffers = np.empty_like(frames[0].depth), np.empty_like(colors[0])
    kept, reused = Mapper(CONFIG), Mapper(CONFIG)
    for frame, color in zip(frames[:3], colors, strict=False):
        kept.push(replace(frame, color_image=color))
        buffers[0][:], buffers[1][:] = frame.depth, color
        reused.push(replace(frame, depth=buffers[0], color_image=buffers[1]))
        assert reused.last is not None
        assert reused.last.status == "tracked"
    for buffer in buffers:
        buffer[:] = 0
    kept_cloud, reused_cloud = kept.finish().cloud, reused.finish().cloud
    np.testing.assert_array_equal(kept_cloud.points, reused_cloud.points)
    np.testing.assert_array_equal(kept_cloud.color, reused_cloud.color)


@pytest.mark.parametrize(
    ("times", "said"),
    [
        ([0.1, 0.2, 0.2, 0.1, 0.4], [r"frame 2: timestamp is 0\.2, after 0\.2"]),
        ([1e9, 0.2, 0.3], [r"frame 1: timestamp is 0\.2, after 1000000000"]),
        ([1e18, 1e18 + 33_000_000], ["frame 1: timestamps have .* camera in ns"]),
        (np.arange(1, 7) * 33.3, ["frame 4: .* camera in ms"]),
        ([0.0, 0.1, 30, 30.1, 400], []),
        ([0.0, 0.0, 0.0], []),
    ],
)
def test_timestamps_of_live_frames_are_checked(frames, times, said) -> None:
    live = FrameSequence()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        for k, time in enumerate(times):
            live.check_time(replace(frames[0], index=k, timestamp=float(time)))
    assert [w.category for w in caught] == [InputWarning] * len(said)
    assert all(re.search(text, str(w.message)) for text, w in zip(said, caught, strict=True))


def test_live_frames_are_mapped_whatever_their_times(frames) -> None:
    mapper = Mapper(CONFIG)
    same_time = [replace(frame, timestamp=5.0) for frame in frames[:3]]
    mapper.push(same_time[0])
    with pytest.warns(InputWarning, match="pass seconds that ascend") as caught:
        mapper.push(same_time[1])
    mapper.push(same_time[2])
    assert [w.filename for w in caught] == [__file__]
    assert mapper.last is not None
    assert mapper.last.status == "tracked"


def test_result_of_whole_run(whole, recording) -> None:
    assert whole.trajectory.shape == (8, 4, 4)
    np.testing.assert_array_equal(whole.trajectory[0], np.eye(4))
    np.testing.assert_array_equal(whole.timestamps, recording.timestamps)
    assert len(whole.mesh.faces) > 1000
    np.testing.assert_array_equal(whole.mesh.vertices, whole.cloud.points)
    assert whole.graph.ids.tolist() == list(range(8))
    assert len(whole.cloud) > 1000
    assert {"filters", "tracking", "loops", "fusion", "checking"} <= set(whole.diagnostics.seconds)
    assert 0 < whole.diagnostics.removed["neighbour_fraction"] < 1
    # The simulated camera rotates; the estimate must be close, not just present.
    error = np.linalg.norm(whole.trajectory[:, :3, 3] - recording.reference[:, :3, 3], axis=1)
    assert error.max() < 0.1


def test_seed_and_threads(recording, whole) -> None:
    same = reconstruct(recording, CONFIG, threads=1)
    assert same.trajectory.tobytes() == whole.trajectory.tobytes()
    assert same.threads == 1
    other = reconstruct(recording, CONFIG, seed=1)
    assert other.trajectory.tobytes() != whole.trajectory.tobytes()
    np.testing.assert_allclose(other.trajectory, whole.trajectory, atol=0.1)


def test_order_kind_and_end_are_checked(frames) -> None:
    mapper = Mapper()
    mapper.push(frames[3])
    for index in (3, 1):
        with pytest.raises(InputError, match=f"frame {index}: comes after frame 3; number"):
            mapper.push(frames[index])
        with pytest.raises(InputError, match=f"frame {index}: comes after frame 3"):
            mapper.skip(index, 0.0, "broken")
    cloud = CloudFrame.of(frames[4].points, index=4)
    with pytest.raises(InputError, match="frame 4: is a cloud view among range views"):
        mapper.push(cloud)
    mapper.push(frames[4])
    assert mapper.finish().has_pose.tolist() == [True, True]
    for call in (
        lambda: mapper.push(frames[5]),
        lambda: mapper.skip(6, 0.0, ""),
        mapper.finish,
        mapper.interrupt,
    ):
        with pytest.raises(InputError, match="mapper: is finished; make a new Mapper"):
            call()


def test_interrupted_finish_can_be_repeated(frames, monkeypatch) -> None:
    """Hours of recording are not lost by one Ctrl-C."""
    mapper, undisturbed = Mapper(CONFIG), Mapper(CONFIG)
    for frame in frames[:4]:
        mapper.push(frame)
        undisturbed.push(frame)

    def interrupted(*_args) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as during:
        during.setattr("tofuse.engine.mapping.backend.BackEnd._fuse", interrupted)
        with pytest.raises(KeyboardInterrupt):
            mapper.finish()
    with pytest.raises(InputError, match="mapper: is finished"):
        mapper.push(frames[4])
    result = mapper.finish()
    assert result.trajectory.tobytes() == undisturbed.finish().trajectory.tobytes()
    with pytest.raises(InputError, match="mapper: is finished"):
        mapper.finish()


def test_joined_recordings_are_told_apart(frames) -> None:
    mapper = Mapper()
    for k, frame in enumerate(frames[:4]):
        if k == 2:
            mapper.interrupt()
        mapper.push(frame)
    second = [view.index >= frames[2].index for view in mapper.views]
    assert {True, False} == set(second)
    assert [view.recording for view in mapper.views] == second


def test_mapper_of_another_process_is_refused(frames, monkeypatch):
    """After a fork its threads are missing, and it would wait for them for ever."""
    mapper = Mapper()
    mapper.push(frames[0])
    with monkeypatch.context() as forked:
        forked.setattr("os.getpid", lambda: -1)
        for call in (lambda: mapper.push(frames[1]), mapper.finish):
            with pytest.raises(InputError, match="mapper: belongs to another process"):
                call()
    mapper.push(frames[1])


@pytest.mark.parametrize(
    ("sensor", "problem"),
    [
        ({"T_odometry": np.diag([1.0, 1, -1, 1])}, "T_odometry.*no rotation"),
        ({"T_odometry": np.eye(4)[:3]}, r"T_odometry: .*has shape \(3, 4\); use a rigid motion"),
        ({"T_odometry": "x"}, "T_odometry"),
        ({"gravity": np.zeros(4)}, "gravity: has the length 0"),
        ({"gravity": [0, 9.81, 0, 0.01]}, "gravity: has the length 9.81"),
        ({"gravity": [0, 1, 0, -0.01]}, "a sigma of -0.01"),
        ({"gravity": [0, 1, 0]}, r"gravity: has shape \(3,\)"),
        ({"gravity": "down"}, "gravity"),
    ],
)
def test_wrong_sensor_data_is_refused_and_costs_no_map(frames, sensor, problem) -> None:
    mapper = Mapper(CONFIG)
    mapper.push(frames[0], T_odometry=np.eye(4).tolist(), gravity=[0, 1, 0, 0.01])
    with pytest.raises(InputError, match=problem):
        mapper.push(frames[1], **sensor)
    unknown = np.full((4, 4), np.nan)
    mapper.push(frames[1], T_odometry=unknown, gravity=unknown[0])
    assert mapper.log.entries[1].T_odometry is None
    assert mapper.log.entries[1].gravity is None
    assert mapper.finish().has_pose.all()


def test_numbers_of_few_bits_do_not_overflow(frames) -> None:
    """Counters of cameras: differences of theirs, once by NumPy, cost the whole recording."""
    mapper = Mapper(CONFIG)
    mapper.skip(np.uint8(249), np.float32(0.1), "broken")
    for k, frame in enumerate(frames[:3]):
        mapper.push(replace(frame, index=np.uint8(250 + k), timestamp=np.uint8(1 + k)))
    mapper.push(replace(frames[3], index=2000, timestamp=4))
    for index, timestamp in ((np.nan, 1.0), (2001, np.nan), ("a", 1.0)):
        with pytest.raises(InputError, match=r"index of a frame|timestamp"):
            mapper.skip(index, timestamp, "broken")
    result = mapper.finish()
    assert [f.index for f in result.diagnostics.frames] == [249, 250, 251, 252, 2000]
    assert all(type(f.timestamp) is float for f in result.diagnostics.frames)


def test_options_configure_images_and_clouds(frames) -> None:
    options = {"method": "thesis", "fusion": {"voxel_m": 0.07}}
    assert Mapper(options).config == changed(
        from_method("thesis"), {"fusion": {"voxel_m": 0.07}}, where=""
    )
    mapper = Mapper({"fusion": {"voxel_m": 0.07}})
    mapper.push(CloudFrame.of(frames[0].points[::20]))
    assert mapper.config.odometry == from_method("default", "cloud").odometry
    assert mapper.config.fusion.voxel_m == 0.07
    with pytest.raises(InputError, match="config: fusion: unknown option 'voxel'"):
        Mapper({"fusion": {"voxel": 0.07}})


def test_loops_are_given_as_pairs() -> None:
    T = se3.exp([0.1, 0, 0, 0, 0.2, 0])
    (i, j, given) = (PriorLoop.of((7, 2, T)).i, PriorLoop.of([2, 7]).j, PriorLoop.of((7, 2, T)))
    assert (i, j, PriorLoop.of((2, 7)).T_i_j) == (2, 7, None)
    np.testing.assert_allclose(given.T_i_j, se3.inverse(T))
    assert PriorLoop.of(PriorLoop(2, 7, by_user=False)).by_user is False
    wrong = (3, "12", [(1,)], [(1, 1)], [(-1, 2)], [(0.5, 2)], [("0", "1")], [(0, 1, np.eye(3))])
    for loops in wrong:
        with pytest.raises(InputError, match="loops"):
            Mapper(loops=loops)


def test_no_frames_and_no_usable_frames_are_refused(frames) -> None:
    with pytest.raises(InputError, match="has no frames"):
        Mapper().finish()
    mapper = Mapper()
    assert mapper.push(blank(frames[0])) is None
    with pytest.raises(InputError, match=r"has 1 frame, none with enough valid points.*0 valid"):
        mapper.finish()


def test_depth_in_mm_is_named(frames) -> None:
    mapper = Mapper()
    mapper.push(replace(frames[0], depth=1000 * frames[0].depth))
    with pytest.raises(InputError, match=r"depth must be in m; here it is \d{4} m"):
        mapper.finish()


def test_filter_for_images_refuses_clouds_early(frames) -> None:
    mapper = Mapper(replace(CONFIG, filters=(TemporalDeviation(),)))
    with pytest.raises(InputError, match=r"filter 'temporal' takes .'range'. views"):
        mapper.push(CloudFrame.of(frames[0].points))
    mapper.push(frames[0])  # the refused view does not set the kind


@pytest.mark.nightly_part
@pytest.mark.parametrize(
    ("method", "amplitude", "filters", "corrected", "ready"),
    [
        ("default", False, [], 2, True),
        ("default", True, [], 1, False),  # multipath is learnt frame by frame
        ("default", False, [{"part": "temporal"}], 2, False),
        ("thesis", True, [], 0, True),
    ],
)
def test_preparation_out_of_order_gives_same_result(
    frames, method, amplitude, filters, corrected, ready
) -> None:
    config = changed(from_method(method), {"filters": filters}, where="tests")
    case = frames[:3] if amplitude else [replace(f, amplitude_image=None) for f in frames[:3]]
    plain, early = Mapper(config, threads=1), Mapper(config, threads=2)
    prepared = [early.prepare(f) for f in reversed(case)][::-1]
    assert {(p.corrected, p.filtered is not None) for p in prepared} == {(corrected, ready)}
    for frame, p in zip(case, prepared, strict=True):
        np.testing.assert_array_equal(plain.push(frame), early.push(frame, prepared=p))
    a, b = plain.finish(), early.finish()
    assert a.trajectory.tobytes() == b.trajectory.tobytes()
    assert a.cloud.points.tobytes() == b.cloud.points.tobytes()
    assert a.diagnostics.removed == b.diagnostics.removed
    assert [s.index for s in a.diagnostics.samples] == [s.index for s in b.diagnostics.samples]


def test_lost_frame_has_no_pose_and_tracking_continues(frames) -> None:
    result = reconstruct(in_memory([blank(f) if f.index == 3 else f for f in frames]), CONFIG)
    assert result.has_pose.tolist() == [k != 3 for k in range(8)]
    assert [f.status for f in result.diagnostics.frames].count("lost") == 1
    assert "0 valid points" in result.diagnostics.frames[3].reason
    assert result.graph.ids.tolist() == [0, 1, 2, 4, 5, 6, 7]
    assert [2, 3] in result.graph.edges.tolist()  # frame 2 to frame 4
    assert result.diagnostics.verdict == "degraded"


def test_lost_first_frame_is_not_the_origin(frames) -> None:
    result = reconstruct(in_memory([blank(frames[0]), *frames[1:4]]))
    assert not result.has_pose[0]
    np.testing.assert_array_equal(result.trajectory[1], np.eye(4))


def test_given_loops_are_used_or_rejected(frames, whole) -> None:
    measured = np.linalg.inv(whole.trajectory[0]) @ whole.trajectory[7]
    given = [PriorLoop(0, 7, measured), PriorLoop(1, 3, np.eye(4))]
    lost = [blank(f) if f.index == 3 else f for f in frames]
    result = reconstruct(in_memory(lost), CONFIG, loops=given)
    used, refused = result.diagnostics.loops[1], result.diagnostics.loops[0]
    assert (used.i, used.j, used.accepted) == (0, 7, True)
    assert (refused.i, refused.j, refused.accepted) == (1, 3, False)
    assert "loop_rejected" in [r.code for r in result.diagnostics.reasons]
    assert result.graph.loop.sum() == 1
    assert len(result.diagnostics.objective) > 0


def test_clouds_alone_give_a_model(frames) -> None:
    clouds = [CloudFrame.of(f.points[::6], index=f.index, timestamp=f.index) for f in frames[:3]]
    result = reconstruct(in_memory(clouds))
    assert result.has_pose.all()
    assert result.cloud.color is None


def test_clouds_all_around_have_z_up(frames) -> None:
    """Of scanners, while cameras look along z."""
    points = frames[0].points[::6]
    axes = np.array([[0, 0, 1.0], [-1, 0, 0], [0, -1, 0]])  # x forward, y left, z up
    for turned, up in ((points, [0, -1, 0]), (points @ axes.T, [0, 0, 1])):
        assert (CloudFrame.of(turned).likely_up is None) == (up[2] == 0)
        result = reconstruct(in_memory([CloudFrame.of(turned)]))
        np.testing.assert_allclose(result.T_up_world[1, :3], up, atol=0.02)
    result = reconstruct(in_memory([CloudFrame.of(points, up=np.array([1.0, 0, 0]))]))
    np.testing.assert_allclose(result.T_up_world[1, :3], [1, 0, 0], atol=0.02)


@pytest.mark.parametrize("up", [np.zeros(3), np.full(3, np.nan), [0.0, 1.0], [0.0, 0.0, 9.81]])
def test_up_direction_of_cloud_is_a_unit_vector(up) -> None:
    with pytest.raises(InputError, match=r"frame 0: up: .*unit vector"):
        CloudFrame(0, 0.0, np.zeros((4, 3), np.float32), up=up)


def test_given_tracker_tracks_clouds_too(frames) -> None:
    """An interrupted run goes on with one that repeats what was tracked."""
    clouds = [CloudFrame.of(f.points[::6], index=f.index, timestamp=f.index) for f in frames[:2]]
    config = from_method("default", "cloud")

    class Counting:
        def __init__(self) -> None:
            self.tracker, self.pushed = config.odometry.start(0, config.search), 0

        def push(self, *arguments):
            self.pushed += 1
            return self.tracker.push(*arguments)

        def __getattr__(self, name):
            return getattr(self.tracker, name)

    given = Counting()
    mapper = Mapper(config, tracker=given)
    for cloud in clouds:
        mapper.push(cloud)
    assert given.pushed == 2


def test_lost_frame_begins_no_component(frames, monkeypatch) -> None:
    """The maps of corrections, as of indirect light, are of the component before and after it."""
    steps = [Step("tracked", "", np.eye(4), component=c) for c in (0, 1, 1)]
    steps.insert(2, Step("lost", "dark", None))
    begun: list[int] = []
    monkeypatch.setattr(Preparation, "begin_component", lambda _: begun.append(len(pushed)))
    pushed: list[int] = []

    class Scripted(Tracker):
        def push(self, frame, T_odometry=None, surface=None):
            pushed.append(frame.index)
            return steps[len(pushed) - 1]

    mapper = Mapper(CONFIG, tracker=Scripted())
    for frame in frames[:4]:
        mapper.push(frame)
    assert begun == [2]


def test_covariances_are_relative_to_first_pose(whole) -> None:
    first, second, *_, last = whole.diagnostics.frames
    np.testing.assert_array_equal(first.covariance, 0)
    edge = np.flatnonzero((whole.graph.edges == [0, 1]).all(1))[0]
    np.testing.assert_allclose(
        second.covariance @ whole.graph.information[edge], np.eye(6), atol=1e-6
    )
    # Without loop closures, errors accumulate.
    assert np.trace(last.covariance[:3, :3]) > 2 * np.trace(second.covariance[:3, :3])


@part("optimiser", "test-doubting")
@dataclass(frozen=True)
class Doubting(Optimiser):
    """Leaves out the second loop as an outlier."""

    def optimise(self, graph):
        weights = np.ones(len(graph.edges))
        weights[np.flatnonzero(graph.loop)[1]] = 0.0
        return Optimisation(graph, (2.0, 1.0), True, weights)


def test_loops_left_out_by_optimiser_are_rejected(frames, whole) -> None:
    loops = [PriorLoop(0, k, whole.trajectory[k]) for k in (3, 4, 5)]
    mapper = Mapper(replace(CONFIG, optimiser=Doubting()), loops=loops)
    for frame in frames[:6]:
        mapper.push(frame)
    result = mapper.finish()
    assert [p.accepted for p in result.diagnostics.loops] == [True, False, True]
    assert "contradicts the rest of the graph" in result.diagnostics.loops[1].reason
    assert result.graph.loop.sum() == 2
    assert result.graph.edges[result.graph.loop].tolist() == [[0, 3], [0, 5]]
    assert [r.code for r in result.diagnostics.reasons].count("loop_rejected") == 1


@part("filter", "test-history")
@dataclass(frozen=True)
class SeesHistory(Filter):
    """Records the frames it was given, and their numbers of points."""

    takes: ClassVar[frozenset[str]] = frozenset({"range", "cloud"})
    seen: ClassVar[list[tuple[int, list[int], list[int]]]] = []

    @property
    def window(self) -> int:
        return 3

    def mask(self, frame, history):
        self.seen.append((frame.index, [f.index for f in history], [len(f) for f in history]))
        keep = frame.valid.copy()
        keep[::2] = False
        return keep


def test_temporal_filters_see_raw_neighbours_of_selected_frames(recording, frames) -> None:
    SeesHistory.seen.clear()
    config = replace(CONFIG, filters=(SeesHistory(),))
    result = reconstruct(recording.select(0, None, 3), config)
    assert [(i, past) for i, past, _ in SeesHistory.seen] == [(0, []), (3, [1, 2]), (6, [4, 5])]
    for _, past, counts in SeesHistory.seen:
        assert counts == [len(frames[k]) for k in past]  # unfiltered
    assert [f.index for f in result.diagnostics.frames] == [0, 3, 6]


def test_another_recording_has_no_neighbours_in_the_one_before(frames) -> None:
    """Nor do its times, or a first image that equals the last one, mean anything there."""
    SeesHistory.seen.clear()
    mapper = Mapper(replace(CONFIG, filters=(SeesHistory(),)))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for k in (0, 1):
            mapper.push(replace(frames[k], timestamp=100 + 0.1 * k))
        mapper.interrupt()
        for index, k in ((2, 1), (3, 2)):
            mapper.push(replace(frames[k], index=index, timestamp=0.1 * index))
    assert [past for _, past, _ in SeesHistory.seen] == [[], [0], [], [2]]
    assert not mapper.log.repeated


def test_unreadable_neighbours_are_left_out(room_recording, tmp_path) -> None:
    copy = shutil.copytree(room_recording, tmp_path / "copy")
    (copy / "depth" / "000002.png").write_bytes(b"no image")
    SeesHistory.seen.clear()
    config = replace(CONFIG, filters=(SeesHistory(),))
    result = reconstruct(tofuse.open(copy).select(0, None, 3), config)
    assert [(i, past) for i, past, _ in SeesHistory.seen] == [(0, []), (3, [1]), (6, [4, 5])]
    assert result.has_pose.all()


def test_failed_run_states_no_bound(room_recording) -> None:
    """Most frames show nothing: the few poses say little about the whole."""
    frames = [*tofuse.open(room_recording).select(end=3)]
    blank = replace(frames[0], depth=np.zeros_like(frames[0].depth))
    frames += [replace(blank, index=k, timestamp=float(k)) for k in range(3, 10)]
    mapper = Mapper("default")
    for frame in frames:
        mapper.push(frame)
    d = mapper.finish().diagnostics
    assert d.verdict == "failed"
    assert not np.isfinite(d.accuracy.position_m)
    assert "uncertain_poses" not in {reason.code for reason in d.reasons}


def test_threads_push_in_turn(frames, monkeypatch) -> None:
    busy = []
    process = Mapper._prepare

    def slow(self, *arguments):
        busy.append(True)
        sleep(0.01)
        assert len(busy) == 1
        filtered = process(self, *arguments)
        busy.clear()
        return filtered

    monkeypatch.setattr(Mapper, "_prepare", slow)
    mapper = Mapper(CONFIG)

    def push(frame) -> bool:
        try:
            mapper.push(frame)
        except InputError:  # comes too late
            return False
        return True

    with ThreadPoolExecutor(3) as pool:
        pushed = list(pool.map(push, frames[:6]))
    indices = [entry.record.index for entry in mapper.log.entries]
    assert indices == sorted(indices)
    assert len(indices) == sum(pushed)


def test_signal_in_compiled_code_is_raised_as_itself(frames, monkeypatch) -> None:
    def interrupted(*_arguments):
        try:
            raise KeyboardInterrupt
        except KeyboardInterrupt as error:
            raise SystemError("returned a result with an exception set") from error

    mapper = Mapper(CONFIG)
    mapper.push(frames[0])
    with monkeypatch.context() as patch:
        patch.setattr(mapper, "_prepare", interrupted)
        with pytest.raises(KeyboardInterrupt):
            mapper.push(frames[1])
    mapper.push(frames[2])
    assert [f.index for f in mapper.finish().diagnostics.frames] == [0, 2]


def test_nothing_can_be_finished_before_the_first_frame(frames) -> None:
    mapper = Mapper(CONFIG)
    with pytest.raises(InputError, match="mapper: has no frames; push frames first"):
        mapper.finish()
    mapper.push(frames[0])
    assert len(mapper.finish().trajectory) == 1
