"""Settings of one client. Values come from a browser, so only usable ones are accepted."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NoReturn

from ..splats.color import BLACK, Color
from .crop import CropBox

MIN_SIZE, MAX_SIZE = 64, 4096  # longest side of a picture [px]
DEFAULT_SIZE = 1920


@dataclass(frozen=True)
class Settings:
    """The choices of a client.

    Attributes
    ----------
    mode : one of `colormaps.MODES`.
    background : colour, 0 to 1 for each channel.
    size : longest side of a still frame [px]; a smaller window has smaller frames.
    sh_degree : highest SH band that is shown, or None for all.
    cap : number of splats that are shown, or None for all. Those that cover most are shown first.
    crop : box that hides the splats outside of it, or None.
    divider : share of the width that shows the first of two models.
    """

    mode: str = "colour"
    background: Color = BLACK
    size: int = DEFAULT_SIZE
    sh_degree: int | None = None
    cap: int | None = None
    crop: CropBox | None = None
    divider: float = 0.5

    def changed(self, name: str, value: Any, modes: tuple[str, ...]) -> Settings:
        """Return the settings with one value of a browser; the same settings if the value is unusable.

        Parameters
        ----------
        value : an object of any kind; a background is three bytes. modes : the allowed modes.
        """
        checks: dict[str, Callable[[Any], Any]] = {
            "mode": lambda mode: mode if mode in modes else _unusable(),
            "background": _rgb,
            "size": lambda size: _whole(size, MIN_SIZE, MAX_SIZE),
            "sh_degree": lambda degree: None if degree is None else _whole(degree, 0, 3),
            "cap": lambda cap: None if cap is None else _whole(cap, 0, 1 << 31),
            "divider": _share,
            "crop": lambda box: box if box is None or isinstance(box, CropBox) else _unusable(),
        }
        try:
            return replace(self, **{name: checks[name](value)})
        except (TypeError, ValueError, OverflowError):
            return self


def _rgb(value: Any) -> Color:
    r, g, b = (float(part) / 255.0 for part in value)
    if not all(0.0 <= part <= 1.0 for part in (r, g, b)):
        _unusable()
    return r, g, b


def _share(value: Any) -> float:
    if isinstance(value, (str, bytes)) or not math.isfinite(value):
        _unusable()
    return float(min(max(value, 0.0), 1.0))


def _whole(value: Any, low: int, high: int) -> int:
    """Return the nearest whole number within bounds."""
    if isinstance(value, (str, bytes)) or not math.isfinite(value):
        _unusable()
    return int(min(max(round(value), low), high))


def _unusable() -> NoReturn:
    raise ValueError
