"""3D Skew-Normal Splatting (SNS, 2026): alternating optimisation of the skew and of all other parameters.

SNS trains all parameters together at first and then in cycles. In the first part of a cycle the skew is frozen. In the
second part all other parameters are frozen. The paper does not give the lengths, which are options here
(alternation_*).
"""

from __future__ import annotations

from typing import NamedTuple

from ...splats.shapes import shape_named
from ..config import TrainConfig


class ParameterGroups(NamedTuple):
    """Whether each parameter group learns. A frozen group keeps its values, its moments and its step count."""

    base: bool  # all parameters except the skew
    skew: bool


def learning_groups(iteration: int, config: TrainConfig) -> ParameterGroups:
    """Return the groups that learn at `iteration` (from 1).

    Both groups learn without alternation, for shapes without a skew, and during the warm-up of `alternation_warmup *
    iterations`. After that, a cycle has `alternation_cycle` iterations. The fraction `alternation_split` of them trains
    the base, the rest trains the skew.
    """
    phases = config.phases
    since = iteration - 1 - int(phases.alternation_warmup * config.iterations)
    if phases.alternation == "off" or since < 0 or shape_named(config.shape).skew_form is None:
        return ParameterGroups(True, True)
    base = since % phases.alternation_cycle < round(phases.alternation_split * phases.alternation_cycle)
    return ParameterGroups(base, not base)
