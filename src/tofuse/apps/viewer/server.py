"""The server of the live view, reachable from this machine only.

It answers only requests whose Host and Origin are names of this machine, which excludes pages of
other sites whose name resolves to this machine (DNS rebinding), and that know the token in its
address, or the cookie set for that, which excludes other users of this machine. It keeps only a few
pages open, as each that does not read what it is sent keeps a copy of the scene.
"""

from __future__ import annotations

import io
import logging
import secrets
import socket
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, redirect_stdout, suppress
from http.cookies import SimpleCookie
from typing import TYPE_CHECKING, Any
from urllib.parse import parse_qs, urlsplit

from tofuse.engine.bounds import Bounds
from tofuse.engine.errors import InputError
from tofuse.engine.parts import check_number
from tofuse.formats.files import reading

if TYPE_CHECKING:
    from viser import ViserServer

HOST, PORT = "127.0.0.1", 8080
_NAMES = ("127.0.0.1", "localhost")  # of this machine, in a browser on it
_MAX_PORTS = 100  # that are tried if none is given
_MAX_PAGES = 8  # open at the same time


def serve(port: int | None = None) -> ViserServer:
    """Start the server, which runs on its own threads until it is stopped.

    Parameters
    ----------
    port
        None: the first free one from 8080 on.

    Raises
    ------
    InputError
        If viser is not installed, or the port is in use.
    """
    viser = reading.required_package("viser", "viewer", "the viewer")
    chosen = choose_port(port)
    logging.getLogger("websockets").setLevel(logging.CRITICAL)
    # Standard output is for results.
    token = _tokens[chosen] = secrets.token_urlsafe(16)
    with redirect_stdout(io.StringIO()), _guarded(f"tofuse-{chosen}", token) as guards:
        server = viser.ViserServer(host=HOST, port=chosen, label="tofuse", verbose=False)
    if not guards:
        stop(server)
        raise InputError(
            f"can't be secured with viser {viser.__version__}",
            where="the viewer",
            remedy="pip install 'viser==1.1.1'",
        )
    server.gui.configure_theme(
        control_width="medium", dark_mode=True, show_logo=False, show_share_button=False
    )
    return server


# Of the servers of this process, by port.
_tokens: dict[int, str] = {}


@contextmanager
def _guarded(cookie: str, token: str) -> Iterator[list[int]]:
    """Check each request to a server that is created in the block, for a token too.

    viser has no hook for that, so its call of the websockets library is wrapped. Yields a list that
    is not empty once that has happened.
    """
    import websockets.asyncio.server as library
    from websockets.datastructures import Headers
    from websockets.http11 import Request, Response

    guards: list[int] = []
    original = library.serve

    def serve_guarded(*arguments: Any, process_request: Any = None, **options: Any) -> Any:
        def process(connection: Any, request: Request) -> Response | None:
            host, origin = request.headers.get_all("Host"), request.headers.get_all("Origin")
            if not is_same_origin(host, origin):
                return Response(403, "Forbidden", Headers(), b"not from this machine\n")
            given = parse_qs(urlsplit(request.path).query).get("token", [""])[0]
            cookies = SimpleCookie("; ".join(request.headers.get_all("Cookie")))
            known = cookies[cookie].value if cookie in cookies else ""
            if not any(
                secrets.compare_digest(each.encode(), token.encode()) for each in (given, known)
            ):
                return Response(403, "Forbidden", Headers(), b"the address lacks its token\n")
            response: Response | None = None
            if process_request is not None:
                response = process_request(connection, request)
            if response is None and not _has_room(connection.server.connections):
                return Response(503, "Busy", Headers(), b"too many pages are open: close one\n")
            if response is not None and given:
                response.headers["Set-Cookie"] = f"{cookie}={token}; HttpOnly; SameSite=Strict"
            return response

        guards.append(1)
        return original(*arguments, process_request=process, **options)

    library.serve = serve_guarded  # type: ignore[misc,assignment]
    try:
        yield guards
    finally:
        library.serve = original  # type: ignore[misc]


def _has_room(pages: set[Any]) -> bool:
    """Whether another page may connect, for which one that does not read is disconnected."""
    if len(pages) < _MAX_PAGES:
        return True
    transports = [page.transport for page in pages]
    slowest = max(transports, key=lambda transport: transport.get_write_buffer_size())
    if not slowest.get_write_buffer_size():
        return False
    slowest.abort()
    return True


def is_same_origin(hosts: Sequence[str], origins: Sequence[str]) -> bool:
    """Whether a request addresses this machine, and comes from this server's page or no page.

    Parameters
    ----------
    hosts, origins
        Values of the headers of those names.
    """
    if len(hosts) != 1 or len(origins) > 1:
        return False
    name, _, port = hosts[0].lower().partition(":")
    if name not in _NAMES or not ((port.isascii() and port.isdecimal()) or not port):
        return False
    return all(o.lower() in (f"http://{hosts[0].lower()}",) for o in origins)


def stop(server: ViserServer) -> None:
    """Stop the server."""
    with redirect_stdout(io.StringIO()):
        server.stop()


def address(server: ViserServer) -> str:
    """Return the address of the page, with its token."""
    port = server.get_port()
    return f"http://{HOST}:{port}/?token={_tokens[port]}"


def choose_port(port: int | None) -> int:
    """Return a port if it is free, or for None the first free one from 8080 on.

    Raises
    ------
    InputError
        If it is in use.
    """
    if port is not None:
        port = check_number(port, Bounds(1, 65535), "--port", whole=True)
    for candidate in range(PORT, PORT + _MAX_PORTS) if port is None else (port,):
        with socket.socket() as probe, suppress(OSError):
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((HOST, candidate))
            return candidate
    if port is None:
        raise InputError(f"no port from {PORT} on is free", where="--port", remedy="use it")
    raise InputError("is in use", where=f"--port {port}", remedy="use another, or none")
