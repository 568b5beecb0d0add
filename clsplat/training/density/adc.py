"""Adaptive density control of 3DGS (Kerbl et al. 2023), and the depth criterion of 3DSGS, as edits made on the host.

Splats with a high mean screen gradient are densified. A small splat is cloned: it gets a copy in the same place. A
large splat is split into two halves (halves.py), which are drawn from its Gaussian and smaller by a factor of 1.6.
Nearly transparent splats are pruned.

3DGS also prunes large splats after the first opacity reset: those larger than a tenth of the scene extent, and those
larger than 20 px on the screen. Neither rule is here. The extent says how far apart cameras are, and walls and skies
need larger splats if cameras are close together. The limit on the screen has no effect in the released code
(graphdeco-inria/gaussian-splatting#123, #643).

With a depth threshold (3DSGS, arXiv 2605.18334) a splat is split if either gradient is high, always along its longest
axis.

Beyond 3DGS, all splats with a high gradient may be split along their longest axis, small ones too, as in Deng et al.
2025 (arXiv 2508.12313). Two copies in one place have the same gradients, and take long to part. Halves side by side
have different ones.

The cap does not end densification either. If it has no room for the splats with a high gradient, the faintest splats
are pruned for them. 3DGS has no cap.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from ...rendering.splat_buffers import SplatStatistics
from ...splats.fields import Array, DoubleArray
from ...splats.optical_depth import opacity_names, raw_of_optical_depth
from ...splats.shapes import Shape
from .edit import DensifyEdit, Indices, NewValues
from .halves import PUBLISHED_DISTANCE, drawn_halves, halves_along_axis, split_along_axis
from .table import SplatTable, smallest

# 3DGS's constants.
MIN_OPACITY = 0.005  # fainter splats are pruned
RESET_OPACITY = 0.01


def plan_adc(
    splats: SplatTable,
    shape: Shape,
    stats: Array,
    rng: np.random.Generator,
    cap: int,
    *,
    extent: float,
    grad_threshold: float,
    depth_threshold: float = 0.0,
    dense_size: float = 0.01,
    turnover: float = 0.0,
    split: str = "published",
) -> DensifyEdit:
    """Return the edit that clones, splits and prunes.

    Each clone and each split adds one splat. If the cap has no room for all, the splats with the highest gradient over
    its threshold come first. Splats that are not finite are removed. If the rules would prune all splats, only the
    non-finite ones are removed.

    Parameters
    ----------
    splats : the splats before the densification.
    stats : (3, N) densification statistics (SplatStatistics): sums of the screen and the depth gradient, and counts.
    rng : generator; three normals are drawn for each half.
    cap : largest number of splats after growth. A larger number of splats is kept.
    extent : extent of the scene [world units].
    grad_threshold : threshold of the mean screen gradient.
    depth_threshold : threshold of the mean depth gradient times the extent; 0: not used.
    dense_size : splats larger than this fraction of the extent are split, the others are cloned.
    turnover : largest number of splats that are pruned to make room under the cap, the faintest first, as a fraction
        of the cap, 0 to 0.5. It has no effect on more splats than the cap.
    split : "published", or "long-axis": all splats with a high gradient are split along their longest axis.

    Raises
    ------
    TrainingError : no splat is finite.
    """
    summary = splats.summary()
    sound = summary.some_finite()
    bright = summary.raw_opacity >= shape.raw_opacity(np.array(MIN_OPACITY))  # this is False for a NaN
    side_by_side = split == "long-axis"
    by_axis = side_by_side or depth_threshold > 0
    rows, score = _above_threshold(stats, grad_threshold, depth_threshold, extent)
    size = summary.log_size[rows].astype(np.float64)
    is_large = by_axis | (size > _log(dense_size * extent))
    splits, clones = bright[rows] & is_large, bright[rows] & ~is_large
    keep = bright if bright.any() else sound
    if turnover and len(keep) <= cap:
        missing = int(np.count_nonzero(keep) + np.count_nonzero(splits | clones) - cap)
        among = np.flatnonzero(keep)
        faint = among[smallest(summary.raw_opacity[among], min(missing, int(turnover * cap)))]
        keep[faint] = False
        at = np.isin(rows, faint, kind="table")
        splits[at] = clones[at] = False
    halved, cloned = _best(rows, score, splits, clones, cap - int(np.count_nonzero(keep)))
    stays = keep.copy()
    stays[halved] = False
    stay = np.flatnonzero(stays)
    source = np.concatenate([stay, cloned, halved, halved])

    parents = splats.take(halved)
    if side_by_side:
        changed = split_along_axis(parents, shape, MIN_OPACITY)
    elif by_axis:
        changed = halves_along_axis(parents, shape, PUBLISHED_DISTANCE)
    else:
        changed = drawn_halves(parents, shape, rng)
    new = np.arange(len(stay) + len(cloned), len(source))
    values = {name: NewValues(new, array) for name, array in changed.items()}
    fresh = np.zeros(len(source), np.bool_)
    fresh[len(stay) :] = True
    return DensifyEdit(
        source, values, fresh, state_source=source, added=len(cloned) + 2 * len(halved), removed=len(keep) - len(stay)
    )


def with_reset(edit: DensifyEdit, splats: SplatTable, shape: Shape) -> DensifyEdit:
    """Return the edit with 3DGS's opacity reset.

    The reset limits |opacity| to RESET_OPACITY and sets the optimizer state of the opacity to zero.
    """
    names, rows = opacity_names(shape.schema(0)), np.arange(len(edit.source))
    values = dict(edit.values)
    for name in names:
        raw = edit.after(name, splats.field(name))
        low = raw_of_optical_depth(shape, np.float64(-math.log1p(-RESET_OPACITY)), raw)
        above = np.abs(raw) > np.abs(low) if shape.signed else raw > low
        values[name] = NewValues(rows, np.where(above, low, raw))
    return replace(edit, values=values, reset_fields=edit.reset_fields + names)


def _above_threshold(
    stats: Array, grad_threshold: float, depth_threshold: float, extent: float
) -> tuple[Indices, DoubleArray]:
    """Return the rows with a mean gradient above its threshold, and the larger of both ratios to the thresholds.

    Gradients that are not finite do not count.
    """
    times = np.maximum(stats[SplatStatistics.TIMES_SEEN], 1.0)
    with np.errstate(over="ignore"):  # a threshold may be too large for float32: nothing exceeds it
        depth = stats[SplatStatistics.DEPTH_GRADIENT]
        deep = depth * extent > 0.5 * depth_threshold * times if depth_threshold > 0 else None
        threshold = np.multiply(times, 0.5 * grad_threshold, out=times)  # faster than new memory
        loud = stats[SplatStatistics.SCREEN_GRADIENT] > threshold
        if deep is not None:
            loud |= deep
    rows = np.flatnonzero(loud)  # only these can exceed a threshold: few, so they may be in double precision
    screen, depth, seen = stats[:, rows]
    seen = np.maximum(seen.astype(np.float64), 1.0)
    ratio: DoubleArray = screen / seen / max(grad_threshold, np.finfo(np.float64).tiny)
    if depth_threshold > 0:
        ratio = np.fmax(ratio, depth * extent / seen / depth_threshold)
    above = np.isfinite(ratio) & (ratio > 1.0)
    return rows[above], ratio[above]


def _log(length: float) -> np.float64:
    """Return the logarithm of a length; that of 0 is -inf."""
    with np.errstate(divide="ignore"):
        return np.float64(np.log(length))


def _best(
    rows: Indices, score: DoubleArray, splits: NDArray[np.bool_], clones: NDArray[np.bool_], room: int
) -> tuple[Indices, Indices]:
    """Return the rows to split and the rows to clone, in rising order: the best ones if there is no room for all.

    rows : rows above a threshold, in rising order. score, splits, clones : of these. room : most splats to add.
    """
    chosen = np.flatnonzero(splits | clones)
    if len(chosen) > room:
        order = np.argsort(-score[chosen], kind="stable")
        chosen = np.sort(chosen[order[: max(room, 0)]])
    return rows[chosen[splits[chosen]]], rows[chosen[clones[chosen]]]
