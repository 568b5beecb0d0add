"""glTF files made and taken apart by the format's document alone."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}


def parts(data: bytes) -> tuple[dict[str, Any], bytes]:
    """The JSON and the binary chunk of a .glb file."""
    magic, version, length = struct.unpack_from("<4sII", data)
    assert (magic, version, length) == (b"glTF", 2, len(data))
    size, kind = struct.unpack_from("<I4s", data, 12)
    assert kind == b"JSON"
    assert size % 4 == 0
    rest = data[20 + size :]
    size_2, kind_2 = struct.unpack_from("<I4s", rest)
    assert (kind_2, size_2) == (b"BIN\0", len(rest) - 8)
    return json.loads(data[20 : 20 + size]), rest[8:]


def whole(document: dict[str, Any], binary: bytes) -> bytes:
    """The bytes of a .glb file."""
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    binary += bytes(-len(binary) % 4)
    chunks = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    return struct.pack("<4sII", b"glTF", 2, 12 + len(chunks)) + chunks


def attributes(path: Path) -> dict[str, np.ndarray]:
    """The attributes of the first primitive, as they are stored."""
    document, binary = parts(path.read_bytes())
    found = {}
    for name, index in document["meshes"][0]["primitives"][0]["attributes"].items():
        accessor = document["accessors"][index]
        view = document["bufferViews"][accessor["bufferView"]]
        width, dtype = WIDTHS[accessor["type"]], np.dtype(TYPES[accessor["componentType"]])
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        assert start % dtype.itemsize == 0
        assert view["byteLength"] >= accessor["count"] * width * dtype.itemsize
        values = np.frombuffer(binary, dtype, accessor["count"] * width, start)
        found[name] = values.reshape(-1, width)
    return found


def rewrite(path: Path, change: Any) -> None:
    """Let a function change the JSON of a file."""
    document, binary = parts(path.read_bytes())
    change(document)
    path.write_bytes(whole(document, binary))
