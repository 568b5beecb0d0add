"""What `clsplat compare` compares: presets, shapes and the default, each with changes of its own."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ..errors import InputError
from ..splats.shapes import SHAPES
from ..training.config import OPTIONS, TrainConfig
from ..training.presets import PRESETS, with_preset

DEFAULT = "default"
# Equal for all systems of a comparison, or set by it.
SHARED = ("cap_max", "seed", "iterations", "background", "device", "save_iterations", "test_iterations")
_SET_BY_COMPARISON = ("shape", "cap_max", "seed")
_WORDS = {"true": True, "on": True, "yes": True, "1": True, "false": False, "off": False, "no": False, "0": False}


@dataclass(frozen=True)
class Method:
    """One contestant.

    Parameters
    ----------
    label : as in tables.
    base : a preset, a shape (clsplat's default options with that shape), or "default".
    changes : options replaced in it, by TrainConfig's names; what makes a preset may be replaced too, as the label
        says so.
    """

    label: str
    base: str
    changes: Mapping[str, Any]

    def config(self, cap: int, seed: int, common: Mapping[str, Any] | None = None) -> TrainConfig:
        """Its training options.

        Parameters
        ----------
        common : options of all systems; the system's changes replace them.

        Raises
        ------
        InputError : options that do not fit the system, or that the comparison sets itself.
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
            raise InputError(f"system {self.label}: {key} has no effect with strategy {config.strategy}: leave it out")
        return config


def parse_methods(text: str) -> list[Method]:
    """Systems of a list such as `3dgs,gaussian,sns:alternation=off,skew_map=coupled`.

    A comma before `key=value` goes on with the changes of the system before it.

    Raises
    ------
    InputError : an unknown system or option, a value of the wrong kind, or the same system twice.
    """
    groups: list[list[str]] = []
    for part in (part.strip() for part in text.split(",")):
        if "=" in part and ":" not in part and groups:
            groups[-1].append(part)
        elif part:
            name, colon, first = part.partition(":")
            groups.append([name.strip(), *([first.strip()] if colon else [])])
    systems = [_system(name, changes) for name, *changes in groups]
    if not systems:
        raise InputError(f"systems {text!r}: name at least one of {', '.join(_known())}")
    labels = [system.label for system in systems]
    for label in labels:
        if labels.count(label) > 1:
            raise InputError(f"system {label}: is named twice: name it once")
    return systems


def _known() -> tuple[str, ...]:
    return (DEFAULT, *PRESETS, *SHAPES)


def _system(name: str, changes: list[str]) -> Method:
    base = name.replace("_", "-")
    if base not in _known():
        raise InputError(f"unknown system {name!r}: choose one of {', '.join(_known())}")
    values = dict(_change(name, change) for change in changes)
    said = ",".join(f"{key}={change.partition('=')[2].strip()}" for key, change in zip(values, changes, strict=False))
    return Method(f"{base}:{said}" if said else base, base, values)


def _change(name: str, change: str) -> tuple[str, Any]:
    """Key and typed value of `key=value`."""
    key, equals, text = (part.strip() for part in change.partition("="))
    key = key.replace("-", "_")
    if not equals or not text:
        raise InputError(f"system {name}: {change!r} is no key=value, such as strategy=mcmc")
    if key in SHARED:
        raise InputError(f"system {name}: {key} is the same for all systems of a comparison: give it as a flag")
    if key not in OPTIONS:
        raise InputError(f"system {name}: unknown option {key!r}: the options of `clsplat train` can be changed")
    kind = OPTIONS[key].value_type
    try:  # all kinds but str, bool, int and float are of SHARED
        return key, _WORDS[text.lower()] if kind is bool else kind(text)
    except (KeyError, ValueError):
        expected = {bool: "on or off", int: "a whole number", float: "a number"}[kind]
        raise InputError(f"system {name}: {key}={text}: expected {expected}") from None
