"""The report of a result in the browser, with the images of its recording at full resolution.

Only this machine is answered (see `server`), and only below a path that other users of it can't
guess. Only pages read at the start and images of frames have addresses: no path of a request
reaches the file system.
"""

from __future__ import annotations

import re
import secrets
import sys
from collections.abc import Mapping, Sequence
from contextlib import suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from threading import Lock, Thread
from typing import Any, Self

from tofuse.apps.report import thumbnails
from tofuse.apps.results import folders, reopening, run_json
from tofuse.apps.viewer.server import HOST, choose_port, is_same_origin
from tofuse.engine.errors import InputError
from tofuse.engine.frames import Recording
from tofuse.formats.files import reading

_FRAME = re.compile(r"frame/(\d{1,9})\.png", re.ASCII)
_HTML, _PNG, _PLY = "text/html; charset=utf-8", "image/png", "application/octet-stream"


class FrameImages:
    """The images of a result's frames.

    Parameters
    ----------
    recordings
        Recordings, each with the offset of its frame indices in the result.
    """

    def __init__(self, recordings: Sequence[tuple[int, Recording]]) -> None:
        self._places = {
            first + index: (recording, row)
            for first, recording in recordings
            for row, index in enumerate(recording.indices.tolist())
        }
        self._lock = Lock()

    @classmethod
    def of(cls, folder: Path) -> Self:
        """Open the recordings of a result again.

        Raises
        ------
        InputError
            If one is missing, can't be opened, or has changed.
        """
        with run_json.opened(folder) as run:
            parts = list(reopening.stored_recordings(folder, run))
        return cls([(part.first, reopening.reopen(part, folder)) for part in parts])

    def png(self, index: int) -> bytes | None:
        """Return the colours of a frame, or else amplitudes or ranges; None without an image."""
        if index not in self._places:
            return None
        recording, row = self._places[index]
        frame = None
        with self._lock, suppress(InputError):  # readers serve one thread
            frame = recording.image(row)
        if frame is None:
            return None
        if frame.color_image is not None:
            return thumbnails.encode(frame.color_image)
        if frame.amplitude_image is not None:
            return thumbnails.encode(thumbnails.grey(frame.amplitude_image))
        return thumbnails.encode(thumbnails.depth_image(frame))


def report_pages(folder: Path) -> dict[str, tuple[str, bytes]]:
    """Read the reports of a result: type and content by address.

    Raises
    ------
    InputError
        If the folder is not a result, was edited, or has no report.
    """
    folders.check_result(folder)
    with run_json.opened(folder):
        pass
    if not (folder / "report.html").exists():
        raise InputError("has no report.html", where=folder, remedy="run again without --no-report")
    pages = {"": (_HTML, reading.read_bytes(folder / "report.html"))}
    for path in sorted(folder.glob("component-*/report.html")):
        if folders.component_number(path.parent) is not None:
            pages[f"{path.parent.name}/report.html"] = _HTML, reading.read_bytes(path)
    for name in ("changes.ply", "mirrors.ply"):  # to which the report links
        if (folder / name).is_file():
            pages[name] = _PLY, reading.read_bytes(folder / name)
    return pages


class ReportServer(ThreadingHTTPServer):
    """Serves pages and the images of frames on threads of its own, until it is stopped.

    Parameters
    ----------
    pages
        See `report_pages`.
    images
        Images of the frames, which the reports show where they are known; None without them.
    port
        None: the first free one from 8080 on.

    Raises
    ------
    InputError
        If the port is in use.
    """

    daemon_threads = True

    def __init__(
        self,
        pages: Mapping[str, tuple[str, bytes]],
        images: FrameImages | None,
        port: int | None = None,
    ) -> None:
        super().__init__((HOST, choose_port(port)), _Handler)
        self._pages, self._images = pages, images
        self._root = f"/{secrets.token_urlsafe(16)}/"
        Thread(target=self.serve_forever, name="tofuse-report", daemon=True).start()

    def __exit__(self, *_: object) -> None:
        self.stop()

    @property
    def address(self) -> str:
        """The address of the report."""
        return f"http://{HOST}:{self.server_port}{self._root}"

    def stop(self) -> None:
        """Stop serving."""
        self.shutdown()
        self.server_close()

    def content(self, path: str) -> tuple[str, bytes] | None:
        """Return type and content at the path of a request; None if there is nothing."""
        if not path.startswith(self._root):
            return None
        path = path.removeprefix(self._root)
        if path in self._pages:
            kind, body = self._pages[path]
            if self._images is not None and kind == _HTML:
                frames = f'<html data-frames="{self._root}frame/"'
                body = body.replace(b"<html", frames.encode(), 1)
            return kind, body
        frame = _FRAME.fullmatch(path)
        image = self._images and frame and self._images.png(int(frame[1]))
        return (_PNG, image) if image else None

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Ignore browsers that close a connection early."""
        if not isinstance(sys.exception(), ConnectionError | TimeoutError):
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    server: ReportServer
    server_version, sys_version = "tofuse", ""
    timeout = 30

    def do_GET(self) -> None:
        if not is_same_origin(*(self.headers.get_all(name, []) for name in ("Host", "Origin"))):
            self._answer(403, "text/plain", b"not from this machine\n")
            return
        found = self.server.content(self.path)
        if found is None:
            self._answer(404, "text/plain", b"not found\n")
        else:
            self._answer(200, *found)

    def _answer(self, status: int, kind: str, body: bytes) -> None:
        self.send_response(status)
        for name, value in (
            ("Content-Type", kind),
            ("Content-Length", str(len(body))),
            ("Cache-Control", "no-store"),
            ("X-Content-Type-Options", "nosniff"),
            ("Referrer-Policy", "no-referrer"),
        ):
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Print nothing."""
