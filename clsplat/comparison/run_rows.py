"""The lines of runs.jsonl: reading them, and checking that a run can have written them."""

from __future__ import annotations

import json
import math
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from ..errors import InputError
from ..files.json_file import describe_any, to_real
from .table import MEASURED, Record

# Values without which a run that did not fail has no place in tables and charts.
_OF_FINISHED = ("psnr", "ssim", "seconds", "splats")


def parse_runs(text: str, file: Path) -> list[Record]:
    """Return the records of a runs.jsonl, without the line at its end that a crash cut short (`torn_tail`).

    Parameters
    ----------
    text : content of the file. file : its path, for messages.

    Warns
    -----
    UserWarning : another line cannot be read, or lacks a value. It is left out, so that its run is repeated.

    Raises
    ------
    InputError : a value is one that no run can have written. The message names the line and the value.
    """
    records = []
    for number, line in enumerate(text.removesuffix(torn_tail(text)).splitlines(), 1):
        if not line.strip():
            continue
        record = _object(line)
        if record is None or (missing := sorted(_FIELDS.keys() - record.keys())):
            why = "is no JSON object" if record is None else f"has no {missing[0]}"
            warnings.warn(
                f"{file}: line {number} {why} and is left out: remove it, and repeat its run if it is missing",
                stacklevel=3,
            )
            continue
        for name, value, expected in _faults(record):
            raise InputError(
                f"{file}: line {number}: {name} is {describe_any(value)}; expected {expected}: "
                "remove the line, so that its run is repeated"
            )
        records.append(record)
    return records


def torn_tail(text: str) -> str:
    """Return the end of a runs.jsonl if a crash cut its last line short, else nothing."""
    tail = text[text.rfind("\n") + 1 :]
    return tail if _object(tail) is None else ""


def _object(line: str) -> Record | None:
    """Return the JSON object in a line; None for anything else."""
    try:
        value = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return value if isinstance(value, dict) else None


def _faults(record: Record) -> Iterator[tuple[str, Any, str]]:
    """Yield name, value and expectation of each value that no run writes. record : has all of _FIELDS."""
    fields = {**_FIELDS, **{key: field for key, field in _OPTIONAL.items() if key in record}}
    yield from _faults_of(record, fields, "")
    for key, parts in _PARTS.items():
        yield from _faults_of(record[key], parts, f"{key}.")
    for point in record.get("curve") or ():
        yield from _faults_of(point, _CURVE, "curve.")
    if record["failed"] is None:
        yield from _faults_of(record, dict.fromkeys(_OF_FINISHED, _NUMBER), "")


def _faults_of(values: Mapping[str, Any], fields: Mapping[str, _Field], place: str) -> Iterator[tuple[str, Any, str]]:
    for key, (expected, is_sound) in fields.items():
        if not is_sound(values.get(key)):
            yield f"{place}{key}", values.get(key), expected


def _is_text(value: object) -> bool:
    return isinstance(value, str)


def _is_count(value: object) -> bool:
    return type(value) is int and value >= 0


def _is_number(value: object) -> bool:
    """Return whether a value is a number. The PSNR of equal images is infinite."""
    number = to_real(value)
    return number is not None and number > -math.inf  # NaN is not


def _is_curve(value: object) -> bool:
    return value is None or (isinstance(value, list) and all(isinstance(point, dict) for point in value))


def _or_none(field: _Field) -> _Field:
    expected, is_sound = field
    return f"{expected} or null", lambda value: value is None or is_sound(value)


_Field = tuple[str, Callable[[Any], bool]]  # what a value must be, in words and as a test
_TEXT: _Field = ("a text", _is_text)
_COUNT: _Field = ("a whole number", _is_count)
_NUMBER: _Field = ("a number", _is_number)
_SWITCH: _Field = ("true or false", lambda value: isinstance(value, bool))
_OBJECT: _Field = ("an object", lambda value: isinstance(value, dict))
_FIELDS: dict[str, _Field] = {
    "scene": _OBJECT,
    "system": _TEXT,
    "config": _OBJECT,
    "failed": _or_none(_TEXT),
    "finite": _SWITCH,
    "cap_held": _SWITCH,
    **dict.fromkeys(("device", "driver", "schedule", "version"), _TEXT),
    "protocol": _OBJECT,
    **dict.fromkeys(MEASURED, _or_none(_NUMBER)),
}
_OPTIONAL: dict[str, _Field] = {
    "repeat": _COUNT,
    "digest": _or_none(_TEXT),
    "curve": ("a list of objects or null", _is_curve),
}
_PARTS: dict[str, dict[str, _Field]] = {
    "scene": {"name": _TEXT, "width": _COUNT, "height": _COUNT},
    "config": {"shape": _TEXT, "cap_max": _COUNT, "iterations": _COUNT, "seed": _COUNT},
    "protocol": {"PSNR": _TEXT, "SSIM": _TEXT},
}
_CURVE: dict[str, _Field] = {"iteration": _COUNT, **dict.fromkeys(("seconds", "psnr", "ssim"), _NUMBER)}
