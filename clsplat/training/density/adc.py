"""Adaptive density control of 3DGS (Kerbl et al. 2023), and 3DSGS's depth criterion, edited on the host.

Splats whose mean screen gradient is high are cloned (small ones: a copy in the same place) or split in two (large
ones: both halves are drawn from the Gaussian, and smaller by 1.6); faint ones, and later large ones, are pruned. Large
is meant in the world: 3DGS's limit on the screen (20 px) has no effect in its released code, nor had it in its
published numbers (graphdeco-inria/gaussian-splatting#123, #643), and where splats are few it removes most of them.

With a depth threshold (3DSGS, arXiv 2605.18334) a splat is split when either gradient is high, always along its
longest axis; that paper leaves the two halves open, so here they keep what the parent had:

    place    mean +- s/2 along the axis, s the parent's deviation there
    scale    s sqrt(3)/2 along the axis: the variance of the pair is the parent's
    skew     its part across the axis stays; the part along it is halved: a piece of a skewed density is less skewed
             than the whole, and how the pieces differ is now their own opacities' and colours' business
    two opacities    a half beyond the plane takes the opacity of that side on both of its sides, as far as the plane
             faces the axis: the thicknesses are mixed by the square of the axis' component of delta (the plane's
             unit normal; eta / sqrt(1 + |eta|^2) of a soft plane, which at no skew leaves both as they are)

In the direct form of skew the place is that of the centroid, location + sqrt(2/pi) R S delta.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...errors import TrainingError
from ...splats.fields import Array, DoubleArray
from ...splats.optical_depth import finite_rows, opacity_names, optical_depth, raw_of_optical_depth
from ...splats.quaternions import rotations
from ...splats.shapes import Shape
from .edit import DensifyEdit

# 3DGS's constants.
MIN_OPACITY = 0.005  # below: pruned
SPLIT_SHRINK = 1.6
WORLD_SIZE = 0.1  # of the scene extent; larger: pruned
RESET_OPACITY = 0.01

Rows = NDArray[np.int64]


def plan_adc(
    arrays: Mapping[str, Array],
    shape: Shape,
    stats: Array,
    rng: np.random.Generator,
    cap: int,
    *,
    extent: float,
    grad_threshold: float,
    depth_threshold: float = 0.0,
    dense_size: float = 0.01,
    prune_large: bool = False,
) -> DensifyEdit:
    """Clone, split and prune.

    Each clone and each split adds one splat. Where the cap has no room for all, those with the highest gradient
    (over its threshold) come first. Splats that are not finite are removed. Where the rules would prune all splats,
    none but those is.

    Parameters
    ----------
    arrays : all public arrays of the model.
    stats : (at least 3, N), see cl/render/project.cl: sums of the screen and the depth gradient, times seen.
    rng : advanced by three normals for each half that is drawn.
    cap : most splats after growth; more than that are kept, not removed.
    extent : of the scene [world units].
    grad_threshold : of the mean screen gradient. depth_threshold : of the mean depth gradient
        times the extent; 0: not looked at.
    dense_size : splats larger than this fraction of the extent are split, others cloned.
    prune_large : whether splats larger than WORLD_SIZE are pruned.

    Raises
    ------
    TrainingError : no splat is finite.
    """
    sound = finite_rows(arrays)
    if len(sound) and not sound.any():
        raise TrainingError("no splat has finite parameters any more: lower the learning rates")
    with np.errstate(over="ignore"):
        size = np.exp(arrays["log_scale"].astype(np.float64).max(axis=1))
    bright = sound & (shape.strength(arrays) >= MIN_OPACITY)
    by_axis = depth_threshold > 0
    limit = WORLD_SIZE * extent if prune_large else math.inf
    keep = bright & (size <= limit)
    splittable = bright & (size / (1.0 if by_axis else SPLIT_SHRINK) <= limit)
    if not keep.any():
        keep = sound

    score = _score(stats, grad_threshold, depth_threshold, extent)
    splits = (score > 1.0) & splittable & (by_axis | (size > dense_size * extent))
    clones = (score > 1.0) & keep & bright & ~splits
    split, clone = _best(score, splits, clones, keep, cap)
    stay = np.flatnonzero(keep & ~np.isin(np.arange(len(keep)), split))
    parents = np.concatenate([split, split])
    source = np.concatenate([stay, clone, parents])

    halved = {name: array[parents] for name, array in arrays.items()}
    changed = _halves_along_axis(halved, shape) if by_axis else _drawn_halves(halved, shape, rng)
    values = {}
    for name, halves in changed.items():
        values[name] = arrays[name][source]
        values[name][len(stay) + len(clone) :] = halves
    fresh = np.arange(len(source)) >= len(stay)
    return DensifyEdit(
        source, values, fresh, state_source=source, added=len(clone) + 2 * len(split), removed=len(keep) - len(stay)
    )


def with_reset(edit: DensifyEdit, arrays: Mapping[str, Array], shape: Shape) -> DensifyEdit:
    """The edit, then 3DGS's opacity reset: |opacity| at most RESET_OPACITY, and its optimizer state zero."""
    names = opacity_names(arrays)
    after = {name: edit.values.get(name, arrays[name][edit.source]) for name in names}
    low = {
        name: raw_of_optical_depth(
            shape, np.minimum(optical_depth(shape, after[name]), -math.log1p(-RESET_OPACITY)), after[name]
        )
        for name in names
    }
    return replace(edit, values=edit.values | low, reset_fields=edit.reset_fields + names)


def _score(stats: Array, grad_threshold: float, depth_threshold: float, extent: float) -> DoubleArray:
    """(N,) mean gradient over its threshold, the higher of the two; 0 where it is not finite."""
    seen = np.maximum(stats[2].astype(np.float64), 1.0)
    tiny = np.finfo(np.float64).tiny
    score: DoubleArray = stats[0] / seen / max(grad_threshold, tiny)
    if depth_threshold > 0:
        score = np.fmax(score, stats[1] * extent / seen / depth_threshold)
    return np.where(np.isfinite(score), score, 0.0)


def _best(
    score: DoubleArray, splits: NDArray[np.bool_], clones: NDArray[np.bool_], keep: NDArray[np.bool_], cap: int
) -> tuple[Rows, Rows]:
    """Rows to split and rows to clone, rising, for which there is room."""
    rows = np.flatnonzero(splits | clones)
    rows = rows[np.argsort(-score[rows], kind="stable")]
    cost = np.cumsum(np.where(keep[rows], 1, 2))  # a split saves a splat that would be pruned for its size
    rows = np.sort(rows[cost <= cap - np.count_nonzero(keep)])
    return rows[splits[rows]], rows[clones[rows]]


def _drawn_halves(parents: Mapping[str, Array], shape: Shape, rng: np.random.Generator) -> dict[str, Array]:
    """3DGS: places drawn from the parents' Gaussians, scales over 1.6. The fields that change, of each half."""
    shift = rng.standard_normal(parents["mean"].shape)
    return _placed(parents, shape, shift, {"log_scale": parents["log_scale"] - math.log(SPLIT_SHRINK)})


def _halves_along_axis(parents: Mapping[str, Array], shape: Shape) -> dict[str, Array]:
    """3DSGS, as the head of the file says; the first half of the rows lies at +s/2, the second at -s/2."""
    n = len(parents["mean"])
    row, axis = np.arange(n), parents["log_scale"].argmax(axis=1)
    side = np.where(row < n // 2, 1.0, -1.0)
    shift = np.zeros((n, 3))
    shift[row, axis] = 0.5 * side
    changed = {"log_scale": parents["log_scale"].copy()}
    changed["log_scale"][row, axis] += 0.5 * math.log(0.75)
    if "skew" in parents:
        changed["skew"] = parents["skew"].copy()
        changed["skew"][row, axis] *= 0.5
    names = opacity_names(parents)
    if len(names) == 2:
        delta = _delta(parents)[row, axis]
        thick = [optical_depth(shape, parents[name]) for name in names]
        beyond = np.where(side * delta > 0, thick[0], thick[1])
        for name, own in zip(names, thick, strict=True):
            changed[name] = raw_of_optical_depth(shape, own + delta**2 * (beyond - own), parents[name])
    return _placed(parents, shape, shift, changed)


def _placed(
    parents: Mapping[str, Array], shape: Shape, shift: DoubleArray, changed: dict[str, Array]
) -> dict[str, Array]:
    """`changed` and the means: centroids move by `shift`, in the parents' deviations along their own axes."""
    old, new = (np.exp(of["log_scale"].astype(np.float64)) for of in (parents, changed))
    step = old * (shift + _centroid(parents, shape)) - new * _centroid({**parents, **changed}, shape)
    step = np.einsum("nij,nj->ni", rotations(parents["quat"].astype(np.float64)), step)
    return changed | {"mean": parents["mean"] + step}


def _delta(arrays: Mapping[str, Array]) -> DoubleArray:
    """(N, 3) delta of the direct form in the splat's own frame: of a slant, or of a plane's normal."""
    if "normal" in arrays:
        normal = arrays["normal"].astype(np.float64)
        unit: DoubleArray = normal / np.linalg.norm(normal, axis=1, keepdims=True)
        return unit
    slant = arrays["skew"].astype(np.float64)
    delta: DoubleArray = slant / np.sqrt(1.0 + np.sum(slant**2, axis=1, keepdims=True))
    return delta


def _centroid(arrays: Mapping[str, Array], shape: Shape) -> DoubleArray:
    """(N, 3) from the stored position to the centroid, in deviations along the splat's own axes.

    Of two opacities the halves on either side of a plane are placed about the plane, not about the centroid.
    """
    if shape.skew_form != "direct" or len(opacity_names(arrays)) == 2:
        return np.zeros((len(arrays["mean"]), 3))
    return math.sqrt(2.0 / math.pi) * _delta(arrays)
