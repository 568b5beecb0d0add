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
_NEIGHBOURS = 32  # pieces whose entries a row may take
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
    edges = _halved(points, mass, n)
    for _ in range(_LEVEL_STEPS):
        levels = np.add.reduceat(mass * points, edges[:-1]) / np.add.reduceat(mass, edges[:-1])
        inner = np.searchsorted(points, 0.5 * (levels[1:] + levels[:-1]))
        moved = np.unique([0, *inner, len(points)])  # a cell without points vanishes
        if np.array_equal(moved, edges):
            break
        edges = moved
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


def _halved(points: DoubleArray, mass: DoubleArray, n: int) -> Indices:
    """Return the edges of at most n cells of points: the cell with the largest error is cut at its mean, repeatedly.

    The cells of the best levels have nearly equal errors (Panter and Dite 1951), so this is a good start.
    """

    def cell(start: int, end: int) -> tuple[float, int, int, float]:
        mean = np.average(points[start:end], weights=mass[start:end])
        return -float(np.sum(mass[start:end] * (points[start:end] - mean) ** 2)), start, end, mean

    cells = [cell(0, len(points))]
    while len(cells) < min(n, len(points)):
        _, start, end, mean = heapq.heappop(cells)
        cut = min(max(int(np.searchsorted(points[start:end], mean)), 1), end - start - 1) + start
        heapq.heappush(cells, cell(start, cut))
        heapq.heappush(cells, cell(cut, end))
    return np.array([*sorted(start for _, start, _, _ in cells), len(points)])


def _distinct(rows: Rows) -> tuple[Indices, Indices]:
    """Return the place of the first of equal rows, for each different row, and the number (N,) of the row it equals."""
    if rows.size == 0:
        return np.arange(min(len(rows), 1)), np.zeros(len(rows), np.int64)
    keys = rows.view(np.dtype((np.void, rows.strides[0])))[:, 0]
    _, first, labels = np.unique(keys, return_index=True, return_inverse=True)
    return first, labels


def _clustered(rows: Rows, weights: Rows, n: int) -> tuple[Rows, Indices]:
    """Return n entries for more than n different rows, and the place of the entry of each row."""
    pieces = _pieces(rows)
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
    for i, piece in enumerate(pieces):
        piece_of[piece] = i
    of_piece = [np.flatnonzero(piece_of[roots] == i) for i in range(len(pieces))]
    centres = np.stack([rows[piece].mean(axis=0) for piece in pieces])
    for _ in range(_ENTRY_STEPS):
        for piece, centre in zip(pieces, centres, strict=True):
            near = np.argsort(np.sum((centres - centre) ** 2, axis=1), kind="stable")[:_NEIGHBOURS]
            choice = np.concatenate([of_piece[i] for i in near])
            labels[piece] = choice[_nearest(rows[piece], entries[choice])]
        entries = _averages(rows, weights, labels, entries)
    return entries, labels


def _pieces(rows: Rows) -> list[Indices]:
    """Return the rows in pieces of at most `_PIECE`: each is cut in two halves along its longest axis."""
    whole, pieces = [np.arange(len(rows))], []
    while whole:
        piece = whole.pop()
        if len(piece) <= _PIECE:
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
    light = 1.0 / weights
    found = []
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
        means = means.copy()
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
