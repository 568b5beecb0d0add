"""Adam for visible splats: the steps that a splat skipped, in closed form.

A splat outside of the image has gradients of zero, but its momentum still moves it. k steps after step t

    m <- beta1^k m,   v <- beta2^k v,   value <- value - m / (sqrt(v) + eps) sum_j rate(t+j) r^j c(t+j),   j = 1..k,
    r = beta1 / sqrt(beta2),   c(t) = sqrt(1 - beta2^t) / (1 - beta1^t),

where m and v are the moments after step t. A table holds the sums by k, so bias corrections and changing rates are
exact. Two things differ from dense Adam. Rounding happens once instead of k times. Dense Adam compares eps with a
falling v; the relative error of the drift is at most eps / sqrt(v). Fields in log space drift there. Their drift is
monotonic, so one clamp at the end equals a clamp at every step.

A vector of LANES splats skips its steps until one of its splats is visible or until it reaches the maximum age of
WAITS - 1 steps. Then it does the skipped steps and the present one. The image is rendered before the step. So a splat
that becomes visible shows its drift one iteration late.

Positions with regularisers, noise or SGHMC change in every step, also without a gradient. Then only the colour is lazy.
"""

from __future__ import annotations

import copy
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...device.device import Device
from ...device.memory import copy as copy_buffer
from ...device.memory import send_to_device, to_device, to_host
from ...device.pending_arrays import PendingArrays
from ...device.program import GROUP_ITEMS
from ...rendering.build import KernelBuild
from ...rendering.splat_buffers import CompactGradients, SplatBuffers
from ...splats.fields import Group, sh_coefficients
from ...splats.morton import morton_order
from ..density.edit import DensifyEdit
from ..programs import PARTS, lazy_program
from .adam import BETA1, BETA2, DRIFT, DRIFT_MEAN, DRIFT_SKEW, WAITS
from .fused import FusedOptimizer
from .rules import Rules, StepCounts

_AGES = np.arange(WAITS)
_DECAYS = np.stack([BETA1**_AGES, BETA2**_AGES])
_RATIO = (BETA1 / np.sqrt(BETA2)) ** _AGES


class Drifts:
    """Sums of the formula up to the present step.

    Attributes
    ----------
    sums : (3, WAITS) float64, by kind and by the number of skipped steps. DRIFT has rate 1. DRIFT_MEAN includes the
        rates of the positions. DRIFT_SKEW has rate 1 and counts the steps of the skew.
    """

    def __init__(self) -> None:
        self.sums = np.zeros((3, WAITS))

    def advance(self, learns: tuple[bool, bool], counts: StepCounts, mean_lr: float) -> None:
        """Add one step.

        Parameters
        ----------
        learns : whether the base parameters and the skew make the step.
        counts : step counts after the step.
        mean_lr : rate of the positions in the step.
        """
        if learns[0]:
            self._add(DRIFT, counts[0], 1.0)
            self._add(DRIFT_MEAN, counts[0], mean_lr)
        if learns[1]:
            self._add(DRIFT_SKEW, counts[1], 1.0)

    @property
    def table(self) -> NDArray[np.float64]:
        """Return the array `decays` of cl/train/lazy.clh, (2 + 3, WAITS): factors of m and of v, and the sums."""
        return np.concatenate([_DECAYS, self.sums])

    def _add(self, kind: int, step: int, rate: float) -> None:
        weight = rate * np.sqrt(1 - BETA2**step) / (1 - BETA1**step)
        self.sums[kind, 1:] = self.sums[kind, :-1] + weight * _RATIO[1:]


def in_morton_order(edit: DensifyEdit, splats: SplatBuffers) -> DensifyEdit:
    """Return the edit with its rows along a Morton curve, so that splats that are visible together share vectors."""
    mean = splats.download(splats.n, ("mean",))["mean"]
    return edit.permuted(morton_order(edit.after("mean", mean)), splats.n)


class VisibleOptimizer(FusedOptimizer):
    """The optimizer on the device that steps only visible splats.

    Attributes
    ----------
    ages, table : buffers of the latest selection; `ages` and `decays` in cl/train/lazy.cl.
    """

    def __init__(self, device: Device, kernels: KernelBuild, splats: SplatBuffers, rules: Rules) -> None:
        super().__init__(device, kernels, splats, rules)
        self.program = lazy_program(device, kernels, self.moments.half)
        self.drifts = Drifts()
        self._step_catches_up = False
        self._vectors = splats.capacity // kernels.lanes
        self.ages, self._last = (device.alloc(8 * self._vectors) for _ in range(2))
        self.table = device.alloc(self._table().nbytes)
        self._mark_settled()

    def step(
        self, grads: CompactGradients, mean_lr: float, sh_degree: int, iteration: int, depth_key: Any = None
    ) -> None:
        groups = self.rules.groups(iteration)
        self._select("wake_visible", depth_key=depth_key, base_learns=int(groups.base), skew_learns=int(groups.skew))
        # One launch does skipped steps and the next one, if it steps all parameters.
        self._step_catches_up = groups.base and (self.skew is None or (groups.skew and not self.skew.map.rotates))
        if not self._step_catches_up:
            self._catch_up(self.splats, None if self.skew is None else self.skew.s.buffer)
        super().step(grads, mean_lr, sh_degree, iteration)
        self.drifts.advance(groups, self.counts, mean_lr)

    def settle(self) -> None:
        self._select("wake_all")
        self._catch_up(self.splats, None if self.skew is None else self.skew.s.buffer)
        self._mark_settled()

    def arranged(self, edit: DensifyEdit) -> DensifyEdit:
        return in_morton_order(edit, self.splats)

    def read(self) -> PendingArrays:
        for group in Group:
            copy_buffer(self.device, self.splats.buffers[group], self.spare[group], self.splats.group_bytes(group))
        settled = copy.copy(self.splats)
        settled.buffers = self.spare
        if self.skew is not None:
            copy_buffer(self.device, self.skew.s.buffer, self.skew.s.spare, self.skew.s.nbytes)
        self._select("wake_all")
        self._catch_up(settled, None if self.skew is None else self.skew.s.spare, keeps_moments=True)
        return settled.pending(settled.n)

    def apply(self, edit: DensifyEdit) -> None:
        self.settle()  # no splat has skipped a step now, so it does not matter which ones move
        super().apply(edit)

    def state(self) -> PendingArrays:
        last = to_host(self.device, self._last, np.empty((2, self._vectors), np.uint32))
        lazy = {"waiting.last": last[:, : self._used].copy(), "waiting.drifts": self.drifts.sums.copy()}
        return PendingArrays.of(super().state(), lazy)

    def load_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        super().load_state(state)
        self.drifts.sums = state["waiting.drifts"].copy()
        last = np.repeat(np.array(self.counts, np.uint32)[:, None], self._vectors, axis=1)
        last[:, : self._used] = state["waiting.last"]
        to_device(self.device, self._last, last)

    @property
    def _used(self) -> int:
        """Number of vectors that hold splats."""
        return -(-self.splats.n // self.kernels.lanes)

    def _table(self) -> NDArray[np.floating]:
        return self.drifts.table.astype(self.splats.dtype)

    def _mark_settled(self) -> None:
        """Record that no vector has skipped a step."""
        to_device(self.device, self._last, np.repeat(np.array(self.counts, np.uint32), self._vectors))

    def _select(self, kernel: str, **arguments: Any) -> None:
        """Select vectors with the kernel wake_visible or wake_all. The step counts are those before the next step."""
        self._sent = send_to_device(self.device, self.table, self._table())  # kept: releasing it waits for the transfer
        self.program[kernel].over(
            self._vectors,
            last=self._last,
            ages=self.ages,
            vectors=self._vectors,
            n_splats=self.splats.n,
            base_steps=self.counts[0],
            skew_steps=self.counts[1],
            **arguments,
        )

    def _catch_up(self, splats: SplatBuffers, skew_s: Any, keeps_moments: bool = False) -> None:
        """Do the skipped steps of the selected vectors on `splats` and `skew_s`."""
        common: dict[str, Any] = {
            "ages": self.ages,
            "decays": self.table,
            "capacity": splats.capacity,
            "keeps_moments": int(keeps_moments),
        }
        self.program.settle_color.over(
            self._columns,
            GROUP_ITEMS,
            sh_coefficients(splats.schema.sh_degree),
            sh=splats.sh,
            **self.moments.color_arguments(self.rules.config.seed, self.steps),
            **self.color_rates,
            **common,
        )
        if not self.rules.geometry_waits:
            return
        self.program.settle_geometry.over(
            self._columns,
            GROUP_ITEMS,
            len(PARTS),
            geom=splats.geom,
            geom_m=self.moments.first.geom,
            geom_v=self.moments.second.geom,
            rates=self.rates,
            **common,
        )
        if self.skew is not None:
            self.program.settle_skew.over(
                self._columns,
                geom=splats.geom,
                skew_s=skew_s,
                skew_m=self.skew.first.buffer,
                skew_v=self.skew.second.buffer,
                lr=self.rules.rates["skew"],
                **common,
            )

    def _arguments(self, grads: CompactGradients, mean_lr: float, sh_degree: int) -> dict[str, Any]:
        waits = {
            "ages": self.ages,
            "decays": self.table,
            "geometry_waits": int(self.rules.geometry_waits),
            "catches_up": int(self._step_catches_up),
        }
        return super()._arguments(grads, mean_lr, sh_degree) | waits
