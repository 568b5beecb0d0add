"""Penalties on opacities and scales in NumPy; the kernel is in cl/train/steps.clh."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ...splats.fields import Array
from ...splats.optical_depth import opacity_names
from ...splats.shapes import Shape


class Penalty(NamedTuple):
    """Weights of the penalty opacity * sum(|o|) + scale * sum(scales) + bisect * sum((o_plus - o_minus)^2).

    The first two terms come from 3DGS-MCMC, the third from 3DSGS. If a splat has two opacities, |o| is their mean.
    """

    opacity: float
    scale: float
    bisect: float

    def gradients(self, shape: Shape, params: Mapping[str, Array]) -> dict[str, Array]:
        """Return the gradients of the raw opacities and of the log scales, by field."""
        names = opacity_names(params)
        sides = [shape.opacity(params[name]) for name in names]
        gap = 2 * self.bisect * (sides[0] - sides[-1])
        grads: dict[str, Array] = {"log_scale": self.scale * np.exp(params["log_scale"])}
        for name, o, v_gap in zip(names, sides, (gap, -gap), strict=False):  # the gap of one opacity is 0
            slope = 1 - o * o if shape.signed else o * (1 - o)
            grads[name] = (self.opacity / len(sides) * np.sign(o) + v_gap) * slope
        return grads
