"""The optimizer in NumPy, the reference of optim/fused.py. Each step copies all parameters to the host and back."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...rendering.splat_buffers import CompactGradients, SplatBuffers
from ...splats.fields import Array, Field
from ..density.edit import DensifyEdit
from ..methods.sns import ParameterGroups
from .adam import NumpyAdam
from .noise import normal3
from .rules import Rules, StepCounts, check_state
from .sghmc import STREAM
from .sghmc import step as sghmc_step

SplatIndices = slice | NDArray[np.int64]


class ReferenceOptimizer:
    """`Optimizer` (optim/optimizer.py) in NumPy.

    Attributes
    ----------
    base, skew : Adam of the base parameters and of the skew. Each has its own step count.
    skew_s : (N, width) the trainable skew.
    momentum : (N, 3) momentum of the means (SGHMC).
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

    def step(
        self, grads: CompactGradients, mean_lr: float, sh_degree: int, iteration: int, depth_key: Any = None
    ) -> None:
        groups, skew_map, n = self.rules.groups(iteration), self.rules.map, self.splats.n
        params, gradients = self.splats.download(n), grads.written_out(n)
        geometry, color = self._select(params, groups, depth_key)
        for name, penalty in self.rules.penalty(n).gradients(self.rules.shape, params).items():
            gradients[name] += penalty
        maps = skew_map is not None and (groups.skew or skew_map.rotates)
        if skew_map is not None and maps:
            gradients["skew"], v_quat = skew_map.vjp(self.skew_s, params["quat"], gradients["skew"])
            gradients["quat"] += v_quat
        if groups.base:
            self.base.advance()
            for field in self.rules.base_fields(self.splats.schema):
                rows = color if field.name == "sh" else geometry
                self._step_field(field, params, gradients[field.name], rows, mean_lr, sh_degree, iteration)
        if skew_map is not None and groups.skew:
            self.skew.advance()
            rate = np.asarray(self.rules.rates["skew"], self.skew_s.dtype)
            self.skew_s[geometry] -= rate * self.skew.direction("skew", gradients["skew"][geometry], geometry)
        if skew_map is not None and maps:
            params["skew"][geometry] = skew_map.forward(self.skew_s[geometry], params["quat"][geometry])
        self.splats.set(params)

    def settle(self) -> None:
        """Do nothing: this optimizer skips no steps."""

    def arranged(self, edit: DensifyEdit) -> DensifyEdit:
        return edit

    def read(self) -> dict[str, Array]:
        return self.splats.download(self.splats.n)

    def apply(self, edit: DensifyEdit) -> None:
        old = self.splats.download(self.splats.n)
        before, after = {name: array[edit.source] for name, array in old.items()}, edit.apply(old)
        self.splats.set(after)
        if self.rules.map is not None:
            self.skew_s = self.rules.map.follow(self.skew_s[edit.source], before, after)
        for adam in (self.base, self.skew):
            for moments in (adam.first, adam.second):
                for name, info in moments.items():
                    moments[name] = edit.apply_state(info, name)
        self.momentum = edit.apply_state(self.momentum, "mean")

    def state(self) -> dict[str, NDArray[Any]]:
        state: dict[str, NDArray[Any]] = {"steps": np.array([self.base.step_count, self.skew.step_count])}
        for adam in (self.base, self.skew) if self.rules.map is not None else (self.base,):
            state |= {f"first.{name}": info.copy() for name, info in adam.first.items()}
            state |= {f"second.{name}": info.copy() for name, info in adam.second.items()}
        if self.rules.map is not None:
            state["skew_s"] = self.skew_s.copy()
        if self.rules.sghmc is not None:
            state["momentum"] = self.momentum.copy()
        return state

    def load_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        check_state(state, self.state())
        self.base.step_count, self.skew.step_count = (int(count) for count in state["steps"])
        for adam in (self.base, self.skew) if self.rules.map is not None else (self.base,):
            adam.first = {name: state[f"first.{name}"].copy() for name in adam.first}
            adam.second = {name: state[f"second.{name}"].copy() for name in adam.second}
        if self.rules.map is not None:
            self.skew_s = state["skew_s"].copy()
        if self.rules.sghmc is not None:
            self.momentum = state["momentum"].copy()

    @property
    def counts(self) -> StepCounts:
        """Steps of the base parameters and of the skew."""
        return self.base.step_count, self.skew.step_count

    def _select(
        self, params: dict[str, Array], groups: ParameterGroups, depth_key: Any
    ) -> tuple[SplatIndices, SplatIndices]:
        """Return the splats with a step of the geometry and those with a step of the colour: all splats in both."""
        return slice(None), slice(None)

    def _step_field(
        self,
        field: Field,
        params: dict[str, Array],
        grad: Array,
        rows: SplatIndices,
        mean_lr: float,
        sh_degree: int,
        iteration: int,
    ) -> None:
        """Step a base field. The caller steps `mean` first, because SGHMC uses the old covariance."""
        name, value, grad = field.name, params[field.name][rows], grad[rows]
        if field.bounds is not None:  # in log space
            rise = self.base.direction(name, grad * value, rows)
            value *= np.exp(-np.asarray(self.rules.rates[name], value.dtype) * rise)
            np.clip(value, *field.bounds, out=value)
        elif name == "mean" and self.rules.sghmc is not None:
            value = self._sghmc(params, grad, mean_lr, iteration)
        elif name == "mean":
            value -= np.asarray(mean_lr, value.dtype) * self.base.direction(name, grad, rows)
        elif name == "sh":
            grad[:, (sh_degree + 1) ** 2 :] = 0
            rates = self.rules.sh_rates(field.width, value.dtype).reshape(1, -1, 3)
            value -= rates * self.base.direction(name, grad, rows)
        else:
            value -= np.asarray(self.rules.rates[name], value.dtype) * self.base.direction(name, grad, rows)
        params[name][rows] = value

    def _sghmc(self, params: dict[str, Array], grad: Array, mean_lr: float, iteration: int) -> Array:
        """Return the means after an SGHMC step of all splats."""
        assert self.rules.sghmc is not None
        xi = normal3(self.rules.config.seed, iteration, len(grad), STREAM)
        mean, self.momentum = sghmc_step(
            params["mean"],
            self.momentum,
            self.base.direction("mean", grad),
            xi,
            params["quat"],
            params["log_scale"],
            self.rules.shape.strength(params),
            self.rules.coefficients(self.rules.sghmc, iteration, mean_lr),
        )
        return mean
