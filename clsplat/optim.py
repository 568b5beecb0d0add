"""Optimizers over splats on the device: the fused kernels, and NumPy's reference behind the same face."""

from __future__ import annotations

from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from .buffers import ParameterBuffers, SplatBuffers, to_device, to_host
from .config import TrainConfig
from .device import Device
from .kernels import KernelBuild
from .optim_reference import BETA1, BETA2, SH_REST_FACTOR, NumpyAdam
from .plan import Plan
from .program import GROUP_ITEMS, lane_group
from .schema import Array, Group
from .skew_map import SkewMap


class Optimizer(Protocol):
    """Steps the splats; owns the moments and the trainable skew s, of which the splats hold m."""

    def step(self, grads: ParameterBuffers, mean_lr: float, sh_degree: int, iteration: int) -> None:
        """One step on all splats.

        Parameters
        ----------
        grads : of the stored parameters; the optimizer may change them.
        mean_lr : Adam's rate of the means at this iteration, scene extent and rate factor included [world units].
        sh_degree : SH bands above it stay.
        iteration : from 1; decides which blocks learn, and the noise.
        """

    def apply(self, plan: Plan) -> None:
        """Move, add and reset splats as planned."""

    def state(self) -> dict[str, NDArray[Any]]:
        """Everything but the splats themselves, for a checkpoint."""

    def load_state(self, state: dict[str, NDArray[Any]]) -> None:
        """Go on from `state`."""


def field_rates(config: TrainConfig) -> dict[str, float]:
    """Adam's rate per field; the mean's changes with the iteration and is set at each step."""
    rates = {"quat": config.rotation_lr, "log_scale": config.scaling_lr, "opacity_logit": config.opacity_lr,
             "sh": config.feature_lr, "skew": config.skew_lr}
    return {name: rate * config.rate_factor(name) for name, rate in rates.items()}


def make_optimizer(device: Device, kernels: KernelBuild, splats: SplatBuffers, config: TrainConfig,
                   extent: float) -> Optimizer:
    """The optimizer that the config names; `extent` of the scene [world units]."""
    return (FusedAdam if config.optimizer == "fused" else HostAdam)(device, kernels, splats, config)


class FusedAdam:
    """Adam on the device (cl/optim.cl); equals NumpyAdam to rounding."""

    def __init__(self, device: Device, kernels: KernelBuild, splats: SplatBuffers, config: TrainConfig) -> None:
        self.device, self.splats, self.kernels = device, splats, kernels
        self.program = kernels.optim_program(device)
        self._group = lane_group(device)
        self.rates = field_rates(config)
        self.steps = 0
        schema, capacity, dtype = splats.schema, splats.capacity, splats.dtype
        self.first = ParameterBuffers(device, schema, capacity, dtype)
        self.second = ParameterBuffers(device, schema, capacity, dtype)
        self.spare = {group: device.alloc(splats.group_bytes(group)) for group in Group}
        self.skewed = "skew" in schema
        self.map = SkewMap(config.map or "cube-root")
        if self.skewed:
            self._skew_bytes = 3 * splats.capacity * dtype.itemsize
            self.skew_s, self.skew_spare = device.alloc(self._skew_bytes), device.alloc(self._skew_bytes)
            self._set_skew(self.map.inverse(splats.download(splats.n, ("skew",))["skew"]))
        # Rows that Adam steps by table: all of geom but the skew, which has its own kernel and comes last.
        self._rows = schema.rows(Group.GEOM) - (3 if self.skewed else 0)
        rows = [self.rates.get(f.name, 0.0) for f in schema.group(Group.GEOM) for _ in range(f.width)]
        self._geom_rates = np.array(rows, dtype)
        n_sh = schema.rows(Group.SH)
        sh_rates = np.full(n_sh, self.rates["sh"], dtype)
        sh_rates[3:] *= SH_REST_FACTOR
        self._rate_buffers = {Group.GEOM: device.alloc(self._geom_rates.nbytes),
                              Group.SH: device.alloc(sh_rates.nbytes)}
        to_device(device, self._rate_buffers[Group.SH], sh_rates)

    def step(self, grads: ParameterBuffers, mean_lr: float, sh_degree: int, iteration: int) -> None:
        self.steps += 1
        correct = {"correct1": 1 / (1 - BETA1**self.steps), "correct2": 1 / (1 - BETA2**self.steps)}
        self._geom_rates[:3] = mean_lr
        to_device(self.device, self._rate_buffers[Group.GEOM], self._geom_rates)
        columns = -(-self.splats.n // (self.kernels.lanes * GROUP_ITEMS)) * GROUP_ITEMS
        for group, rows in ((Group.GEOM, self._rows), (Group.SH, 3 * (sh_degree + 1) ** 2)):
            self.program.adam_step(
                (columns, rows), (GROUP_ITEMS, 1), value=self.splats.buffers[group], grad=grads.buffers[group],
                adam_m=self.first.buffers[group], adam_v=self.second.buffers[group], lr=self._rate_buffers[group],
                capacity=self.splats.capacity, first_row=0, **correct,
            )
        if self.skewed:
            self.program.adam_step_skew.over(
                columns, self._group, skew_s=self.skew_s, geom=self.splats.geom, grad_geom=grads.geom,
                adam_m=self.first.geom, adam_v=self.second.geom, capacity=self.splats.capacity,
                lr=self.rates["skew"], **correct,
            )

    def apply(self, plan: Plan) -> None:
        n_new, splats = len(plan.source), self.splats
        source = self.device.alloc(4 * n_new)
        to_device(self.device, source, plan.source.astype(np.int32))
        fresh = self.device.alloc(n_new)
        to_device(self.device, fresh, plan.fresh.astype(np.uint8))
        for group in Group:
            rows = splats.schema.rows(group)
            self._gather(splats.buffers[group], source, self.spare[group], n_new, rows)
            splats.buffers[group], self.spare[group] = self.spare[group], splats.buffers[group]
            for moments in (self.first, self.second):
                self.program.zero_columns(self._columns(n_new, rows), (GROUP_ITEMS, 1),
                                          values=moments.buffers[group], fresh=fresh, capacity=splats.capacity,
                                          n=n_new)
        if self.skewed:
            self._gather(self.skew_s, source, self.skew_spare, n_new, 3)
            self.skew_s, self.skew_spare = self.skew_spare, self.skew_s
        splats.n = n_new
        splats.upload(plan.values)

    def state(self) -> dict[str, NDArray[Any]]:
        n = self.splats.n
        state: dict[str, NDArray[Any]] = {"steps": np.array(self.steps)}
        for role, buffers in (("first", self.first), ("second", self.second)):
            state |= {f"{role}.{name}": array for name, array in buffers.download(n).items()}
        if self.skewed:
            rows = np.empty((3, self.splats.capacity), self.splats.dtype)
            state["skew_s"] = to_host(self.device, self.skew_s, rows)[:, :n].T.copy()
        return state

    def load_state(self, state: dict[str, NDArray[Any]]) -> None:
        self.steps = int(state["steps"])
        for role, buffers in (("first", self.first), ("second", self.second)):
            buffers.upload({name: state[f"{role}.{name}"] for name in self.splats.schema.names})
        if self.skewed:
            self._set_skew(state["skew_s"])

    def _gather(self, values: Any, source: Any, moved: Any, n: int, rows: int) -> None:
        self.program.gather_columns(self._columns(n, rows), (GROUP_ITEMS, 1), values=values, source=source,
                                    moved=moved, capacity=self.splats.capacity, n=n)

    @staticmethod
    def _columns(n: int, rows: int) -> tuple[int, int]:
        return -(-n // GROUP_ITEMS) * GROUP_ITEMS, rows

    def _set_skew(self, s: Array) -> None:
        rows = np.zeros((3, self.splats.capacity), self.splats.dtype)
        rows[:, : len(s)] = s.T
        to_device(self.device, self.skew_s, rows)


class HostAdam:
    """The same in NumPy: parameters travel to the host and back at each step. Slow, plain, always there."""

    def __init__(self, device: Device, kernels: KernelBuild, splats: SplatBuffers, config: TrainConfig) -> None:
        self.splats, self.adam, self.rates = splats, NumpyAdam(), field_rates(config)
        self.map = SkewMap(config.map or "cube-root")
        self.skewed = "skew" in splats.schema
        self.skew_s: Array = np.empty(0)
        if self.skewed:
            self.skew_s = self.map.inverse(splats.download(splats.n, ("skew",))["skew"])

    def step(self, grads: ParameterBuffers, mean_lr: float, sh_degree: int, iteration: int) -> None:
        n = self.splats.n
        params, gradients = self.splats.download(n), grads.download(n)
        rates: dict[str, Any] = self.rates | {"mean": mean_lr}
        used = (sh_degree + 1) ** 2
        bands = np.full((1, params["sh"].shape[1], 1), self.rates["sh"])
        bands[:, 1:] *= SH_REST_FACTOR
        rates["sh"] = bands
        gradients["sh"][:, used:] = 0
        if self.skewed:
            gradients["skew"] = self.map.vjp(self.skew_s, gradients["skew"])
            params["skew"] = self.skew_s
        self.adam.step(params, gradients, {name: rates[name] for name in params})
        if self.skewed:
            self.skew_s = params["skew"]
            params["skew"] = self.map.forward(self.skew_s)
        self.splats.set(params)

    def apply(self, plan: Plan) -> None:
        arrays = {name: array[plan.source] for name, array in self.splats.download(self.splats.n).items()}
        self.splats.set(arrays)
        self.adam.relocate(plan.fresh)
        if self.skewed:
            self.skew_s = self.skew_s[plan.source]
        self.splats.upload(plan.values)

    def state(self) -> dict[str, NDArray[Any]]:
        state: dict[str, NDArray[Any]] = dict(self.adam.state_dict())
        return state | ({"skew_s": self.skew_s} if self.skewed else {})

    def load_state(self, state: dict[str, NDArray[Any]]) -> None:
        self.adam.load_state_dict({k: v for k, v in state.items() if k != "skew_s"})
        if self.skewed:
            self.skew_s = state["skew_s"]
