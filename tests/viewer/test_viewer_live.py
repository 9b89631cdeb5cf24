"""The live view of a run: it grows, and does not change the result."""

from __future__ import annotations

import importlib.util
import json
from time import sleep

import numpy as np
import pytest

from browser import changed, watched
from tofuse.apps.jobs.run_options import Options
from tofuse.apps.jobs.running import run
from tofuse.apps.viewer.server import serve, stop
from tofuse.engine.progress import Silent

needs_viser = pytest.mark.skipif(
    importlib.util.find_spec("viser") is None, reason="viser is not installed"
)
CANVAS = "canvas[data-engine]"


def drawn(seen):
    """The picture after rendering has settled."""
    last = seen.pixels(CANVAS)
    for _ in range(40):
        seen.page.wait_for_timeout(250)
        now = seen.pixels(CANVAS)
        if changed(last, now) == 0:
            return now
        last = now
    return last


class Recorder(Silent):
    def __init__(self):
        self.frames, self.stages = [], []

    def stage(self, name, total=None):
        self.stages.append(name)

    def placed(self, frame, T_world_camera):
        self.frames.append((frame.index, T_world_camera.copy(), len(self.stages)))


@needs_viser
def test_live_view_shows_advice_until_tracking_ends(room_recording, monkeypatch):
    from tofuse.apps.viewer import live_view
    from tofuse.engine.mapping import Mapper
    from tofuse.formats.recordings import open_recording

    monkeypatch.setattr(live_view, "_ADVICE_PERIOD", 0.0)
    monkeypatch.setattr(live_view, "_ADVICE_SHARE", 0.0)
    server = serve()
    try:
        live = live_view.LiveView(server)
        live.stage("tracking", 8)
        mapper = Mapper(threads=1, progress=live)
        for frame in open_recording(room_recording):
            mapper.push(frame)
        assert live._advice.content.startswith("**Next:** ")
        live._show_advice("**Next:** turn around", np.diag([-1.0, 1, -1, 1]), np.eye(4))
        arrow, target = live._advised
        np.testing.assert_allclose(arrow.points[0, 1], [0, 0, -0.5], atol=1e-6)
        np.testing.assert_allclose(np.abs(target.wxyz), [0, 0, 1, 0], atol=1e-9)
        live.stage("closing loops")
        monkeypatch.setattr(live_view, "_UPDATE_PERIOD", 0.0)
        live.advance()
        assert live._status.content == "**closing loops** 1"
        assert live._advice.content == ""
        assert not live._advised
        assert live._so_far is None
    finally:
        stop(server)


def test_live_map_places_the_frames_of_a_camera(room_recording):
    from tofuse.apps.viewer import LiveMap
    from tofuse.formats.recordings import open_recording

    recorder = Recorder()
    frames = list(open_recording(room_recording))[:3]
    with LiveMap(recorder) as live_map:
        for k, frame in enumerate(frames):
            live_map.offer(frame)
            while len(recorder.frames) <= k:
                sleep(0.01)
    assert [index for index, *_ in recorder.frames] == [0, 1, 2]
    np.testing.assert_array_equal(recorder.frames[0][1], np.eye(4))
    assert np.linalg.norm(recorder.frames[2][1] - np.eye(4)) > 0.01
    assert recorder.stages == ["tracking", "recorded"]


@pytest.mark.nightly
@needs_viser
def test_live_view_grows_and_does_not_change_result(room_recording, tmp_path, browser):
    from tofuse.apps.viewer.live_view import LiveView
    from tofuse.apps.viewer.server import address
    from tofuse.engine.progress import CombinedProgress

    same = ("trajectory.txt", "pose_graph.g2o", "cloud.ply", "mesh.ply")
    quick = {"end": 4, "method": "thesis"}
    recorder = Recorder()
    server = serve()
    try:
        live = LiveView(server)
        watched_run = run(
            [room_recording], Options(out=tmp_path / "a", **quick), CombinedProgress(recorder, live)
        )
        # The first frame is shown while the recording is opened, and then each one with its pose.
        assert recorder.frames[0][0::2] == (0, 1)
        assert [k for k, *_ in recorder.frames[1:]] == [0, 1, 2, 3]
        np.testing.assert_allclose(recorder.frames[-1][1], watched_run.trajectory[3], atol=0.05)
        place = address(server)
        with watched(browser, place, ours=place, viewport={"width": 700, "height": 460}) as seen:
            seen.page.get_by_text("writing").wait_for(timeout=30_000)
            assert len(np.unique(drawn(seen).reshape(-1, 3), axis=0)) > 100
            live.finish("http://127.0.0.1:1")
            seen.page.get_by_role("link", name="The report").wait_for(timeout=30_000)
            seen.check()
    finally:
        stop(server)
    run([room_recording], Options(out=tmp_path / "b", no_report=True, **quick))
    for name in same:
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    assert json.loads((tmp_path / "a/run.json").read_text())["schema"] == 1
