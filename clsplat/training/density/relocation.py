"""Relocation and growth of 3DGS-MCMC (Kheradmand et al. 2024) for every shape, as edits made on the host.

N copies with opacity o' and another scale replace a splat of opacity o. Along a line through the splat, the stack of
copies absorbs as much as the splat did. With g the profile of the kernel (splats/profiles.py):

    1 - (1 - o')^N = o
    length factor = integral of o g  /  integral of 1 - (1 - o' g)^N

Both integrals are numerical (length_factor.py), so they exist for every profile. For the Gaussian they equal the
published double sum. The factor applies to lengths (ubc-vision/3dgs-mcmc#37). Student splatting squares it, which is
the rule "length-squared". If a splat has two opacities, each has its o', and the line crosses the plane between them.
For negative opacities (the scooping of Student splatting) the formula applies to |o|, and the sign stays.

Beyond 3DGS-MCMC, splats still move once their number no longer grows. With a turnover the faintest ones count as dead
then. Copies are drawn in proportion to the mean screen gradient, by which `adc` chooses too. A splat with a single copy
may be split along its longest axis instead (halves.py): two splats in one place have the same gradients, and take long
to part.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError
from ...splats.fields import Array, DoubleArray
from ...splats.optical_depth import opacity_names, optical_depth, raw_of_optical_depth
from ...splats.shapes import Shape
from ..methods import sss
from .edit import DensifyEdit, Indices, NewValues
from .halves import split_along_axis
from .length_factor import length_factor
from .table import SplatTable, smallest

# 3DGS-MCMC's constants.
MIN_OPACITY = 0.005  # splats with at most this opacity are dead: they are relocated
GROWTH = 1.05  # growth factor of the number of splats per call
N_MAX = 51  # largest number of copies in the formula; it also replaces larger numbers

# Scales are multiplied by this power of the length factor. "opacity-only" is the rule of Deformable Beta Splatting.
RULES = {"length": 1.0, "length-squared": sss.RELOCATION_POWER, "opacity-only": 0.0}


def plan_relocation(
    splats: SplatTable,
    shape: Shape,
    rng: np.random.Generator,
    cap: int,
    *,
    growth: float = GROWTH,
    min_opacity: float = MIN_OPACITY,
    rule: str = "length",
    limit: float = 1.0,
    turnover: float = 0.0,
    gradient: Array | None = None,
    split: str = "published",
) -> DensifyEdit:
    """Return the edit that moves dead splats onto live ones and grows towards the cap.

    Splats with a parameter that is not finite are relocated like dead ones. All copies are drawn at once, with
    replacement, in proportion to strength (the larger |opacity|). The edit depends only on the arguments and the state
    of the generator. If no splat is alive, the number of splats does not grow and dead splats stay.

    Parameters
    ----------
    splats : the splats before the densification.
    rng : generator; one number is drawn for each copy.
    cap : largest number of splats after growth. A larger number of splats is kept.
    growth : new count over old count, at least 1.
    min_opacity : splats with at most this opacity are dead. New opacities are at least this large (with two opacities,
        the larger one).
    rule : "length" (opacity and scale, as above), "length-squared" (Student splatting as released), or "opacity-only"
        (the scale does not change; Deformable Beta Splatting).
    limit : largest number of dead splats that are relocated, the weakest first, as a fraction of all splats. Non-finite
        splats are always relocated.
    turnover : number of the faintest splats that count as dead if the number of splats does not grow, as a fraction of
        all splats, 0 to 0.5.
    gradient : (N,) mean screen gradient, which draws the copies if there is a turnover.
    split : "published", or "long-axis": a splat with a single copy is split along its longest axis.

    Raises
    ------
    InputError : unknown rule, growth below 1, min_opacity outside (0, 1) or limit outside [0, 1].
    TrainingError : no splat is finite.
    """
    if rule not in RULES:
        raise InputError(f"unknown relocation rule {rule!r}: choose one of {', '.join(RULES)}")
    if not 1 <= growth < math.inf or not 0 < min_opacity < 1 or not 0 <= limit <= 1:
        raise InputError(
            f"growth {growth} must be at least 1, min_opacity {min_opacity} between 0 and 1, limit {limit} 0 to 1"
        )
    summary = splats.summary()
    sound = summary.some_finite()
    n = len(sound)
    raw = np.where(sound, summary.raw_opacity, -np.inf)  # rises with the opacity
    alive = np.ones(n, np.bool_)
    faint = np.flatnonzero(raw < shape.raw_opacity(np.array(min_opacity)) + 0.01)  # the others are above it
    alive[faint] = shape.opacity(raw[faint].astype(np.float64)) > min_opacity
    n_new = max(n, min(cap, math.ceil(growth * n - 1e-6)))  # 1.05 * 100 is a little above 105 in binary
    replacing = turnover > 0 and n_new == n
    if replacing:
        alive[smallest(raw, int(turnover * n))] = False
    dead = np.flatnonzero(sound & ~alive)
    if not alive.any():
        alive, dead, n_new = sound, dead[:0], n
    weakest = dead[smallest(raw[dead], int(limit * n))]
    moving = np.sort(np.concatenate([np.flatnonzero(~sound), weakest]), kind="stable")  # merges two rising parts

    if gradient is None or not replacing:
        weights = np.where(alive, shape.opacity(summary.raw_opacity.astype(np.float64)), 0.0)
    else:
        weights = np.where(alive & np.isfinite(gradient), gradient, 0.0)
    drawn, order = _draw(weights if weights.any() else alive, len(moving) + n_new - n, rng)
    source = np.arange(n_new, dtype=np.int64)
    source[moving] = drawn[: len(moving)]
    source[n:] = drawn[len(moving) :]

    targets, stack, copies = _stacked(drawn, order)
    places = np.concatenate([moving, np.arange(n, n_new)])  # of the copies
    old = splats.take(targets)
    halved = (copies == 1) & (split == "long-axis")
    piled = ~halved
    stacks = _stacks(_rows(old, piled), copies[piled] + 1, shape, rule, min_opacity)
    number = np.cumsum(piled) - 1  # of the stack of a target
    rows = np.concatenate([targets[piled], places[piled[stack]]])
    of_stack = np.concatenate([number[piled], number[stack][piled[stack]]])
    values = {name: NewValues(rows, array[of_stack]) for name, array in stacks.items()}
    if halved.any():
        beside = np.empty_like(targets)
        beside[stack] = places
        rows = np.concatenate([targets[halved], beside[halved]])
        values = _merged(values, rows, split_along_axis(_rows(old, halved), shape, min_opacity))

    fresh = np.zeros(n_new, np.bool_)
    fresh[targets] = True
    fresh[:n] |= ~sound
    fresh[n:] = True
    return DensifyEdit(source, values, fresh, relocated=len(moving), added=n_new - n)


def _stacks(
    targets: Mapping[str, Array], ratio: NDArray[np.integer], shape: Shape, rule: str, min_opacity: float
) -> dict[str, Array]:
    """Return the changed fields of each stack's splats. ratio : number of splats that replace each target."""
    raw, factor = relocation(shape, targets, ratio, min_opacity)
    new: dict[str, Array] = {**raw}
    if RULES[rule]:
        log_scale = targets["log_scale"]
        new["log_scale"] = log_scale + (RULES[rule] * np.log(factor))[:, None].astype(log_scale.dtype)
    return new


def _merged(values: Mapping[str, NewValues], rows: Indices, more: Mapping[str, Array]) -> dict[str, NewValues]:
    """Return `values` with the new values `more` of other rows."""
    merged = dict(values)
    for name, array in more.items():
        known = values.get(name, NewValues(rows[:0], array[:0]))
        merged[name] = NewValues(np.concatenate([known.rows, rows]), np.concatenate([known.values, array]))
    return merged


def relocation(
    shape: Shape, arrays: Mapping[str, Array], ratio: NDArray[np.integer], min_opacity: float = 0.0
) -> tuple[dict[str, DoubleArray], DoubleArray]:
    """Return the opacities and the length factor of the copies if `ratio` equal splats replace one.

    Parameters
    ----------
    arrays : public arrays of N splats. ratio : (N,) number of copies, at least 1; numbers above N_MAX count as N_MAX.
    min_opacity : minimum of the new |opacity|. With two opacities, it is the minimum of the larger one, and the ratio
        of the two stays.

    Returns
    -------
    raw : by opacity field, (N,) new raw values. length_factor : (N,).
    """
    names = opacity_names(arrays)
    old = np.stack([optical_depth(shape, arrays[name]) for name in names], axis=1)  # (N, S)
    count = np.minimum(ratio, N_MAX)
    shared = np.maximum(old / count[:, None], 1e-300)
    thickest = shared.max(axis=1, initial=1e-300, keepdims=True)
    shared = shared * np.maximum(-math.log1p(-min_opacity) / thickest, 1.0)
    factor = length_factor(shape.profile, arrays, old, shared, count)
    raw = {name: raw_of_optical_depth(shape, shared[:, side], arrays[name]) for side, name in enumerate(names)}
    return raw, factor


def _rows(arrays: Mapping[str, Array], chosen: NDArray[np.bool_]) -> dict[str, Array]:
    """Return the chosen rows of all arrays."""
    rows = np.flatnonzero(chosen)  # a mask takes longer than numbers of rows
    return {name: np.take(array, rows, axis=0) for name, array in arrays.items()}


def _draw(
    weights: Array | NDArray[np.bool_], count: int, rng: np.random.Generator
) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Draw `count` indices in proportion to `weights` (at least 0, not all 0), with replacement.

    Returns
    -------
    drawn : (count,) the indices. order : (count,) numbers that sort them.
    """
    drawn = np.empty(count, np.int64)
    if not count:
        return drawn, drawn.copy()
    cumulative = np.cumsum(weights, dtype=np.float64)  # a float32 sum of all splats would lose small weights
    places = rng.random(count) * cumulative[-1]
    last = np.searchsorted(cumulative, cumulative[-1])  # random() * total may round up to the total
    order = np.argsort(places)  # a search in rising order reads the memory in order
    drawn[order] = np.minimum(np.searchsorted(cumulative, places[order], side="right"), last)
    return drawn, order


def _stacked(
    drawn: NDArray[np.int64], order: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Return different indices in rising order, the number of each drawn one among them, and how often each was drawn.

    It is `np.unique` without another sort. drawn, order : from `_draw`.
    """
    rising = drawn[order]
    first = np.flatnonzero(np.diff(rising, prepend=-1))
    copies = np.diff(first, append=len(drawn))
    stack = np.empty_like(drawn)
    stack[order] = np.repeat(np.arange(len(first)), copies)
    return rising[first], stack, copies
