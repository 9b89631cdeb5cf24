"""Tiled surfaces in the viewer: which tiles are selected, their content, and the page."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from browser import changed, chromium, watched
from report_results import make_room
from tofuse.errors import InputError
from tofuse.files.tileset import Tile
from tofuse.fusion import levels as detail
from tofuse.report.pictures import draw
from tofuse.results import tiles
from tofuse.results.folder import OutputFolder
from tofuse.results.output import write_result
from tofuse.viewer.content import TiledLayer, layer_colors, read_content
from tofuse.viewer.frame_budget import FrameBudget
from tofuse.viewer.level_of_detail import Eye, select_tiles
from tofuse.viewer.server import serve, stop
from tofuse.viewer.view_file import NAME, write_view_file
from viewer_scene import drawn, needs_viser
from wavy_surface import waves


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Iterator[Path]:
    """A result whose surface, waves of 1.8 m before the first camera, is in tiles."""
    result, _ = make_room()
    mesh = waves(origin=(-0.9, -0.9, 2.0))
    flipped = replace(mesh, faces=mesh.faces[:, ::-1].copy(), normals=-mesh.normals)
    out = tmp_path_factory.mktemp("view") / "out"
    pictures = draw(result.diagnostics.samples)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(tiles, "MAX_UNTILED_FACES", 10_000)
        patch.setattr(detail, "_TRIANGLES_PER_EDGE", 32)
        write_result(
            replace(result, mesh=flipped),
            OutputFolder(out),
            lambda r, f: write_view_file(r, pictures, f / NAME),
        )
        yield out


@pytest.fixture(scope="module")
def layer(folder) -> TiledLayer:
    return TiledLayer.read(folder / "tiles")


def eye(layer, position, target, height=800):
    """A viewer at a position in the world, in the axes of the tiles."""
    at, to = (layer.R_up_world @ np.asarray(p, float) for p in (position, target))
    return Eye(at, (to - at) / np.linalg.norm(to - at), 1.0, 1.5, height)


def finest(tile):
    return sum(t.faces for t in tile.walk() if t.content and t.content.startswith("0-"))


def covered(root, shown):
    """Check that each leaf is shown once, by itself or by an ancestor."""
    names = {tile.content for tile in shown}
    assert len(names) == len(shown)

    def count(tile, above):
        mine = above + (tile.content in names)
        if not tile.children:
            return [mine] if finest(tile) else []
        return [n for child in tile.children for n in count(child, mine)]

    assert set(count(root, 0)) == {1}


@pytest.mark.parametrize("budget", [1, 5_000, 20_000, 40_000, 10**9])
def test_each_part_is_shown_once_within_budget(layer, budget) -> None:
    whole = finest(layer.root)
    for at in (None, eye(layer, [0, 0, 1.9], [0.5, 0.4, 2.0]), eye(layer, [0, 0, -9], [0, 0, 2])):
        shown = select_tiles(layer.root, at, budget)
        covered(layer.root, shown)
        faces = sum(tile.faces for tile in shown)
        assert faces <= max(budget, layer.root.faces)
    assert sum(t.faces for t in select_tiles(layer.root, None, 10**9)) == whole


def test_near_tiles_are_fine_and_distant_or_hidden_ones_coarse(layer) -> None:
    near = select_tiles(layer.root, eye(layer, [-0.7, -0.7, 1.8], [-0.8, -0.8, 2.0]), 10**9)
    at = layer.R_up_world @ [-0.8, -0.8, 2.0]
    here = [t for t in near if (t.low <= at + 0.1).all() and (t.high >= at - 0.1).all()]
    assert min(t.error_m for t in here) == 0
    away = select_tiles(layer.root, eye(layer, [0, 0, -0.5], [0, 0, -4.0]), 10**9)
    assert [t.content for t in away] == [layer.root.content]  # everything is behind the viewer
    far = select_tiles(layer.root, eye(layer, [0, 0, -200.0], [0, 0, 2.0]), 10**9)
    assert [t.content for t in far] == [layer.root.content]
    steps = [
        sum(t.faces for t in select_tiles(layer.root, eye(layer, [0, 0, z], [0, 0, 2]), 10**9))
        for z in (-60.0, -20.0, -6.0, -1.0)
    ]
    assert steps == sorted(steps)
    assert steps[-1] > 4 * steps[0]
    # No error exceeds 2 pixels if the budget is unlimited.
    here_eye = eye(layer, [0, 0, -3.0], [0, 0, 2])
    shown = select_tiles(layer.root, here_eye, 10**9)
    assert max((here_eye.pixels(t) for t in shown if t.children), default=0) <= 2


def test_budget_is_spent_on_largest_screen_errors(layer) -> None:
    at = eye(layer, [-0.7, -0.7, 1.7], [0.2, 0.2, 2.0])
    shown = select_tiles(layer.root, at, 20_000)
    worst = max(at.pixels(t) for t in shown if t.children)
    refined = {t.content for t in layer.root.walk() if t.children} - {t.content for t in shown}
    done = [
        t
        for t in layer.root.walk()
        if t.content in refined and not any(t.content in _below(s) for s in shown)
    ]
    assert done
    assert min(at.pixels(t) for t in done) >= 0.9 * worst


def _below(tile):
    return {t.content for t in tile.walk()}


def test_empty_tiles_are_skipped() -> None:
    low, high = np.zeros(3), np.ones(3)
    leaf = Tile(low, high, 0.0, "0-0-0-0.glb", 5)
    nothing = Tile(low, high, 0.0, None, 0)
    root = Tile(low, high, 2.0, None, 0, [Tile(low, high, 1.0, None, 0, [leaf, nothing])])
    assert select_tiles(root, None, 1) == [leaf]
    coarse = Tile(low, high, 1.0, "1-0-0-0.glb", 9, [nothing])
    assert select_tiles(coarse, None, 100) == []  # the finer tile is empty
    assert select_tiles(coarse, Eye(np.full(3, 90.0), np.ones(3), 1.0, 1.0, 100), 100) == [coarse]


def test_tiled_result_is_read_with_its_overview(folder, layer) -> None:
    result = read_content(folder)
    mesh = waves(origin=(-0.9, -0.9, 2.0))
    assert result.tiles is not None
    assert result.mesh is not None
    assert len(result.mesh.faces) <= 250_000
    z = 2 + 0.1 * np.sin(9 * (result.mesh.points[:, 0] + 0.9)) * np.cos(
        7 * (result.mesh.points[:, 1] + 0.9)
    )
    np.testing.assert_allclose(result.mesh.points[:, 2], z, atol=0.02)
    assert result.cloud.faces is None
    assert len(result.cloud.points) == len(result.mesh.points)
    assert result.up @ [0, -1, 0] > 0.9
    (tile,) = [t for t in layer.root.walk() if t.content == "0-0-0-0.glb"]
    part = layer.layer(tile)
    sigma = part.scalars["sigma"].astype(float)
    assert set(np.round(sigma, 7)) <= set(np.round(mesh.sigma.astype(float), 7))
    # One colour scale for all tiles.
    lone, _ = layer_colors(part, "accuracy", result.up)
    scaled, bar = layer_colors(part, "accuracy", result.up, result.mesh)
    assert bar.labels == layer_colors(result.mesh, "accuracy", result.up)[1].labels
    assert (lone != scaled).any()
    same, _ = layer_colors(part, "accuracy", result.up, part)
    np.testing.assert_array_equal(same, lone)


@pytest.mark.parametrize("how", ["missing", "cut", "turned", "an object", "empty"])
def test_damaged_tiles_are_reported_in_one_line(folder, tmp_path, how) -> None:
    import shutil

    out = tmp_path / "out"
    shutil.copytree(folder, out)
    path = out / "tiles" / "tileset.json"
    if how == "missing":
        path.unlink()
    elif how == "cut":
        largest = max(out.glob("tiles/0-*.glb"), key=lambda p: p.stat().st_size)
        largest.write_bytes(largest.read_bytes()[:500])
    else:
        document = json.loads(path.read_text())
        if how == "empty":
            document["root"].pop("content", None)
            document["root"]["children"] = []
        else:
            document["extras"]["T_up_world"] = [[1]] if how == "turned" else {"a": 1}
        path.write_text(json.dumps(document))
    with pytest.raises(InputError) as caught:
        read_content(out)
    assert "\n" not in str(caught.value)


@pytest.fixture(scope="module")
def browser():
    with chromium() as found:
        yield found


@pytest.mark.slow
@needs_viser
def test_viewer_loads_tiles_on_approach(folder, browser, monkeypatch) -> None:
    from tofuse.viewer.app import ResultView
    from tofuse.viewer.server import address
    from tofuse.viewer.tiled import TiledSurface

    # A browser that renders in software on a busy machine gets coarser tiles.
    monkeypatch.setattr(FrameBudget, "moved", lambda *_: None)
    server = serve()
    try:
        result = read_content(folder)
        view = ResultView(server, result)
        surface = view._model["surface"]
        assert isinstance(surface, TiledSurface)
        place = address(server)
        with watched(browser, place, ours=place, viewport={"width": 860, "height": 560}) as seen:
            page = seen.page
            page.get_by_text("Degraded", exact=True).wait_for(timeout=30_000)
            settled(surface)
            (client,) = server.get_clients().values()
            first = drawn(seen)
            far = sum(tile.faces for tile in surface.shown()[0])
            covered(result.tiles.root, surface.shown()[0])
            client.camera.position = (-0.5, -0.5, 1.5)
            client.camera.look_at = (-0.5, -0.4, 2.0)
            page.wait_for_timeout(500)
            settled(surface)
            near = drawn(seen)
            assert changed(first, near) > 0.2
            tiles_near = surface.shown()[0]
            assert sum(t.error_m == 0 for t in tiles_near) > 0
            assert {t.content for t in tiles_near} != {t.content for t in result.tiles.root.walk()}
            assert far > 0
            # Points are picked on the finest surface shown.
            point = surface.layer_along([-0.5, -0.5, 1.5], [0.0, 0.0, 1.0])
            assert len(point.points) > 0
            page.get_by_label("Colour by").click()
            page.get_by_role("option", name="height").click()
            page.wait_for_timeout(500)
            settled(view._model["surface"])
            colored = drawn(seen)
            assert changed(near, colored) > 0.1
            page.get_by_label("Surface").click()
            hidden = drawn(seen)
            assert changed(colored, hidden) > 0.1
            page.get_by_label("Surface").click()
            assert changed(colored, drawn(seen)) < 0.02
            seen.check()
    finally:
        stop(server)


def settled(surface) -> None:
    """Wait until the tiles of the only page no longer change."""
    import time

    last: list[str | None] = []
    for _ in range(120):
        time.sleep(0.25)
        now = sorted((t.content for t in shown), key=str) if (shown := _only(surface)) else []
        if now and now == last:
            return
        last = now
    raise AssertionError("tiles don't come")


def _only(surface):
    pages = surface.shown()
    return pages[0] if pages else []
