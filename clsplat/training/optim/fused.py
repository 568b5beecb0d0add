"""The optimizer on the device (cl/train/optim.cl). It equals optim/reference.py to rounding."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...device.device import Device
from ...device.memory import copy, fill_zero, to_device, to_host
from ...device.pending_arrays import PendingArrays
from ...device.program import GROUP_ITEMS, Program, lane_group
from ...rendering.build import KernelBuild
from ...rendering.splat_buffers import CompactGradients, ParameterBuffers, SplatBuffers
from ...splats.fields import Array, Group, Schema, sh_coefficients
from ..columns import Columns
from ..density.edit import DensifyEdit
from ..programs import PARTS, coefficients_of_item, columns_program, optim_program
from .adam import BETA1, BETA2
from .moments import AdamMoments
from .rules import Rules, StepCounts, check_state
from .sghmc import STREAM, Sghmc
from .skew_map import SkewMap


class StateRows:
    """A buffer [width, capacity] of optimizer state, which starts at zero. Its arrays on the host are (n, width)."""

    def __init__(self, splats: SplatBuffers, width: int) -> None:
        self.device, self.width, self.capacity, self.dtype = splats.device, width, splats.live_capacity, splats.dtype
        self.buffer, self.spare = (self.device.alloc(self.nbytes) for _ in range(2))
        fill_zero(self.device, self.buffer, self.nbytes)

    @property
    def nbytes(self) -> int:
        """Bytes of the buffer."""
        return self.width * self.capacity * self.dtype.itemsize

    def set(self, array: Array) -> None:
        """Write an array into the first columns, and zeros into the others."""
        rows = np.zeros((self.width, self.capacity), self.dtype)
        rows[:, : len(array)] = array.T
        to_device(self.device, self.buffer, rows)

    def get(self, n: int) -> Array:
        """Return the first n columns."""
        rows = np.empty((self.width, self.capacity), self.dtype)
        return np.ascontiguousarray(to_host(self.device, self.buffer, rows)[:, :n].T)


class TrainableSkew:
    """The trainable skew s and its Adam moments."""

    def __init__(self, splats: SplatBuffers, skew_map: SkewMap) -> None:
        self.map, self.steps = skew_map, 0
        self.s, self.first, self.second = (StateRows(splats, skew_map.width) for _ in range(3))
        values = splats.download(splats.n_live, ("skew", "quat"))
        self.s.set(skew_map.inverse(values["skew"], values["quat"]))


class FusedOptimizer:
    """`Optimizer` (optim/optimizer.py) whose steps run on the device.

    Its state has columns for the splats that change. Frozen ones are behind them in the buffers of the splats.
    """

    def __init__(self, device: Device, kernels: KernelBuild, splats: SplatBuffers, rules: Rules) -> None:
        self.device, self.kernels, self.splats, self.rules = device, kernels, splats, rules
        half = rules.config.optim.half_moments
        self.program: Program = optim_program(device, kernels, half, rules.config.schedule.batch)
        self._group = lane_group(device)
        program, capacities = columns_program(device, kernels), (splats.capacity, splats.live_capacity)
        self.columns, self._state = (Columns(device, program, each, splats.dtype) for each in capacities)
        self.steps = 0
        schema, dtype = splats.schema, splats.dtype
        # The rows of the skew are not used, so that moments and splats have the same rows.
        self.moments = AdamMoments(device, schema, splats.live_capacity, dtype, half)
        self.spare = {group: device.alloc(splats.group_bytes(group)) for group in Group}
        self.skew = TrainableSkew(splats, rules.map) if rules.map is not None else None
        self.momentum = StateRows(splats, 3) if rules.sghmc is not None else None
        base = rules.base_fields(schema)
        self._base_names = tuple(field.name for field in base)
        table = _rate_table(schema, rules, dtype)
        self.rates = device.alloc(table.nbytes)
        to_device(device, self.rates, table)
        sh_rates = rules.sh_rates(schema.rows(Group.SH), dtype)
        self.color_rates = {"lr": sh_rates[0], "rest_lr": sh_rates[-1]}

    def step(
        self, grads: CompactGradients, mean_lr: float, sh_degree: int, iteration: int, depth_key: Any = None
    ) -> None:
        groups, skew, sghmc = self.rules.groups(iteration), self.skew, self.rules.sghmc
        if skew is not None and skew.map.rotates:
            self._launch("turn_skew_gradient", grad_geom=grads.geom, skew_s=skew.s.buffer)
        if groups.base:
            self.steps += 1
            if sghmc is not None and self.momentum is not None:  # before the geometry: SGHMC uses the old covariance
                self._sghmc(sghmc, self.momentum, grads, mean_lr, iteration)
        with_skew = skew is not None and groups.skew
        if skew is not None and groups.skew:
            skew.steps += 1
        arguments = self._arguments(grads, mean_lr, sh_degree)
        follows = skew is not None and skew.map.rotates  # the skew needs the new rotation: it steps after the geometry
        if groups.base:
            first = int(sghmc is not None)  # SGHMC moves the means
            self._step(arguments, with_skew and not follows, sh_coefficients(sh_degree), first, len(PARTS) - first)
        if with_skew and (follows or not groups.base):
            self._step(arguments, True)
        elif follows and not with_skew and skew is not None:
            self._launch("map_skew", skew_s=skew.s.buffer, n_live=self.splats.n_live)

    def settle(self) -> None:
        """Do nothing: this optimizer skips no steps."""

    def arranged(self, edit: DensifyEdit) -> DensifyEdit:
        return edit

    def read(self) -> PendingArrays:
        return self.splats.pending(self.splats.n_live)

    def apply(self, edit: DensifyEdit) -> None:
        splats, n_old, n_new = self.splats, self.splats.n_live, len(edit.source)
        # Frozen splats stay behind the others.
        source = self.columns.indices(np.concatenate([edit.source, np.arange(n_old, splats.n)]))
        fresh = edit.fresh.copy()
        state_source = None
        if edit.state_source is None:
            fresh[n_old:] = True  # columns above the old count may hold an older state
        else:
            same = edit.state_source is edit.source
            state_source = source if same else self.columns.indices(edit.state_source)
        fresh_buffer = self.device.alloc(n_new)
        to_device(self.device, fresh_buffer, fresh.view(np.uint8))
        for group in Group:
            rows = splats.schema.rows(group)
            self.columns.gather(splats.buffers[group], source, self.spare[group], n_new + splats.n_frozen, rows)
            self._swap(splats, group)
            for moments in self.moments.of(group):
                if state_source is not None:
                    self._state.gather(moments.buffers[group], state_source, self.spare[group], n_new, rows)
                    self._swap(moments, group)
                self._state.zero(moments.buffers[group], fresh_buffer, n_new, rows)
        for state in self._other_state():
            if state_source is not None:
                self._gather_rows(state, state_source, n_new)
            self._state.zero(state.buffer, fresh_buffer, n_new, state.width)
        splats.n = n_new + splats.n_frozen
        self._set_values(edit, source)
        self._reset_fields(edit.reset_fields)

    def state(self) -> PendingArrays:
        steps = {"steps": np.array([self.steps, self.skew.steps if self.skew else 0])}
        rows: dict[str, StateRows] = {}
        if self.skew is not None:
            rows |= {"skew_s": self.skew.s, "first.skew": self.skew.first, "second.skew": self.skew.second}
        if self.momentum is not None:
            rows["momentum"] = self.momentum
        n = self.splats.n_live
        others = PendingArrays({name: partial(each.get, n) for name, each in rows.items()})
        return PendingArrays.of(steps, self.moments.state(n, self._base_names), others)

    def load_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        if self.splats.n_frozen:  # earlier versions had a state of frozen splats, which was zero
            rows = PendingArrays.first_of(PendingArrays.of(state, without="steps"), self.splats.n_live)
            state = PendingArrays.of(rows, {"steps": state["steps"]})
        check_state(state, self.state())
        self.steps = int(state["steps"][0])
        self.moments.load_state(state, self._base_names)
        if self.skew is not None:
            self.skew.steps = int(state["steps"][1])
            self.skew.s.set(state["skew_s"])
            self.skew.first.set(state["first.skew"])
            self.skew.second.set(state["second.skew"])
        if self.momentum is not None:
            self.momentum.set(state["momentum"])

    @property
    def counts(self) -> StepCounts:
        """Steps of the base parameters and of the skew."""
        return self.steps, 0 if self.skew is None else self.skew.steps

    @property
    def _columns(self) -> int:
        """Work-items of a kernel over all splats that change."""
        return -(-self.splats.n_live // (self.kernels.lanes * GROUP_ITEMS)) * GROUP_ITEMS

    def _step(
        self, arguments: dict[str, Any], with_skew: bool, coefficients: int = 0, first_part: int = 0, parts: int = 0
    ) -> None:
        """Step coefficients of the colour, parts of the geometry, and the skew."""
        color_items = -(-coefficients // coefficients_of_item(self.kernels))
        self.program.step_splats.over(
            self._columns,
            GROUP_ITEMS,
            color_items + parts + int(with_skew),
            coefficients=coefficients,
            first_part=first_part,
            parts=parts,
            **arguments,
        )

    def _arguments(self, grads: CompactGradients, mean_lr: float, sh_degree: int) -> dict[str, Any]:
        """Return the arguments of the kernel `step_splats`, except what it steps."""
        penalty, skew = self.rules.penalty(self.splats.n_live), self.skew
        arguments = {
            "sh": self.splats.sh,
            "grad_sh": grads.sh,
            **self.moments.color_arguments(self.rules.config.seed, self.steps),
            "geom": self.splats.geom,
            "grad_geom": grads.geom,
            "geom_m": self.moments.first.geom,
            "geom_v": self.moments.second.geom,
            "rates": self.rates,
            "capacity": self.splats.capacity,
            "live_capacity": self.splats.live_capacity,
            "n_live": self.splats.n_live,
            "sh_degree": sh_degree,
            "mean_lr": mean_lr,
            "opacity_scale": penalty.opacity,
            "scale_scale": penalty.scale,
            "bisect_scale": penalty.bisect,
            **self.color_rates,
            **bias_corrections(self.steps),
        }
        if skew is not None:
            buffers = {"skew_s": skew.s.buffer, "skew_m": skew.first.buffer, "skew_v": skew.second.buffer}
            corrections = {f"skew_{name}": value for name, value in bias_corrections(skew.steps).items()}
            arguments |= {**buffers, "skew_lr": self.rules.rates["skew"], **corrections}
        return arguments

    def _launch(self, name: str, **arguments: Any) -> None:
        """Run a kernel over the geometry of all splats that change."""
        capacities = {"capacity": self.splats.capacity, "live_capacity": self.splats.live_capacity}
        self.program[name].over(self._columns, geom=self.splats.geom, **capacities, **arguments)

    def _sghmc(
        self, sghmc: Sghmc, momentum: StateRows, grads: CompactGradients, mean_lr: float, iteration: int
    ) -> None:
        c, seed = self.rules.coefficients(sghmc, iteration, mean_lr), self.rules.config.seed
        self.program.sghmc_step.over(
            self._columns,
            self._group,
            geom=self.splats.geom,
            grad_geom=grads.geom,
            adam_m=self.moments.first.geom,
            adam_v=self.moments.second.geom,
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
            **bias_corrections(self.steps),
        )

    def _other_state(self) -> list[StateRows]:
        """Return the state that is not in `first` and `second`."""
        state = [] if self.skew is None else [self.skew.first, self.skew.second]
        return state if self.momentum is None else [*state, self.momentum]

    def _set_values(self, edit: DensifyEdit, source: Any) -> None:
        """Write the new values of the edit, and the trainable skew that belongs to them."""
        followers = self._followers(edit, source)
        schema = self.splats.schema
        for name, new in edit.values.items():
            field, target = schema[name], self.columns.indices(new.rows)
            values = new.values.reshape(len(new.rows), field.width)
            self.columns.put(self.splats.buffers[field.group], target, values, schema.offset(name))
        if self.skew is not None and followers is not None:
            rows, before = followers
            s = self._state.take(self.skew.s.buffer, rows, len(before["quat"]), 0, self.skew.s.width)
            s = self.skew.map.follow(s, before, self._skew_and_quat(rows, len(s)))
            self._state.put(self.skew.s.buffer, rows, s, 0)

    def _followers(self, edit: DensifyEdit, source: Any) -> tuple[Any, dict[str, Array]] | None:
        """Move the trainable skew. Return the rows with a new skew or rotation, and both before they change."""
        if self.skew is None:
            return None
        self._gather_rows(self.skew.s, source, self.splats.n_live)
        rows = [edit.values[name].rows for name in ("skew", "quat") if name in edit.values]
        if not rows:
            return None
        marked = np.zeros(self.splats.n_live, np.bool_)  # np.unique hashes its values, which takes many times as long
        for each in rows:
            marked[each] = True
        changed = np.flatnonzero(marked)
        target = self.columns.indices(changed)
        return target, self._skew_and_quat(target, len(changed))

    def _skew_and_quat(self, rows: Any, n: int) -> dict[str, Array]:
        """Return the skew and the quaternion of n splats."""
        schema = self.splats.schema
        return {
            name: self.columns.take(self.splats.geom, rows, n, schema.offset(name), schema[name].width)
            for name in ("skew", "quat")
        }

    def _reset_fields(self, names: tuple[str, ...]) -> None:
        self.moments.reset(self.splats.n_live, names)
        if self.skew is not None and "skew" in names:
            for rows in (self.skew.first, self.skew.second):
                rows.set(np.zeros((0, rows.width)))
        if self.momentum is not None and "mean" in names:
            self.momentum.set(np.zeros((0, 3)))

    def _swap(self, values: ParameterBuffers, group: Group) -> None:
        """Take the spare buffer of a group for the present one. If it is larger, because of frozen splats, copy it."""
        if values.capacity == self.splats.capacity:
            values.buffers[group], self.spare[group] = self.spare[group], values.buffers[group]
        else:
            copy(self.device, self.spare[group], values.buffers[group], values.group_bytes(group))

    def _gather_rows(self, rows: StateRows, source: Any, n: int) -> None:
        self._state.gather(rows.buffer, source, rows.spare, n, rows.width)
        rows.buffer, rows.spare = rows.spare, rows.buffer


def bias_corrections(steps: int) -> dict[str, float]:
    """Return the bias corrections of Adam after `steps`; 0 before the first step."""
    return {"correct1": 1 / (1 - BETA1**steps) if steps else 0.0, "correct2": 1 / (1 - BETA2**steps) if steps else 0.0}


def _rate_table(schema: Schema, rules: Rules, dtype: np.dtype[np.floating]) -> Array:
    """Return the rate, lower bound and upper bound of each row of geom, (3, G). Fields without bounds have 0 and 0."""
    fields = schema.group(Group.GEOM)
    columns = [
        (rules.rates.get(field.name, 0.0), *(field.bounds or (0.0, 0.0)))
        for field in fields
        for _ in range(field.width)
    ]
    return np.array(columns, dtype).T.copy()
