"""Access to the viewer's server, and permissions of its page."""

from __future__ import annotations

import base64
import hashlib
import http.client
import select
import socket
from time import sleep

import numpy as np
import pytest

from tofuse.apps.report.html import secured
from tofuse.apps.viewer import server as module
from tofuse.apps.viewer.server import HOST, is_same_origin

HOSTS: dict[str, tuple[list[str], list[str], bool]] = {
    "our own page": (["127.0.0.1:8080"], ["http://127.0.0.1:8080"], True),
    "by name": (["localhost:8080"], ["http://localhost:8080"], True),
    "typed in": (["localhost:8080"], [], True),
    "through a tunnel": (["localhost:9000"], ["http://localhost:9000"], True),
    "no port": (["localhost"], [], True),
    "a name made to lead here": (["evil.example:8080"], ["http://evil.example:8080"], False),
    "a page elsewhere": (["127.0.0.1:8080"], ["http://evil.example"], False),
    "another port": (["127.0.0.1:8080"], ["http://127.0.0.1:3000"], False),
    "a file": (["127.0.0.1:8080"], ["null"], False),
    "no host": ([], [], False),
    "two hosts": (["127.0.0.1:8080", "evil.example"], [], False),
    "two origins": (["127.0.0.1"], ["http://127.0.0.1", "http://evil.example"], False),
    "begins alike": (["127.0.0.1.evil.example:8080"], [], False),
    "a user": (["127.0.0.1:8080@evil.example"], [], False),
    "another address": (["192.168.1.5:8080"], [], False),
}


@pytest.mark.parametrize("name", HOSTS)
def test_hosts_and_origins_that_are_answered(name: str) -> None:
    hosts, origins, ours = HOSTS[name]
    assert is_same_origin(hosts, origins) is ours


@pytest.fixture(scope="module")
def port():
    pytest.importorskip("viser")
    from tofuse.apps.viewer.server import serve, stop

    server = serve()
    yield server.get_port()
    stop(server)


def with_token(port: int) -> str:
    return f"/?token={module._tokens[port]}"


def ask(port: int, path: str, **headers: str) -> http.client.HTTPResponse:
    connection = http.client.HTTPConnection(HOST, port, timeout=20)
    connection.putrequest("GET", path, skip_host="Host" in headers, skip_accept_encoding=True)
    for name, value in headers.items():
        connection.putheader(name.replace("_", "-"), value)
    connection.endheaders()
    answer = connection.getresponse()
    answer.read()
    connection.close()
    return answer


def test_server_answers_local_requests_only(port: int) -> None:
    page = with_token(port)
    assert ask(port, page).status == 200
    assert ask(port, page, Host="evil.example").status == 403
    assert ask(port, page, Origin="http://evil.example").status == 403
    upgrade = {"Upgrade": "websocket", "Connection": "Upgrade", "Sec_WebSocket_Version": "13"}
    upgrade |= {"Sec_WebSocket_Key": "dGhlIHNhbXBsZSBub25jZQ=="}
    assert ask(port, page, **upgrade, Origin="http://evil.example").status == 403
    assert ask(port, page, **upgrade, Host="evil.example:80").status == 403


def test_other_users_of_this_machine_do_not_know_the_token(port: int) -> None:
    for path in ("/", "/?token=", "/?token=guess", "/assets/index.js"):
        assert ask(port, path).status == 403
    cookie = ask(port, with_token(port)).getheader("Set-Cookie")
    assert cookie is not None
    assert "HttpOnly; SameSite=Strict" in cookie
    assert ask(port, "/", Cookie=cookie.split(";")[0]).status == 200
    assert ask(port, "/", Cookie=f"tofuse-{port}=guess").status == 403


def connect(port: int, *, reads: bool) -> tuple[int, socket.socket]:
    """Open a page's connection; return the status of the answer, and the connection."""
    import viser

    page = socket.create_connection((HOST, port), timeout=5)
    lines = (
        f"GET {with_token(port)} HTTP/1.1",
        f"Host: {HOST}:{port}",
        "Upgrade: websocket",
        "Connection: Upgrade",
        "Sec-WebSocket-Version: 13",
        "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==",
        f"Sec-WebSocket-Protocol: viser-v{viser.__version__}",
    )
    page.sendall("".join(f"{line}\r\n" for line in (*lines, "")).encode())
    status = int(page.recv(12).split()[1])
    while reads and select.select([page], [], [], 0.3)[0] and page.recv(1 << 20):
        pass
    return status, page


@pytest.mark.parametrize("reads", [True, False])
def test_few_pages_are_open_at_a_time(reads: bool) -> None:
    """A page that reads stays; one that does not makes room for the next."""
    pytest.importorskip("viser")
    server = module.serve()
    try:
        colors = np.zeros((500_000, 3), np.uint8)
        server.scene.add_point_cloud("/big", np.zeros(colors.shape, np.float32), colors)
        limit = module._MAX_PAGES
        answers = []
        for _ in range(limit + 4):
            answers.append(connect(server.get_port(), reads=reads))
            sleep(0.0 if reads else 0.3)  # until it is sent the scene
        statuses = [status for status, _ in answers]
        assert statuses == [101] * limit + [503 if reads else 101] * 4
        assert len(server.get_clients()) <= limit
        for _, page in answers:
            page.close()
    finally:
        module.stop(server)


@pytest.mark.parametrize(
    "path",
    ["/../../../../etc/passwd", "/%2e%2e/%2e%2e/etc/passwd", "/..%5c..%5cetc/passwd", "//etc"],
)
def test_paths_outside_the_page_are_refused(port: int, path: str) -> None:
    cookie = f"tofuse-{port}={module._tokens[port]}"
    assert ask(port, path, Cookie=cookie).status in (400, 403, 404)


def test_server_does_not_listen_on_other_interfaces(port: int) -> None:
    name = socket.gethostbyname(socket.gethostname())
    if name.startswith("127."):
        pytest.skip("this machine has no other address")
    with pytest.raises(OSError, match=r"refused|timed out"):
        socket.create_connection((name, port), timeout=5)


PAGE = """<!doctype html><head><meta charset="utf-8"></head>
<script type="application/json">{"a": 1}</script><script>let a = 1;</script>"""


def test_page_policy_lists_its_own_scripts_only() -> None:
    digest = base64.b64encode(hashlib.sha256(b"let a = 1;").digest()).decode()
    page = secured(PAGE)
    assert f"script-src 'sha256-{digest}';" in page
    assert page.index("Content-Security-Policy") < page.index("<script")
    assert "default-src 'none'" in page
    assert "script-src 'none'" in secured('<meta charset="utf-8">')
    assert f"'sha256-{digest}'" not in secured(PAGE.replace("let a = 1;", "let b = 1;"))
