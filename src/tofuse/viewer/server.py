"""The server behind the page: on this machine alone, and found missing in one line."""

from __future__ import annotations

import io
import logging
import socket
from contextlib import redirect_stdout
from typing import TYPE_CHECKING

from tofuse.errors import InputError

if TYPE_CHECKING:
    from viser import ViserServer

HOST, PORT = "127.0.0.1", 8080
_TRIED = 100  # ports, where none is asked for


def serve(port: int | None = None) -> ViserServer:
    """Start the server; it works on threads of its own until it is stopped.

    Parameters
    ----------
    port
        None: the first free one from 8080 on.

    Raises
    ------
    InputError
        If viser is not installed, or the port is taken.
    """
    try:
        import viser
    except ImportError as error:
        raise InputError(
            "needs viser, which is not installed",
            where="the viewer",
            remedy="pip install 'tofuse[viewer]'",
        ) from error
    chosen = _free_port() if port is None else port
    if port is not None and not _is_free(port):
        raise InputError("is taken", where=f"--port {port}", remedy="give another, or none")
    logging.getLogger("websockets").setLevel(logging.CRITICAL)
    # Standard output is for results.
    with redirect_stdout(io.StringIO()):
        server = viser.ViserServer(host=HOST, port=chosen, label="tofuse", verbose=False)
    server.gui.configure_theme(
        control_width="medium",
        dark_mode=True,
        show_logo=False,
        show_share_button=False,
    )
    return server


def stop(server: ViserServer) -> None:
    """End it, and all pages with it."""
    with redirect_stdout(io.StringIO()):
        server.stop()


def address(server: ViserServer) -> str:
    """Return where the page is."""
    return f"http://{HOST}:{server.get_port()}"


def _is_free(port: int) -> bool:
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((HOST, port))
        except (OSError, OverflowError):
            return False
    return True


def _free_port() -> int:
    for port in range(PORT, PORT + _TRIED):
        if _is_free(port):
            return port
    raise InputError(f"no port from {PORT} on is free", where="the viewer", remedy="give --port")
