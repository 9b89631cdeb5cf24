"""`tofuse view` in a browser, and its input; a run with a live view gives the same result."""

from __future__ import annotations

import contextlib
import json
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from browser import changed, chromium, watched
from report_results import make_room
from tofuse.cli import main
from tofuse.files.geometry_record import GeometryRecord
from tofuse.fusion.mesh import Mesh
from tofuse.geometry import se3
from tofuse.geometry.quaternion import to_matrix
from tofuse.pipeline.progress import Silent
from tofuse.pipeline.run import run
from tofuse.pipeline.run_options import Options
from tofuse.recordings.frames import CloudFrame
from tofuse.report.pictures import draw
from tofuse.report.thumbnails import viridis
from tofuse.results.folder import OutputFolder
from tofuse.results.output import write_result
from tofuse.viewer.content import colorings, layer_colors, read_content
from tofuse.viewer.coverage import Coverage
from tofuse.viewer.picking import pick
from tofuse.viewer.server import serve, stop
from tofuse.viewer.view_file import NAME, read_view_file, write_view_file
from viewer_scene import CANVAS, drawn, needs_viser


def sheet():
    """A curved sheet of triangles that faces the first camera."""
    n = 40
    x, y = np.meshgrid(np.linspace(-1.5, 1.5, n), np.linspace(-1, 1, n))
    vertices = np.stack([x, y, 2 + 0.2 * x**2], -1).reshape(-1, 3).astype(np.float32)
    k = np.arange(n * n).reshape(n, n)
    a, b, c, d = k[:-1, :-1].ravel(), k[:-1, 1:].ravel(), k[1:, 1:].ravel(), k[1:, :-1].ravel()
    faces = np.concatenate([np.stack([a, c, d], 1), np.stack([a, b, c], 1)]).astype(np.int32)
    normals = np.tile(np.float32([0, 0, -1]), (n * n, 1))
    color = np.repeat((np.arange(n * n) % 200 + 40).astype(np.uint8)[:, None], 3, axis=1)
    sigma = np.linspace(0.001, 0.02, n * n).astype(np.float32)
    views = (np.arange(n * n) // n).astype(np.int32)
    return Mesh(vertices, faces[:, ::-1].copy(), normals, color, sigma, views, np.zeros(3))


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """The output folder of a synthetic run: 24 frames, two of them lost, one loop."""
    result, _ = make_room()
    cloud = result.cloud
    result = replace(
        result,
        mesh=sheet(),
        diagnostics=replace(result.diagnostics, cloud_before=cloud),
    )
    out = tmp_path_factory.mktemp("view") / "out"
    pictures = draw(result.diagnostics.samples)
    write_result(result, OutputFolder(out), lambda r, f: write_view_file(r, pictures, f / NAME))
    return out


def test_content_matches_result(folder):
    made, _ = make_room()
    found = read_content(folder)
    posed = np.flatnonzero(made.has_pose)
    assert sorted(found.after) == sorted(found.view.before) == posed.tolist()
    for k in posed:
        np.testing.assert_allclose(found.after[k], made.trajectory[k], atol=1e-12)
        np.testing.assert_array_equal(found.view.before[k], made.diagnostics.sequential[k])
    assert [p.index for p in found.view.pictures] == list(range(0, 15, 2))
    assert set(found.view.pictures[0].images) == {"range", "amplitude", "fate"}
    np.testing.assert_allclose(found.loops, made.trajectory[[[0, 23]], :3, 3], atol=1e-12)
    assert len(found.view.model_before.points) == len(made.cloud)
    np.testing.assert_allclose(np.linalg.norm(found.up), 1)
    assert found.up[1] < -0.9


def test_result_without_view_file_is_shown(folder, tmp_path):
    out = shutil.copytree(folder, tmp_path / "out")
    (out / NAME).unlink()
    found = read_content(out)
    assert len(found.after) == 21
    assert found.view.before == {}
    assert found.view.pictures == ()
    assert found.view.model_before is None


def damaged(out, how):
    if how == "cut":
        data = (out / NAME).read_bytes()
        (out / NAME).write_bytes(data[: len(data) // 2])
    elif how == "pickled":
        np.savez(out / NAME, index=np.array([print], object))
    elif how == "short":
        path = out / "trajectory.txt"
        path.write_text("".join(path.read_text().splitlines(True)[:-1]))
    elif how == "none":
        (out / "run.json").unlink()


@pytest.mark.parametrize("how", ["cut", "pickled", "short", "none", "missing"])
def test_invalid_result_is_reported_in_one_line(folder, tmp_path, how, capsys):
    out = tmp_path / "out"
    if how != "missing":
        damaged(shutil.copytree(folder, out), how)
    assert main(["view", str(out), "--no-open"]) == 2
    message = capsys.readouterr().err
    assert re.fullmatch(r"tofuse: .*out.*\n", message)


@pytest.mark.parametrize("field", ["frames", "components", "reasons", "loops", "T_up_world"])
@pytest.mark.parametrize("value", [None, 3, [1]])
def test_damaged_run_json_is_reported_in_one_line(folder, tmp_path, field, value, capsys):
    out = shutil.copytree(folder, tmp_path / "out")
    run = json.loads((out / "run.json").read_text())
    (out / "run.json").write_text(json.dumps(run | {field: value}))
    expected = r"tofuse: .*run\.json: (is damaged|T_up_world: is not a finite 4x4 matrix).*\n"
    assert main(["view", str(out), "--no-open"]) == 2
    assert re.fullmatch(expected, capsys.readouterr().err)
    if field in ("frames", "T_up_world"):
        assert main(["export", str(out), "log", "3dtiles"]) == 2
        assert re.fullmatch(expected, capsys.readouterr().err)


def test_view_file_is_reproducible(tmp_path):
    made, _ = make_room()
    pictures = draw(made.diagnostics.samples)
    for name in "ab":
        (tmp_path / name).mkdir()
        write_view_file(made, pictures, tmp_path / name / NAME)
    assert (tmp_path / "a" / NAME).read_bytes() == (tmp_path / "b" / NAME).read_bytes()
    assert [p.images for p in read_view_file(tmp_path / "a").pictures] == [
        p.images for p in pictures
    ]


def test_missing_package_is_reported_in_one_line(folder, monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "viser", None)
    assert main(["view", str(folder), "--no-open"]) == 2
    assert "pip install 'tofuse[viewer]'" in capsys.readouterr().err


@needs_viser
def test_occupied_port_is_reported_in_one_line(folder, capsys):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        assert main(["view", str(folder), "--no-open", "--port", str(port)]) == 2
    assert f"--port {port}" in capsys.readouterr().err


def test_options_of_page_require_page(tmp_path, capsys):
    assert main(["run", "x", "--out", str(tmp_path / "o"), "--port", "9000"]) == 2
    assert "--view" in capsys.readouterr().err


def test_colours_follow_values(folder):
    found = read_content(folder)
    assert colorings([found.mesh, found.cloud]) == [
        "colour", "height", "accuracy", "view count"
    ]  # fmt: skip
    bright = {
        by: layer_colors(found.mesh, by, found.up)[0].astype(int).sum(1) for by in ("height",)
    }
    heights = found.mesh.points @ found.up
    assert np.corrcoef(bright["height"], heights)[0, 1] > 0.9
    colors, bar = layer_colors(found.mesh, "accuracy", found.up)
    assert np.corrcoef(colors.astype(int).sum(1), found.mesh.scalars["sigma"])[0, 1] > 0.9
    assert bar.label == "Accuracy (95 %)"
    assert bar.labels[0].startswith("±")
    shaded = layer_colors(found.mesh, "colour", found.up)[0].astype(float)
    assert np.all(shaded >= 0.6 * found.mesh.color - 1)
    assert np.all(shaded <= found.mesh.color)


def test_nearest_point_on_ray_is_picked():
    points = np.array([[0, 0, 4], [0.001, 0, 2], [0, 0, -1], [0.5, 0, 2]], np.float32)
    cloud = GeometryRecord(points, scalars={"sigma": np.array([0.001, 0.002, 0.003, 0.004])})
    found = pick([cloud], [0, 0, 0], [0, 0, 2])
    np.testing.assert_array_equal(found.point, points[1])
    assert found.sigma == 0.002
    np.testing.assert_array_equal(pick([cloud], [0, 0, 3], [0, 0, 1]).point, points[0])
    assert pick([cloud], [0, 0, 0], [1, 1, 0]) is None
    # Surfaces are invisible from behind, so they cannot be picked.
    faces, away = np.array([[0, 1, 3]], np.int32), np.tile(np.float32([0, 0, 1]), (4, 1))
    assert pick([GeometryRecord(points, faces, away)], [0, 0, 0], [0, 0, 1]) is None


@pytest.fixture(scope="module")
def browser():
    with chromium() as found:
        yield found


def screen(client, point, box):
    """Position of a point on the page."""
    T = np.eye(4)
    T[:3, :3] = to_matrix(np.roll(client.camera.wxyz, -1))
    T[:3, 3] = client.camera.position
    x, y, z = se3.transform(se3.inverse(T), np.asarray(point, float)[None])[0]
    scale = box["height"] / 2 / np.tan(client.camera.fov / 2)
    return (
        box["x"] + box["width"] / 2 + scale * x / z,
        box["y"] + box["height"] / 2 + scale * y / z,
    )


@pytest.mark.slow
@needs_viser
def test_page_toggles_selects_frames_and_measures(folder, browser):
    from playwright.sync_api import TimeoutError as NotYet

    from tofuse.viewer.app import ResultView
    from tofuse.viewer.server import address

    server = serve()
    try:
        result = read_content(folder)
        view = ResultView(server, result)
        place = address(server)
        size = {"width": 860, "height": 560}
        with watched(browser, place, ours=place, viewport=size) as seen:
            page = seen.page
            page.get_by_text("Degraded", exact=True).wait_for(timeout=30_000)
            first = drawn(seen)
            assert len(np.unique(first.reshape(-1, 3), axis=0)) > 100

            # Cameras before optimisation are orange: none, then some.
            def orange(image):
                return int((image[..., 2] - image[..., 0] > 110).sum())

            none = orange(first)
            page.get_by_label("Cameras before").click()
            assert orange(drawn(seen)) > none + 40
            page.get_by_label("Cameras before").click()
            page.get_by_label("Surface").click()
            assert changed(first, drawn(seen)) > 0.02
            page.get_by_label("Surface").click()
            page.get_by_label("Colour by").click()
            page.get_by_role("option", name="accuracy").click()
            colored = drawn(seen)
            assert changed(first, colored) > 0.02
            assert page.get_by_text("Accuracy (95 %)").is_visible()
            # There is no shading: drawn pixels have colours of the bar.
            ramp = viridis(np.linspace(0, 1, 256)).astype(int)
            for name in ("Cameras", "Loop closures"):
                page.get_by_label(name, exact=True).click()
            model = drawn(seen)[200:-40, 60:460, ::-1].reshape(-1, 3)
            for name in ("Cameras", "Loop closures"):
                page.get_by_label(name, exact=True).click()
            model = model[np.ptp(model, axis=1) > 60][::23]
            off = np.abs(model[:, None] - ramp).max(2).min(1)
            assert np.mean(off < 12) > 0.85

            shot = page.get_by_alt_text("Range")
            was = shot.get_attribute("src")
            track = page.locator(".mantine-Slider-track").first.bounding_box()
            height = track["y"] + track["height"] / 2
            page.mouse.move(track["x"], height)
            page.mouse.down()
            page.mouse.move(track["x"] + track["width"] * 10 / 23, height, steps=3)
            page.mouse.up()
            page.get_by_text("Frame 10: lost – too few correspondences").wait_for(timeout=15_000)
            assert shot.get_attribute("src") != was

            page.get_by_role("button", name="Pick two points").click()
            page.get_by_text("Click the first point.").wait_for(timeout=15_000)
            (client,) = server.get_clients().values()
            box = page.locator(CANVAS).bounding_box()
            ends = [result.mesh.points[40 * 20 + 8], result.mesh.points[40 * 20 + 30]]
            second = page.get_by_text("Click the second point.")
            for _ in range(3):  # viser drops clicks until its page has drawn the new mode
                if not view.ends:  # a slow page has not yet confirmed it
                    page.mouse.click(*screen(client, ends[0], box))
                with contextlib.suppress(NotYet):
                    second.wait_for(timeout=10_000)
                    break
            page.mouse.click(*screen(client, ends[1], box))
            true = float(np.linalg.norm(ends[1] - ends[0]))
            page.locator("strong", has_text=" m").first.wait_for(timeout=15_000)
            np.testing.assert_allclose(view.ends, ends, atol=0.03)
            assert view.distance == pytest.approx(true, abs=0.05)
            assert 0.001 < view.error < 0.06
            words = f"{view.distance:.3f} m ± {1000 * view.error:.0f} mm"
            assert page.locator("strong", has_text=words).count() == 1
            seen.check()
    finally:
        stop(server)


@pytest.mark.slow
@needs_viser
@pytest.mark.skipif(sys.platform == "win32", reason="sends a signal of POSIX")
def test_command_serves_until_interrupted(folder):
    command = [sys.executable, "-m", "tofuse", "view", str(folder), "--no-open"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as p:
        lines = [p.stderr.readline(), p.stderr.readline()]
        assert re.fullmatch(r"see http://127\.0\.0\.1:\d+\n", lines[0])
        assert lines[1] == "press Ctrl-C to stop\n"
        p.send_signal(signal.SIGINT)
        out, err = p.communicate(timeout=60)
    assert (p.returncode, out, err) == (0, "", "")


class Recorder(Silent):
    def __init__(self):
        self.frames, self.stages = [], []

    def stage(self, name, total=None):
        self.stages.append(name)

    def placed(self, frame, T_world_camera):
        self.frames.append((frame.index, T_world_camera.copy(), len(self.stages)))


@pytest.mark.slow
@needs_viser
def test_live_view_grows_and_does_not_change_result(room_recording, tmp_path, browser, monkeypatch):
    from tofuse.pipeline.progress import CombinedProgress
    from tofuse.viewer.live_view import LiveView
    from tofuse.viewer.server import address

    same = ("trajectory.txt", "pose_graph.g2o", "cloud.ply", "mesh.ply")
    quick = {"end": 4, "method": "thesis"}
    recorder = Recorder()
    server = serve()
    try:
        live = LiveView(server)
        began = time.perf_counter()
        watched_run = run(
            [room_recording], Options(out=tmp_path / "a", **quick), CombinedProgress(recorder, live)
        )
        assert live.first_seconds <= time.perf_counter() - began
        # The first frame is shown before any stage begins, and then each one with its pose.
        assert recorder.frames[0][0::2] == (0, 0)
        assert [k for k, *_ in recorder.frames[1:]] == [0, 1, 2, 3]
        np.testing.assert_allclose(recorder.frames[-1][1], watched_run.trajectory[3], atol=0.05)
        place = address(server)
        with watched(browser, place, ours=place, viewport={"width": 700, "height": 460}) as seen:
            seen.page.get_by_text("writing").wait_for(timeout=30_000)
            growing = drawn(seen)
            assert len(np.unique(growing.reshape(-1, 3), axis=0)) > 100
            seen.page.get_by_label("Colour by").click()
            seen.page.get_by_role("option", name="accuracy").click()
            seen.page.get_by_text("Go to bright places next").wait_for(timeout=15_000)
            assert changed(growing, drawn(seen)) > 0.01
            live.finish(tmp_path / "a")
            seen.page.get_by_text("Pick two points").wait_for(timeout=30_000)
            drawn(seen)
            seen.check()
    finally:
        stop(server)
    run([room_recording], Options(out=tmp_path / "b", no_report=True, **quick))
    for name in same:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    assert json.loads((tmp_path / "a/run.json").read_text())["schema"] == 1


def test_accuracy_improves_with_proximity_and_number_of_views():
    rng = np.random.default_rng(1)
    wall = np.float32(rng.uniform([-1, -1, 2], [1, 1, 2.001], (4000, 3)))
    left = wall[:, 0] < 0
    coverage = Coverage(0.05)
    assert np.isinf(coverage.sigma(wall)).all()
    coverage.add(wall, np.full(len(wall), 0.008))
    for _ in range(3):
        coverage.add(wall[left], np.full(left.sum(), 0.008))
    inside = np.abs(wall[:, 0]) > 0.1
    np.testing.assert_allclose(coverage.sigma(wall)[left & inside], 0.004, rtol=1e-6)
    np.testing.assert_allclose(coverage.sigma(wall)[~left & inside], 0.008, rtol=1e-6)
    assert np.isinf(coverage.sigma(wall + np.float32([0, 0, 1]))).all()


@needs_viser
def test_views_of_long_run_are_thinned():
    from tofuse.viewer import live_view as live_module

    server = serve()
    try:
        live = live_module.LiveView(server)
        rng = np.random.default_rng(0)
        for k in range(2 * live_module._CLOUDS):
            T = np.eye(4)
            T[0, 3] = 0.5 * k
            live.placed(CloudFrame.of(rng.normal(0, 1, (50, 3)), index=k), T)
        assert len(live._shown) <= live_module._CLOUDS
        xs = [T[0, 3] for T, _ in live._shown]
        assert xs == sorted(xs)
        assert xs[0] == 0
    finally:
        stop(server)
