"""Colours: red, green and blue as real numbers, 0 to 1 in what a screen shows."""

from __future__ import annotations

Color = tuple[float, float, float]

SPREAD = 4  # largest difference, of 255, between pixels of one colour

BLACK: Color = (0.0, 0.0, 0.0)  # the background unless another is chosen, as in 3DGS
WHITE: Color = (1.0, 1.0, 1.0)
