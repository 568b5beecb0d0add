"""Reader of PLY bodies: columns of numbers for each element, in any of the three encodings."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from .ply_header import BYTE_ORDER, INTEGER_TYPES, REAL_TYPES, Element, Header

Columns = Mapping[str, NDArray[Any]]
_CODES = REAL_TYPES | INTEGER_TYPES


def read_body(path: object, stream: BinaryIO, header: Header) -> dict[str, dict[str, NDArray[Any]]]:
    """Return, for each element name, its columns by name, in their types and the byte order of the machine.

    Elements with lists, and those after them, are not read.

    Parameters
    ----------
    stream : the file, at the first byte after the header.

    Raises
    ------
    InputError : the body is shorter or longer than the header says, or a text is not a number. A wrong length is found
        before memory for the claimed length is allocated.
    """
    read = _read_ascii if header.encoding == "ascii" else _read_binary
    return read(path, stream, header)


def _read_binary(path: object, stream: BinaryIO, header: Header) -> dict[str, dict[str, NDArray[Any]]]:
    order = BYTE_ORDER[header.encoding]
    dtypes = [
        np.dtype([(name, order + _CODES[kind]) for kind, name in element.properties]) for element in header.tables
    ]
    expected = sum(element.count * dtype.itemsize for element, dtype in zip(header.tables, dtypes, strict=True))
    available = os.fstat(stream.fileno()).st_size - stream.tell()
    if _is_wrong(header, available, expected):
        raise _wrong_size(path, header, f"{expected} bytes", f"{available}", available < expected)
    body: dict[str, dict[str, NDArray[Any]]] = {}
    for element, dtype in zip(header.tables, dtypes, strict=True):
        if not element.properties:  # gsplat's exporter writes such an element for a model without SH bands
            body[element.name] = {}
            continue
        table: NDArray[Any] = np.frombuffer(stream.read(element.count * dtype.itemsize), dtype=dtype)
        # Columns in the byte order of the machine are views of the rows: a copy of each would double the memory.
        body[element.name] = {name: table[name].astype(_CODES[kind], copy=False) for kind, name in element.properties}
    return body


def _read_ascii(path: object, stream: BinaryIO, header: Header) -> dict[str, dict[str, NDArray[Any]]]:
    expected = sum(element.count * len(element.properties) for element in header.tables)
    text = stream.read()
    # Every value takes a digit and a separator, so the file size bounds the count.
    if 2 * expected > len(text) + 1:
        raise _wrong_size(path, header, f"{expected} values", f"{len(text)} bytes", True)
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # NumPy reports text that is not a number this way
        try:
            values = np.fromstring(text, dtype=np.float64, sep=" ") if text.strip() else np.empty(0)
        except (DeprecationWarning, ValueError):
            raise InputError(f"{path}: the ascii body holds text that is not a number; export again") from None
    if _is_wrong(header, values.size, expected):
        raise _wrong_size(path, header, f"{expected} values", f"{values.size}", values.size < expected)
    body, at = {}, 0
    for element in header.tables:
        width = len(element.properties)
        table = values[at : at + element.count * width].reshape(element.count, width)
        at += table.size
        body[element.name] = {
            name: _cast(path, element, name, table[:, i], _CODES[kind])
            for i, (kind, name) in enumerate(element.properties)
        }
    return body


def _cast(path: object, element: Element, name: str, values: NDArray[np.float64], code: str) -> NDArray[Any]:
    """Convert numbers read from text to the type that the header states."""
    dtype = np.dtype(code)
    if dtype.kind in "iu":
        info = np.iinfo(dtype)
        good = (values >= info.min) & (values <= info.max) & (values == np.floor(values))
        if not good.all():
            row = int(np.flatnonzero(~good)[0])
            raise InputError(
                f"{path}: element {element.name!r}, row {row}: {name} is {values[row]:g}, expected a "
                f"whole number from {info.min} to {info.max}; export again"
            )
    with np.errstate(over="ignore"):  # the check of the model finds and names values that overflow
        return values.astype(dtype)


def _is_wrong(header: Header, found: int, expected: int) -> bool:
    """Return whether the length of a body differs from that of its tables. Lists may follow them."""
    return found < expected or (found > expected and len(header.tables) == len(header.elements))


def _wrong_size(path: object, header: Header, expected: str, found: str, short: bool) -> InputError:
    problem = "is truncated" if short else "has extra data at its end"
    held = "vertices need" if len(header.elements) == 1 else "vertices and what follows them need"
    return InputError(f"{path}: {problem}: {header.count} {held} {expected}, found {found}; copy or export it again")
