"""Readers of the package rosbags with bounded memory, disk space and time.

rosbags decompresses all that a bag contains, and a compressed kilobyte may expand to gigabytes. The
limits are set in subclasses, and in a private copy of one module, without effect on other users of
rosbags in this process. Importing this module needs rosbags.
"""

from __future__ import annotations

import bz2
import importlib.util
import json
import sys
from collections.abc import Callable, Collection, Generator, Mapping
from contextlib import closing
from pathlib import Path, PurePath
from tempfile import TemporaryDirectory
from typing import Any

import apsw
import lz4.frame
from rosbags import highlevel, rosbag1, typesys
from rosbags.interfaces import Connection
from rosbags.rosbag1.reader import Chunk
from rosbags.rosbag2.reader import DirectoryReader, Reader
from rosbags.rosbag2.storage_sqlite3 import Sqlite3Reader
from ruamel.yaml import YAML

from tofuse.errors import InputError

if sys.version_info >= (3, 14):
    from compression import zstd
else:
    from backports import zstd

Messages = Generator[tuple[Connection, int, bytes], None, None]

MAX_CHUNK_BYTES = 1 << 30  # of one chunk or message; rosbag writes chunks of 768 kB, MCAP of 4 MB
MAX_RATIO = 100  # of a whole file beyond MAX_CHUNK_BYTES; depth images reach 2 to 10
_BLOCK_BYTES = 1 << 20


def _limited(factory: Callable[[], Any]) -> Callable[[bytes, int], bytes]:
    def decompress(data: bytes, size: int) -> bytes:
        limit = min(size, MAX_CHUNK_BYTES)
        decompressor = factory()
        content: bytes = decompressor.decompress(data, limit)
        if not decompressor.eof:
            raise ValueError(f"a chunk is cut off, or has more than {limit} bytes")
        return content

    return decompress


_BZ2 = _limited(bz2.BZ2Decompressor)
_LZ4 = _limited(lz4.frame.LZ4FrameDecompressor)
_ZSTD = _limited(zstd.ZstdDecompressor)


def _private_copy(name: str) -> Any:
    """Return a new instance of a module, with separate globals."""
    spec = importlib.util.find_spec(name)
    if spec is None or spec.loader is None:
        raise ImportError(name)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


_mcap = _private_copy("rosbags.rosbag2.storage_mcap")
# McapReader offers no hook: its methods look up decompressors in this table of their module.
_mcap.DECOMPRESSORS |= {"lz4": _LZ4, "zstd": _ZSTD}


class Rosbag1(rosbag1.Reader):
    """A ROS 1 bag, with one chunk in memory at a time."""

    def read_chunk(self) -> Chunk:
        """Read a chunk's header at the current position."""
        chunk = super().read_chunk()
        limited = {bz2.decompress: _BZ2, lz4.frame.decompress: _LZ4}.get(chunk.decompressor)
        if limited is None:
            return chunk
        return chunk._replace(decompressor=lambda data: limited(data, MAX_CHUNK_BYTES))


class _Sqlite(Sqlite3Reader):
    """A .db3 file."""

    def open(self) -> None:
        """Open the file, unless its queries could have more rows than it has messages.

        A view may generate rows without end, and each topic listed twice doubles all messages.
        """
        path = Path(str(self.path)).resolve()
        flags = apsw.SQLITE_OPEN_READONLY | apsw.SQLITE_OPEN_URI
        with closing(apsw.Connection(f"{path.as_uri()}?immutable=1", flags=flags)) as db:
            query = "SELECT count(*) FROM pragma_table_list WHERE type IN ('view', 'virtual')"
            ((views,),) = db.execute(query)
            ((repeated,),) = db.execute("SELECT count(*) - count(DISTINCT id) FROM topics")
        if views or repeated:
            raise InputError(
                f"is not a database of ROS messages: it has {views} views or virtual tables and"
                f" {repeated} duplicate topics",
                where=path,
                remedy="record or convert the bag again",
            )
        super().open()


class _Folder(DirectoryReader):
    """A folder with metadata.yaml and files."""

    STORAGE_PLUGINS: Mapping[str, Any] = {"mcap": _mcap.McapReader, "sqlite3": _Sqlite}

    def __init__(self, path: Path) -> None:
        super().__init__(path)
        self._folder = path
        self._compressed_messages = False
        self._expanded: TemporaryDirectory[str] | None = None

    def open(self) -> None:
        """Open the bag; decompress its files into a temporary folder if they are compressed."""
        try:
            self._expand()
            super().open()
        except BaseException:
            self._remove()
            raise
        # `messages` decompresses, with a limit.
        self._compressed_messages = self.metadata.compression_mode == "message"
        if self._compressed_messages:
            self.metadata = self.metadata._replace(compression_mode=None)

    def close(self) -> None:
        """Close the bag, and remove its decompressed files."""
        try:
            super().close()
        finally:
            self._remove()

    def messages(
        self, connections: Collection[Connection], start: int | None = None, stop: int | None = None
    ) -> Messages:
        """Yield connection, time in ns and data of the messages from `start` to before `stop`."""
        for connection, time, data in super().messages(connections, start, stop):
            content = _ZSTD(data, MAX_CHUNK_BYTES) if self._compressed_messages else data
            yield connection, time, content

    def _expand(self) -> None:
        try:
            content = YAML(typ="safe").load((self._folder / "metadata.yaml").read_text())
            information = content["rosbag2_bagfile_information"]
            compression = (
                information["compression_mode"].lower(),
                information["compression_format"],
            )
            paths = [
                self._folder / PurePath(name).name for name in information["relative_file_paths"]
            ]
        except Exception:  # rosbags raises a better error, or needs no such entry
            return
        if compression != ("file", "zstd") or not all(path.is_file() for path in paths):
            return
        remaining = limit = _limit(sum(path.stat().st_size for path in set(paths)))
        self._expanded = TemporaryDirectory(prefix="tofuse-bag-")
        for path in paths:
            with zstd.open(path) as file, Path(self._expanded.name, path.stem).open("wb") as out:
                while block := file.read(_BLOCK_BYTES):
                    remaining -= len(block)
                    if remaining < 0:
                        raise _expansion_error(self._folder, limit)
                    out.write(block)
        information |= {"compression_mode": "", "compression_format": ""}
        information["relative_file_paths"] = [path.stem for path in paths]
        temporary = Path(self._expanded.name)
        (temporary / "metadata.yaml").write_text(json.dumps(content))  # JSON is YAML
        self.path = temporary

    def _remove(self) -> None:
        if self._expanded is not None:
            self._expanded.cleanup()


class _Rosbag2(Reader):
    """A folder, or a .mcap or .db3 file."""

    STORAGE_PLUGINS: Mapping[str, Any] = {
        "dir": _Folder,
        ".mcap": _mcap.McapReader,
        ".db3": _Sqlite,
    }

    def open(self) -> None:
        """Open the bag, unless the chunks listed in an MCAP file expand too much.

        Chunks that overlap in time are in memory together, and an index may list a chunk many
        times.
        """
        super().open()
        for storage in getattr(self.storage, "storages", [self.storage]):
            chunks = getattr(storage, "chunks", [])
            limit = _limit(storage.path.stat().st_size)
            if sum(chunk.uncompressed_size for chunk in chunks) > limit:
                self.close()
                raise _expansion_error(storage.path, limit)


class AnyReader(highlevel.AnyReader):
    """Any bag, with its messages decoded."""

    def __init__(self, path: Path) -> None:
        types = typesys.get_typestore(typesys.Stores.LATEST)
        super().__init__([path], default_typestore=types)
        self.readers = [_Rosbag2(path)] if self.is2 else [Rosbag1(path)]


def _limit(size: int) -> int:
    """Bytes that a file of `size` bytes may expand to."""
    return max(MAX_CHUNK_BYTES, MAX_RATIO * size)


def _expansion_error(path: Path, limit: int) -> InputError:
    return InputError(
        f"expands to more than {limit / 1e9:.3g} GB",
        where=path,
        remedy="convert it to a bag without compression",
    )
