"""Recordings tracked in several components: joined if they overlap, else separate."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from made_rooms import OTHER, at, seen
from pose_errors import assert_near
from tofuse.engine.fusion.options import Fusion
from tofuse.engine.geometry import se3
from tofuse.engine.loops.joining import Joining
from tofuse.engine.mapping.mapper import Mapper
from tofuse.engine.mapping.methods import from_method
from tofuse.engine.search.search_grid import SearchOptions

DEFAULT = from_method("default")
QUICK = SearchOptions("full", full_candidates=15, photometric_candidates=5)
# Coarse and fast: these tests are about poses.
CONFIG = replace(
    DEFAULT,
    corrections=(),
    model_filters=(),
    fusion=Fusion(voxel_m=0.05),
    loops=replace(DEFAULT.loops, searches=0, similar_pairs=0),
    search=QUICK,
    joining=Joining(searches=2),
)
STRANGE = {"boxes": OTHER, "half": (2.3, 1.2, 2.2), "scene": 9}
PATH = [at(0.2 * np.sin(0.2 * k), 0.2 * np.cos(0.2 * k), 0.06 * k) for k in range(40)]


def frames_of(places, **scene):
    """Views from these places of the path, in the given order."""
    return [seen(PATH[k], k, **scene) for k in places]


def in_order(frames):
    return [replace(f, index=k, timestamp=0.1 * k) for k, f in enumerate(frames)]


def blank(frame):
    return replace(frame, depth=np.zeros_like(frame.depth))


def run(frames, threads=1):
    mapper = Mapper(CONFIG, threads=threads)
    live = [mapper.push(frame) for frame in frames]
    return mapper.finish(), live


def assert_right(trajectory, places, rows, metres=0.02, degrees=0.7):
    """Some poses are correct relative to the first of them."""
    first = rows[0]
    for k in rows[1:]:
        true = se3.inverse(PATH[places[first]]) @ PATH[places[k]]
        assert_near(se3.inverse(trajectory[first]) @ trajectory[k], true, metres, degrees)


@pytest.fixture(scope="module")
def there_and_back():
    """Out through a room, from another place in it, and back; with lost frames in between."""
    places = [*range(8), 7, 7, *range(22, 28), 27, *range(3, 9)]
    frames = frames_of(places)
    for k in (8, 9, 16):
        frames[k] = blank(frames[k])
    return places, in_order(frames)


@pytest.fixture(scope="module")
def joined(there_and_back):
    return run(there_and_back[1])


def test_revisited_part_is_joined_into_one_model(there_and_back, joined) -> None:
    """Frames 17 to 22 revisit 0 to 7; those in between show the other side."""
    places, _ = there_and_back
    result, live = joined
    lost = [8, 9, 16]
    assert [r.index for r in result.diagnostics.frames if r.status == "lost"] == lost
    assert all(live[k] is None for k in lost)
    assert not result.has_pose[lost].any()
    main = [k for k in range(23) if result.has_pose[k]]
    assert set(main) >= {*range(8), *range(17, 23)}
    assert_right(result.trajectory, places, main)
    np.testing.assert_array_equal(result.trajectory[0], np.eye(4))
    first, *others = result.components
    assert first.connected
    assert first.joined is None
    again = next(c for c in others if c.frames[0][0] == 17)
    assert again.connected
    assert again.joined == "links"
    # Each frame with a pose in the main model belongs to a connected component.
    for record in result.diagnostics.frames:
        if record.component is not None:
            assert result.has_pose[record.index] == result.components[record.component].connected


def test_live_poses_of_connected_components_are_correct(there_and_back, joined) -> None:
    places, _ = there_and_back
    _, live = joined
    rows = [k for k, T in enumerate(live) if T is not None]
    assert set(rows) >= set(range(8))
    assert_right([np.eye(4) if T is None else T for T in live], places, rows)


@pytest.mark.nightly_part
def test_two_scenes_give_two_components_with_models() -> None:
    places = [*range(10), *range(8)]
    result, _ = run(in_order([*frames_of(range(10)), *frames_of(range(8), **STRANGE)]))
    assert result.has_pose.tolist() == [True] * 10 + [False] * 8
    assert_right(result.trajectory, places, list(range(10)))
    assert [c.connected for c in result.components] == [True, False]
    main, other = result.components
    assert main.frames == ((0, 9),)
    assert main.result is None
    assert other.frames == ((10, 17),)
    assert [r.component for r in result.diagnostics.frames] == [0] * 10 + [1] * 8
    own = other.result
    assert own is not None
    assert own.has_pose.all()
    assert len(own.trajectory) == 8
    np.testing.assert_array_equal(own.trajectory[0], np.eye(4))
    assert_right(own.trajectory, list(range(8)), list(range(8)))
    assert len(own.cloud) > 100
    assert result.diagnostics.verdict == "degraded"


@pytest.mark.nightly
def test_few_frames_of_another_scene_get_no_model() -> None:
    result, _ = run(in_order([*frames_of(range(6)), *frames_of(range(3), **STRANGE)]))
    assert [c.connected for c in result.components] == [True, False]
    assert result.components[1].result is None


@pytest.mark.nightly_part
def test_unordered_views_are_joined() -> None:
    places = np.random.default_rng(2).permutation(range(0, 24, 2)).tolist()
    result, _ = run(in_order(frames_of(places)))
    rows = np.flatnonzero(result.has_pose).tolist()
    assert len(rows) >= 10
    assert_right(result.trajectory, places, rows)
    assert len(result.components) > 1
    assert {c.joined for c in result.components[1:] if c.connected} == {"links"}
