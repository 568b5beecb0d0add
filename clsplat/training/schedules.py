"""What changes during a run: learning rate and SH degree with the iteration, resolution also with the splats.

Iterations count from 1, as in 3DGS; every function also accepts 0.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise

from ..errors import InputError
from .config import TrainConfig
from .options.density import Mcmc

# (fraction of the run, downscale): coarse to fine, the last half at full resolution.
COARSE_TO_FINE = ((0.0, 4), (0.2, 2), (0.5, 1))
MANY_PIXELS = 8.0  # of the image for each splat: above it coarse stages last longer
LONGEST = 1.3  # times as long: full resolution from 0.65 of the run


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
            exponential_decay(config.optim.position_lr_init, config.optim.position_lr_final, steps),
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
    actions = max(window // config.density.densify_interval // 2, 1)
    return float(max(config.density.growth, (config.cap_max / n_first) ** (1 / actions)))


def exponential_decay(start: float, end: float, steps: int) -> Callable[[int], float]:
    """Log-linear from `start` at iteration 0 to `end` at `steps`, constant beyond (3DGS's positions).

    Parameters
    ----------
    start, end : learning rates, both above 0.
    steps : iterations from one to the other, at least 1.

    Raises
    ------
    InputError : a rate not above 0 or not finite, or fewer than one step.
    """
    if not (0 < start < math.inf and 0 < end < math.inf):
        raise InputError(f"learning rates {start} -> {end}: both must be above 0 and finite")
    if steps < 1:
        raise InputError(f"a decay over {steps} iterations: needs at least 1")
    ratio = math.log(end / start)

    def rate(iteration: int) -> float:
        return start * math.exp(ratio * min(max(iteration / steps, 0.0), 1.0))

    return rate


def sh_degree_at(iteration: int, interval: int, max_degree: int) -> int:
    """SH degree in use: one more every `interval` iterations up to `max_degree`; all if `interval` is 0."""
    if interval <= 0:
        return max_degree
    return min(max_degree, max(iteration, 0) // interval)


def resolution_schedule(
    iterations: int,
    stages: Sequence[tuple[float, int]] = COARSE_TO_FINE,
    image_side: int | None = None,
    smallest_side: int = 64,
) -> list[tuple[int, int]]:
    """When each image downscale begins.

    Parameters
    ----------
    iterations : length of the run.
    stages : (fraction of the run in [0, 1), integer downscale); the first fraction is 0, fractions rise,
        downscales fall and the last is 1, so that a run always ends at full resolution.
    image_side : shorter side of the smallest image [px]; a downscale that would leave less than
        `smallest_side` is replaced by the next finer one of the schedule.

    Returns
    -------
    List of (first iteration, downscale), the first at iteration 0, without empty or repeated stages.

    Raises
    ------
    InputError : stages out of order.
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
    """Downscale of `iteration` in a schedule from `resolution_schedule`."""
    current = schedule[0][1]
    for first, downscale in schedule:
        if iteration >= first:
            current = downscale
    return current


def downscale_for(schedule: Sequence[tuple[int, int]], iteration: int, n_splats: int, pixels: float) -> int:
    """Downscale of `iteration`: the schedule's, later where splats are few: they learn as much from small images.

    From MANY_PIXELS to twice as many pixels a splat, the stages grow longer, by LONGEST at most.

    Parameters
    ----------
    schedule : from `resolution_schedule`. pixels : of an image at full size.
    """
    plenty = min(max(pixels / (MANY_PIXELS * max(n_splats, 1)) - 1.0, 0.0), 1.0)
    return downscale_at(schedule, int(iteration / (1.0 + (LONGEST - 1.0) * plenty)))
