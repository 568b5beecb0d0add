"""Densification edits: a strategy makes them on the host, an optimizer applies them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...splats.fields import Array


@dataclass(frozen=True, slots=True)
class DensifyEdit:
    """The splats after a densification: copies of old splats, with new values of some fields.

    Attributes
    ----------
    source : (N_new,) int64, the old row that each new row copies.
    values : new values by field, as public arrays of N_new splats.
    fresh : (N_new,) bool, whether the optimizer state (moments, momentum) of a row becomes zero.
    state_source : (N_new,) int64, the old row that each new row copies its optimizer state from, before `fresh` is
        applied. None: the state stays in its row, and additional rows start at zero.
    reset_fields : fields whose optimizer state becomes zero in all rows.
    relocated, added, removed : numbers of splats.
    """

    source: NDArray[np.int64]
    values: dict[str, Array]
    fresh: NDArray[np.bool_]
    state_source: NDArray[np.int64] | None = None
    reset_fields: tuple[str, ...] = ()
    relocated: int = 0
    added: int = 0
    removed: int = 0

    def permuted(self, order: NDArray[np.int64], n_old: int) -> DensifyEdit:
        """Return the same splats in another order.

        Parameters
        ----------
        order : rows of the edit in their new order.
        n_old : number of splats before the edit.
        """
        states, fresh = self.state_source, self.fresh
        if states is None:
            rows = np.arange(len(self.source))
            states, fresh = np.minimum(rows, n_old - 1), fresh | (rows >= n_old)
        values = {name: array[order] for name, array in self.values.items()}
        return replace(self, source=self.source[order], values=values, fresh=fresh[order], state_source=states[order])

    def apply(self, arrays: Mapping[str, Array]) -> dict[str, Array]:
        """Return copies of the parameters after the edit. The device must produce the same values."""
        moved = {name: array[self.source] for name, array in arrays.items()}
        for name, values in self.values.items():
            moved[name] = values.astype(arrays[name].dtype)
        return moved

    def apply_state(self, state: Array, name: str) -> Array:
        """Return a copy of the optimizer state (N, ...) of one field after the edit."""
        n, n_new = len(state), len(self.source)
        if self.state_source is not None:
            moved = state[self.state_source]
        else:
            moved = np.zeros((n_new, *state.shape[1:]), state.dtype)
            moved[: min(n, n_new)] = state[:n_new]
        moved[self.fresh] = 0
        if name in self.reset_fields:
            moved[:] = 0
        return moved
