"""The optimizer on the device (cl/optim.cl); equals optim_host's to rounding."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .buffers import ParameterBuffers, SplatBuffers, fill_zero, to_device, to_host
from .device import Device
from .kernels import KernelBuild
from .optim_reference import BETA1, BETA2
from .optim_rules import Rules
from .plan import Plan
from .program import GROUP_ITEMS, lane_group
from .schema import Array, Field, Group, Schema
from .sghmc import STREAM, Sghmc
from .skew_map import SkewMap


class Rows:
    """A buffer [width, capacity] beside the splats' own; zero at first. Its arrays are (n, width)."""

    def __init__(self, splats: SplatBuffers, width: int) -> None:
        self.device, self.width, self.capacity, self.dtype = splats.device, width, splats.capacity, splats.dtype
        nbytes = width * self.capacity * self.dtype.itemsize
        self.buffer, self.spare = (self.device.alloc(nbytes) for _ in range(2))
        fill_zero(self.device, self.buffer, nbytes)

    def set(self, array: Array) -> None:
        """Into the first columns; zero beyond."""
        rows = np.zeros((self.width, self.capacity), self.dtype)
        rows[:, : len(array)] = array.T
        to_device(self.device, self.buffer, rows)

    def get(self, n: int) -> Array:
        """The first n columns."""
        rows = np.empty((self.width, self.capacity), self.dtype)
        return np.ascontiguousarray(to_host(self.device, self.buffer, rows)[:, :n].T)


class TrainableSkew:
    """The trainable skew s, the gradient that the map's chain rule gives it, and Adam's moments of it."""

    def __init__(self, splats: SplatBuffers, skew_map: SkewMap, rate: float) -> None:
        self.map, self.steps = skew_map, 0
        self.s, self.grad, self.first, self.second = (Rows(splats, skew_map.width) for _ in range(4))
        values = splats.download(splats.n, ("skew", "quat"))
        self.s.set(skew_map.inverse(values["skew"], values["quat"]))
        rates = np.full(skew_map.width, rate, splats.dtype)
        self.rates = splats.device.alloc(rates.nbytes)
        to_device(splats.device, self.rates, rates)


class FusedOptimizer:
    """See optim.Optimizer."""

    def __init__(self, device: Device, kernels: KernelBuild, splats: SplatBuffers, rules: Rules) -> None:
        self.device, self.kernels, self.splats, self.rules = device, kernels, splats, rules
        self.program = kernels.optim_program(device)
        self._group = lane_group(device)
        self.steps = 0
        schema, dtype = splats.schema, splats.dtype
        # Of the size of the splats' own buffers, so that one spare serves all; the skew's rows are not used.
        self.first = ParameterBuffers(device, schema, splats.capacity, dtype)
        self.second = ParameterBuffers(device, schema, splats.capacity, dtype)
        self.spare = {group: device.alloc(splats.group_bytes(group)) for group in Group}
        self.skew = TrainableSkew(splats, rules.map, rules.rates["skew"]) if rules.map is not None else None
        self.momentum = Rows(splats, 3) if rules.sghmc is not None else None
        base = rules.base_fields(schema)
        self._base_names = tuple(field.name for field in base)
        self._bounded = [field for field in base if field.bounds is not None]
        plain = [field for field in base if field.group is Group.GEOM and field.bounds is None
                 and not (field.name == "mean" and self.momentum is not None)]
        self._runs = _runs(schema, plain)
        rates = [rules.rates.get(field.name, 0.0) for field in schema.group(Group.GEOM) for _ in range(field.width)]
        self._geom_rates = np.array(rates, dtype)
        sh_rates = rules.sh_rates(schema.rows(Group.SH), dtype)
        self._rate_buffers = {Group.GEOM: device.alloc(self._geom_rates.nbytes),
                              Group.SH: device.alloc(sh_rates.nbytes)}
        to_device(device, self._rate_buffers[Group.SH], sh_rates)

    def step(self, grads: ParameterBuffers, mean_lr: float, sh_degree: int, iteration: int) -> None:
        blocks, skew = self.rules.blocks(iteration), self.skew
        capacity = self.splats.capacity
        maps = skew is not None and (blocks.skew or skew.map.rotates)
        if skew is not None and maps:
            self.program.skew_map_vjp.over(self._columns, self._group, skew_s=skew.s.buffer, geom=self.splats.geom,
                                           grad_geom=grads.geom, v_s=skew.grad.buffer, capacity=capacity)
        if blocks.base:
            self._step_base(grads, mean_lr, sh_degree, iteration)
        if skew is not None and blocks.skew:
            skew.steps += 1
            self._adam(skew.s.buffer, skew.grad.buffer, skew.first.buffer, skew.second.buffer, skew.rates, 0,
                       skew.map.width, skew.steps)
        if skew is not None and maps:
            self.program.skew_map.over(self._columns, self._group, skew_s=skew.s.buffer, geom=self.splats.geom,
                                       capacity=capacity)

    def apply(self, plan: Plan) -> None:
        splats, n_old, n_new = self.splats, self.splats.n, len(plan.source)
        source = self._indices(plan.source)
        fresh = plan.fresh.copy()
        state_source = None
        if plan.state_source is None:
            fresh[n_old:] = True  # columns beyond the old count may hold an older state
        else:
            state_source = self._indices(plan.state_source)
        fresh_buffer = self.device.alloc(n_new)
        to_device(self.device, fresh_buffer, fresh.astype(np.uint8))
        for group in Group:
            rows = splats.schema.rows(group)
            splats.buffers[group], self.spare[group] = self._gather(
                splats.buffers[group], source, self.spare[group], n_new, rows)
            for moments in (self.first, self.second):
                if state_source is not None:
                    moments.buffers[group], self.spare[group] = self._gather(
                        moments.buffers[group], state_source, self.spare[group], n_new, rows)
                self._zero(moments.buffers[group], fresh_buffer, n_new, rows)
        for rows_of_state in self._own_state():
            if state_source is not None:
                self._gather_rows(rows_of_state, state_source, n_new)
            self._zero(rows_of_state.buffer, fresh_buffer, n_new, rows_of_state.width)
        splats.n = n_new
        self._set_values(plan, source)
        self._reset_fields(plan.reset_fields)

    def state(self) -> dict[str, NDArray[Any]]:
        n = self.splats.n
        state: dict[str, NDArray[Any]] = {"steps": np.array([self.steps, self.skew.steps if self.skew else 0])}
        for role, buffers in (("first", self.first), ("second", self.second)):
            state |= {f"{role}.{name}": array for name, array in buffers.download(n, self._base_names).items()}
        if self.skew is not None:
            state |= {"skew_s": self.skew.s.get(n), "first.skew": self.skew.first.get(n),
                      "second.skew": self.skew.second.get(n)}
        if self.momentum is not None:
            state["momentum"] = self.momentum.get(n)
        return state

    def load_state(self, state: dict[str, NDArray[Any]]) -> None:
        self.rules.check_state(state, self.splats.schema)
        self.steps = int(state["steps"][0])
        for role, buffers in (("first", self.first), ("second", self.second)):
            buffers.upload({name: state[f"{role}.{name}"] for name in self._base_names})
        if self.skew is not None:
            self.skew.steps = int(state["steps"][1])
            self.skew.s.set(state["skew_s"])
            self.skew.first.set(state["first.skew"])
            self.skew.second.set(state["second.skew"])
        if self.momentum is not None:
            self.momentum.set(state["momentum"])

    @property
    def _columns(self) -> int:
        """Work-items of a kernel over all splats."""
        return -(-self.splats.n // (self.kernels.lanes * GROUP_ITEMS)) * GROUP_ITEMS

    def _step_base(self, grads: ParameterBuffers, mean_lr: float, sh_degree: int, iteration: int) -> None:
        self.steps += 1
        if self.rules.sghmc is not None and self.momentum is not None:  # first: it sees the old covariance
            self._sghmc(self.rules.sghmc, self.momentum, grads, mean_lr, iteration)
        self._geom_rates[:3] = mean_lr
        to_device(self.device, self._rate_buffers[Group.GEOM], self._geom_rates)
        runs = [(Group.GEOM, *run) for run in self._runs] + [(Group.SH, 0, 3 * (sh_degree + 1) ** 2)]
        for group, first_row, rows in runs:
            self._adam(self.splats.buffers[group], grads.buffers[group], self.first.buffers[group],
                       self.second.buffers[group], self._rate_buffers[group], first_row, rows, self.steps)
        for field in self._bounded:
            assert field.bounds is not None
            self.program.adam_step_bounded.over(
                self._columns, self._group, value=self.splats.geom, grad=grads.geom, adam_m=self.first.geom,
                adam_v=self.second.geom, capacity=self.splats.capacity, row=self.splats.schema.offset(field.name),
                lr=self.rules.rates[field.name], low=field.bounds[0], high=field.bounds[1],
                **_corrections(self.steps))

    def _adam(self, value: Any, grad: Any, first: Any, second: Any, rates: Any, first_row: int, rows: int,
              steps: int) -> None:
        self.program.adam_step(
            (self._columns, rows), (GROUP_ITEMS, 1), value=value, grad=grad, adam_m=first, adam_v=second, lr=rates,
            capacity=self.splats.capacity, first_row=first_row, **_corrections(steps))

    def _sghmc(self, sghmc: Sghmc, momentum: Rows, grads: ParameterBuffers, mean_lr: float, iteration: int) -> None:
        c, seed = self.rules.coefficients(sghmc, iteration, mean_lr), self.rules.config.seed
        self.program.sghmc_step.over(
            self._columns, self._group, geom=self.splats.geom, grad_geom=grads.geom, adam_m=self.first.geom,
            adam_v=self.second.geom, momentum=momentum.buffer, capacity=self.splats.capacity,
            n_splats=self.splats.n, seed_lo=seed & 0xFFFFFFFF, seed_hi=seed >> 32, iteration=iteration,
            stream=STREAM, length=c.length, drive=c.drive, keep=c.keep, noise=c.noise,
            by_covariance=int(c.by_covariance), **_corrections(self.steps))

    def _own_state(self) -> list[Rows]:
        """State that is not in `first` and `second`."""
        state = [] if self.skew is None else [self.skew.first, self.skew.second]
        return state if self.momentum is None else [*state, self.momentum]

    def _set_values(self, plan: Plan, source: Any) -> None:
        """The plan's new values, and the trainable skew where it must follow them."""
        if self.skew is None:
            self.splats.upload(plan.values)
            return
        n, names = self.splats.n, ("skew", "quat")
        self._gather_rows(self.skew.s, source, n)
        if not any(name in plan.values for name in names):
            self.splats.upload(plan.values)
            return
        before = self.splats.download(n, names)
        self.splats.upload(plan.values)
        self.skew.s.set(self.skew.map.follow(self.skew.s.get(n), before, self.splats.download(n, names)))

    def _reset_fields(self, names: tuple[str, ...]) -> None:
        n, schema = self.splats.n, self.splats.schema
        for moments in (self.first, self.second):
            moments.upload({name: np.zeros((n, schema[name].width)) for name in names})
        if self.skew is not None and "skew" in names:
            for rows in (self.skew.first, self.skew.second):
                rows.set(np.zeros((0, rows.width)))
        if self.momentum is not None and "mean" in names:
            self.momentum.set(np.zeros((0, 3)))

    def _indices(self, source: NDArray[np.int64]) -> Any:
        buffer = self.device.alloc(4 * len(source))
        to_device(self.device, buffer, source.astype(np.int32))
        return buffer

    def _gather(self, values: Any, source: Any, spare: Any, n: int, rows: int) -> tuple[Any, Any]:
        """The gathered buffer and the one that is spare now."""
        self.program.gather_columns((-(-n // GROUP_ITEMS) * GROUP_ITEMS, rows), (GROUP_ITEMS, 1), values=values,
                                    source=source, moved=spare, capacity=self.splats.capacity, n=n)
        return spare, values

    def _gather_rows(self, rows: Rows, source: Any, n: int) -> None:
        rows.buffer, rows.spare = self._gather(rows.buffer, source, rows.spare, n, rows.width)

    def _zero(self, values: Any, fresh: Any, n: int, rows: int) -> None:
        self.program.zero_columns((-(-n // GROUP_ITEMS) * GROUP_ITEMS, rows), (GROUP_ITEMS, 1), values=values,
                                  fresh=fresh, capacity=self.splats.capacity, n=n)


def _corrections(steps: int) -> dict[str, float]:
    """Adam's bias corrections after `steps`."""
    return {"correct1": 1 / (1 - BETA1**steps), "correct2": 1 / (1 - BETA2**steps)}


def _runs(schema: Schema, fields: list[Field]) -> list[tuple[int, int]]:
    """(first row, rows) of each run of neighbouring fields of geom."""
    runs: list[tuple[int, int]] = []
    for field in fields:
        start = schema.offset(field.name)
        if runs and sum(runs[-1]) == start:
            runs[-1] = (runs[-1][0], runs[-1][1] + field.width)
        else:
            runs.append((start, field.width))
    return runs
