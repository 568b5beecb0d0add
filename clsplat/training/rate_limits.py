"""Learning rates that no training survives: refused before it starts.

Adam's step is about its rate, whatever the gradient, so a rate has a size of its own: a fraction of the scene, a
factor of scale, an angle. The limits are where runs on a capture (200 iterations, 64 px) and on fox (300, -r 4)
began to lose more than half a decibel (benchmarks/STABILITY.md).
"""

from __future__ import annotations

import math

from ..errors import InputError
from .config import OPTIONS, TrainConfig

# By option: the field whose rates grow in short runs with it, and the most that a step may be.
LIMITS = {
    "position_lr_init": ("mean", 0.03),  # scene extents
    "position_lr_final": ("mean", 0.03),
    "scaling_lr": ("log_scale", 0.1),  # of a logarithm
    "rotation_lr": ("quat", 0.1),  # of a quaternion, about half the angle [rad]
    "opacity_lr": ("opacity_logit", 0.4),  # of a logit
    "feature_lr": ("sh", 0.08),  # of a colour's coefficient
}


def check_rates(config: TrainConfig) -> None:
    """Raise InputError naming the first rate that is too high for the length of the run.

    The default rates always pass, in runs of a few iterations too.
    """
    for name, (grows_with, limit) in LIMITS.items():
        rate, default = float(getattr(config.optim, name)), float(OPTIONS[name].default)
        factor = config.rate_factor(grows_with)
        most = max(limit / factor, default)
        if rate > most:
            digit = 10.0 ** (math.floor(math.log10(most)) - 1)
            usable = digit * math.floor(most / digit)  # rounded down: it must pass
            raise InputError(
                f"{name} {rate:g}: each of {config.iterations} iterations would take steps of "
                f"{rate * factor:.2g}, and training falls apart above {limit:g}: use at most {usable:.2g}"
            )
