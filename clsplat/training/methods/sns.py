"""3D Skew-Normal Splatting (SNS, 2026): alternating optimisation of the skew and of all other parameters.

SNS trains all parameters jointly at first and then in cycles. In the first part of a cycle the skew is frozen, in the
rest all other parameters are. The paper does not give the lengths; they are options here (alternation_*).
"""

from __future__ import annotations

from typing import NamedTuple

from ...splats.shapes import shape_named
from ..config import TrainConfig


class ParameterGroups(NamedTuple):
    """The groups that learn. A frozen group keeps its values, its moments and its step count."""

    base: bool  # all parameters but the skew
    skew: bool


def learning_groups(iteration: int, config: TrainConfig) -> ParameterGroups:
    """Return the groups that learn at `iteration` (from 1).

    Both learn without alternation, for shapes without a skew, and during the warm-up of `alternation_warmup *
    iterations`. After that, each cycle of `alternation_cycle` iterations trains the base in its first
    `alternation_split` and the skew in the rest.
    """
    phases = config.phases
    since = iteration - 1 - int(phases.alternation_warmup * config.iterations)
    if phases.alternation == "off" or since < 0 or shape_named(config.shape).skew_form is None:
        return ParameterGroups(True, True)
    base = since % phases.alternation_cycle < round(phases.alternation_split * phases.alternation_cycle)
    return ParameterGroups(base, not base)
