"""The colour bars: their numbers are the values of the colours above them."""

from __future__ import annotations

import re

import numpy as np
import pytest

from clsplat.rendering.colormaps import FULL_COUNT, colour_map, count_picture, depth_picture
from clsplat.rendering.renderer import Rendered
from clsplat.viewer.legend import legend


def ticks(html: str) -> list[float]:
    """Return the numbers, which are evenly spaced below the bar."""
    return [float(text.rstrip("+")) for text in re.findall(r"<span>([^<]*)</span>", html)]


def stops(html: str) -> np.ndarray:
    return np.array([[int(part) for part in rgb.split(",")] for rgb in re.findall(r"rgb\(([^)]*)\)", html)])


def test_the_numbers_of_depth_have_the_colours_above_them() -> None:
    near, far = 2.0, 11.0
    html = legend("depth", (near, far))
    depths, bar = np.array(ticks(html)), stops(html)
    assert depths[0] == far
    assert depths[-1] == near
    image = Rendered(np.zeros((1, 5, 3)), np.ones((1, 5)), depths[None])
    shown = depth_picture(image, (near, far))[0].astype(int)
    assert np.abs(shown - bar[:: (len(bar) - 1) // 4]).max() <= 4  # the numbers have three digits


def test_the_numbers_of_counts_have_the_colours_above_them() -> None:
    html = legend("splats", None)
    counts, bar = np.array(ticks(html)), stops(html)
    assert counts[-1] == FULL_COUNT
    assert "255+" in html
    shown = count_picture(counts[None])[0].astype(int)
    assert np.abs(shown - bar[:: (len(bar) - 1) // 4]).max() <= 4  # the numbers have three digits


@pytest.mark.parametrize(
    ("near_far", "first"), [((0.001, 0.0123), "0.0123"), ((1.0, 12345.6), "12346"), ((1e-9, 1e9), "1.0e+09")]
)
def test_numbers_are_short(near_far: tuple[float, float], first: str) -> None:
    assert re.findall(r"<span>([^<]*)</span>", legend("depth", near_far))[0] == first


def test_every_mode_but_colour_has_a_bar() -> None:
    assert legend("colour", None) == legend("depth", None) == ""
    assert ticks(legend("alpha", None)) == ticks(legend("skew", None)) == [0, 0.25, 0.5, 0.75, 1]
    assert np.array_equal(stops(legend("skew", None))[-1], colour_map(np.array([1.0]))[0])
