"""Colour bars of the modes, as HTML for the panel."""

from __future__ import annotations

import math

import numpy as np

from ..rendering.colormaps import FULL_COUNT, colour_map

_STOPS = 17  # colours of a bar; the browser draws straight lines between them
_TICKS = 5
_GREY = "#000,#fff"


def legend(mode: str, near_far: tuple[float, float] | None) -> str:
    """Return the colour bar of a mode with its numbers, "" for colours of the model.

    Parameters
    ----------
    near_far : depths at the bright and at the dark end; mode "depth" needs them.
    """
    along = np.linspace(0.0, 1.0, _TICKS)
    if mode == "depth" and near_far is not None:
        near, far = near_far  # the colours are even in 1/depth
        ticks = [_number(1.0 / (1.0 / far + share * (1.0 / near - 1.0 / far))) for share in along]
        return _bar(_stops(), ticks, "depth [world units]")
    if mode == "splats":  # the colours are even in log(1 + count)
        ticks = [f"{math.expm1(share * math.log1p(FULL_COUNT)):.0f}" for share in along]
        return _bar(_stops(), [*ticks[:-1], f"{ticks[-1]}+"], "splats a pixel")
    if mode == "alpha":
        return _bar(_GREY, [f"{share:g}" for share in along], "alpha")
    if mode == "skew":
        return _bar(_stops(), [f"{share:g}" for share in along], "skew over its limit")
    return ""


def _stops() -> str:
    return ",".join(f"rgb({r},{g},{b})" for r, g, b in colour_map(np.linspace(0.0, 1.0, _STOPS)).tolist())


def _bar(stops: str, ticks: list[str], label: str) -> str:
    numbers = "".join(f"<span>{tick}</span>" for tick in ticks)
    return (
        '<div style="margin:0 1em 0.5em;font-size:0.75em">'
        f'<div style="height:0.9em;border-radius:2px;background:linear-gradient(to right,{stops})"></div>'
        f'<div style="display:flex;justify-content:space-between">{numbers}</div>'
        f'<div style="text-align:center;opacity:0.7">{label}</div></div>'
    )


def _number(value: float) -> str:
    """Return a depth with three digits, and without an exponent where it is readable."""
    if not 1e-3 <= value < 1e6:
        return f"{value:.1e}"
    return f"{value:.{max(2 - math.floor(math.log10(value)), 0)}f}"
