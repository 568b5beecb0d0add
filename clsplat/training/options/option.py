"""Options as dataclass fields: each field carries its help text, range and choices in its metadata.

`option` declares a field, `option_table` lists the options of a class, and `check_options` checks the values of one
object. The command line, the reader of config.json and the checks all use this one definition.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from types import NoneType, UnionType
from typing import Any, ClassVar, get_args, get_origin, get_type_hints

import numpy as np

from ...errors import InputError, check_choice
from ...files.json_file import describe_any, to_real


@dataclass(frozen=True, slots=True)
class Range:
    """The range of a number; each bound is optional.

    Parameters
    ----------
    at_least, at_most : smallest and largest allowed value.
    above, below : bounds that the value must not reach.
    """

    at_least: float | None = None
    at_most: float | None = None
    above: float | None = None
    below: float | None = None

    def allows(self, number: float) -> bool:
        """Whether a number is in the range. NaN is not in any range."""
        return (
            (self.at_least is None or number >= self.at_least)
            and (self.at_most is None or number <= self.at_most)
            and (self.above is None or number > self.above)
            and (self.below is None or number < self.below)
            and not math.isnan(number)
        )

    def __str__(self) -> str:
        if self.at_least is not None and self.at_most is not None:
            return f"{self.at_least:g} to {self.at_most:g}"
        words = (
            ("at least", self.at_least),
            ("above", self.above),
            ("at most", self.at_most),
            ("below", self.below),
        )
        return " and ".join(f"{word} {bound}" for word, bound in words if bound is not None)


@dataclass(frozen=True, slots=True)
class Option:
    """One training option.

    Parameters
    ----------
    name : name in config.json, and with dashes on the command line.
    type : Python type of the values, such as `float | None`.
    default : default value; `dataclasses.MISSING` if the subclasses define it.
    help : one or two sentences for `--help`.
    range : the range of numbers. choices : allowed words, empty if there are none; a registry such as
        SHAPES may grow.
    metavar : placeholder for the value in `--help`. aliases : further flags.
    by_scene : whether a run decides the value by the scene, if the caller does not name it.
    """

    name: str
    type: Any
    default: Any
    help: str
    range: Range | None = None
    choices: Collection[str] = ()
    metavar: str | None = None
    aliases: tuple[str, ...] = ()
    by_scene: bool = False

    @property
    def value_type(self) -> Any:
        """Type without None: `float` for `float | None`."""
        if isinstance(self.type, UnionType):
            return next(part for part in get_args(self.type) if part is not NoneType)
        return self.type

    def check(self, value: Any) -> None:
        """Raise InputError if a value is not one of the choices, not finite, of another type, or out of range."""
        if self.choices:
            check_choice(self.name, value, self.choices)
        if isinstance(value, float) and not math.isfinite(value):
            raise InputError(f"{self.name} {value}: must be finite{f' and {self.range}' if self.range else ''}")
        if not _fits(value, self.type):
            raise InputError(f"{self.name} is {describe_any(value)}; expected {_expected(self.type)}")
        if self.range is not None and value is not None and not self.range.allows(value):
            raise InputError(f"{self.name} {value}: must be {self.range}")

    def from_json(self, value: Any) -> Any:
        """Return a JSON value as the option's type: lists become tuples.

        Raises
        ------
        InputError : the value has another type.
        """
        converted = tuple(value) if isinstance(value, list) else value
        if not _is_instance(converted, self.type):
            raise InputError(f"config: {self.name} is {describe_any(value)}; expected {_expected(self.type)}")
        return converted


def option(
    default: Any = dataclasses.MISSING,
    *,
    help: str,
    at_least: float | None = None,
    at_most: float | None = None,
    above: float | None = None,
    below: float | None = None,
    choices: Collection[str] = (),
    metavar: str | None = None,
    aliases: Sequence[str] = (),
    by_scene: bool = False,
) -> Any:
    """Return a dataclass field that is a training option; see `Option` and `Range` for the parameters."""
    allowed = Range(at_least, at_most, above, below)
    metadata = {
        "help": help,
        "range": None if allowed == Range() else allowed,
        "choices": choices,
        "metavar": metavar,
        "aliases": tuple(aliases),
        "by_scene": by_scene,
    }
    return dataclasses.field(default=default, metadata=metadata)


_TABLES: dict[type, dict[str, Option]] = {}  # tables by class; each table is made once


def option_table(group: type[Any]) -> dict[str, Option]:
    """Return the options of a dataclass by name.

    A subclass may redefine only the default of an option: the metadata then comes from its base class.
    """
    if group not in _TABLES:
        types, fields = get_type_hints(group), group.__dataclass_fields__.values()
        _TABLES[group] = {
            field.name: Option(field.name, types[field.name], field.default, **metadata)
            for field in fields
            if (metadata := _metadata(group, field.name))
        }
    return _TABLES[group]


def check_options(values: Any) -> None:
    """Raise InputError naming the first option of a dataclass object that has a wrong value."""
    for name, definition in option_table(type(values)).items():
        definition.check(getattr(values, name))


class OptionGroup:
    """Base class of the groups of options, which are dataclasses. A group checks its values when it is created."""

    title: ClassVar[str]  # heading in `--help`

    def __post_init__(self) -> None:
        check_options(self)


def _metadata(cls: type, name: str) -> dict[str, Any]:
    """Return the metadata of a field, from the first class that has it; empty if the field is not an option."""
    tables = (getattr(base, "__dataclass_fields__", {}) for base in cls.__mro__)
    return next((dict(fields[name].metadata) for fields in tables if name in fields and fields[name].metadata), {})


def _is_instance(value: Any, hint: Any) -> bool:
    if isinstance(hint, UnionType):
        return any(_is_instance(value, part) for part in get_args(hint))
    if get_origin(hint) is tuple:
        parts = get_args(hint)
        same_length = parts[1:] == (...,) or (isinstance(value, tuple) and len(value) == len(parts))
        return isinstance(value, tuple) and same_length and all(_is_instance(part, parts[0]) for part in value)
    if hint is float:
        real = to_real(value)
        return real is not None and math.isfinite(real)
    return isinstance(value, hint) and (hint is bool or not isinstance(value, bool))


def _fits(value: Any, hint: Any) -> bool:
    """Return whether a value of a Python program has a type: NumPy's numbers, lists and arrays have it, too."""
    if isinstance(value, np.generic | np.ndarray):
        value = value.tolist()
    if isinstance(hint, UnionType):
        return any(_fits(value, part) for part in get_args(hint))
    if get_origin(hint) is tuple:
        return isinstance(value, tuple | list) and all(_fits(part, get_args(hint)[0]) for part in value)
    return to_real(value) is not None if hint is float else _is_instance(value, hint)  # `check` has refused NaN


def _expected(hint: Any) -> str:
    if isinstance(hint, UnionType):
        return f"{' or '.join(_expected(part) for part in get_args(hint) if part is not NoneType)}, or null"
    names = {bool: "true or false", int: "a whole number", float: "a finite number", str: "a text"}
    return names.get(hint, "a list of numbers" if get_origin(hint) is tuple else "another kind of value")
