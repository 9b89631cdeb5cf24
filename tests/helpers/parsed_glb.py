"""Read a GLB file back, independently of the writer."""

from __future__ import annotations

import json
import struct

import numpy as np

SIZES = {5121: "u1", 5123: "<u2", 5125: "<u4", 5126: "<f4"}


WIDTHS = {"SCALAR": 1, "VEC3": 3, "VEC4": 4}


def parse(path):
    """Header, chunks and accessors according to the specification."""
    data = path.read_bytes()
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    at, chunks = 12, []
    while at < length:
        size, kind = struct.unpack_from("<I4s", data, at)
        assert size % 4 == 0
        chunks.append((kind, data[at + 8 : at + 8 + size]))
        at += 8 + size
    assert at == length
    assert [kind for kind, _ in chunks] in ([b"JSON"], [b"JSON", b"BIN\0"])
    document = json.loads(chunks[0][1])
    arrays = []
    for accessor in document.get("accessors", []):
        view = document["bufferViews"][accessor["bufferView"]]
        dtype = np.dtype(SIZES[accessor["componentType"]])
        width = WIDTHS[accessor["type"]]
        assert view["byteOffset"] % 4 == 0
        assert view["byteLength"] == accessor["count"] * width * dtype.itemsize
        assert view["byteOffset"] + view["byteLength"] <= document["buffers"][0]["byteLength"]
        body = chunks[1][1]
        values = np.frombuffer(body, dtype, accessor["count"] * width, view["byteOffset"])
        arrays.append(values.reshape(-1, width))
    return document, arrays
