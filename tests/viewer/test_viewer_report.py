"""`tofuse view`: the report with the images of the recording, and nothing else, is served."""

from __future__ import annotations

import http.client
import re
import shutil
import signal
import socket
import subprocess
import sys
from dataclasses import replace
from threading import Timer
from urllib.parse import urlsplit

import cv2
import numpy as np
import pytest

from browser import watched
from report_results import circle, make_room, view
from tofuse.apps.cli.program import main
from tofuse.apps.report.sections import write_report
from tofuse.apps.results.folders import OutputFolder
from tofuse.apps.results.output import write_result
from tofuse.apps.viewer.report_server import FrameImages, ReportServer, report_pages
from tofuse.engine.cameras.cameras import Pinhole
from tofuse.engine.errors import InputError
from tofuse.engine.frames.recording import ArraySource, Recording
from tofuse.engine.geometry import se3
from tofuse.formats.export.conversion import convert

CAMERA = Pinhole(64, 48, 64 * 1.4, 64 * 1.4, 32, 24)
# The world is tilted and the model not shown upright: in other axes, and from rolled cameras.
T_TILTED_WORLD = se3.exp([0.3, -0.2, 0.1, 0.5, 0.2, 0.3])


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A recording of a room, and the folder of its result: frames, and folder."""
    folder = tmp_path_factory.mktemp("view")
    frames = [view(k, T, CAMERA, np.random.default_rng(k)) for k, T in enumerate(circle(24))]
    convert(Recording.of(ArraySource(frames), "room", "arrays"), folder / "recording")
    result, extras = make_room()
    cloud = result.cloud
    result = replace(
        result,
        trajectory=T_TILTED_WORLD @ result.trajectory,
        cloud=replace(
            cloud,
            points=se3.transform(T_TILTED_WORLD, cloud.points.astype(float)).astype(np.float32),
            normals=cloud.normals @ T_TILTED_WORLD[:3, :3].T.astype(np.float32),
        ),
        up=np.array([0.28, -0.96, 0.0]),
        recording=result.recording | {"path": str(folder / "recording")},
    )
    extras = replace(extras, reference=None, truth_points=None)
    write_result(
        result,
        OutputFolder(folder / "out"),
        lambda r, out: write_report(r, out / "report.html", extras),
    )
    (folder / "out" / "component-1").mkdir()
    (folder / "out" / "component-1" / "report.html").write_text("<html>another</html>")
    for name in ("changes.ply", "mirrors.ply"):
        (folder / "out" / name).write_text(name)
    return frames, folder / "out"


def test_result_without_report_is_refused(made, tmp_path) -> None:
    shutil.copytree(made[1], tmp_path / "out")
    (tmp_path / "out" / "report.html").unlink()
    with pytest.raises(InputError, match=r"has no report\.html; run again without no_report"):
        report_pages(tmp_path / "out")


@pytest.fixture(scope="module")
def server(made):
    with ReportServer(report_pages(made[1]), FrameImages.of(made[1])) as running:
        yield running


def ask(server, path: str, **headers: str) -> tuple[int, bytes]:
    """Ask for a path below that of the address."""
    path = urlsplit(server.address).path.removesuffix("/") + path
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=20)
    connection.putrequest("GET", path, skip_host="Host" in headers, skip_accept_encoding=True)
    for name, value in headers.items():
        connection.putheader(name, value)
    connection.endheaders()
    answer = connection.getresponse()
    body = answer.read()
    connection.close()
    return answer.status, body


def test_report_and_images_of_frames_are_served(made, server) -> None:
    frames, out = made
    status, page = ask(server, "/")
    assert status == 200
    report = (out / "report.html").read_bytes()
    opening = f'<html data-frames="{urlsplit(server.address).path}frame/"'.encode()
    assert page == report.replace(b"<html", opening, 1) != report
    assert ask(server, "/component-1/report.html")[0] == 200
    for name in ("changes.ply", "mirrors.ply"):
        assert ask(server, f"/{name}") == (200, name.encode())
    for k in (0, 9, 23):  # lost frames, too
        status, png = ask(server, f"/frame/{k}.png")
        assert status == 200
        image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_GRAYSCALE)
        assert image.shape == (48, 64)
        ranks = np.corrcoef(image.ravel(), np.sqrt(frames[k].amplitude_image.ravel()))
        assert ranks[0, 1] > 0.95


@pytest.mark.parametrize(
    "path",
    [
        "/run.json", "/frame/24.png", "/frame/-1.png", "/frame/0.png/", "/frame/%30.png",
        "/../../etc/passwd", "/%2e%2e/run.json", "//etc/passwd", "/component-1/../run.json",
        "/component-1/", "/report.html?x", "*",
    ],
)  # fmt: skip
def test_nothing_else_is_served(server, path) -> None:
    assert ask(server, path) == (404, b"not found\n")


def test_nothing_is_served_without_the_path_of_the_address(server) -> None:
    connection = http.client.HTTPConnection("127.0.0.1", server.server_port, timeout=20)
    for path in ("/", "/frame/0.png", "/AAAAAAAAAAAAAAAAAAAAAA/"):
        connection.request("GET", path)
        answer = connection.getresponse()
        answer.read()
        assert answer.status == 404


def test_pages_of_other_sites_are_refused(server) -> None:
    for path in ("/", "/frame/0.png"):
        for headers in ({"Host": "evil.example"}, {"Origin": "http://evil.example"}):
            assert ask(server, path, **headers)[0] == 403


@pytest.mark.nightly_part
@pytest.mark.skipif(sys.platform == "win32", reason="sends a signal of POSIX")
def test_command_serves_until_interrupted_and_without_recording(made, tmp_path) -> None:
    out = shutil.copytree(made[1], tmp_path / "out")
    text = (out / "run.json").read_text()
    (out / "run.json").write_text(text.replace(str(made[1].parent), str(tmp_path / "gone")))
    command = [sys.executable, "-m", "tofuse", "view", str(out), "--no-open", "--edited"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as p:
        end = Timer(60, p.kill)  # else a failed assertion would wait for it
        end.daemon = True
        end.start()
        assert p.stderr is not None
        lines = [p.stderr.readline() for _ in range(3)]
        assert re.fullmatch(
            r"only small images .*gone/recording, which doesn't exist.*\n", lines[0]
        )
        found = re.fullmatch(r"see (http://127\.0\.0\.1:(\d+)(/\S+/))\n", lines[1])
        assert found is not None
        assert lines[2] == "press Ctrl-C to stop\n"
        connection = http.client.HTTPConnection("127.0.0.1", int(found[2]), timeout=20)
        connection.request("GET", found[3])
        assert connection.getresponse().read() == (out / "report.html").read_bytes()
        p.send_signal(signal.SIGINT)
        rest, err = p.communicate(timeout=60)
    assert (p.returncode, rest, err) == (0, "", "")


@pytest.mark.parametrize("what", ["no result", "nothing", "no report", "port in use"])
def test_failures_are_reported_in_one_line(made, tmp_path, what, capsys) -> None:
    out = tmp_path / "out"
    options: list[str] = []
    if what != "nothing":
        shutil.copytree(made[1], out)
    if what in ("no result", "no report"):
        (out / {"no result": "run.json", "no report": "report.html"}[what]).unlink()
    with socket.socket() as other:
        if what == "port in use":
            other.bind(("127.0.0.1", 0))
            other.listen()
            options = ["--port", str(other.getsockname()[1])]
        assert main(["view", str(out), "--no-open", *options]) == 2
    expected = f"--port {options[1]}" if options else str(out)
    assert re.fullmatch(f"tofuse: .*{re.escape(expected)}.*\n", capsys.readouterr().err)


def opened(browser, server):
    size = {"width": 1200, "height": 900}
    return watched(browser, server.address, ours=server.address, viewport=size)


CANVAS = "#viewer .stage canvas"


@pytest.mark.nightly
def test_camera_shows_its_image_over_the_model(browser, server) -> None:
    with opened(browser, server) as seen:
        page = seen.page
        page.locator("#viewer.live").wait_for(timeout=20_000)
        page.get_by_text("Colours, cameras and views").click()
        page.locator("#viewer .timeline canvas").scroll_into_view_if_needed()
        line = page.locator("#viewer .timeline canvas").bounding_box()

        def choose(frame: int) -> None:
            page.mouse.click(line["x"] + (frame + 0.5) / 24 * line["width"], line["y"] + 10)
            served = page.locator(f"#viewer .inset img[src$='frame/{frame}.png']")
            served.wait_for(state="attached")

        def shown(opacity: int) -> np.ndarray:
            page.locator("#viewer .inset input").fill(str(opacity))
            seen.rest()
            picture = seen.pixels(CANVAS)[..., 1]
            # Without the tools above, the inset below, and the gaps between points.
            part = picture[80 : picture.shape[0] * 2 // 3, 60 : picture.shape[1] * 2 // 3]
            return cv2.GaussianBlur(part.astype(np.float32), (0, 0), 8).ravel()

        # The frame has no small image, only one that is served.
        choose(3)
        assert page.locator("#viewer .overlay").is_hidden()
        page.get_by_role("button", name="Look through this camera").click()
        page.locator("#viewer .overlay").wait_for()
        model = shown(0)
        assert np.corrcoef(model, shown(100))[0, 1] > 0.7
        # The next camera is looked through, too.
        choose(4)
        assert np.corrcoef(shown(0), shown(100))[0, 1] > 0.7
        assert np.corrcoef(model, shown(100))[0, 1] < 0.5
        page.get_by_role("button", name="Back to the model").click()
        page.locator("#viewer .overlay").wait_for(state="hidden")
        seen.check()
