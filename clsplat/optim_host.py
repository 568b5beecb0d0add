"""The optimizer in NumPy: parameters travel to the host and back at each step. Slow, plain, the reference."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .buffers import SplatBuffers
from .gradients import CompactGradients
from .noise import normal3
from .optim_reference import NumpyAdam
from .optim_rules import Rules
from .plan import Plan
from .schema import Array, Field
from .sghmc import STREAM
from .sghmc import step as sghmc_step


class HostOptimizer:
    """See optim.Optimizer.

    Attributes
    ----------
    base, skew : Adam of the two blocks, each with its own count of steps.
    skew_s : (N, width) the trainable skew. momentum : (N, 3) of the means.
    """

    def __init__(self, splats: SplatBuffers, rules: Rules) -> None:
        self.splats, self.rules = splats, rules
        params = splats.download(splats.n)
        self.base = NumpyAdam({field.name: params[field.name] for field in rules.base_fields(splats.schema)})
        self.momentum = np.zeros_like(params["mean"])
        self.skew_s: Array = np.empty((splats.n, 0), splats.dtype)
        if rules.map is not None:
            self.skew_s = rules.map.inverse(params["skew"], params["quat"])
        self.skew = NumpyAdam({"skew": self.skew_s})

    def step(self, grads: CompactGradients, mean_lr: float, sh_degree: int, iteration: int) -> None:
        blocks, skew_map, n = self.rules.blocks(iteration), self.rules.map, self.splats.n
        params, gradients = self.splats.download(n), grads.written_out(n)
        for name, pull in self.rules.penalty(n).gradients(self.rules.shape, params).items():
            gradients[name] += pull
        maps = skew_map is not None and (blocks.skew or skew_map.rotates)
        if skew_map is not None and maps:
            gradients["skew"], v_quat = skew_map.vjp(self.skew_s, params["quat"], gradients["skew"])
            gradients["quat"] += v_quat
        if blocks.base:
            self.base.advance()
            for field in self.rules.base_fields(self.splats.schema):
                self._step_field(field, params, gradients[field.name], mean_lr, sh_degree, iteration)
        if skew_map is not None and blocks.skew:
            self.skew.step({"skew": self.skew_s}, gradients, self.rules.rates)
        if skew_map is not None and maps:
            params["skew"] = skew_map.forward(self.skew_s, params["quat"])
        self.splats.set(params)

    def apply(self, plan: Plan) -> None:
        old = self.splats.download(self.splats.n)
        before, after = {name: array[plan.source] for name, array in old.items()}, plan.apply(old)
        self.splats.set(after)
        if self.rules.map is not None:
            self.skew_s = self.rules.map.follow(self.skew_s[plan.source], before, after)
        for adam in (self.base, self.skew):
            for moments in (adam.first, adam.second):
                for name, moment in moments.items():
                    moments[name] = plan.apply_state(moment, name)
        self.momentum = plan.apply_state(self.momentum, "mean")

    def state(self) -> dict[str, NDArray[Any]]:
        state: dict[str, NDArray[Any]] = {"steps": np.array([self.base.step_count, self.skew.step_count])}
        for adam in (self.base, self.skew) if self.rules.map is not None else (self.base,):
            state |= {f"first.{name}": moment.copy() for name, moment in adam.first.items()}
            state |= {f"second.{name}": moment.copy() for name, moment in adam.second.items()}
        if self.rules.map is not None:
            state["skew_s"] = self.skew_s.copy()
        if self.rules.sghmc is not None:
            state["momentum"] = self.momentum.copy()
        return state

    def load_state(self, state: dict[str, NDArray[Any]]) -> None:
        self.rules.check_state(state, self.splats.schema)
        self.base.step_count, self.skew.step_count = (int(count) for count in state["steps"])
        for adam in (self.base, self.skew) if self.rules.map is not None else (self.base,):
            adam.first = {name: state[f"first.{name}"].copy() for name in adam.first}
            adam.second = {name: state[f"second.{name}"].copy() for name in adam.second}
        if self.rules.map is not None:
            self.skew_s = state["skew_s"].copy()
        if self.rules.sghmc is not None:
            self.momentum = state["momentum"].copy()

    def _step_field(self, field: Field, params: dict[str, Array], grad: Array, mean_lr: float, sh_degree: int,
                    iteration: int) -> None:
        """One step of a field of the base block; `mean` comes first, so that SGHMC sees the old covariance."""
        name, value = field.name, params[field.name]
        if field.bounds is not None:  # on the logarithm
            rise = self.base.direction(name, grad * value)
            value *= np.exp(-np.asarray(self.rules.rates[name], value.dtype) * rise)
            np.clip(value, *field.bounds, out=value)
        elif name == "mean" and self.rules.sghmc is not None:
            self._sghmc(params, grad, mean_lr, iteration)
        elif name == "mean":
            value -= np.asarray(mean_lr, value.dtype) * self.base.direction(name, grad)
        elif name == "sh":
            grad[:, (sh_degree + 1) ** 2 :] = 0
            rates = self.rules.sh_rates(field.width, value.dtype).reshape(1, -1, 3)
            value -= rates * self.base.direction(name, grad)
        else:
            value -= np.asarray(self.rules.rates[name], value.dtype) * self.base.direction(name, grad)

    def _sghmc(self, params: dict[str, Array], grad: Array, mean_lr: float, iteration: int) -> None:
        assert self.rules.sghmc is not None
        xi = normal3(self.rules.config.seed, iteration, len(grad), STREAM)
        params["mean"], self.momentum = sghmc_step(
            params["mean"], self.momentum, self.base.direction("mean", grad), xi, params["quat"], params["log_scale"],
            self.rules.shape.strength(params), self.rules.coefficients(self.rules.sghmc, iteration, mean_lr))
