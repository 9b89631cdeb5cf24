"""Fusion in regions that fit into memory: their blocks and views, and seamless borders."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ball_views import CAMERA, EYE, around_a_ball, frame_of, look, plane_range
from made_rooms import at, seen
from tofuse.engine.compute.spill import Spill
from tofuse.engine.compute.thread_pool import threads
from tofuse.engine.fusion import tsdf_kernels as tsdf
from tofuse.engine.fusion.block_kernels import EDGE, block_of
from tofuse.engine.fusion.layout import Frusta, Layout
from tofuse.engine.fusion.options import Fusion
from tofuse.engine.fusion.range_view import RangeView
from tofuse.engine.fusion.tsdf import Piece, Volume, _free_space_limits, fuse_surface, stitch
from whole_volume import volume_around

COLUMNS = ("vertices", "faces", "normals", "color", "sigma", "views")


def a_room(count=24):
    """Views (views, poses) of a furnished room, turning on the spot in two places."""
    poses = np.array(
        [at(-0.5 + (k % 2), 0.2 * (k % 3) - 0.2, 2 * np.pi * k / count) for k in range(count)]
    )
    return [RangeView.of(seen(T, k)) for k, T in enumerate(poses)], poses


@pytest.fixture(scope="module")
def room():
    return a_room()


def same(a, b):
    for name in COLUMNS:
        assert getattr(a, name).tobytes() == getattr(b, name).tobytes(), name


@pytest.mark.parametrize(("memory_mb", "least"), [(8, 2), (1, 30)])
def test_regions_give_same_bytes(room, memory_mb, least) -> None:
    views, poses = room
    options = Fusion(voxel_m=0.03, island=60)
    single_region = fuse_surface(views, poses, options)
    small = replace(options, memory_mb=memory_mb)
    layout = Layout.of(views, poses, 0.03)
    assert len(layout.regions(memory_mb * 1_000_000 // layout.block_bytes)) >= least
    same(fuse_surface(views, poses, small), single_region)
    with threads(1):
        same(fuse_surface(views, poses, small), single_region)


def test_round_robin_colours_and_two_cameras_make_no_seam() -> None:
    """Round-robin depends on the numbers of blocks and views, not on how they are grouped."""
    frames, poses = around_a_ball(70, noise=np.random.default_rng(3))
    color = np.random.default_rng(4).integers(0, 255, (72, 88, 3)).astype(np.uint8)
    other = replace(CAMERA, fx=93.0)
    frames = [
        replace(f, camera=other if k % 40 > 25 else CAMERA, color_image=None if k % 9 else color)
        for k, f in enumerate(frames)
    ]
    views = [RangeView.of(frame) for frame in frames]
    for options in (Fusion(voxel_m=0.009), Fusion(voxel_m=0.009, min_views=30, island=0)):
        same(
            fuse_surface(views, poses, replace(options, memory_mb=2)),
            fuse_surface(views, poses, options),
        )


def test_each_block_has_one_region_with_its_neighbours(room) -> None:
    views, poses = room
    layout = Layout.of(views, poses, 0.03)
    place = {block_of(int(key)): k for k, key in enumerate(layout.keys)}
    regions = layout.regions(300)
    owned = np.concatenate([region.rows[: region.owned] for region in regions])
    np.testing.assert_array_equal(np.sort(owned), np.arange(len(layout.keys)))
    for region in regions:
        assert len(region.rows) <= 300
        assert (np.diff(region.rows[: region.owned]) > 0).all()
        assert len(np.unique(region.rows)) == len(region.rows)
        contained = set(region.rows.tolist())
        for row in region.rows[: region.owned]:
            i, j, k = block_of(int(layout.keys[row]))
            around = np.stack(np.meshgrid(*[(-1, 0, 1)] * 3), -1).reshape(-1, 3)
            near = [place.get((i + a, j + b, k + c)) for a, b, c in around.tolist()]
            assert contained.issuperset(n for n in near if n is not None)
            assert (region.low < [i, j, k]).all()
            assert (region.high > [i + 1, j + 1, k + 1]).all()
    # Recursive halving: no region is much smaller than the others.
    sizes = [region.owned for region in regions]
    assert min(sizes) > max(sizes) / 5
    assert len(layout.regions(1)) == len(layout.keys)  # regions are at least single blocks
    assert len(layout.regions(len(layout.keys))) == 1


@pytest.mark.parametrize("which", ["room", "ball", "grazing"])
def test_skipped_views_contribute_nothing(room, which) -> None:
    if which == "room":
        views, poses = room
    elif which == "ball":
        frames, poses = around_a_ball(20, noise=np.random.default_rng(7))
        views = [RangeView.of(f) for f in frames]
    else:  # noisy pixels and grazing planes carve free space far behind them
        poses = np.array([look([0.4 * k, 0, 0], [0.4 * k + 1.5, 0.3, 2]) for k in range(6)])
        floor = [plane_range(T, np.array([0, 1.0, 0]), 0.4) for T in poses]
        near = [np.where(f < 6, f, np.inf) for f in floor]
        views = [RangeView.of(frame_of(f, k, sigma=0.03)) for k, f in enumerate(near)]
    layout = Layout.of(views, poses, 0.01 if which == "ball" else 0.03)
    frusta = Frusta.of(views, poses, _free_space_limits(layout.reach_m))
    skipped = 0
    for region in layout.regions(40):
        edge = EDGE * layout.voxel_m
        touching = frusta.touching(edge * (region.low - 1.0), edge * (region.high + 1.0))
        skipped += (~touching).sum()
        volume = Volume.of(layout, region)
        volume.add(views, poses, touching=~touching)
        assert not volume.weight.any()
        assert not volume.free.any()
        assert not volume.seen.any()
    assert skipped > len(views)


def test_islands_are_measured_across_regions() -> None:
    """A strip across several regions exceeds the island size, but not in any single region."""
    ranges = plane_range(EYE, np.array([0, 0, 1.0]), 2.0)
    ranges[:34] = np.inf
    ranges[40:] = np.inf
    view = RangeView.of(frame_of(ranges))
    layout = Layout.of([view], EYE[None], 0.01)
    pieces: Spill[Piece] = Spill(0)
    largest = 0
    for region in layout.regions(30):
        volume = Volume.of(layout, region)
        volume.add([view], EYE[None])
        piece = volume.piece()
        largest = max(largest, len(piece))
        pieces.put(piece)
    assert len(pieces) > 5
    mesh = stitch(pieces, len(layout.keys), 2 * largest)
    assert len(mesh) > 3 * largest
    assert len(stitch(pieces, len(layout.keys), 2 * len(mesh))) == 0


def test_view_counts_saturate() -> None:
    view = RangeView.of(frame_of(plane_range(EYE, np.array([0, 0, 1.0]), 2.0)))
    volume = volume_around([view], EYE[None], 0.05)
    volume.add([view], EYE[None])
    near = volume.seen > 0
    volume.seen[near] = tsdf.MAX_VIEWS
    volume.add([view], EYE[None])
    assert (volume.seen[near] == tsdf.MAX_VIEWS).all()
