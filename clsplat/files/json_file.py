"""Fields of foreign JSON files, each checked, each complaint naming the key."""

from __future__ import annotations

import json
import math
import os
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .atomic import atomic_writer


def read_json(path: str | os.PathLike[str], choose: str) -> Any:
    """What a JSON file holds. `choose`: the file to give instead, for messages.

    Raises
    ------
    InputError : the file cannot be read or is no JSON.
    """
    path = Path(path)
    try:
        return json.loads(path.read_bytes())
    except OSError as error:
        reason = error.strerror or str(error)
        raise InputError(f"{path}: cannot be read ({reason}); check name and rights") from error
    except (ValueError, RecursionError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(f"{path}: is no JSON ({reason}); choose {choose}") from error


def read_object(path: str | os.PathLike[str]) -> dict[str, Any]:
    """The JSON object in a file that clsplat wrote; InputError names the file and what is wrong."""
    values = read_json(path, "the file as clsplat wrote it")
    if not isinstance(values, dict):
        raise InputError(f"{path}: expected a JSON object")
    return values


def write_json(path: Path, values: Any) -> None:
    """Indented JSON, written whole or not at all."""
    with atomic_writer(path) as stream:
        stream.write((json.dumps(values, indent=1) + "\n").encode())


def value(entry: dict[str, Any], key: str, mend: str) -> Any:
    """The value of `key`; raises InputError with the `mend` where it is missing."""
    if key not in entry:
        raise InputError(f"key {key!r} is missing; {mend}")
    return entry[key]


def number(entry: dict[str, Any], key: str, mend: str) -> float:
    """A finite number; raises InputError."""
    return _finite(value(entry, key, mend), key)


def size(entry: dict[str, Any], key: str, mend: str) -> int:
    """A whole number of pixels, at least 1; raises InputError."""
    real = number(entry, key, mend)
    if real < 1 or real != int(real):
        raise InputError(f"key {key!r} is {real:g}; expected a whole number of pixels, at least 1")
    return int(real)


def matrix(entry: dict[str, Any], key: str, shape: tuple[int, ...], mend: str) -> NDArray[np.float64]:
    """Finite numbers in nested lists of exactly `shape`, of one or two dimensions; raises InputError."""
    given = value(entry, key, mend)
    rows = given if len(shape) == 2 else [given]
    right = isinstance(rows, list) and (len(shape) == 1 or len(rows) == shape[0])
    if not right or not all(isinstance(row, list) and len(row) == shape[-1] for row in rows):
        form = " x ".join(str(part) for part in shape)
        raise InputError(f"key {key!r} has the wrong form; expected {form} numbers in lists")
    return np.array([[_finite(part, key) for part in row] for row in rows]).reshape(shape)


def kind(given: object) -> str:
    """What a JSON value is, in a word."""
    if given is None or isinstance(given, bool):
        return json.dumps(given)
    if isinstance(given, str):
        return f"the text {ascii(given)[:40]}"
    if isinstance(given, (list, dict)):
        return "a list" if isinstance(given, list) else "an object"
    return "a number"


def to_real(given: object) -> float | None:
    """A JSON number, infinite where it is too large; None of anything else."""
    if isinstance(given, bool) or not isinstance(given, (int, float)):
        return None
    try:
        return float(given)
    except OverflowError:
        return math.inf


def _finite(given: object, key: str) -> float:
    real = to_real(given)
    if real is None:
        raise InputError(f"key {key!r} is {kind(given)}; expected a number")
    if not math.isfinite(real):
        raise InputError(f"key {key!r} is not finite; expected a number")
    return real
