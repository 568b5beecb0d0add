"""Schedules of a run: learning rate and SH degree by iteration, resolution also by the number of splats.

Iterations count from 1, as in 3DGS. Every function also accepts 0.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

from ..errors import InputError
from .config import TrainConfig
from .options.density import Mcmc

# (fraction of the run, downscale). The second half of a run has full resolution.
COARSE_TO_FINE = ((0.0, 4), (0.2, 2), (0.5, 1))
MANY_PIXELS = 8.0  # pixels per splat; with more, coarse stages last longer
LONGEST = 1.3  # largest factor of the length of coarse stages: full resolution starts at 0.65 of the run


@dataclass(frozen=True)
class RunSchedule:
    """The schedules of a run, from its config.

    Attributes
    ----------
    mean_rate : iteration to the learning rate of positions, without the scene extent.
    sh_interval : iterations from one SH degree to the next.
    densify_first, densify_last : iterations between which the strategy densifies.
    growth : factor of the number of splats per densification (strategy "mcmc").
    """

    mean_rate: Callable[[int], float]
    sh_interval: int
    densify_first: int
    densify_last: int
    growth: float

    @classmethod
    def create(cls, config: TrainConfig, n_first: int) -> RunSchedule:
        """Return the schedules of a run that starts with `n_first` splats."""
        steps = config.iterations
        first = max(int(config.density.densify_from * steps), 1)
        last = int(config.density.densify_until * steps)
        return cls(
            exponential_decay(
                config.optim.lr_factor * config.optim.position_lr_init, config.optim.position_lr_final, steps
            ),
            config.schedule.sh_interval or max(1, min(1000, steps // 10)),
            first,
            last,
            growth_factor(config, n_first, last - first),
        )


def growth_factor(config: TrainConfig, n_first: int, window: int) -> float:
    """Return the growth per densification: the option `growth`, or more if the cap is far.

    The larger factor reaches the cap after half of the densifications in `window` iterations.
    """
    if not isinstance(config.density, Mcmc):
        return 1.0
    actions = max(window // config.densify_every // 2, 1)
    return float(max(config.density.growth, (config.cap_max / n_first) ** (1 / actions)))


def exponential_decay(start: float, end: float, steps: int) -> Callable[[int], float]:
    """Return a log-linear rate: `start` at iteration 0, `end` from `steps` on (the positions of 3DGS).

    Parameters
    ----------
    start, end : learning rates, both above 0.
    steps : iterations from `start` to `end`, at least 1.

    Raises
    ------
    InputError : a rate is not above 0 or not finite, or `steps` is below 1.
    """
    if not (0 < start < math.inf and 0 < end < math.inf):
        raise InputError(f"learning rates {start} -> {end}: both must be above 0 and finite")
    if steps < 1:
        raise InputError(f"a decay over {steps} iterations: at least 1 is needed")
    ratio = math.log(end / start)

    def rate(iteration: int) -> float:
        return start * math.exp(ratio * min(max(iteration / steps, 0.0), 1.0))

    return rate


def sh_degree_at(iteration: int, interval: int, max_degree: int) -> int:
    """Return the SH degree of an iteration.

    It rises by one every `interval` iterations up to `max_degree`. If `interval` is 0, it is always `max_degree`.
    """
    if interval <= 0:
        return max_degree
    return min(max_degree, max(iteration, 0) // interval)


def resolution_schedule(
    iterations: int,
    stages: Sequence[tuple[float, int]] = COARSE_TO_FINE,
    image_side: int | None = None,
    smallest_side: int = 64,
) -> list[tuple[int, int]]:
    """Return the first iteration of each image downscale.

    Parameters
    ----------
    iterations : length of the run.
    stages : (fraction of the run in [0, 1), integer downscale). The fractions rise from 0. The downscales fall to 1, so
        that a run always ends at full resolution.
    image_side : shorter side of the smallest image [px]. A downscale to less than `smallest_side` is replaced by the
        next finer one of the schedule.

    Returns
    -------
    List of (first iteration, downscale), which begins at iteration 0 and has no empty or repeated stages.

    Raises
    ------
    InputError : the stages are not in order.
    """
    fractions = [fraction for fraction, _ in stages]
    downscales = [downscale for _, downscale in stages]
    rising = all(a < b for a, b in pairwise(fractions))
    falling = all(a > b for a, b in pairwise(downscales))
    ends_fit = bool(stages) and fractions[0] == 0 and fractions[-1] < 1 and downscales[-1] == 1
    if not (ends_fit and rising and falling):
        raise InputError(
            f"resolution schedule {list(stages)}: fractions must rise from 0 to below 1 and downscales fall to 1"
        )
    schedule: list[tuple[int, int]] = []
    for (fraction, downscale), upcoming in zip(stages, [*fractions[1:], 1.0], strict=True):
        too_small = downscale > 1 and image_side is not None and image_side < smallest_side * downscale
        first, following = int(fraction * iterations), int(upcoming * iterations)
        if too_small or (first == following and downscale > 1):
            continue
        schedule.append((first if schedule else 0, downscale))
    return schedule


def downscale_at(schedule: Sequence[tuple[int, int]], iteration: int) -> int:
    """Return the downscale at `iteration` of a schedule from `resolution_schedule`."""
    current = schedule[0][1]
    for first, downscale in schedule:
        if iteration >= first:
            current = downscale
    return current


def downscale_for(schedule: Sequence[tuple[int, int]], iteration: int, n_splats: int, pixels: float) -> int:
    """Return the image downscale at `iteration`. With few splats per pixel, coarse stages last longer.

    Few splats learn as much from small images as from large ones. Above MANY_PIXELS pixels per splat the coarse stages
    become longer. From 2 * MANY_PIXELS on, their length is multiplied by LONGEST.

    Parameters
    ----------
    schedule : schedule from `resolution_schedule`.
    pixels : pixels of an image at full size.
    """
    plenty = min(max(pixels / (MANY_PIXELS * max(n_splats, 1)) - 1.0, 0.0), 1.0)
    return downscale_at(schedule, int(iteration / (1.0 + (LONGEST - 1.0) * plenty)))
