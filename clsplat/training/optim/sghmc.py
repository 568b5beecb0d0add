"""Stochastic gradient Hamiltonian Monte Carlo for positions (Chen, Fox & Guestrin 2014), as SSS trains them.

Student Splatting and Scooping (2025) moves means x with a momentum p, where g is Adam's bias-corrected direction, l the
square root of Adam's rate, s = sigmoid(0.5 - 100 |opacity|) a gate that only nearly transparent splats pass (noise.py),
and xi a standard normal:

    burn-in   p <- -l g + Sigma s sqrt(2 l C_b) xi                x <- x + l p
    after     p <- s (1 - l C) p - l g + s sqrt(2 l C) xi         x <- x + l p     (p = 0 before the first)

A visible splat thus takes Adam's steps, l^2 g; momentum and noise act on nearly transparent ones.

As written ("sghmc-sss") it diverges where s |1 - l C| > 1, that is in large scenes (l grows with the square root of
the extent E) or with a large C, and its noise does not scale with the scene. "sghmc" takes E out of l: with
l' = l / sqrt(E) the friction per step is f = min(l' C', 1), so that s (1 - f) < 1 always, and the displacement by noise
grows as E, in the burn-in too. C' = C sqrt(E_SSS) and the factors of the noise are such that both forms have
the same noise, and the same friction up to the bound, at E = E_SSS, the extent to which SSS's constants belong.

Our rates are larger in runs shorter than SSS's (config.rate_factor). That factor multiplies g alone: friction
and noise keep the published rate of the same fraction of the run.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...splats.fields import Array
from .noise import PUBLISHED_EXTENT as SSS_EXTENT
from .noise import covariance_times, noise_gate

STREAM = 1  # of noise.normal3
_SMALLEST_EXTENT = 1e-6  # cameras in one place have none


class Coefficients(NamedTuple):
    """One step: p <- s keep p - drive g + s noise (Sigma if by_covariance) xi, x <- x + length p."""

    length: float
    drive: float
    keep: float
    noise: float
    by_covariance: bool


@dataclass(frozen=True, slots=True)
class Sghmc:
    """The options of a run.

    Parameters
    ----------
    literal : as SSS writes it, else in scene units and stable.
    extent : of the scene [world units].
    friction, burn_in_friction : C and C_b.
    burn_in : its last iteration.
    """

    literal: bool
    extent: float
    friction: float
    burn_in_friction: float
    burn_in: int

    def coefficients(self, iteration: int, rate: float, factor: float) -> Coefficients:
        """Of an iteration (from 1), from Adam's rate without the factor of short runs, and that factor."""
        length = math.sqrt(rate)
        burning = iteration <= self.burn_in
        friction = self.burn_in_friction if burning else self.friction
        if self.literal:
            unit, noise = length, 1.0
        else:
            extent = max(self.extent, _SMALLEST_EXTENT)
            unit, friction = length / math.sqrt(extent), friction * math.sqrt(SSS_EXTENT)
            # x moves by length * noise, and in the burn-in by Sigma, too, which grows as E^2.
            noise = (SSS_EXTENT / extent) ** 1.5 if burning else math.sqrt(extent / SSS_EXTENT)
        lost = unit * friction if self.literal else min(unit * friction, 1.0)
        keep = 1.0 - lost if iteration > self.burn_in + 1 else 0.0
        return Coefficients(length, length * factor, keep, noise * math.sqrt(2.0 * unit * friction), burning)


def step(
    mean: Array,
    momentum: Array,
    direction: Array,
    xi: Array,
    quat: Array,
    log_scale: Array,
    strength: Array,
    c: Coefficients,
) -> tuple[Array, Array]:
    """Means and momenta after one step.

    Parameters
    ----------
    mean, momentum, direction, xi : (N, 3); the direction is Adam's.
    quat, log_scale : (N, 4), (N, 3), raw values of Sigma.
    strength : (N,) the largest |opacity| of each splat (Shape.strength).
    """
    gate = noise_gate(strength)[:, None]
    spread: NDArray[np.float64] = xi.astype(np.float64)
    if c.by_covariance:
        spread = covariance_times(quat, log_scale, spread)
    p = gate * (c.keep * momentum + c.noise * spread) - c.drive * direction
    return (mean + c.length * p).astype(mean.dtype), p.astype(momentum.dtype)
