"""Densification edits: a strategy makes them on the host, an optimizer applies them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ...splats.fields import Array

Indices = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class NewValues:
    """New values of one field.

    Attributes
    ----------
    rows : (M,) int64, different rows of an edit.
    values : (M, ...) public array of these rows.
    """

    rows: Indices
    values: Array


@dataclass(frozen=True, slots=True)
class DensifyEdit:
    """The splats after a densification: copies of old splats, some of them with new values of some fields.

    Attributes
    ----------
    source : (N_new,) int64, the old row that each new row copies.
    values : new values by field.
    fresh : (N_new,) bool, whether the optimizer state (moments, momentum) of a row becomes zero.
    state_source : (N_new,) int64, the old row that each new row copies its optimizer state from, before `fresh` is
        applied. None: the state stays in its row, and additional rows start at zero.
    reset_fields : fields whose optimizer state becomes zero in all rows.
    relocated, added, removed : numbers of splats.
    """

    source: Indices
    values: dict[str, NewValues]
    fresh: NDArray[np.bool_]
    state_source: Indices | None = None
    reset_fields: tuple[str, ...] = ()
    relocated: int = 0
    added: int = 0
    removed: int = 0

    def permuted(self, order: Indices, n_old: int) -> DensifyEdit:
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
        place = np.empty_like(order)
        place[order] = np.arange(len(order))
        values = {name: NewValues(place[new.rows], new.values) for name, new in self.values.items()}
        return replace(self, source=self.source[order], values=values, fresh=fresh[order], state_source=states[order])

    def after(self, name: str, old: Array) -> Array:
        """Return a copy of one field after the edit. old : (N, ...) the field before it."""
        moved: Array = old[self.source]
        if name in self.values:
            moved[self.values[name].rows] = self.values[name].values
        return moved

    def apply(self, arrays: Mapping[str, Array]) -> dict[str, Array]:
        """Return copies of the parameters after the edit. The device must produce the same values."""
        return {name: self.after(name, array) for name, array in arrays.items()}

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
