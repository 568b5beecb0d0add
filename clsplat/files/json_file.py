"""JSON files: reading, writing, and checked access to the fields of files that other programs wrote."""

from __future__ import annotations

import json
import math
import os
from numbers import Integral, Real
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .atomic import atomic_writer
from .whole_file import read_whole

MAX_NUMBER = 1e30  # numbers of files are smaller than this where float32 must store them
_LONG_NUMBER = 10**16  # messages show shorter whole numbers with all digits


def read_json(path: str | os.PathLike[str], expected: str) -> Any:
    """Return the content of a JSON file.

    Parameters
    ----------
    expected : the kind of file to choose instead, for the error message.

    Raises
    ------
    InputError : the file cannot be read or is not JSON.
    """
    path = Path(path)
    try:
        return json.loads(read_whole(path))
    except OSError as error:
        reason = error.strerror or str(error)
        raise InputError(f"{path}: cannot be read ({reason}); check its name and permissions") from error
    except (ValueError, RecursionError) as error:
        raise InputError(f"{path}: is not JSON ({str(error).splitlines()[0]}); choose {expected}") from error


def read_object(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Return the JSON object in a file that clsplat wrote.

    Raises
    ------
    InputError : the file cannot be read, is not JSON, or holds something else than an object.
    """
    values = read_json(path, "the file as clsplat wrote it")
    if not isinstance(values, dict):
        raise InputError(f"{path}: expected a JSON object")
    return values


def write_json(path: Path, values: Any) -> None:
    """Write indented JSON atomically."""
    with atomic_writer(path) as stream:
        stream.write((json.dumps(values, indent=1) + "\n").encode())


def get_value(entry: dict[str, Any], key: str, remedy: str) -> Any:
    """Return the value of `key`; raises InputError with the `remedy` if the key is missing."""
    if key not in entry:
        raise InputError(f"key {key!r} is missing; {remedy}")
    return entry[key]


def get_number(entry: dict[str, Any], key: str, remedy: str) -> float:
    """Return the finite number at `key`; raises InputError."""
    return _finite(get_value(entry, key, remedy), key)


def get_objects(entry: dict[str, Any], key: str, remedy: str) -> list[dict[str, Any]]:
    """Return the list of objects at `key`; raises InputError."""
    found = get_value(entry, key, remedy)
    if not isinstance(found, list) or not all(isinstance(item, dict) for item in found):
        raise InputError(f"key {key!r} has the wrong form; expected a list of objects")
    return found


def get_text(entry: dict[str, Any], key: str, remedy: str) -> str:
    """Return the text at `key`, which is not empty; raises InputError."""
    found = get_value(entry, key, remedy)
    if not isinstance(found, str) or not found:
        raise InputError(f"key {key!r} is {describe(found)}; expected a text")
    return found


def get_id(entry: dict[str, Any], key: str, remedy: str) -> int:
    """Return the whole number at `key`, at least 0; raises InputError."""
    found = get_value(entry, key, remedy)
    if type(found) is not int or found < 0:
        raise InputError(f"key {key!r} is {describe(found)}; expected a whole number, at least 0")
    return found


def get_size(entry: dict[str, Any], key: str, remedy: str) -> int:
    """Return the whole number of pixels at `key`, at least 1; raises InputError."""
    number = get_number(entry, key, remedy)
    if number < 1 or number != int(number):
        raise InputError(f"key {key!r} is {number:g}; expected a whole number of pixels, at least 1")
    return int(number)


def get_matrix(entry: dict[str, Any], key: str, shape: tuple[int, ...], remedy: str) -> NDArray[np.float64]:
    """Return the finite numbers at `key`, nested lists of exactly `shape` (1 or 2 dimensions); raises InputError."""
    value = get_value(entry, key, remedy)
    rows = value if len(shape) == 2 else [value]
    has_rows = isinstance(rows, list) and (len(shape) == 1 or len(rows) == shape[0])
    if not has_rows or not all(isinstance(row, list) and len(row) == shape[-1] for row in rows):
        form = " x ".join(str(length) for length in shape)
        raise InputError(f"key {key!r} has the wrong form; expected {form} numbers in lists")
    return np.array([[_finite(number, key) for number in row] for row in rows]).reshape(shape)


def describe(value: object) -> str:
    """Describe a JSON value in a few words, for error messages."""
    if value is None or isinstance(value, bool):
        return json.dumps(value)
    if isinstance(value, str):
        return f"the text {ascii(value)[:40]}"
    if isinstance(value, (list, dict)):
        return "a list" if isinstance(value, list) else "an object"
    if isinstance(value, float) and not math.isfinite(value):
        return f"{value}"
    return "a number"


def describe_any(value: object) -> str:
    """Describe a value of any type in a few words, a number by its digits, for error messages.

    None is null, as in the files that hold such values.
    """
    if is_real(value):
        if not isinstance(value, int) or abs(value) < _LONG_NUMBER:
            return f"{value}"
        number = to_real(value)  # Python does not write numbers of thousands of digits
        return f"{number:.6g}" if number is not None and math.isfinite(number) else "a number of hundreds of digits"
    if value is None or isinstance(value, bool | str | list | dict):
        return describe(value)
    return f"a {type(value).__name__}"


def is_real(value: object) -> bool:
    """Return whether a value of a Python program is a real number; NumPy's numbers are, true and false are not."""
    return isinstance(value, Real) and not isinstance(value, bool)


def is_whole(value: object) -> bool:
    """Return whether a value of a Python program is an integer; NumPy's integers are, true and false are not."""
    return isinstance(value, Integral) and not isinstance(value, bool)


def to_real(value: object) -> float | None:
    """Return a JSON number as a float, infinite if it is too large; None for any other value."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return None
    try:
        return float(value)
    except OverflowError:
        return math.inf


def _finite(value: object, key: str) -> float:
    number = to_real(value)
    if number is None:
        raise InputError(f"key {key!r} is {describe(value)}; expected a number")
    if not math.isfinite(number):
        raise InputError(f"key {key!r} is not finite; expected a number")
    return number
