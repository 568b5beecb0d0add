"""Rules of both optimizers: rates, regularisers, skew map, optimizer of the positions, groups that learn."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...splats.fields import Array, Field, Schema
from ...splats.shapes import Shape, shape_named
from ..config import TrainConfig
from ..methods.sns import ParameterGroups, learning_groups
from ..methods.sss import PublishedSghmc
from .noise import PUBLISHED_EXTENT
from .regularisers import Penalty
from .sghmc import Coefficients, Sghmc
from .skew_map import SkewMap

StepCounts = tuple[int, int]  # steps of the base parameters and of the skew

SH_REST_FACTOR = 1.0 / 20.0  # 3DGS: bands above the constant learn 20 times slower
SH_REST_POWER = 1.0 / 4.0  # of the length factor of their rate (`TrainConfig.rate_factor`)


# Options that hold the rates of the core fields, of colour and of the second opacity.
_RATE_OPTIONS = {
    "quat": "rotation_lr",
    "log_scale": "scaling_lr",
    "opacity_logit": "opacity_lr",
    "opacity_minus_logit": "opacity_lr",
    "sh": "feature_lr",
}


def rate_option(field: Field) -> str:
    """Return the name of the option with a field's learning rate.

    The option of a field NAME of a shape is NAME_lr. It may not exist if the shape was registered.
    """
    return _RATE_OPTIONS.get(field.name, f"{field.name}_lr")


def field_rate(config: TrainConfig, field: Field) -> float:
    """Return the learning rate of a field: its option, or the rate in its descriptor if no option has a value."""
    value: float | None = getattr(config.optim, rate_option(field), None)
    return field.lr if value is None else value


def run_rate(config: TrainConfig, field: Field) -> float:
    """Return Adam's rate of a field in a run, its learning rate times all factors. "sh" is the constant band here."""
    factor = 1.0 if field.name == "sh" else config.optim.lr_factor
    return field_rate(config, field) * config.rate_factor(field.name) * factor


def run_rest_rate(config: TrainConfig) -> float:
    """Return Adam's rate of the SH bands above the constant one in a run."""
    rate = config.optim.feature_rest_lr
    rate = SH_REST_FACTOR * config.optim.feature_lr if rate is None else rate
    return rate * config.length_factor(SH_REST_POWER) * config.optim.lr_factor


@dataclass(frozen=True)
class Rules:
    """Values of the config that the optimizers use. extent : extent of the scene [world units]."""

    config: TrainConfig
    extent: float

    @property
    def shape(self) -> Shape:
        return shape_named(self.config.shape)

    @cached_property
    def rates(self) -> dict[str, float]:
        """Adam's rate of each field except the mean. The rate of the mean is an argument of each step."""
        return {field.name: run_rate(self.config, field) for field in self.shape.schema(0) if field.name != "mean"}

    def sh_rates(self, rows: int, dtype: np.dtype[np.floating]) -> Array:
        """Return the rate of each row of the colour. The first three rows are the constant band."""
        rates = np.full(rows, self.rates["sh"], dtype)
        rates[3:] = run_rest_rate(self.config)
        return rates

    def penalty(self, n: int) -> Penalty:
        """Return the regularisers of n splats. The weights of the config belong to means over splats.

        Scales are in world units, as published. In scenes larger than the published ones, they are in units of the
        extent. Otherwise the regulariser would be larger than the image loss.
        """
        config = self.config
        scale = config.density.scale_reg * min(PUBLISHED_EXTENT / self.extent, 1.0)
        return Penalty(config.density.opacity_reg / n, scale / (3 * n), config.loss.bisect_reg / n)

    @cached_property
    def map(self) -> SkewMap | None:
        """Map of the trainable skew; None for shapes without a skew."""
        return SkewMap(self.config.skew_map) if self.config.skew_map else None

    @cached_property
    def sghmc(self) -> Sghmc | None:
        """SGHMC of the positions; None if Adam moves them."""
        config = self.config
        if config.sghmc.position_optimizer == "adam":
            return None
        return (PublishedSghmc if config.sghmc.position_optimizer == "sghmc-sss" else Sghmc)(
            self.extent,
            config.sghmc.sghmc_friction,
            config.sghmc.sghmc_burn_in_friction,
            int(config.sghmc.sghmc_burn_in * config.iterations),
        )

    def coefficients(self, sghmc: Sghmc, iteration: int, mean_lr: float) -> Coefficients:
        """Return the coefficients of an SGHMC step. mean_lr : the rate of an Adam step."""
        factor = self.config.rate_factor("mean")
        return sghmc.coefficients(iteration, mean_lr / factor, factor)

    def groups(self, iteration: int) -> ParameterGroups:
        """Return the parameter groups that learn at `iteration`. The skew never learns in shapes without a skew."""
        base, skew = learning_groups(iteration, self.config)
        return ParameterGroups(base, skew and self.map is not None)

    def base_fields(self, schema: Schema) -> tuple[Field, ...]:
        """Return all fields except the skew."""
        return tuple(field for field in schema if field.name != "skew")

    @property
    def geometry_waits(self) -> bool:
        """Whether `visible_adam` skips steps of the geometry too: without regularisers, noise and SGHMC."""
        config = self.config
        pulled = config.density.opacity_reg or config.density.scale_reg or config.loss.bisect_reg
        return not (pulled or config.density.noise_lr or self.sghmc)


def check_state(state: Mapping[str, NDArray[Any]], expected: Mapping[str, NDArray[Any]]) -> None:
    """Compare an optimizer state with one of the optimizer that is to continue from it.

    Raises
    ------
    InputError : an entry is missing, unknown, or of another shape.
    """
    if odd := sorted(expected.keys() ^ state.keys()):
        raise InputError(f"checkpoint: the optimizer's {odd[0]!r} is missing or unknown: start with --overwrite")
    for name, array in expected.items():
        if state[name].shape != array.shape:
            raise InputError(
                f"checkpoint: the optimizer's {name!r} has the shape {state[name].shape}, but {array.shape} is "
                "expected: start with --overwrite"
            )
