"""Student Splatting and Scooping (SSS, 2025): SGHMC for positions and relocation, as published."""

from __future__ import annotations

import math
from dataclasses import dataclass

from ..optim.sghmc import Coefficients, Sghmc

RELOCATION_POWER = 2.0  # SSS multiplies scales by the square of the length factor of 3DGS-MCMC


@dataclass(frozen=True, slots=True)
class PublishedSghmc(Sghmc):
    """SGHMC with the published coefficients. It diverges if s |1 - l C| > 1: in large scenes, or for a large C."""

    def coefficients(self, iteration: int, rate: float, factor: float) -> Coefficients:
        length = math.sqrt(rate)
        burning = iteration <= self.burn_in
        friction = self.burn_in_friction if burning else self.friction
        keep = 1.0 - length * friction if iteration > self.burn_in + 1 else 0.0
        return Coefficients(length, length * factor, keep, math.sqrt(2.0 * length * friction), burning)
