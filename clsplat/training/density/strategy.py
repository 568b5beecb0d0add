"""What a run's strategy does to the splats at one of its actions: from the options to an edit."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ...splats.fields import Array
from ...splats.shapes import shape_named
from ..config import TrainConfig
from ..options.density import Adc, Mcmc
from .adc import plan_adc, with_reset
from .edit import DensifyEdit
from .relocation import plan_relocation

# Opacities are reset this many iterations apart at least, and not earlier, however short the run: their rate does not
# grow in short runs. A reset at 500 of 1000 iterations cost 1 dB (half-Gaussians on 400 px photos).
RESET_INTERVAL_MIN = 1000


@dataclass(frozen=True, slots=True)
class StepInfo:
    """Where a run stands when its strategy acts.

    Parameters
    ----------
    iteration : from 1. last : the last one at which the strategy may act.
    growth : new count over old count of "mcmc". extent : of the scene [world units].
    """

    iteration: int
    last: int
    growth: float
    extent: float


def next_edit(
    config: TrainConfig, arrays: Mapping[str, Array], stats: Array, rng: np.random.Generator, info: StepInfo
) -> DensifyEdit:
    """The edit of one action.

    Parameters
    ----------
    arrays : all public arrays of the model. stats : (3, N), collected since the last action (cl/render/project.cl).
    rng : of the run; the edit depends on nothing else that is random.

    Raises
    ------
    TrainingError : no splat is finite.
    """
    shape, density = shape_named(config.shape), config.density
    if isinstance(density, Mcmc):
        # The profile has peak 1; without that the length factor would be another one for each view.
        scaled = config.normalisation == "peak" or not shape.normalised
        return plan_relocation(
            arrays,
            shape,
            rng,
            config.cap_max,
            growth=info.growth,
            limit=density.relocation_limit,
            rule=density.relocation if scaled else "opacity-only",
        )
    every = reset_interval(density, config.iterations)
    grown = plan_adc(
        arrays,
        shape,
        stats,
        rng,
        config.cap_max,
        extent=info.extent,
        grad_threshold=density.grad_threshold,
        depth_threshold=density.depth_threshold,
        dense_size=density.dense_size,
        prune_large=0 < every < info.iteration,
    )
    return with_reset(grown, arrays, shape) if resets(density, config.iterations, info) else grown


def reset_interval(density: Adc, iterations: int) -> int:
    """Iterations from one opacity reset to the next; 0: there is none."""
    return density.opacity_reset and max(iterations // density.opacity_reset, RESET_INTERVAL_MIN)


def resets(density: Adc, iterations: int, info: StepInfo) -> bool:
    """Whether the action resets opacities: the first at or after a multiple of the interval, but not the last.

    3DGS: at 3000, 6000, 9000 and 12 000 of 30 000 iterations, of which 15 000 densify.
    """
    every = reset_interval(density, iterations)
    if not every or info.iteration >= info.last:
        return False
    return info.iteration // every > (info.iteration - density.densify_interval) // every
