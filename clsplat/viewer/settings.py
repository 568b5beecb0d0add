"""What one looker-on has chosen to see. Values come from a browser: only what can be used is taken."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NoReturn

from ..splats.color import BLACK, Color

SMALLEST, LARGEST = 64, 4096  # longest side of a picture [px]
DEFAULT_SIZE = 1920


@dataclass(frozen=True)
class Settings:
    """A looker-on's choices.

    Attributes
    ----------
    mode : one of `display.MODES`.
    background : 0 to 1 each.
    size : longest side of a still picture [px]; a smaller window has smaller pictures.
    sh_degree : highest band of colour shown; None: all.
    cap : splats shown, those first that cover most; None: all.
    """

    mode: str = "colour"
    background: Color = BLACK
    size: int = DEFAULT_SIZE
    sh_degree: int | None = None
    cap: int | None = None

    def changed(self, name: str, value: Any, modes: tuple[str, ...]) -> Settings:
        """With a browser's value for one of the attributes; the same settings where it is unusable.

        Parameters
        ----------
        value : of any kind; background as bytes. modes : that may be chosen.
        """
        checks: dict[str, Callable[[Any], Any]] = {
            "mode": lambda given: given if given in modes else _unusable(),
            "background": _rgb,
            "size": lambda given: _whole(given, SMALLEST, LARGEST),
            "sh_degree": lambda given: _whole(given, 0, 3),
            "cap": lambda given: _whole(given, 0, 1 << 31),
        }
        try:
            return replace(self, **{name: checks[name](value)})
        except (TypeError, ValueError, OverflowError):
            return self


def _rgb(given: Any) -> Color:
    r, g, b = (float(part) / 255.0 for part in given)
    if not all(0.0 <= part <= 1.0 for part in (r, g, b)):
        _unusable()
    return r, g, b


def _whole(given: Any, least: int, most: int) -> int:
    """The nearest whole number within bounds."""
    if isinstance(given, (str, bytes)) or not math.isfinite(given):
        _unusable()
    return int(min(max(round(given), least), most))


def _unusable() -> NoReturn:
    raise ValueError
