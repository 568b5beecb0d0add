"""The methods that `clsplat compare` compares: presets, shapes and the default, each with its own changes.

Command line and tables call a method a system.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ..errors import InputError
from ..splats.shapes import SHAPES
from ..training.config import OPTIONS, TrainConfig
from ..training.presets import PRESETS, with_preset

DEFAULT = "default"
# Options that are equal for all methods of a comparison.
SHARED = ("cap_max", "seed", "iterations", "background", "device", "save_iterations", "test_iterations")
_SET_BY_COMPARISON = ("shape", "cap_max", "seed")
_SWITCHES = {"true": True, "on": True, "yes": True, "1": True, "false": False, "off": False, "no": False, "0": False}


@dataclass(frozen=True)
class Method:
    """One method of a comparison.

    Parameters
    ----------
    label : name in tables.
    base : a preset, a shape (default options with that shape), or "default".
    changes : options that replace those of the base, by the names of `TrainConfig`. They may also replace what
        makes a preset, because the label shows them.
    """

    label: str
    base: str
    changes: Mapping[str, Any]

    def config(self, cap: int, seed: int, common: Mapping[str, Any] | None = None) -> TrainConfig:
        """Return the training options of one run.

        Parameters
        ----------
        common : options of all methods; the changes of this method replace them.

        Raises
        ------
        InputError : options that contradict the method, that have no effect in it, or that the comparison sets.
        """
        shared = {key: value for key, value in (common or {}).items() if key not in self.changes}
        for key in _SET_BY_COMPARISON:
            if key in shared:
                raise InputError(f"{key} is set for each run of a comparison: name systems, caps and seeds instead")
        if self.base in PRESETS:
            values = with_preset(self.base, shared)
        else:
            values = shared if self.base == DEFAULT else shared | {"shape": self.base}
        try:
            config = TrainConfig(**(values | dict(self.changes) | {"cap_max": cap, "seed": seed}))
        except InputError as error:
            raise InputError(f"system {self.label}: {error}") from None
        for key in config.without_effect(self.changes):
            raise InputError(f"system {self.label}: {key} has no effect with strategy {config.strategy}: remove it")
        return config


def parse_methods(text: str) -> list[Method]:
    """Return the methods of a list such as `3dgs,gaussian,sns:alternation=off,skew_map=coupled`.

    A `key=value` after a comma is another change of the method before it.

    Raises
    ------
    InputError : an unknown method or option, a value of another type, or the same method or option twice.
    """
    groups: list[list[str]] = []
    for part in (part.strip() for part in text.split(",")):
        if "=" in part and ":" not in part and groups:
            groups[-1].append(part)
        elif part:
            name, colon, first = part.partition(":")
            groups.append([name.strip(), *([first.strip()] if colon else [])])
    methods = [_parse_method(name, changes) for name, *changes in groups]
    if not methods:
        raise InputError(f"systems {text!r}: name at least one of {', '.join(_known_bases())}")
    labels = [method.label for method in methods]
    for label in labels:
        if labels.count(label) > 1:
            raise InputError(f"system {label}: is named twice: name it once")
    return methods


def _known_bases() -> tuple[str, ...]:
    return (DEFAULT, *PRESETS, *SHAPES)


def _parse_method(name: str, changes: list[str]) -> Method:
    base = name.replace("_", "-")
    if base not in _known_bases():
        raise InputError(f"unknown system {name!r}: choose one of {', '.join(_known_bases())}")
    pairs = [_parse_change(name, change) for change in changes]
    keys = [key for key, _ in pairs]
    for key in keys:
        if keys.count(key) > 1:
            raise InputError(f"system {name}: {key} is named twice: name it once")
    values = dict(pairs)
    texts = [change.partition("=")[2].strip() for change in changes]
    suffix = ",".join(f"{key}={text}" for key, text in zip(keys, texts, strict=True))
    return Method(f"{base}:{suffix}" if suffix else base, base, values)


def _parse_change(name: str, change: str) -> tuple[str, Any]:
    """Return the key and the typed value of `key=value`."""
    key, equals, text = (part.strip() for part in change.partition("="))
    key = key.replace("-", "_")
    if not equals or not text:
        raise InputError(f"system {name}: {change!r} is not a key=value, such as strategy=mcmc")
    if key in SHARED:
        raise InputError(f"system {name}: {key} is the same for all systems of a comparison: give it as a flag")
    if key not in OPTIONS:
        raise InputError(f"system {name}: unknown option {key!r}: the options of `clsplat train` can be changed")
    value_type = OPTIONS[key].value_type
    try:  # options of other types than str, bool, int and float are in SHARED
        return key, _SWITCHES[text.lower()] if value_type is bool else value_type(text)
    except (KeyError, ValueError):
        expected = {bool: "on or off", int: "a whole number", float: "a number"}[value_type]
        raise InputError(f"system {name}: {key}={text}: expected {expected}") from None
