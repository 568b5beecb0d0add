"""Adam for visible splats in NumPy: the reference of optim/lazy.py, which has the formula."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...device.memory import to_host
from ...rendering.build import CULLED_KEY
from ...rendering.splat_buffers import CompactGradients, SplatBuffers
from ...splats.fields import Array
from ..density.edit import DensifyEdit
from ..methods.sns import ParameterGroups
from .adam import DECAY_ROWS, DRIFT, DRIFT_MEAN, DRIFT_SKEW, EPS, WAITS, NumpyAdam
from .lazy import Drifts, in_morton_order
from .reference import ReferenceOptimizer, SplatIndices
from .rules import Rules, StepCounts


class VisibleReferenceOptimizer(ReferenceOptimizer):
    """The NumPy reference that steps only visible splats.

    Attributes
    ----------
    last : (2, V) step count of base and skew that each vector of `lanes` splats has reached.
    """

    def __init__(self, splats: SplatBuffers, rules: Rules, lanes: int) -> None:
        super().__init__(splats, rules)
        self.lanes, self.drifts = lanes, Drifts()
        self._mark_settled()

    def step(
        self, grads: CompactGradients, mean_lr: float, sh_degree: int, iteration: int, depth_key: Any = None
    ) -> None:
        super().step(grads, mean_lr, sh_degree, iteration, depth_key)
        self.drifts.advance(self.rules.groups(iteration), self.counts, mean_lr)

    def settle(self) -> None:
        params = self.splats.download(self.splats.n)
        self.skew_s = self._caught_up(params, slice(None))
        self.splats.set(params)
        self._mark_settled()

    def arranged(self, edit: DensifyEdit) -> DensifyEdit:
        return in_morton_order(edit, self.splats)

    def read(self) -> dict[str, Array]:
        params = self.splats.download(self.splats.n)
        self._caught_up(params, slice(None), keeps_moments=True)
        return params

    def apply(self, edit: DensifyEdit) -> None:
        self.settle()
        super().apply(edit)
        self._mark_settled()

    def state(self) -> dict[str, NDArray[Any]]:
        lazy: dict[str, NDArray[Any]] = {
            "waiting.last": self.last.astype(np.uint32),
            "waiting.drifts": self.drifts.sums.copy(),
        }
        return super().state() | lazy

    def load_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        super().load_state(state)
        self.last, self.drifts.sums = state["waiting.last"].astype(np.int64), state["waiting.drifts"].copy()

    def _select(
        self, params: dict[str, Array], groups: ParameterGroups, depth_key: Any
    ) -> tuple[SplatIndices, SplatIndices]:
        n = self.splats.n
        keys = to_host(self.splats.device, depth_key, np.empty(n, np.uint32))
        vectors = awake(keys != CULLED_KEY, self.last, self.counts, self.lanes)
        color = np.flatnonzero(np.repeat(vectors, self.lanes)[:n])
        self.skew_s = self._caught_up(params, color)
        self.last[:, vectors] = np.array([self.counts]).T + np.array([groups]).T
        return color if self.rules.geometry_waits else slice(None), color

    def _mark_settled(self) -> None:
        """Record that no vector has skipped a step."""
        self.last = np.repeat(np.array([self.counts]).T, -(-self.splats.n // self.lanes), axis=1)

    def _caught_up(self, params: dict[str, Array], rows: SplatIndices, keeps_moments: bool = False) -> Array:
        """Return the trainable skew after the skipped steps of the splats `rows`, which also change `params`."""
        rules, skew_map, dtype = self.rules, self.rules.map, self.splats.dtype
        skipped = np.repeat(np.array([self.counts]).T - self.last, self.lanes, axis=1)[:, : self.splats.n]
        base, skew = skipped[0][rows], skipped[1][rows]
        table = self.drifts.table.astype(dtype)
        fields = rules.base_fields(self.splats.schema)
        for field in fields if rules.geometry_waits else [field for field in fields if field.name == "sh"]:
            rate: Array = np.asarray(rules.rates.get(field.name, 1.0), dtype)
            if field.name == "sh":
                rate = rules.sh_rates(field.width, dtype).reshape(1, -1, 3)
            sums = table[DECAY_ROWS + (DRIFT_MEAN if field.name == "mean" else DRIFT)]
            moved = _drift(self.base, field.name, rows, base, table, sums, rate, keeps_moments)
            if field.bounds is not None:  # in log space
                params[field.name][rows] = np.clip(params[field.name][rows] * np.exp(-moved), *field.bounds)
            else:
                params[field.name][rows] -= moved
        if skew_map is None or not rules.geometry_waits:
            return self.skew_s
        skew_s = self.skew_s.copy()
        rate = np.asarray(rules.rates["skew"], dtype)
        skew_s[rows] -= _drift(
            self.skew, "skew", rows, skew, table, table[DECAY_ROWS + DRIFT_SKEW], rate, keeps_moments
        )
        changed = np.arange(len(skew_s))[rows][(skew > 0) | skew_map.rotates]
        params["skew"][changed] = skew_map.forward(skew_s[changed], params["quat"][changed])
        return skew_s


def awake(visible: NDArray[np.bool_], last: NDArray[np.integer], counts: StepCounts, lanes: int) -> NDArray[np.bool_]:
    """Return which vectors of splats step, (V,); the kernel wake_visible in NumPy.

    Parameters
    ----------
    visible : (N,) whether the image shows each splat. last : (2, V) step count that each vector has reached.
    counts : the present step counts. lanes : number of splats of a vector.
    """
    padded = np.zeros(last.shape[1] * lanes, bool)
    padded[: len(visible)] = visible
    overdue = (np.array(counts)[:, None] - last >= WAITS - 1).any(axis=0)
    due: NDArray[np.bool_] = padded.reshape(-1, lanes).any(axis=1) | overdue
    return due


def _drift(
    adam: NumpyAdam,
    name: str,
    rows: SplatIndices,
    skipped: NDArray[np.int64],
    table: Array,
    sums: Array,
    rate: Array,
    keeps_moments: bool,
) -> Array:
    """Return the drift of a field. Its moments decay unless `keeps_moments` is set."""
    first, second = adam.first[name][rows], adam.second[name][rows]
    decay1, decay2, drift = (row[skipped].reshape(-1, *[1] * (first.ndim - 1)) for row in (table[0], table[1], sums))
    moved: Array = rate * drift * (first / (np.sqrt(second) + first.dtype.type(EPS)))
    if not keeps_moments:
        adam.first[name][rows], adam.second[name][rows] = first * decay1, second * decay2
    return moved
