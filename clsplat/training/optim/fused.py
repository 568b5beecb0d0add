"""The optimizer on the device (cl/train/optim.cl); equals optim_host's to rounding."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...device.device import Device
from ...device.memory import copy as copy_buffer
from ...device.memory import fill_zero, to_device, to_host
from ...device.program import GROUP_ITEMS, lane_group
from ...rendering.build import KernelBuild
from ...rendering.splat_buffers import CompactGradients, ParameterBuffers, SplatBuffers
from ...splats.fields import Array, Group, Schema, sh_coefficients
from ..density.edit import DensifyEdit
from ..programs import optim_program
from .adam import BETA1, BETA2
from .lazy import Steps
from .rules import Rules
from .sghmc import STREAM, Sghmc
from .skew_map import SkewMap
from .waiting import Waiting

_PARTS = 5  # of geometry in a step (cl/train/optim.cl)
_NO_PART = 1 << 31


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
    """The trainable skew s and Adam's moments of it."""

    def __init__(self, splats: SplatBuffers, skew_map: SkewMap) -> None:
        self.map, self.steps = skew_map, 0
        self.s, self.first, self.second = (Rows(splats, skew_map.width) for _ in range(3))
        values = splats.download(splats.n, ("skew", "quat"))
        self.s.set(skew_map.inverse(values["skew"], values["quat"]))


class FusedOptimizer:
    """See optim.Optimizer."""

    def __init__(self, device: Device, kernels: KernelBuild, splats: SplatBuffers, rules: Rules) -> None:
        self.device, self.kernels, self.splats, self.rules = device, kernels, splats, rules
        self.program = optim_program(device, kernels)
        self._group = lane_group(device)
        self.steps = 0
        schema, dtype = splats.schema, splats.dtype
        # Of the size of the splats' own buffers, so that one spare serves all; the skew's rows are not used.
        self.first = ParameterBuffers(device, schema, splats.capacity, dtype)
        self.second = ParameterBuffers(device, schema, splats.capacity, dtype)
        self.spare = {group: device.alloc(splats.group_bytes(group)) for group in Group}
        self.skew = TrainableSkew(splats, rules.map) if rules.map is not None else None
        self.momentum = Rows(splats, 3) if rules.sghmc is not None else None
        base = rules.base_fields(schema)
        self._base_names = tuple(field.name for field in base)
        table = _rate_table(schema, rules, dtype)
        self._rates = device.alloc(table.nbytes)
        to_device(device, self._rates, table)
        self._sh_rates = rules.sh_rates(schema.rows(Group.SH), dtype)
        self.waiting = Waiting(splats, kernels) if rules.config.optim.visible_adam else None
        self._lazy_from = _NO_PART if self.waiting is None else 0 if rules.geometry_waits else _PARTS

    def step(
        self, grads: CompactGradients, mean_lr: float, sh_degree: int, iteration: int, depth_key: Any = None
    ) -> None:
        blocks, skew, sghmc = self.rules.blocks(iteration), self.skew, self.rules.sghmc
        if self.waiting is not None:
            self.waiting.wake(self._counts, blocks, depth_key)
        self.steps += blocks.base
        if blocks.base and sghmc is not None and self.momentum is not None:  # first: it sees the old covariance
            self._sghmc(sghmc, self.momentum, grads, mean_lr, iteration)
        if skew is not None:
            skew.steps += blocks.skew
        of_skew = _corrections(self._counts[1])
        penalty = self.rules.penalty(self.splats.n)
        self.program.step_splats(
            (self._columns, _PARTS + sh_coefficients(sh_degree)),
            (GROUP_ITEMS, 1),
            geom=self.splats.geom,
            grad_geom=grads.geom,
            sh=self.splats.sh,
            grad_sh=grads.sh,
            **self._state_arguments(),
            sh_degree=sh_degree,
            base_learns=int(blocks.base),
            means_learn=int(blocks.base and sghmc is None),
            skew_learns=int(blocks.skew),
            mean_lr=mean_lr,
            **_corrections(self.steps),
            skew_correct1=of_skew["correct1"],
            skew_correct2=of_skew["correct2"],
            opacity_scale=penalty.opacity,
            scale_scale=penalty.scale,
            bisect_scale=penalty.bisect,
        )
        if self.waiting is not None:
            self.waiting.drifts.advance(blocks, self._counts, mean_lr)

    def settle(self) -> None:
        if self.waiting is not None:
            self.waiting.wake(self._counts)
            self._settle(self.splats, None if self.skew is None else self.skew.s.buffer, keeps_moments=False)

    def read(self) -> dict[str, Array]:
        if self.waiting is None:
            return self.splats.download(self.splats.n)
        for group in Group:
            copy_buffer(self.device, self.splats.buffers[group], self.spare[group], self.splats.group_bytes(group))
        settled = copy.copy(self.splats)
        settled.buffers = self.spare
        if self.skew is not None:
            s = self.skew.s
            copy_buffer(self.device, s.buffer, s.spare, s.width * s.capacity * s.dtype.itemsize)
        self.waiting.wake(self._counts, peeks=True)
        self._settle(settled, None if self.skew is None else self.skew.s.spare, keeps_moments=True)
        return settled.download(settled.n)

    def apply(self, edit: DensifyEdit) -> None:
        self.settle()
        splats, n_old, n_new = self.splats, self.splats.n, len(edit.source)
        source = self._indices(edit.source)
        fresh = edit.fresh.copy()
        state_source = None
        if edit.state_source is None:
            fresh[n_old:] = True  # columns beyond the old count may hold an older state
        else:
            state_source = self._indices(edit.state_source)
        fresh_buffer = self.device.alloc(n_new)
        to_device(self.device, fresh_buffer, fresh.astype(np.uint8))
        for group in Group:
            rows = splats.schema.rows(group)
            splats.buffers[group], self.spare[group] = self._gather(
                splats.buffers[group], source, self.spare[group], n_new, rows
            )
            for moments in (self.first, self.second):
                if state_source is not None:
                    moments.buffers[group], self.spare[group] = self._gather(
                        moments.buffers[group], state_source, self.spare[group], n_new, rows
                    )
                self._zero(moments.buffers[group], fresh_buffer, n_new, rows)
        for rows_of_state in self._own_state():
            if state_source is not None:
                self._gather_rows(rows_of_state, state_source, n_new)
            self._zero(rows_of_state.buffer, fresh_buffer, n_new, rows_of_state.width)
        splats.n = n_new
        self._set_values(edit, source)
        self._reset_fields(edit.reset_fields)
        if self.waiting is not None:
            self.waiting.none_waits(self._counts)

    def state(self) -> dict[str, NDArray[Any]]:
        n = self.splats.n
        state: dict[str, NDArray[Any]] = {"steps": np.array([self.steps, self.skew.steps if self.skew else 0])}
        for role, buffers in (("first", self.first), ("second", self.second)):
            state |= {f"{role}.{name}": array for name, array in buffers.download(n, self._base_names).items()}
        if self.skew is not None:
            state |= {
                "skew_s": self.skew.s.get(n),
                "first.skew": self.skew.first.get(n),
                "second.skew": self.skew.second.get(n),
            }
        if self.momentum is not None:
            state["momentum"] = self.momentum.get(n)
        return state if self.waiting is None else state | self.waiting.state()

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
        if self.waiting is not None:
            self.waiting.load_state(state, self._counts)

    @property
    def _counts(self) -> Steps:
        return self.steps, 0 if self.skew is None else self.skew.steps

    @property
    def _columns(self) -> int:
        """Work-items of a kernel over all splats."""
        return -(-self.splats.n // (self.kernels.lanes * GROUP_ITEMS)) * GROUP_ITEMS

    def _state_arguments(self) -> dict[str, Any]:
        """Arguments that step_splats and settle_splats share; what the shape or the options lack is not looked at."""
        skew, waiting = self.skew, self.waiting
        rows = [self.first.geom] * 3 if skew is None else [skew.s.buffer, skew.first.buffer, skew.second.buffer]
        return {
            "geom_m": self.first.geom,
            "geom_v": self.second.geom,
            "sh_m": self.first.sh,
            "sh_v": self.second.sh,
            "skew_s": rows[0],
            "skew_m": rows[1],
            "skew_v": rows[2],
            "rates": self._rates,
            "ages": self._rates if waiting is None else waiting.ages,
            "waits": self._rates if waiting is None else waiting.table,
            "lazy_from": self._lazy_from,
            "capacity": self.splats.capacity,
            "sh_lr": self._sh_rates[0],
            "sh_rest_lr": self._sh_rates[-1],
            "skew_lr": self.rules.rates.get("skew", 0.0),
        }

    def _settle(self, splats: SplatBuffers, skew_s: Any, keeps_moments: bool) -> None:
        """The steps that woken splats sat out, on these values."""
        arguments = self._state_arguments() | ({} if skew_s is None else {"skew_s": skew_s})
        self.program.settle_splats(
            (self._columns, _PARTS + sh_coefficients(splats.schema.sh_degree)),
            (GROUP_ITEMS, 1),
            geom=splats.geom,
            sh=splats.sh,
            keeps_moments=int(keeps_moments),
            **arguments,
        )

    def _sghmc(self, sghmc: Sghmc, momentum: Rows, grads: CompactGradients, mean_lr: float, iteration: int) -> None:
        c, seed = self.rules.coefficients(sghmc, iteration, mean_lr), self.rules.config.seed
        self.program.sghmc_step.over(
            self._columns,
            self._group,
            geom=self.splats.geom,
            grad_geom=grads.geom,
            adam_m=self.first.geom,
            adam_v=self.second.geom,
            momentum=momentum.buffer,
            capacity=self.splats.capacity,
            n_splats=self.splats.n,
            seed_lo=seed & 0xFFFFFFFF,
            seed_hi=seed >> 32,
            iteration=iteration,
            stream=STREAM,
            length=c.length,
            drive=c.drive,
            keep=c.keep,
            noise=c.noise,
            by_covariance=int(c.by_covariance),
            **_corrections(self.steps),
        )

    def _own_state(self) -> list[Rows]:
        """State that is not in `first` and `second`."""
        state = [] if self.skew is None else [self.skew.first, self.skew.second]
        return state if self.momentum is None else [*state, self.momentum]

    def _set_values(self, edit: DensifyEdit, source: Any) -> None:
        """The edit's new values, and the trainable skew where it must follow them."""
        if self.skew is None:
            self.splats.upload(edit.values)
            return
        n, names = self.splats.n, ("skew", "quat")
        self._gather_rows(self.skew.s, source, n)
        if not any(name in edit.values for name in names):
            self.splats.upload(edit.values)
            return
        before = self.splats.download(n, names)
        self.splats.upload(edit.values)
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
        self.program.gather_columns(
            (-(-n // GROUP_ITEMS) * GROUP_ITEMS, rows),
            (GROUP_ITEMS, 1),
            values=values,
            source=source,
            moved=spare,
            capacity=self.splats.capacity,
            n=n,
        )
        return spare, values

    def _gather_rows(self, rows: Rows, source: Any, n: int) -> None:
        rows.buffer, rows.spare = self._gather(rows.buffer, source, rows.spare, n, rows.width)

    def _zero(self, values: Any, fresh: Any, n: int, rows: int) -> None:
        self.program.zero_columns(
            (-(-n // GROUP_ITEMS) * GROUP_ITEMS, rows),
            (GROUP_ITEMS, 1),
            values=values,
            fresh=fresh,
            capacity=self.splats.capacity,
            n=n,
        )


def _corrections(steps: int) -> dict[str, float]:
    """Adam's bias corrections after `steps`; 0 before the first."""
    return {"correct1": 1 / (1 - BETA1**steps) if steps else 0.0, "correct2": 1 / (1 - BETA2**steps) if steps else 0.0}


def _rate_table(schema: Schema, rules: Rules, dtype: np.dtype[np.floating]) -> Array:
    """Per row of geom (3, G): its rate, and its bounds, 0 and 0 without."""
    fields = schema.group(Group.GEOM)
    columns = [
        (rules.rates.get(field.name, 0.0), *(field.bounds or (0.0, 0.0)))
        for field in fields
        for _ in range(field.width)
    ]
    return np.array(columns, dtype).T.copy()
