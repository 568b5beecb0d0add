"""Stochastic gradient Hamiltonian Monte Carlo for positions (Chen, Fox & Guestrin 2014; SSS 2025), in a stable form.

Student Splatting and Scooping (SSS) steps the means x with a momentum p:

    burn-in   p <- -l g + Sigma s sqrt(2 l C_b) xi                x <- x + l p
    after     p <- s (1 - l C) p - l g + s sqrt(2 l C) xi         x <- x + l p     (p = 0 before the first)

g is the bias-corrected direction of Adam, l the square root of Adam's rate and xi a standard normal. The gate s =
sigmoid(0.5 - 100 |opacity|) is open only for nearly transparent splats (noise.py). Only such splats move by momentum
and noise; all other splats take Adam's steps l^2 g.

The published form is methods/sss.py ("sghmc-sss"). It diverges if s |1 - l C| > 1. That happens in large scenes,
because l grows with the square root of the extent E. The noise of this form does not scale with the scene.

The stable form ("sghmc") removes E from l. With l' = l / sqrt(E), the friction per step is f = min(l' C', 1), so
s (1 - f) < 1 always. The displacement by noise is proportional to E, also in the burn-in. C' = C sqrt(E_SSS), where
E_SSS is the extent that the constants of SSS belong to. At E = E_SSS both forms have the same noise. Their frictions
are equal there if l' C' <= 1.

Runs shorter than those of SSS have larger rates (TrainConfig.rate_factor). That factor multiplies only g. Friction and
noise have the rate that SSS has at the same fraction of its run.
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

STREAM = 1  # argument `stream` of noise.normal3
_SMALLEST_EXTENT = 1e-6  # for cameras in one place, whose extent is 0


class Coefficients(NamedTuple):
    """Coefficients of a step p <- s keep p - drive g + s noise (Sigma if by_covariance) xi, x <- x + length p."""

    length: float
    drive: float
    keep: float
    noise: float
    by_covariance: bool


@dataclass(frozen=True, slots=True)
class Sghmc:
    """SGHMC in scene units.

    Parameters
    ----------
    extent : extent of the scene [world units].
    friction, burn_in_friction : C and C_b of SSS.
    burn_in : last iteration of the burn-in.
    """

    extent: float
    friction: float
    burn_in_friction: float
    burn_in: int

    def coefficients(self, iteration: int, rate: float, factor: float) -> Coefficients:
        """Return the coefficients of an iteration (from 1).

        Parameters
        ----------
        rate : Adam's rate, without the factor of short runs.
        factor : the factor of short runs (TrainConfig.rate_factor).
        """
        length = math.sqrt(rate)
        burning = iteration <= self.burn_in
        extent = max(self.extent, _SMALLEST_EXTENT)
        unit = length / math.sqrt(extent)
        friction = (self.burn_in_friction if burning else self.friction) * math.sqrt(SSS_EXTENT)
        # x moves by length * noise. In the burn-in, the factor Sigma grows as E^2 as well.
        noise = (SSS_EXTENT / extent) ** 1.5 if burning else math.sqrt(extent / SSS_EXTENT)
        keep = 1.0 - min(unit * friction, 1.0) if iteration > self.burn_in + 1 else 0.0
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
    """Return the means and momenta after one step.

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
