"""The optimizer in NumPy: parameters travel to the host and back at each step. Slow, plain, the reference."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...device.memory import to_host
from ...rendering.splat_buffers import CompactGradients, SplatBuffers
from ...splats.fields import Array, Field
from ..density.edit import DensifyEdit
from .adam import NumpyAdam
from .lazy import DRIFT, DRIFT_MEAN, DRIFT_SKEW, Drifts, Steps, ascent, woken
from .noise import normal3
from .rules import Rules
from .sghmc import STREAM
from .sghmc import step as sghmc_step

Rows = slice | NDArray[np.int64]  # of splats
CULLED_KEY = 0xFFFFFFFF  # cl/render/project.cl


class HostOptimizer:
    """See optim.Optimizer.

    Attributes
    ----------
    base, skew : Adam of the two blocks, each with its own count of steps.
    skew_s : (N, width) the trainable skew. momentum : (N, 3) of the means.
    last : (2, V) the counts of steps that each vector of `lanes` splats was brought up to, with `visible_adam`.
    """

    def __init__(self, splats: SplatBuffers, rules: Rules, lanes: int) -> None:
        self.splats, self.rules, self.lanes = splats, rules, lanes
        params = splats.download(splats.n)
        self.base = NumpyAdam({field.name: params[field.name] for field in rules.base_fields(splats.schema)})
        self.momentum = np.zeros_like(params["mean"])
        self.skew_s: Array = np.empty((splats.n, 0), splats.dtype)
        if rules.map is not None:
            self.skew_s = rules.map.inverse(params["skew"], params["quat"])
        self.skew = NumpyAdam({"skew": self.skew_s})
        self.drifts = Drifts()
        self._none_waits()

    def step(
        self, grads: CompactGradients, mean_lr: float, sh_degree: int, iteration: int, depth_key: Any = None
    ) -> None:
        blocks, skew_map, n = self.rules.blocks(iteration), self.rules.map, self.splats.n
        params, gradients = self.splats.download(n), grads.written_out(n)
        geometry: Rows = slice(None)  # the splats that step
        colour: Rows = slice(None)
        if self.rules.config.optim.visible_adam:
            vectors = woken(self._seen(depth_key), self.last, self._counts, self.lanes)
            colour = np.flatnonzero(np.repeat(vectors, self.lanes)[:n])
            geometry = colour if self.rules.geometry_waits else geometry
            self.skew_s = self._caught_up(params, self.skew_s, colour)
            self.last[:, vectors] = np.array([self._counts]).T + np.array([blocks]).T
        for name, pull in self.rules.penalty(n).gradients(self.rules.shape, params).items():
            gradients[name] += pull
        maps = skew_map is not None and (blocks.skew or skew_map.rotates)
        if skew_map is not None and maps:
            gradients["skew"], v_quat = skew_map.vjp(self.skew_s, params["quat"], gradients["skew"])
            gradients["quat"] += v_quat
        if blocks.base:
            self.base.advance()
            for field in self.rules.base_fields(self.splats.schema):
                rows = colour if field.name == "sh" else geometry
                self._step_field(field, params, gradients[field.name], rows, mean_lr, sh_degree, iteration)
        if skew_map is not None and blocks.skew:
            self.skew.advance()
            rate = np.asarray(self.rules.rates["skew"], self.skew_s.dtype)
            self.skew_s[geometry] -= rate * self.skew.direction("skew", gradients["skew"][geometry], geometry)
        if skew_map is not None and maps:
            params["skew"][geometry] = skew_map.forward(self.skew_s[geometry], params["quat"][geometry])
        self.splats.set(params)
        self.drifts.advance(blocks, self._counts, mean_lr)

    def settle(self) -> None:
        if self.rules.config.optim.visible_adam:
            params = self.splats.download(self.splats.n)
            self.skew_s = self._caught_up(params, self.skew_s, slice(None))
            self.splats.set(params)
            self._none_waits()

    def read(self) -> dict[str, Array]:
        params = self.splats.download(self.splats.n)
        if self.rules.config.optim.visible_adam:
            self._caught_up(params, self.skew_s, slice(None), keeps_moments=True)
        return params

    def apply(self, edit: DensifyEdit) -> None:
        self.settle()
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
        self._none_waits()

    def state(self) -> dict[str, NDArray[Any]]:
        state: dict[str, NDArray[Any]] = {"steps": np.array([self.base.step_count, self.skew.step_count])}
        for adam in (self.base, self.skew) if self.rules.map is not None else (self.base,):
            state |= {f"first.{name}": info.copy() for name, info in adam.first.items()}
            state |= {f"second.{name}": info.copy() for name, info in adam.second.items()}
        if self.rules.map is not None:
            state["skew_s"] = self.skew_s.copy()
        if self.rules.sghmc is not None:
            state["momentum"] = self.momentum.copy()
        if self.rules.config.optim.visible_adam:
            state |= {"waiting.last": self.last.astype(np.uint32), "waiting.drifts": self.drifts.sums.copy()}
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
        if self.rules.config.optim.visible_adam:
            self.last, self.drifts.sums = state["waiting.last"].astype(np.int64), state["waiting.drifts"].copy()

    @property
    def _counts(self) -> Steps:
        return self.base.step_count, self.skew.step_count

    def _none_waits(self) -> None:
        """All vectors are up to date, whatever splats they hold."""
        self.last = np.repeat(np.array([self._counts]).T, -(-self.splats.n // self.lanes), axis=1)

    def _seen(self, depth_key: Any) -> NDArray[np.bool_]:
        keys = to_host(self.splats.device, depth_key, np.empty(self.splats.n, np.uint32))
        seen: NDArray[np.bool_] = keys != CULLED_KEY
        return seen

    def _caught_up(self, params: dict[str, Array], skew_s: Array, rows: Rows, keeps_moments: bool = False) -> Array:
        """Do the steps that the splats `rows` sat out, in `params`; returns the trainable skew after them."""
        rules, skew_map, dtype = self.rules, self.rules.map, self.splats.dtype
        waited = np.repeat(np.array([self._counts]).T - self.last, self.lanes, axis=1)[:, : self.splats.n]
        base, skew = waited[0][rows], waited[1][rows]
        table = self.drifts.table.astype(dtype)
        fields = rules.base_fields(self.splats.schema)
        for field in fields if rules.geometry_waits else [field for field in fields if field.name == "sh"]:
            rate: Array = np.asarray(rules.rates.get(field.name, 1.0), dtype)
            if field.name == "sh":
                rate = rules.sh_rates(field.width, dtype).reshape(1, -1, 3)
            kind = DRIFT_MEAN if field.name == "mean" else DRIFT
            moved = self._drift(self.base, field.name, rows, base, table, kind, rate, keeps_moments)
            if field.bounds is not None:  # on the logarithm
                params[field.name][rows] = np.clip(params[field.name][rows] * np.exp(-moved), *field.bounds)
            else:
                params[field.name][rows] -= moved
        if skew_map is None or not rules.geometry_waits:
            return skew_s
        skew_s = skew_s.copy()
        rate = np.asarray(rules.rates["skew"], dtype)
        skew_s[rows] -= self._drift(self.skew, "skew", rows, skew, table, DRIFT_SKEW, rate, keeps_moments)
        changed = np.arange(len(skew_s))[rows][(skew > 0) | skew_map.rotates]
        params["skew"][changed] = skew_map.forward(skew_s[changed], params["quat"][changed])
        return skew_s

    def _drift(
        self,
        adam: NumpyAdam,
        name: str,
        rows: Rows,
        waited: NDArray[np.int64],
        table: Array,
        kind: int,
        rate: Array,
        keeps_moments: bool,
    ) -> Array:
        """How far a field's values fall; the moments shrink unless kept."""
        first, second = adam.first[name][rows], adam.second[name][rows]
        decay1, decay2, drift = (table[row][waited].reshape(-1, *[1] * (first.ndim - 1)) for row in (0, 1, 2 + kind))
        moved: Array = rate * drift * ascent(first, second)
        if not keeps_moments:
            adam.first[name][rows], adam.second[name][rows] = first * decay1, second * decay2
        return moved

    def _step_field(
        self,
        field: Field,
        params: dict[str, Array],
        grad: Array,
        rows: Rows,
        mean_lr: float,
        sh_degree: int,
        iteration: int,
    ) -> None:
        """One step of a field of the base block; `mean` comes first, so that SGHMC sees the old covariance."""
        name, value, grad = field.name, params[field.name][rows], grad[rows]
        if field.bounds is not None:  # on the logarithm
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
        """The means after one step of all splats."""
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
