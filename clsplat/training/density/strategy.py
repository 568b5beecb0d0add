"""Densification strategies: from the options of a run to the edit of one densification."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...rendering.splat_buffers import SplatStatistics
from ...splats.fields import Array
from ...splats.shapes import shape_named
from ..config import TrainConfig
from ..options.density import Adc, Mcmc
from .adc import plan_adc, with_reset
from .edit import DensifyEdit
from .relocation import plan_relocation
from .table import SplatTable

# Minimum number of iterations between opacity resets. The learning rate of opacities is the same in short runs, so
# opacities always need this time to recover.
RESET_INTERVAL_MIN = 1000
# Default turnover, as parts of the cap: of a whole run that densifies from its first iteration to its last, and the
# most of one densification.
TURNOVER = 3.5
LARGEST_TURNOVER = 0.08


@dataclass(frozen=True, slots=True)
class StepInfo:
    """The iteration of a densification, and values that depend on it.

    Parameters
    ----------
    iteration : counts from 1.
    last : last iteration at which the strategy may densify.
    growth : factor of the number of splats ("mcmc").
    extent : extent of the scene [world units].
    """

    iteration: int
    last: int
    growth: float
    extent: float


def relocation_rule(config: TrainConfig) -> str:
    """Return the rule of relocation (`relocation.RULES`) of a run with strategy "mcmc"."""
    # The length factor needs a profile with peak 1. Other normalisations change the peak with the view.
    scaled = config.normalisation == "peak" or not shape_named(config.shape).normalised
    return str(config.to_json()["relocation"]) if scaled else "opacity-only"


def next_edit(
    config: TrainConfig, splats: SplatTable, stats: Array, rng: np.random.Generator, info: StepInfo
) -> DensifyEdit:
    """Return the edit of one densification.

    Parameters
    ----------
    splats : the splats before the densification.
    stats : (3, N) densification statistics since the last densification (SplatStatistics).
    rng : generator of the run, the only source of randomness.

    Raises
    ------
    TrainingError : no splat is finite.
    """
    shape, density = shape_named(config.shape), config.density
    if isinstance(density, Mcmc):
        return plan_relocation(
            splats,
            shape,
            rng,
            config.cap_max,
            growth=info.growth,
            limit=density.relocation_limit,
            rule=relocation_rule(config),
            turnover=turnover(config),
            split=density.split,
            gradient=stats[SplatStatistics.SCREEN_GRADIENT] / np.maximum(stats[SplatStatistics.TIMES_SEEN], 1.0),
        )
    grown = plan_adc(
        splats,
        shape,
        stats,
        rng,
        config.cap_max,
        extent=info.extent,
        grad_threshold=density.grad_threshold,
        depth_threshold=density.depth_threshold,
        dense_size=density.dense_size,
        turnover=turnover(config),
        split=density.split,
    )
    return with_reset(grown, splats, shape) if resets(config, density, info) else grown


def turnover(config: TrainConfig) -> float:
    """Return the part of the cap that a densification may replace: the option, or a default by the length of the run.

    By default, all densifications of a run together may replace about the same number of splats.
    """
    if config.density.turnover is not None:
        return config.density.turnover
    return min(TURNOVER * config.densify_every / config.iterations, LARGEST_TURNOVER)


def reset_interval(density: Adc, iterations: int) -> int:
    """Return the number of iterations from one opacity reset to the next; 0 means no resets."""
    return density.opacity_reset and max(iterations // density.opacity_reset, RESET_INTERVAL_MIN)


def resets(config: TrainConfig, density: Adc, info: StepInfo) -> bool:
    """Return whether this densification resets opacities: the first one at or after a multiple of the interval does.

    The last densification never resets. 3DGS resets at 3000, 6000, 9000 and 12 000 of 30 000 iterations, and densifies
    until 15 000.
    """
    every = reset_interval(density, config.iterations)
    if not every or info.iteration >= info.last:
        return False
    return info.iteration // every > (info.iteration - config.densify_every) // every
