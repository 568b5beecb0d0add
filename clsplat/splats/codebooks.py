"""Codebooks: few values that stand for many, so that a file can store each value as its place in a list.

`best_levels` makes a codebook of numbers, `palette` one of rows of numbers. Both minimise the squared error by Lloyd's
method (Lloyd 1982, "Least squares quantization in PCM"), and both give equal results for equal inputs.

A palette has too many entries to compare every row with every entry. So rows are first divided into cells, and each
cell gets entries of its own: more of them where the error is larger. Afterwards a row may take an entry of a
neighbouring cell.
"""

from __future__ import annotations

import heapq

import numpy as np
from numpy.typing import NDArray

from .fields import DoubleArray

Rows = NDArray[np.float32]
Labels = NDArray[np.int64]

LEVELS = 256
MAX_ENTRIES = 1 << 16

_LEVEL_STEPS = 200  # limit of Lloyd's steps for numbers; each takes microseconds
_CELL_STEPS, _ENTRY_STEPS = 8, 8  # Lloyd's steps for rows; more of them gain less than 0.1 dB
_SAMPLE = 1 << 15  # rows that the cells are made from
_NEIGHBOURS = 4  # cells whose entries a row may take, with its cell
_CHUNK = 1 << 22  # distances that are in memory at a time


def best_levels(
    values: NDArray[np.floating], weights: NDArray[np.floating] | None = None, finest: float = 0.0, n: int = LEVELS
) -> DoubleArray:
    """Return n ascending numbers for which the squared distances of values to the nearest one are small.

    If fewer numbers are needed, the last one is repeated.

    Parameters
    ----------
    values : real numbers of any shape.
    weights : importance of each value, above 0; any shape that broadcasts to that of values.
    finest : width of steps around 0 and its multiples; values of one step get one level together. Levels at equal
        distances make the error larger than the best ones do, but places in such a list compress better. 0 means none.
    """
    if values.size == 0:
        return np.zeros(n)
    points, mass = _points(values, weights, finest)
    middle = float(np.average(points, weights=mass))
    offsets = points - middle
    moments = np.zeros((3, len(points) + 1))  # sums before each point, so that those of a cell are a difference
    np.cumsum([mass, mass * offsets, mass * offsets**2], axis=1, out=moments[:, 1:])

    # The best cells have nearly equal errors (Panter and Dite 1951). So the worst cell is halved, at its mean.
    cells = [(-np.inf, 0, len(points))]
    while len(cells) < n and cells[0][0] < 0.0:
        _, first, end = heapq.heappop(cells)
        if end - first < 2:
            heapq.heappush(cells, (0.0, first, end))
            continue
        total, first_moment, _ = moments[:, end] - moments[:, first]
        cut = int(np.clip(np.searchsorted(offsets, first_moment / total), first + 1, end - 1))
        for start, stop in ((first, cut), (cut, end)):
            heapq.heappush(cells, (-_spread(moments[:, stop] - moments[:, start]), start, stop))
    edges = np.array([*sorted(first for _, first, _ in cells), len(points)])

    for _ in range(_LEVEL_STEPS):
        total, first_moment, _ = np.diff(moments[:, edges], axis=1)
        levels = first_moment / total
        inner = np.searchsorted(offsets, 0.5 * (levels[1:] + levels[:-1]))
        moved = np.unique([0, *inner, len(points)])  # cells without points vanish
        if np.array_equal(moved, edges):
            break
        edges = moved
    return np.pad(levels + middle, (0, n - len(levels)), mode="edge")


def nearest_levels(levels: DoubleArray, values: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Return the place of the nearest of at most 256 ascending levels for each value, in the shape of values."""
    distinct = np.unique(levels)
    return np.searchsorted(0.5 * (distinct[1:] + distinct[:-1]), values).astype(np.uint8)


def palette(rows: Rows, weights: NDArray[np.floating], n: int = MAX_ENTRIES) -> tuple[Rows, Labels]:
    """Return at most n entries (M, D) for rows (N, D), and the place (N,) of each row's entry.

    Entries have the order of their first row. If there are at most n different rows, these are the entries. Otherwise
    an entry is the weighted average of its rows.

    Parameters
    ----------
    weights : (N,) importance of each row, above 0.
    """
    rows = np.ascontiguousarray(rows + np.float32(0.0))  # -0 becomes 0
    if rows.size == 0:
        return rows[: min(len(rows), 1)], np.zeros(len(rows), np.int64)
    text = rows.view(np.dtype((np.void, rows.strides[0])))[:, 0]
    _, first, labels = np.unique(text, return_index=True, return_inverse=True)
    labels = labels.reshape(-1)
    entries = rows[first]
    if len(entries) > n:
        order = np.argsort(first)  # neighbours stay neighbours
        entries, places = _clustered(entries[order], np.bincount(labels, weights)[order].astype(np.float32), n)
        at = np.empty_like(places)
        at[order] = places
        labels = at[labels]
    return _by_first_use(entries, labels)
