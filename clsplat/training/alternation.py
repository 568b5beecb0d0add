"""Which parameters learn at an iteration: block-coordinate descent of everything else against the skew.

Skew-normal splatting (papers: 3D Skew-Normal Splatting, 2026) trains all jointly at first and then in cycles, the first
part of a cycle with one of the two blocks frozen, the rest with the other. Its lengths are not published; ours are
options (config.py).
"""

from __future__ import annotations

from typing import NamedTuple

from ..splats.shapes import shape_named
from .config import TrainConfig


class Blocks(NamedTuple):
    """The blocks that learn. A frozen block keeps its values, its moments and its count of steps."""

    base: bool  # everything but the skew
    skew: bool


def active_blocks(iteration: int, config: TrainConfig) -> Blocks:
    """The blocks that learn at `iteration` (from 1).

    Both without alternation, in shapes that have no skew, and during the warm-up of
    `alternation_warmup * iterations`. Then each cycle of `alternation_cycle` iterations gives its first
    `alternation_split` to the base and the rest to the skew.
    """
    since = iteration - 1 - int(config.phases.alternation_warmup * config.iterations)
    if config.phases.alternation == "off" or since < 0 or shape_named(config.shape).skew_form is None:
        return Blocks(True, True)
    base = since % config.phases.alternation_cycle < round(
        config.phases.alternation_split * config.phases.alternation_cycle
    )
    return Blocks(base, not base)
