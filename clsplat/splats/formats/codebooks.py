"""Codebooks: few values that stand for many, so that a file can store each value as its place in a list.

`best_levels` makes a codebook of numbers, `palette` one of rows of numbers. Both make the squared error small, and both
give equal results for equal inputs.

A palette has too many rows to compare all pairs. So the rows are halved again and again, until pieces are small. In
each piece the two rows are merged that increase the error least (Ward 1963, "Hierarchical grouping to optimize an
objective function"), until one is left. Then only the cheapest merges of all pieces count. Finally a row may take a
nearer entry of another piece.
"""

from __future__ import annotations

import heapq

import numpy as np
from numpy.typing import NDArray

from ..fields import DoubleArray

Rows = NDArray[np.float32]
Indices = NDArray[np.int64]

LEVELS = 256
MAX_ENTRIES = 1 << 16

_LEVEL_STEPS = 20  # limit of Lloyd's steps for numbers
_SMALL_CELLS = 4  # for each level, of the first estimate
_PIECE = 1024  # rows that are compared pair by pair; twice as many gain 0.2 dB and take twice the time
_AXIS_ROWS = 4096  # rows that the direction of a cut is computed from
_NEIGHBOURS = 32  # pieces whose entries a row may take
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
    halved = _halved(points, mass, n)
    starts = [halved] if len(points) <= n else [halved, _balanced(points, mass, n)]
    _, levels = min((_lloyd(points, mass, edges) for edges in starts), key=lambda found: found[0])
    return np.pad(levels, (0, n - len(levels)), mode="edge")


def nearest_level(levels: DoubleArray, values: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Return the place of the nearest of at most 256 ascending levels for each value, the first of equal ones."""
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


def _moments(points: DoubleArray, mass: DoubleArray, edges: Indices) -> tuple[DoubleArray, DoubleArray]:
    """Return the average and the squared error of each cell of points, between two edges."""
    starts = edges[:-1]
    averages = np.add.reduceat(mass * points, starts) / np.add.reduceat(mass, starts)
    errors = np.add.reduceat(mass * (points - np.repeat(averages, np.diff(edges))) ** 2, starts)
    return averages, errors


def _halved(points: DoubleArray, mass: DoubleArray, n: int) -> Indices:
    """Return the edges of n cells, or one for each point: the cell with the largest error is cut, at its average."""

    def cell(start: int, end: int) -> tuple[float, int, int, float]:
        (average,), (error,) = _moments(points[start:end], mass[start:end], np.array([0, end - start]))
        return np.inf if end - start == 1 else -error, start, end, average

    cells = [cell(0, len(points))]  # a heap, the largest error first
    while len(cells) < min(n, len(points)):
        _, start, end, average = heapq.heappop(cells)
        cut = min(max(int(np.searchsorted(points[start:end], average)), 1), end - start - 1) + start
        heapq.heappush(cells, cell(start, cut))
        heapq.heappush(cells, cell(cut, end))
    return np.array([*sorted(start for _, start, _, _ in cells), len(points)])


def _balanced(points: DoubleArray, mass: DoubleArray, n: int) -> Indices:
    """Return the edges of at most n cells with equal errors, as the best cells of smooth data have (Panter, Dite 1951).

    A cell that is cut into k parts has k^2 times less error. So the cube roots of errors say how many cells there
    should be up to each place. Single points far from others have no error and get no cell, which the data must allow.
    """
    small = _halved(points, mass, _SMALL_CELLS * n)
    parts = np.concatenate([[0.0], np.cumsum(np.cbrt(_moments(points, mass, small)[1]))])
    inner = np.interp(np.linspace(0.0, parts[-1], n + 1)[1:-1], parts, small)
    return np.unique([0, *np.rint(inner).astype(np.int64), len(points)])


def _lloyd(points: DoubleArray, mass: DoubleArray, edges: Indices) -> tuple[float, DoubleArray]:
    """Return the squared error and the levels after some of Lloyd's steps."""
    for _ in range(_LEVEL_STEPS):
        levels, errors = _moments(points, mass, edges)
        inner = np.searchsorted(points, 0.5 * (levels[1:] + levels[:-1]))
        moved = np.unique([0, *inner, len(points)])  # a cell without points vanishes
        if np.array_equal(moved, edges):
            break
        edges = moved
    return float(errors.sum()), levels


def _distinct(rows: Rows) -> tuple[Indices, Indices]:
    """Return the place of the first of equal rows, for each different row, and the number (N,) of the row it equals."""
    if rows.size == 0:
        return np.arange(min(len(rows), 1)), np.zeros(len(rows), np.int64)
    keys = rows.view(np.dtype((np.void, rows.strides[0])))[:, 0]
    _, first, labels = np.unique(keys, return_index=True, return_inverse=True)
    return first, labels


def _clustered(rows: Rows, weights: Rows, n: int) -> tuple[Rows, Indices]:
    """Return n entries for more than n different rows, and the place of the entry of each row."""
    pieces = _pieces(rows, max(_PIECE, 4 * len(rows) // n))  # at most n / 2 pieces, because each keeps an entry
    merges = [_merges(piece, rows[piece], weights[piece]) for piece in pieces]
    kept, gone, added = (np.concatenate(parts) for parts in zip(*merges, strict=True))
    cheapest = np.argsort(added, kind="stable")[: len(rows) - n]
    root = np.arange(len(rows))
    root[gone[cheapest]] = kept[cheapest]
    while not np.array_equal(root, higher := root[root]):
        root = higher
    roots, labels = np.unique(root, return_inverse=True)
    entries = _averages(rows, weights, labels, rows[roots])

    piece_of = np.empty(len(rows), np.int64)
    for number, piece in enumerate(pieces):
        piece_of[piece] = number
    entries_of = [np.flatnonzero(piece_of[roots] == number) for number in range(len(pieces))]
    centres = np.stack([rows[piece].mean(axis=0) for piece in pieces])
    for piece, centre in zip(pieces, centres, strict=True):
        near = np.argsort(np.sum((centres - centre) ** 2, axis=1), kind="stable")[:_NEIGHBOURS]
        choice = np.concatenate([entries_of[number] for number in near])
        labels[piece] = choice[_nearest(rows[piece], entries[choice])]
    return _averages(rows, weights, labels, entries), labels


def _pieces(rows: Rows, size: int) -> list[Indices]:
    """Return the rows in pieces of at most this size: a larger one is cut in two halves along its longest axis."""
    whole, pieces = [np.arange(len(rows))], []
    while whole:
        piece = whole.pop()
        if len(piece) <= size:
            pieces.append(piece)
            continue
        some = rows[piece[:: -(-len(piece) // _AXIS_ROWS)]]
        some = some - some.mean(axis=0)
        axis = np.linalg.eigh(some.T @ some)[1][:, -1]
        half = len(piece) // 2
        order = np.argpartition(rows[piece] @ axis, half)
        whole += [np.sort(piece[order[:half]]), np.sort(piece[order[half:]])]
    return pieces


def _merges(names: Indices, means: Rows, weights: Rows) -> tuple[Indices, Indices, Rows]:
    """Return the merges of rows into one: the name of the row that stays, that of the other one, and the added error.

    Two clusters that are nearest to each other merge at once. The tree is that of merging the nearest pair of all,
    because a merge does not bring clusters nearer (Murtagh 1983).
    """
    means, light, found = means.copy(), 1.0 / weights, []
    while len(names) > 1:
        half = 0.5 * np.einsum("nd,nd->n", means, means)
        added = means @ means.T
        np.subtract(half, added, out=added)
        added += half[:, None]
        added /= light + light[:, None]
        np.fill_diagonal(added, np.inf)
        nearest = added.argmin(axis=1)
        places = np.arange(len(names))
        one = np.flatnonzero((nearest[nearest] == places) & (places < nearest))
        if len(one) == 0:  # rounding can make a circle of nearest ones
            one = added[places, nearest].argmin(keepdims=True)
        other = nearest[one]
        found.append((names[one], names[other], added[one, other]))
        share = (light[one] / (light[one] + light[other]))[:, None]  # the lighter one has the smaller share
        means[one] += share * (means[other] - means[one])
        light[one] = 1.0 / (1.0 / light[one] + 1.0 / light[other])
        names, means, light = (np.delete(values, other, axis=0) for values in (names, means, light))
    kept, gone, cost = (np.concatenate(parts) for parts in zip(*found, strict=True))
    return kept, gone, cost


def _nearest(rows: Rows, entries: Rows) -> Indices:
    """Return the place of the nearest entry of each row."""
    half = 0.5 * np.einsum("nd,nd->n", entries, entries)
    step = max(1, _CHUNK // len(entries))
    parts = [(rows[i : i + step] @ entries.T - half).argmax(axis=1) for i in range(0, len(rows), step)]
    return np.concatenate(parts)


def _averages(rows: Rows, weights: Rows, labels: Indices, entries: Rows) -> Rows:
    """Return the weighted average of the rows of each entry; entries without rows stay."""
    mass = np.bincount(labels, weights, len(entries))
    sums = np.stack([np.bincount(labels, weights * column, len(entries)) for column in rows.T], axis=1)
    averages = entries.copy()
    averages[mass > 0.0] = sums[mass > 0.0] / mass[mass > 0.0, None]
    return averages
