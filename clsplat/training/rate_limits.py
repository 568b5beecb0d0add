"""Upper limits of learning rates: rates that make every run diverge are refused before the run starts.

The size of Adam's step is about its rate and does not depend on the gradient. So each rate has a meaning: a fraction of
the scene, a factor of the scale, an angle. benchmarks/STABILITY.md has the measurements of the limits.
"""

from __future__ import annotations

import math

from ..errors import InputError
from .config import OPTIONS, TrainConfig
from .optim.rules import SH_REST_POWER

# By option: the field with the `rate_factor` that applies, and the largest step per iteration.
LIMITS = {
    "position_lr_init": ("mean", 0.03),  # scene extents
    "position_lr_final": ("mean", 0.03),
    "scaling_lr": ("log_scale", 0.1),  # change of a logarithm
    "rotation_lr": ("quat", 0.1),  # change of a quaternion, about half the angle [rad]
    "opacity_lr": ("opacity_logit", 0.4),  # change of a logit
    "feature_lr": ("sh", 0.08),  # change of a colour coefficient
    "feature_rest_lr": ("sh", 0.08),
}
_WITHOUT_FACTOR = ("position_lr_final", "feature_lr")  # `lr_factor` does not apply to these


def check_rates(config: TrainConfig) -> None:
    """Check the learning rates for the length of the run. The default rates always pass, also in very short runs.

    Raises
    ------
    InputError : names the first rate that is too high, and the highest usable one. It names `lr_factor` if the rate
        itself is not too high.
    """
    for name, (field, limit) in LIMITS.items():
        rate, default = getattr(config.optim, name), OPTIONS[name].default or 0.0
        if rate is None:
            continue
        length = config.length_factor(SH_REST_POWER) if name == "feature_rest_lr" else config.rate_factor(field)
        highest = max(limit / length, default)
        if rate > highest:
            raise _too_high(config, name, rate, rate * length, limit, highest)
        factor = 1.0 if name in _WITHOUT_FACTOR else config.optim.lr_factor
        if factor > 1 and factor * rate * length > limit:
            raise _too_high(
                config, "lr_factor", factor, factor * rate * length, limit, max(limit / (rate * length), 1.0)
            )


def _too_high(config: TrainConfig, name: str, value: float, step: float, limit: float, highest: float) -> InputError:
    """Return the error of an option whose value leads to steps above the limit. highest : highest usable value."""
    digit = 10.0 ** (math.floor(math.log10(highest)) - 1)
    usable = digit * math.floor(highest / digit)  # rounded down, so that the check accepts it
    return InputError(
        f"{name} {value:g}: each of {config.iterations} iterations would take steps of {step:.2g}, and training falls "
        f"apart above {limit:g}: use at most {usable:.2g}"
    )
