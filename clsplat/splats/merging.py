"""Levels of detail: models with ever fewer Gaussians, in which neighbours are merged in pairs.

A merged Gaussian has the mean and the covariance of its pair, each weighted by opacity times area, and their mean
colour. Its opacity keeps the sum of opacity times area, as far as that is below 1. These are the rules of Hierarchical
3DGS (Kerbl et al. 2024). The area is that of the two longer axes.

Pairs are chosen among near neighbours. The cheapest go first: those that are faint or small, close to each other in
their deviations, and alike in colour.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from .fields import Array, DoubleArray
from .harmonics import SH_C0
from .quaternions import of_rotations, rotations
from .shapes import GAUSSIAN

Indices = NDArray[np.int64]

_NEIGHBOURS = 8
_CLOSENESS = 0.02  # cost of a squared distance in deviations, against that of a squared difference in colour
_ROUNDS = 40  # limit of the rounds in which pairs choose each other
_OPACITIES = (1e-6, 1.0 - 1e-6)
_FLATTEST = 1e-12  # smallest variance, relative to the largest of a splat
_REACH = 3.0  # standard deviations: the extent of a Gaussian in a box

Box = tuple[DoubleArray, DoubleArray]  # its lowest and its highest corner, (3,) each


@dataclass(frozen=True)
class Level:
    """Gaussians of one level.

    Parameters
    ----------
    mean, covariance : (N, 3) and (N, 3, 3). opacity : (N,) 0..1. sh : (N, K, 3).
    group : (N,) number of the part of the scene; only splats of one part are merged.
    error : (N,) sum of the costs of the merges below each splat.
    spread : (N,) variance of the centres that were merged into each splat, along all axes together [world units²].
    """

    mean: DoubleArray
    covariance: DoubleArray
    opacity: DoubleArray
    sh: DoubleArray
    group: Indices
    error: DoubleArray
    spread: DoubleArray

    def __len__(self) -> int:
        return len(self.mean)

    def arrays(self) -> dict[str, Array]:
        """Return the public arrays in float32."""
        variances, axes = np.linalg.eigh(self.covariance)
        variances = np.maximum(variances, _FLATTEST * variances[:, -1:])
        axes[np.linalg.det(axes) < 0.0, :, 0] *= -1.0
        values = {
            "mean": self.mean,
            "quat": of_rotations(axes),
            "log_scale": 0.5 * np.log(np.maximum(variances, 1e-60)),
            "opacity_logit": GAUSSIAN.raw_opacity(np.clip(self.opacity, *_OPACITIES)),
            "sh": self.sh,
        }
        return {name: value.astype(np.float32) for name, value in values.items()}


def level_of(arrays: Mapping[str, Array], group: Indices) -> Level:
    """Return the Gaussians of public arrays as the first level."""
    frame = rotations(arrays["quat"].astype(np.float64)) * np.exp(arrays["log_scale"].astype(np.float64))[:, None]
    return Level(
        arrays["mean"].astype(np.float64),
        frame @ frame.transpose(0, 2, 1),
        np.asarray(GAUSSIAN.opacity(arrays["opacity_logit"].astype(np.float64)), np.float64),
        arrays["sh"].astype(np.float64),
        group,
        np.zeros(len(group)),
        np.zeros(len(group)),
    )


def leaves_of(mean: Array, size: int) -> list[Indices]:
    """Return the rows of the parts of a scene with at most `size` splats each.

    Splats are halved along the longest side of their box, repeatedly. mean : (N, 3).
    """
    waiting, found = [np.arange(len(mean))], []
    while waiting:
        rows = waiting.pop()
        if len(rows) <= size:
            found.append(rows)
            continue
        places = mean[rows]
        order = np.argsort(places[:, np.ptp(places, axis=0).argmax()], kind="stable")
        half = len(rows) // 2
        waiting += [rows[order[half:]], rows[order[:half]]]
    return found


def levels_of(arrays: Mapping[str, Array], leaves: Sequence[Indices], count: int) -> list[Level]:
    """Return at most `count` levels of Gaussians, the finest first. Splats of one leaf alone are merged.

    arrays : public arrays. leaves : the rows of each leaf.
    """
    group = np.empty(len(arrays["mean"]), np.int64)
    for number, rows in enumerate(leaves):
        group[rows] = number
    found = [level_of(arrays, group)]
    while len(found) < count and len(coarser := merged(found[-1])) < len(found[-1]):
        found.append(coarser)
    return found


def boxes_of(levels: Sequence[Level], leaves: int) -> list[Box]:
    """Return the box of each leaf around the Gaussians of all levels."""
    low, high = np.full((leaves, 3), np.inf), np.full((leaves, 3), -np.inf)
    for level in levels:
        reach = _REACH * np.sqrt(np.diagonal(level.covariance, axis1=1, axis2=2))
        np.minimum.at(low, level.group, level.mean - reach)
        np.maximum.at(high, level.group, level.mean + reach)
    return list(zip(low, high, strict=True))


def merged(level: Level) -> Level:
    """Return a level with about half as many Gaussians: as many pairs as have a near neighbour of their part."""
    mass = level.opacity * _areas(level.covariance)
    one, other, cost = _pairs(level, mass)
    if len(one) == 0:
        return level
    share = mass[one] / np.maximum(mass[one] + mass[other], 1e-300)
    first, second = share[:, None], 1.0 - share[:, None]
    mean = first * level.mean[one] + second * level.mean[other]
    covariance, spread = np.zeros((len(one), 3, 3)), np.zeros(len(one))
    for part, weight in ((one, first), (other, second)):
        offset = level.mean[part] - mean
        spread += weight[:, 0] * (level.spread[part] + np.sum(offset * offset, axis=1))
        covariance += weight[:, :, None] * (level.covariance[part] + offset[:, :, None] * offset[:, None, :])
    pair = Level(
        mean,
        covariance,
        np.minimum((mass[one] + mass[other]) / np.maximum(_areas(covariance), 1e-300), 1.0),
        first[:, :, None] * level.sh[one] + second[:, :, None] * level.sh[other],
        level.group[one],
        level.error[one] + level.error[other] + cost,
        spread,
    )
    alone = np.ones(len(level), np.bool_)
    alone[one] = alone[other] = False
    names = ("mean", "covariance", "opacity", "sh", "group", "error", "spread")
    joined = {name: np.concatenate([getattr(level, name)[alone], getattr(pair, name)]) for name in names}
    return replace(level, **joined)


def _areas(covariance: DoubleArray) -> DoubleArray:
    """Return the product of the two longer axes of each splat."""
    variances = np.linalg.eigvalsh(covariance)
    return np.sqrt(np.maximum(variances[:, 1] * variances[:, 2], 0.0))


def _pairs(level: Level, mass: DoubleArray) -> tuple[Indices, Indices, DoubleArray]:
    """Return both members of at most half as many pairs as there are splats, and the cost of each merge."""
    from scipy.spatial import cKDTree  # lazy: a slow import

    n = len(level)
    none = np.empty(0, np.int64), np.empty(0, np.int64), np.empty(0)
    if n < 2:
        return none
    # Parts of the scene lie far from each other along a fourth axis, so that all neighbours are of one part.
    far = 4.0 * max(float(np.ptp(level.mean, axis=0).max()), 1e-30)
    places = np.column_stack([level.mean, far * level.group])
    near = np.asarray(cKDTree(places).query(places, min(_NEIGHBOURS + 1, n), workers=-1)[1])[:, 1:]
    one = np.repeat(np.arange(n), near.shape[1])
    other = near.ravel()
    kept = (level.group[one] == level.group[other]) & (one != other)
    if not kept.any():
        return none
    one, other = np.minimum(one, other)[kept], np.maximum(one, other)[kept]
    one, other = np.unique(np.stack([one, other]), axis=1)
    cost = _costs(level, mass, one, other)
    taken = np.zeros(n, np.bool_)
    chosen: list[Indices] = []
    left = np.argsort(cost, kind="stable")
    for _ in range(_ROUNDS):
        if len(left) == 0:
            break
        # A pair is taken if it is the cheapest one of both its members.
        first = np.full(n, len(left))
        np.minimum.at(first, one[left], np.arange(len(left)))
        np.minimum.at(first, other[left], np.arange(len(left)))
        places_of = np.arange(len(left))
        mutual = left[(first[one[left]] == places_of) & (first[other[left]] == places_of)]
        chosen.append(mutual)
        taken[one[mutual]] = taken[other[mutual]] = True
        left = left[~(taken[one[left]] | taken[other[left]])]
    best = np.concatenate(chosen)
    return one[best], other[best], cost[best]


def _costs(level: Level, mass: DoubleArray, one: Indices, other: Indices) -> DoubleArray:
    """Return the cost of each pair's merge; mass (N,) is opacity times area."""
    weight = mass[one] * mass[other] / np.maximum(mass[one] + mass[other], 1e-300)
    difference = SH_C0 * (level.sh[one, 0] - level.sh[other, 0])
    offset = level.mean[one] - level.mean[other]
    both = level.covariance[one] + level.covariance[other]
    both += 1e-9 * np.trace(both, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    distance = np.einsum("ni,ni->n", offset, np.linalg.solve(both, offset[:, :, None])[:, :, 0])
    cost: DoubleArray = weight * (np.sum(difference**2, axis=1) + _CLOSENESS * distance)
    return cost
