"""Cells that divide the world into blocks: a grid of columns and rows, each place in exactly one cell."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import InputError
from ..splats.fields import DoubleArray

AUTO = "auto"
MOST_BLOCKS = 64  # in each direction
SPLATS_OF_A_BLOCK = 200_000  # at most, with "auto"
_FAR = 4.0  # distances of the cameras from their middle; farther places count as if they were there


def parse_blocks(text: str, cap: int) -> tuple[int, int]:
    """Return columns and rows of a text such as 2x3.

    With "auto", each block has at most SPLATS_OF_A_BLOCK splats, and there are about as many columns as rows.

    Parameters
    ----------
    cap : largest number of splats of the whole model.

    Raises
    ------
    InputError : the text has another form.
    """
    if text == AUTO:
        count = max(-(-cap // SPLATS_OF_A_BLOCK), 2)
        columns = min(math.ceil(math.sqrt(count)), MOST_BLOCKS)
        return columns, min(-(-count // columns), MOST_BLOCKS)
    found = re.fullmatch(r"(\d{1,3})[xX](\d{1,3})", text)
    columns, rows = (int(found[1]), int(found[2])) if found else (0, 0)
    if not (1 <= columns <= MOST_BLOCKS and 1 <= rows <= MOST_BLOCKS) or columns * rows < 2:
        raise InputError(
            f"blocks {text!r}: give columns x rows with at least two blocks, such as 2x2, at most "
            f"{MOST_BLOCKS} of each, or {AUTO}"
        )
    return columns, rows


@dataclass(frozen=True, eq=False)
class Cells:
    """Columns across one axis of the world, each divided into rows across another one.

    Cells are half-open: a place on a border belongs to the cell behind it. The outer cells have no end. So each place
    belongs to exactly one cell.

    Attributes
    ----------
    axes : (2, 3) unit vectors.
    columns : (N - 1,) borders of the columns along the first axis, in rising order [world units].
    rows : (N, M - 1) borders of the rows of each column along the second axis, in rising order [world units].
    """

    axes: DoubleArray
    columns: DoubleArray
    rows: DoubleArray

    @property
    def count(self) -> int:
        """Number of cells."""
        n, borders = self.rows.shape
        return n * (borders + 1)

    def of(self, places: ArrayLike) -> NDArray[np.int64]:
        """Return the number of the cell of each place, (N,). places : (N, 3) [world units]."""
        x, y = self.axes @ np.asarray(places, np.float64).T
        column = np.searchsorted(self.columns, x, side="right")
        row = (self.rows[column] <= y[:, None]).sum(axis=1)
        cell: NDArray[np.int64] = column * (self.rows.shape[1] + 1) + row
        return cell

    def distance_to_border(self, places: ArrayLike) -> DoubleArray:
        """Return the distance of each place to the nearest border of its cell, (N,) [world units]."""
        x, y = self.axes @ np.asarray(places, np.float64).T
        column = np.searchsorted(self.columns, x, side="right")
        across = np.abs(x[:, None] - self.columns).min(axis=1, initial=np.inf)
        along: DoubleArray = np.abs(y[:, None] - self.rows[column]).min(axis=1, initial=np.inf)
        return np.minimum(across, along)

    def to_json(self) -> dict[str, Any]:
        """Return plain values of all attributes."""
        return {"axes": self.axes.tolist(), "columns": self.columns.tolist(), "rows": self.rows.tolist()}

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> Cells:
        """Return the cells of the values of `to_json`."""
        rows = np.asarray(values["rows"], np.float64)
        columns = np.asarray(values["columns"], np.float64)
        return cls(np.asarray(values["axes"], np.float64), columns, rows.reshape(len(columns) + 1, -1))


def make_cells(places: ArrayLike, weights: ArrayLike, cameras: ArrayLike, n_columns: int, n_rows: int) -> Cells:
    """Return cells with about equal weights.

    The axes are those along which the places differ most. Far places are moved towards the cameras first, so that a
    far background does not choose them.

    Parameters
    ----------
    places : (N, 3) [world units]. weights : (N,) at least 0. cameras : (C, 3) their centres.
    """
    places, weights = np.asarray(places, np.float64), np.asarray(weights, np.float64)
    weights = weights if weights.any() else np.ones(len(places))
    cameras = np.asarray(cameras, np.float64)
    middle = cameras.mean(axis=0)
    reach = _FAR * max(float(np.linalg.norm(cameras - middle, axis=1).max()), 1e-9)
    offset = places - middle
    length = np.maximum(np.linalg.norm(offset, axis=1, keepdims=True), 1e-12)
    near = np.where(length > reach, offset * (reach / length), offset)
    centred = near - np.average(near, axis=0, weights=weights)
    vectors = np.linalg.eigh(centred.T @ (centred * weights[:, None]))[1].T[::-1]  # the largest variance first
    largest = np.take_along_axis(vectors, np.abs(vectors).argmax(axis=1)[:, None], axis=1)
    axes = (vectors * np.sign(largest))[:2]
    x, y = axes @ places.T
    columns = _borders(x, weights, n_columns)
    inside = np.searchsorted(columns, x, side="right")
    rows = [_borders(y[inside == column], weights[inside == column], n_rows) for column in range(n_columns)]
    return Cells(axes, columns, np.array(rows).reshape(n_columns, n_rows - 1))


def _borders(values: DoubleArray, weights: DoubleArray, parts: int) -> DoubleArray:
    """Return the borders between `parts` parts of equal weight, (parts - 1,)."""
    if not len(values):
        return np.zeros(parts - 1)
    order = np.argsort(values, kind="stable")
    sums = np.cumsum(weights[order])
    aims = sums[-1] * np.arange(1, parts) / parts
    return values[order][np.minimum(np.searchsorted(sums, aims), len(values) - 1)]
