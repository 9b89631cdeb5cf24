"""Components of one recording, joined by consistent links."""

from __future__ import annotations

import itertools
from dataclasses import replace

import numpy as np
import pytest

from made_rooms import OTHER, at, seen, surface
from pose_errors import assert_near, pose_error
from tofuse.engine.alignment.base import Link, Registration
from tofuse.engine.geometry import se3
from tofuse.engine.loops.join_checks import JoinChecks
from tofuse.engine.loops.joining import Joining, _Joiner
from tofuse.engine.loops.merged_components import MergedComponents, TrackedComponent
from tofuse.engine.search.verification import MAX_OVERLAP_DISTANCE
from tofuse.engine.search.view_pair import follow, register_pair
from tofuse.engine.stored_views.view_store import PosedView

RATE = 10.0
SPARSELY = Joining(searches=2, bridge=False)
BY_LINKS = replace(SPARSELY, tries=0)  # without a search for others
# A camera that moves on a circle and rotates.
PATH = [at(0.3 * np.sin(0.2 * k), 0.3 * np.cos(0.2 * k), 0.08 * k) for k in range(40)]
STRANGE = {"boxes": OTHER, "half": (2.3, 1.2, 2.2), "scene": 9}


def stretch(component, frames, path=PATH, every=3, dark=False, late=0.0, **scene):
    """A component with exact poses in its own frame, and every n-th view."""
    frames = list(frames)
    poses = np.stack([se3.inverse(path[frames[0]]) @ path[k] for k in frames])
    views = []
    for k, T in list(zip(frames, poses, strict=True))[::every]:
        frame = seen(path[k], k, **scene)
        if dark:
            frame = replace(frame, amplitude_image=None)
        views.append(PosedView(surface(frame), T, component))
    times = np.array(frames) / RATE + late
    return TrackedComponent(component, np.array(frames), times, poses, tuple(views))


def linked(first, second, certain=True, off=None):
    """A correct link between frames of two components, or one with an error."""
    a, b = first.views[-1], second.views[0]
    T = se3.inverse(PATH[a.index]) @ PATH[b.index]
    return link_of(a, b, T if off is None else T @ off, certain)


def link_of(a, b, T, certain=True):
    found = Registration(T, True, 5, 100, 100, 0.1, 0.01, np.diag([1e4] * 6), support=0.5)
    return Link(a.index, b.index, found, certain, "made")


@pytest.fixture(scope="module")
def three():
    return [stretch(c, range(12 * c, 12 * c + 10)) for c in range(3)]


@pytest.fixture(scope="module")
def elsewhere():
    return stretch(1, range(12, 22), **STRANGE)


def assert_joined(group, stretches, path=PATH, metres=0.02, degrees=0.5):
    """Components of a group have their true poses in the frame of the first one."""
    first, *_ = group.T_group_component
    np.testing.assert_allclose(group.T_group_component[first], np.eye(4), atol=1e-12)
    began = {s.component: int(s.frames[0]) for s in stretches}
    assert began[first] == min(began[c] for c in group.T_group_component)
    for c, T in group.T_group_component.items():
        assert_near(T, se3.inverse(path[began[first]]) @ path[began[c]], metres, degrees)


def members(groups):
    return [sorted(group.T_group_component) for group in groups]


def test_single_component_is_a_group(three) -> None:
    (group,) = Joining().join(three[:1], [])
    np.testing.assert_array_equal(group.T_group_component[0], np.eye(4))
    assert (group.frames, group.joins, group.bridged) == (10, (), {})
    assert group.connection(0) == "links"


def test_components_of_one_path_are_joined_without_given_links(three) -> None:
    (group,) = Joining().join(three, [])
    assert group.frames == 30
    assert_joined(group, three)
    assert not group.bridged
    assert [group.connection(c) for c in range(3)] == ["links"] * 3
    # Each join needs one link; the others confirm it.
    assert sum(join.defines_pose for join in group.joins) == 2
    assert len(group.joins) > 2
    for join in group.joins:
        assert join.kind == "links"
        true = se3.inverse(PATH[join.link.i]) @ PATH[join.link.j]
        assert pose_error(join.link.T_i_j, true)[0] < 0.02


def test_given_links_are_used(three) -> None:
    links = [linked(three[0], three[1]), linked(three[1], three[2])]
    (group,) = Joining().join(three, links)
    assert_joined(group, three)
    assert {(j.link.i, j.link.j) for j in group.joins} >= {(x.i, x.j) for x in links}


@pytest.mark.parametrize("seed", range(3))
def test_order_of_links_does_not_matter(three, seed) -> None:
    links = [linked(three[0], three[1]), linked(three[1], three[2]), linked(three[0], three[2])]
    links += [linked(three[0], three[1], certain=False, off=se3.exp([0.7, 0, 0, 0, 0.4, 0]))]
    (expected,) = SPARSELY.join(three, links)
    order = np.random.default_rng(seed).permutation(len(links))
    (group,) = SPARSELY.join(three, [links[k] for k in order])
    assert group.T_group_component.keys() == expected.T_group_component.keys()
    for c, T in expected.T_group_component.items():
        np.testing.assert_allclose(group.T_group_component[c], T, atol=1e-9)
    assert_joined(group, three)


def test_views_of_two_scenes_stay_separate(three, elsewhere) -> None:
    groups = SPARSELY.join([three[0], elsewhere], [])
    assert members(groups) == [[0], [1]]
    assert all(not group.joins for group in groups)


@pytest.mark.nightly
def test_component_of_another_scene_does_not_separate_others(three, elsewhere) -> None:
    path = [*PATH[:22], *PATH[4:14]]
    parts = [three[0], elsewhere, stretch(2, range(22, 32), path)]
    groups = SPARSELY.join(parts, [])
    assert members(groups) == [[0, 2], [1]]
    assert_joined(groups[0], parts, path)


def test_largest_group_comes_first(three) -> None:
    strange = stretch(0, range(4), **STRANGE)
    groups = SPARSELY.join([strange, three[1], three[2]], [])
    assert members(groups) == [[1, 2], [0]]
    assert [group.frames for group in groups] == [20, 4]


def test_certain_but_wrong_link_is_outvoted(three) -> None:
    wrong = linked(three[0], three[1], off=se3.exp([0.8, 0, -0.5, 0, 0.5, 0]))
    right = [
        link_of(a, b, se3.inverse(PATH[a.index]) @ PATH[b.index], certain=False)
        for a in three[0].views[1:]
        for b in three[1].views[:3]
    ]
    groups = SPARSELY.join(three[:2], [wrong, *right])
    assert members(groups) == [[0, 1]]
    assert_joined(groups[0], three)
    pairs = {(j.link.i, j.link.j): j.link for j in groups[0].joins}
    assert all(link is not wrong for link in pairs.values())


def test_contradictory_certain_links_are_not_used(three) -> None:
    wrong = linked(three[0], three[1], off=se3.exp([0.8, 0, -0.5, 0, 0.5, 0]))
    right = linked(three[0], three[1])
    assert members(BY_LINKS.join(three[:2], [right])) == [[0, 1]]
    assert members(BY_LINKS.join(three[:2], [right, wrong])) == [[0], [1]]


@pytest.mark.parametrize(
    "off", [[0, 0, -0.5, 0, 0, 0], [0, 0, 0.5, 0, 0, 0], [0.4, 0, 0, 0, 0.3, 0]]
)
def test_link_contradicted_by_free_space_is_rejected(three, off) -> None:
    wrong = linked(three[0], three[1], off=se3.exp(np.array(off)))
    assert members(BY_LINKS.join(three[:2], [wrong])) == [[0], [1]]


def test_uncertain_link_needs_confirmation_by_another_view(three, elsewhere) -> None:
    (group,) = BY_LINKS.join(three[:2], [linked(three[0], three[1], certain=False)])
    assert_joined(group, three)
    # No confirmation is found if the scene is another one.
    unlike = linked(three[0], elsewhere, certain=False)
    assert members(BY_LINKS.join([three[0], elsewhere], [unlike])) == [[0], [1]]


def turned_back(late):
    """A slow rotation to the right, and a view from its start, some time after its end."""
    turn = [at(0.0, 0.2, 0.05 * k) for k in range(31)]
    path = [*turn, *(at(0.0, 0.2, 0.05 * k) for k in range(8))]
    before = stretch(0, range(31), path, every=5)
    after = stretch(1, range(31, 39), path, late=late)
    first, again = before.views[0], after.views[0]
    return path, [before, after], link_of(first, again, np.eye(4))


@pytest.mark.parametrize(("late", "joined"), [(0.0, False), (5.0, True)])
def test_link_must_imply_feasible_motion(late, joined) -> None:
    """The camera rotated at 0.5 rad/s, and would have to rotate by 1.5 rad at once."""
    path, parts, link = turned_back(late)
    groups = BY_LINKS.join(parts, [link])
    assert members(groups) == ([[0, 1]] if joined else [[0], [1]])
    if joined:
        assert_joined(groups[0], parts, path)


def similar_rooms():
    """One session in a room, and one that starts in its duplicate, 6 m away, and returns."""
    away = np.eye(4)
    away[0, 3] = 6.0
    # True camera poses, and poses with the same view in the first room.
    local = [*PATH[:10], *PATH[9:13], *PATH[:8]]
    path = [*PATH[:10], *(away @ T for T in PATH[9:13]), *PATH[:8]]
    parts = []
    for c, frames in enumerate((range(10), range(10, 22))):
        poses = np.stack([se3.inverse(path[frames[0]]) @ path[k] for k in frames])
        views = [
            PosedView(surface(seen(local[k], k)), T, c) for k, T in zip(frames, poses, strict=True)
        ]
        times = np.array(frames) / RATE + 60.0 * c
        parts.append(TrackedComponent(c, np.array(frames), times, poses, tuple(views)))
    return path, parts


@pytest.mark.nightly_part
def test_single_link_waits_for_links_elsewhere() -> None:
    """The views at the gap are similar, and a link between them would be certain."""
    path, parts = similar_rooms()
    a, b = parts[0].views[-1], parts[1].views[0]
    wrong = link_of(a, b, np.eye(4))
    (group,) = Joining().join(parts, [wrong])
    assert_joined(group, parts, path)
    # If the camera had no time to move away, it would be accepted.
    soon = replace(parts[1], times=parts[1].times - 60.0)
    (group,) = Joining().join([parts[0], soon], [wrong])
    with pytest.raises(AssertionError):
        assert_joined(group, parts, path)


def unordered_views(off):
    """A few consecutive frames, then single ones; a certain link between the first two is wrong."""
    order = [0, 1, 2, 14, 4, 16, 6, 18, 8, 12, 10]
    path = [PATH[k] for k in order]
    frames = [range(3), *([k] for k in range(3, len(order)))]
    parts = [stretch(c, some, path, every=1) for c, some in enumerate(frames)]
    a, b = parts[0].views[0], parts[1].views[0]
    T = se3.inverse(path[a.index]) @ path[b.index] @ off
    return path, parts, link_of(a, b, T)


def test_join_by_single_link_is_reconsidered() -> None:
    """When the two views were joined, there was nothing else to compare them with."""
    path, parts, wrong = unordered_views(se3.exp([0.8, 0, -0.9, 0, 1.8, 0]))
    (group,) = Joining().join(parts, [wrong])
    assert_joined(group, parts, path)
    assert all(join.link is not wrong for join in group.joins)


def test_short_gap_does_not_support_distant_pose(three) -> None:
    """A single link is used at once if it implies no motion; but not if it implies motion."""
    merged = MergedComponents(three[:2])
    checks = JoinChecks(merged)
    a, b = merged.all
    right = se3.inverse(PATH[0]) @ PATH[12]
    assert checks.is_near(a, b, right, MAX_OVERLAP_DISTANCE)
    assert not checks.is_near(a, b, right @ se3.exp([0, 0, -4.0, 0, 1.5, 0]), MAX_OVERLAP_DISTANCE)


def test_equal_timestamps_say_nothing_of_the_gap(three) -> None:
    merged = MergedComponents([replace(each, times=0 * each.times) for each in three[:2]])
    checks = JoinChecks(merged)
    T = se3.inverse(PATH[0]) @ PATH[12]
    assert not checks.is_near(*merged.all, T, MAX_OVERLAP_DISTANCE)


def test_component_may_lie_between_the_frames_of_another() -> None:
    """As in earlier results: what was joined around it is one component."""
    around, inside = stretch(0, [*range(14), *range(24, 38)]), stretch(1, range(15, 23))
    merged = MergedComponents([around, inside])
    checks = JoinChecks(merged)
    a, b = merged.all
    right = se3.inverse(PATH[0]) @ PATH[15]
    assert checks.reachable(a, b, right)
    assert checks.reachable(b, a, se3.inverse(right))
    assert checks.is_near(a, b, right, MAX_OVERLAP_DISTANCE)
    aside = right @ se3.exp([0, 0, -4.0, 0, 1.5, 0])
    assert not checks.reachable(a, b, aside)
    assert not checks.is_near(a, b, aside, MAX_OVERLAP_DISTANCE)


def test_component_of_several_recordings_constrains_motion_within_each() -> None:
    """As in earlier merges; the frames of the second one follow those of the other component."""
    both = stretch(0, [*range(14), *range(24, 38)])
    recording = np.repeat([0, 1], 14)
    both = replace(both, recording=recording, times=both.times - 100.0 * recording)
    merged = MergedComponents([both, stretch(1, range(15, 23))])
    checks = JoinChecks(merged)
    a, b = merged.all
    assert checks.reachable(a, b, se3.inverse(PATH[0]) @ PATH[15])
    elsewhere = se3.translation([0, 0, 40.0])
    second = replace(merged.tracked[1], recording=1)
    later = replace(second, times=second.times - 100.0)
    checks = JoinChecks(merged := MergedComponents([both, later]))
    assert not checks.reachable(*merged.all, elsewhere)


def test_motion_between_recordings_is_unconstrained() -> None:
    path, parts, link = turned_back(0.0)
    (group,) = BY_LINKS.join([parts[0], replace(parts[1], recording=1)], [link])
    assert_joined(group, parts, path)


BARE = {"boxes": (), "spots": 0, "dark": True}


def along_a_wall(shake=0.0):
    """A camera that moves along a bare wall, where all places look the same."""
    rng = np.random.default_rng(4)
    path = [
        at(0.02 * k, 1.0, 0.0, pitch=0.0) @ se3.exp(shake * rng.standard_normal(6))
        for k in range(24)
    ]
    return path, [stretch(0, range(10), path, **BARE), stretch(1, range(13, 24), path, **BARE)]


def test_gap_in_steady_motion_is_bridged_and_reported() -> None:
    path, parts = along_a_wall()
    (group,) = Joining(searches=0).join(parts, [])
    assert_joined(group, parts, path)
    assert group.bridged == {1: "motion"}
    assert (group.connection(0), group.connection(1)) == ("links", "motion")
    (join,) = group.joins
    assert (join.kind, join.defines_pose) == ("motion", True)
    assert (join.link.i, join.link.j) == (9, 13)
    assert not join.link.certain
    assert np.linalg.eigvalsh(join.link.information).min() > 0


@pytest.mark.nightly
def test_gap_in_irregular_motion_is_not_bridged() -> None:
    _, parts = along_a_wall()
    assert members(replace(SPARSELY, searches=0).join(parts, [])) == [[1], [0]]
    _, restless = along_a_wall(shake=0.03)
    assert members(Joining(searches=0).join(restless, [])) == [[1], [0]]
    # Nor between recordings, nor over a long time.
    apart = [parts[0], replace(parts[1], recording=1)]
    assert members(Joining(searches=0).join(apart, [])) == [[1], [0]]


def with_odometry(parts, path, sigma, seed=4):
    """The components with odometry whose steps have errors, m and rad."""
    rng = np.random.default_rng(seed)
    poses = [np.eye(4)]
    for a, b in itertools.pairwise(path):
        poses.append(poses[-1] @ se3.inverse(a) @ b @ se3.exp(sigma * rng.standard_normal(6)))
    return [replace(p, odometry=np.stack(poses)[p.frames]) for p in parts]


def test_gap_in_irregular_motion_is_bridged_by_odometry() -> None:
    path, parts = along_a_wall(shake=0.03)
    (group,) = Joining(searches=0).join(with_odometry(parts, path, 0.002), [])
    assert group.connection(1) == "odometry"
    (join,) = group.joins
    off = se3.log(se3.inverse(se3.inverse(path[9]) @ path[13]) @ join.link.T_i_j)
    sigma = np.sqrt(np.diag(np.linalg.inv(join.link.information)))
    assert (np.abs(off) < 3 * sigma).all()
    assert np.linalg.norm(off) < 0.03


@pytest.mark.nightly
def test_odometry_inconsistent_with_tracking_bridges_nothing() -> None:
    path, parts = along_a_wall(shake=0.03)
    for odometry in (with_odometry(parts, path, 0.2), [replace(p, odometry=None) for p in parts]):
        assert members(Joining(searches=0).join(odometry, [])) == [[1], [0]]
    # Nor does odometry that is missing at one end of the gap.
    first, second = with_odometry(parts, path, 0.002)
    unknown = second.odometry.copy()
    unknown[0] = np.nan
    missing = [first, replace(second, odometry=unknown)]
    assert members(Joining(searches=0).join(missing, [])) == [[1], [0]]


def test_links_to_frames_without_pose_are_left_out(three) -> None:
    stray = replace(linked(three[0], three[1]), j=999)
    (group,) = SPARSELY.join(three[:2], [stray])
    assert all(999 not in (join.link.i, join.link.j) for join in group.joins)


def test_links_of_real_searches_and_alignments_are_used(three) -> None:
    """As relocalization finds them during tracking."""
    a, b, c = three
    ends = [(a.views[-1].view, b.views[0].view), (b.views[-1].view, c.views[0].view)]
    made = [register_pair(*reversed(ends[0])), follow(*reversed(ends[1]), np.eye(4))]
    links = [
        Link(target.index, source.index, found, bool(found.believed), found.how)
        for (target, source), found in zip(ends, made, strict=True)
    ]
    (group,) = BY_LINKS.join(three, links)
    assert_joined(group, three)


def probable(first, second, p, T=None):
    """A correct link with a stated probability."""
    a, b = first, second
    T = se3.inverse(PATH[a.index]) @ PATH[b.index] if T is None else T
    link = link_of(a, b, T)
    return replace(link, registration=replace(link.registration, probability=p))


@pytest.fixture
def min_probability(three, monkeypatch):
    """Join two components by links alone, and return the probability; None if rejected."""
    monkeypatch.setattr(JoinChecks, "confirming", lambda *_: [])

    def joined(links, at_least=0.9):
        groups = replace(BY_LINKS, min_probability=at_least).join(three[:2], links)
        found = {join.probability for group in groups for join in group.joins}
        assert len(found) <= 1
        return found.pop() if found else None

    return joined


def test_independent_links_raise_probability(three, min_probability) -> None:
    a, b = three[0].views, three[1].views
    assert min_probability([probable(a[-1], b[0], 0.95)]) == pytest.approx(0.95)
    # The same views again add little: here the rotations are 0.24 rad.
    same = min_probability([probable(a[-1], b[0], 0.95), probable(a[-1], b[1], 0.95)])
    odds = 19 ** (1 + 0.24 / MAX_OVERLAP_DISTANCE) / 2
    assert same == pytest.approx(odds / (1 + odds), abs=0.02)
    assert min_probability([probable(a[-1], b[0], 0.95), probable(a[0], b[-1], 0.95)]) > same


def test_half_of_the_tries_are_away_from_the_links(monkeypatch) -> None:
    """The most similar views are of one place, of which more evidence adds little."""
    two = [stretch(c, range(20 * c, 20 * c + 20)) for c in range(2)]
    tried = []

    def registered(_, first, second):
        tried.append((first.index, second.index))
        return probable(first, second, 0.7)

    monkeypatch.setattr(JoinChecks, "confirming", lambda *_: [])
    monkeypatch.setattr(_Joiner, "_register", registered)
    joining = Joining(bridge=False, tries=6, min_probability=0.9999)
    main, other = joining.join(two, [])
    assert len(tried) == 6
    # What was reached is known of the group that is not joined.
    assert (main.reached, 0.7 < other.reached < 0.9999) == (0.0, True)

    def apart(pairs) -> float:
        turned = np.abs(0.08 * (np.array(pairs)[:, None] - np.array(pairs))).max(2)
        return turned[np.triu_indices(len(pairs), 1)].min()

    assert apart(tried[:3]) > 0.4
    assert apart(tried) < 0.3
    # Links that tracking found count as well.
    first = tried[0]
    a, b = (next(v for s in two for v in s.views if v.index == k) for k in first)
    tried.clear()
    joining.join(two, [probable(a, b, 0.7)])
    assert apart([first, *tried[:3]]) > 0.4


def test_sufficient_probability_is_not_what_a_contradicted_join_lacked(monkeypatch) -> None:
    two = [stretch(c, range(20 * c, 20 * c + 20)) for c in range(2)]
    monkeypatch.setattr(JoinChecks, "confirming", lambda *_: [])
    monkeypatch.setattr(JoinChecks, "contradicts", lambda *_: True)
    monkeypatch.setattr(_Joiner, "_register", lambda _, a, b: probable(a, b, 0.7))
    _, other = Joining(bridge=False, tries=6, min_probability=0.5).join(two, [])
    assert other.reached == 0.0


def test_first_group_is_main_on_request(three) -> None:
    strange = stretch(0, range(4), **STRANGE)
    groups = replace(SPARSELY, main="first").join([strange, three[1], three[2]], [])
    assert members(groups) == [[0], [1, 2]]
