"""glTF 2.0 files: their JSON and their arrays, whole in a .glb file, or as .gltf with the arrays beside it.

Format: https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html, sections 3.6 (binary data) and 4 (GLB). The reader
trusts no number: an array is a view of bytes that are there, so a false count allocates no memory.
"""

from __future__ import annotations

import base64
import binascii
import json
import os
import struct
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import unquote

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...files.atomic import atomic_writer
from ..fields import Array

MAGIC = b"glTF"
Json = dict[str, Any]

_HEADER = struct.Struct("<4sII")  # magic, version, length
_CHUNK = struct.Struct("<I4s")  # length, kind
_JSON, _BIN = b"JSON", b"BIN\0"
_VERSION = 2
_MAX_BYTES = (1 << 32) - 1  # of a .glb file
_ALIGNMENT = 4
_DATA_URI = "data:"
_ARRAY_BUFFER = 34962
_TYPES = {"5120": "<i1", "5121": "<u1", "5122": "<i2", "5123": "<u2", "5125": "<u4", "5126": "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_NAMES = {width: name for name, width in _WIDTHS.items()}
_CODES = {np.dtype(name): int(code) for code, name in _TYPES.items()}


@dataclass(frozen=True)
class GltfFile:
    """A glTF file that was read.

    Parameters
    ----------
    path : the file, for messages.
    json : its JSON object.
    binary : the binary chunk of a .glb file; empty without one.
    """

    path: Path
    json: Json
    binary: bytes
    _buffers: dict[int, bytes] = field(default_factory=dict, repr=False)

    def objects(self, name: str) -> list[Json]:
        """Return a list of objects of the JSON, such as "nodes"; an empty one if it is missing."""
        found = self.json.get(name, [])
        if not isinstance(found, list) or not all(isinstance(item, dict) for item in found):
            raise self.fault(f"its {name} are not a list of objects")
        return found

    def object(self, name: str, index: Any) -> Json:
        """Return an object of a list by its index."""
        found = self.objects(name)
        if type(index) is not int or not 0 <= index < len(found):
            raise self.fault(f"it has no {name}[{str(index)[:20]}]")
        return found[index]

    def fault(self, what: str) -> InputError:
        """Return the error of a damaged file."""
        return InputError(f"{self.path}: {what}; export it again")

    def array(self, index: Any) -> Array:
        """Return the values (N, width) of an accessor; normalised whole numbers become -1..1 or 0..1.

        Raises
        ------
        InputError : the accessor or what it refers to is missing, sparse, or larger than its buffer.
        """
        name, accessor = f"accessors[{index}]", self.object("accessors", index)
        dtype, width = _TYPES.get(str(accessor.get("componentType"))), _WIDTHS.get(str(accessor.get("type")))
        if dtype is None or width is None:
            raise self.fault(f"{name} has an unknown type")
        if "sparse" in accessor or "bufferView" not in accessor:
            raise InputError(f"{self.path}: {name} is sparse or empty, which is not read; export it without")
        view = self.object("bufferViews", accessor["bufferView"])
        data = self._buffer(view.get("buffer"))
        element = np.dtype(dtype)
        count = self._whole(accessor, "count", name)
        stride = self._whole(view, "byteStride", name, element.itemsize * width)
        begin, inside = self._whole(view, "byteOffset", name, 0), self._whole(accessor, "byteOffset", name, 0)
        length = self._whole(view, "byteLength", name)
        needed = inside + stride * (count - 1) + element.itemsize * width if count else 0
        if needed > length or begin + length > len(data) or stride < element.itemsize * width:
            raise self.fault(f"{name} needs {needed} bytes, its buffer has fewer")
        raw: NDArray[Any] = np.ndarray(
            (count, width), element, data, begin + inside if count else 0, (stride, element.itemsize)
        )
        if element.kind == "f":
            return raw
        if accessor.get("normalized") is True:
            return np.maximum(raw / np.iinfo(element).max, -1.0)
        return raw.astype(np.float64)

    def _whole(self, holder: Json, key: str, name: str, default: int | None = None) -> int:
        found = holder.get(key, default)
        if type(found) is not int or not 0 <= found <= _MAX_BYTES:
            raise self.fault(f"{name}: its {key} is {str(found)[:40]!r}")
        return found

    def _buffer(self, index: Any) -> bytes:
        """Return a buffer: the binary chunk, data in the JSON, or a file in the same folder."""
        uri = self.object("buffers", index).get("uri")
        if index not in self._buffers:
            self._buffers[index] = self._fetched(index, uri)
        return self._buffers[index]

    def _fetched(self, index: int, uri: Any) -> bytes:
        if uri is None:
            if index != 0:
                raise self.fault(f"buffers[{index}] has no data")
            return self.binary
        if not isinstance(uri, str):
            raise self.fault(f"buffers[{index}] has no text as its uri")
        if uri.startswith(_DATA_URI):
            try:
                return base64.b64decode(uri.partition(",")[2], validate=True)
            except (binascii.Error, ValueError):
                raise self.fault(f"buffers[{index}] is not base64") from None
        name = Path(unquote(uri)).name  # never a file outside of the folder
        try:
            return (self.path.parent / name).read_bytes()
        except (OSError, ValueError):
            raise InputError(f"{self.path}: needs the file {name[:80]!r} beside it: put it there") from None


def is_glb(start: bytes) -> bool:
    """Return whether a file that begins with these bytes is a .glb file."""
    return start.startswith(MAGIC)


def read_gltf(path: Path) -> GltfFile:
    """Read a .glb or .gltf file.

    Raises
    ------
    InputError : the file is missing or damaged, or has another version.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror or error}); check name and rights") from None
    text, binary = _chunks(path, data) if is_glb(data) else (data, b"")
    try:
        found = json.loads(text)
    except (ValueError, RecursionError):
        raise InputError(f"{path}: is not a glTF file (its JSON is damaged); export it again") from None
    if not isinstance(found, dict):
        raise InputError(f"{path}: is not a glTF file (its JSON is not an object); export it again")
    asset = found.get("asset")
    version = asset.get("version") if isinstance(asset, dict) else None
    if not str(version).startswith(f"{_VERSION}."):
        raise InputError(f"{path}: has version {str(version)[:20]!r}, version 2 of glTF is read; export it again")
    return GltfFile(path, found, binary)


def _chunks(path: Path, data: bytes) -> tuple[bytes, bytes]:
    """Return the JSON and the binary chunk of a .glb file."""
    if len(data) < _HEADER.size:
        raise InputError(f"{path}: ends in its header; export it again")
    _, version, length = _HEADER.unpack_from(data)
    if version != _VERSION:
        raise InputError(f"{path}: has version {version}, version 2 of .glb is read; export it again")
    if length > len(data):
        raise InputError(f"{path}: has {len(data)} of its {length} bytes; export or copy it again")
    found, at = {_JSON: b"", _BIN: b""}, _HEADER.size
    while at + _CHUNK.size <= length:
        size, kind = _CHUNK.unpack_from(data, at)
        at += _CHUNK.size
        if at + size > length:
            raise InputError(f"{path}: a chunk of {size} bytes ends behind the file; export it again")
        if kind in found and not found[kind]:
            found[kind] = data[at : at + size]
        at += size
    return found[_JSON], found[_BIN]


def write_glb(path: str | os.PathLike[str], document: Json, attributes: Mapping[str, NDArray[Any]]) -> None:
    """Write a .glb file with one primitive's attributes, atomically.

    Parameters
    ----------
    document : the JSON without buffers, buffer views and accessors. Accessor i is the i-th attribute.
    attributes : arrays (N, width) by name, of a type that glTF has. Whole numbers are normalised. That of POSITION gets
        its limits, as glTF demands.

    Raises
    ------
    InputError : the file would be larger than 4 GiB. OutputError : it cannot be written.
    """
    views: list[Json] = []
    accessors: list[Json] = []
    parts: list[bytes] = []
    at = 0
    for name, array in attributes.items():
        part = np.ascontiguousarray(array).tobytes()
        views.append({"buffer": 0, "byteOffset": at, "byteLength": len(part), "target": _ARRAY_BUFFER})
        accessors.append(_accessor(len(accessors), name, array))
        padding = -len(part) % _ALIGNMENT
        parts += [part, bytes(padding)]
        at += len(part) + padding
    whole = document | {"buffers": [{"byteLength": at}], "bufferViews": views, "accessors": accessors}
    text = json.dumps(whole, separators=(",", ":"), allow_nan=False).encode()
    text += b" " * (-len(text) % _ALIGNMENT)
    length = _HEADER.size + 2 * _CHUNK.size + len(text) + at
    if length > _MAX_BYTES:
        raise InputError(f"{path}: a .glb file holds 4 GiB, this one needs {length / (1 << 30):.1f}: write a .ply")
    chunks: Sequence[bytes] = (
        _HEADER.pack(MAGIC, _VERSION, length),
        _CHUNK.pack(len(text), _JSON),
        text,
        _CHUNK.pack(at, _BIN),
        *parts,
    )
    with atomic_writer(path) as stream:
        stream.writelines(chunks)


def _accessor(view: int, name: str, array: NDArray[Any]) -> Json:
    accessor: Json = {
        "bufferView": view,
        "componentType": _CODES[array.dtype],
        "count": len(array),
        "type": _NAMES[array.shape[1]],
    }
    if array.dtype.kind in "iu":
        accessor["normalized"] = True
    if name == "POSITION":
        accessor |= {"min": array.min(axis=0).tolist(), "max": array.max(axis=0).tolist()}
    return accessor
