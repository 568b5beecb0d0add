"""Codebooks: few values that stand for many, so that a file can store each value as its place in a list.

`best_levels` makes a codebook of numbers, `palette` one of rows of numbers. Both make the squared error small, and both
give equal results for equal inputs.

A palette has too many rows to compare all pairs. So the rows are halved again and again, until pieces are small. In
each piece the two rows are merged that increase the error least (Ward 1963, "Hierarchical grouping to optimize an
objective function"), until one is left. Of all merges of all pieces, only the cheapest count. Finally a row may take a
nearer entry of another piece.
"""

from __future__ import annotations

import heapq

import numpy as np
from numpy.typing import NDArray

from .fields import DoubleArray

Rows = NDArray[np.float32]
Indices = NDArray[np.int64]

LEVELS = 256
MAX_ENTRIES = 1 << 16

_LEVEL_STEPS = 200  # limit of Lloyd's steps for numbers, which take microseconds
_PIECE = 1024  # rows that are compared pair by pair; twice as many gain 0.2 dB and take twice the time
_AXIS_ROWS = 4096  # rows that the direction of a cut is computed from
_NEIGHBOURS = 16  # pieces whose entries a row may take
_ENTRY_STEPS = 2  # Lloyd's steps for entries
_CHUNK = 1 << 22  # distances that are in memory at a time


def best_levels(
    values: NDArray[np.floating], weights: NDArray[np.floating] | None = None, finest: float = 0.0, n: int = LEVELS
) -> DoubleArray:
    """Return n ascending numbers with a small mean squared distance of values to the nearest of them.

    The method is that of Lloyd 1982, "Least squares quantization in PCM". If fewer numbers are enough, the last one is
    repeated.

    Parameters
    ----------
    values : finite real numbers of any shape.
    weights : importance of each value, above 0; a shape that broadcasts to that of values.
    finest : width of the steps whose middles are the multiples of this number. The values of a step get one level
        together. The error is then larger, but places in the list compress better. 0 means no steps.
    """
    if values.size == 0:
        return np.zeros(n)
    points, mass = _points(values, weights, finest)
    middle = np.average(points, weights=mass)
    points -= middle
    moments = np.zeros((3, len(points) + 1))  # sums over the points before each one; those of a cell are differences
    np.cumsum([mass, mass * points, mass * points**2], axis=1, out=moments[:, 1:])
    edges = _halved(points, moments, n)
    for _ in range(_LEVEL_STEPS):
        total, first, _ = np.diff(moments[:, edges], axis=1)
        levels = first / total
        inner = np.searchsorted(points, 0.5 * (levels[1:] + levels[:-1]))
        moved = np.unique([0, *inner, len(points)])  # a cell without points vanishes
        if np.array_equal(moved, edges):
            break
        edges = moved
    return np.pad(levels + middle, (0, n - len(levels)), mode="edge")


def nearest_level(levels: DoubleArray, values: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Return the place of the nearest of at most 256 ascending levels, for each value. Of equal ones the first counts."""
    distinct = np.unique(levels)
    return np.searchsorted(0.5 * (distinct[1:] + distinct[:-1]), values).astype(np.uint8)


def palette(rows: Rows, weights: NDArray[np.floating], n: int = MAX_ENTRIES) -> tuple[Rows, Indices]:
    """Return at most n entries (M, D) for rows (N, D), and the place (N,) of the entry of each row.

    Entries have the order of their first rows. At most n different rows are their own entries. Otherwise an entry is
    the weighted average of its rows.

    Parameters
    ----------
    weights : (N,) importance of each row, above 0.
    """
    rows = np.ascontiguousarray(rows + np.float32(0.0))  # -0 becomes 0
    first, labels = _distinct(rows)
    if len(first) > n:
        distinct = np.argsort(first)  # in the order of the rows: neighbours stay neighbours
        mass = np.bincount(labels, weights)[distinct].astype(np.float32)
        entries, places = _clustered(rows[first[distinct]], mass, n)
        back = np.empty_like(distinct)
        back[distinct] = places
        labels = back[labels]
    else:
        entries = rows[first]
    used, first, labels = np.unique(labels, return_index=True, return_inverse=True)
    order = np.argsort(first)
    return entries[used[order]], np.argsort(order)[labels]


def _points(
    values: NDArray[np.floating], weights: NDArray[np.floating] | None, finest: float
) -> tuple[DoubleArray, DoubleArray]:
    """Return ascending numbers and their weights: the values, or the average of each step."""
    flat = values.ravel().astype(np.float64)
    mass = np.ones(len(flat)) if weights is None else np.broadcast_to(weights, values.shape).ravel().astype(np.float64)
    order = np.argsort(flat, kind="stable")
    flat, mass = flat[order], mass[order]
    steps = np.rint(flat / finest) if finest > 0.0 else flat
    starts = np.flatnonzero(np.concatenate([[True], steps[1:] != steps[:-1]]))
    total = np.add.reduceat(mass, starts)
    return np.add.reduceat(mass * flat, starts) / total, total


def _halved(points: DoubleArray, moments: DoubleArray, n: int) -> Indices:
    """Return the edges of at most n cells of points: the cell with the largest error is cut at its mean, repeatedly.

    The cells of the best levels have nearly equal errors (Panter and Dite 1951), so this is a good start.
    """
    cells = [(-np.inf, 0, len(points))]
    while len(cells) < n and cells[0][0] < 0.0:
        _, start, end = heapq.heappop(cells)
        total, first, _ = moments[:, end] - moments[:, start]
        cut = start + np.searchsorted(points[start:end], first / total)
        cut = int(np.clip(cut, start + 1, max(end - 1, start + 1)))
        for low, high in ((start, cut), (cut, end)):
            total, first, second = moments[:, high] - moments[:, low]
            error = second - first**2 / total if high - low > 1 else 0.0
            heapq.heappush(cells, (-error, low, high))
    return np.array([*sorted(start for _, start, _ in cells), len(points)])
