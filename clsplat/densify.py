"""Relocation and growth of 3DGS-MCMC (Kheradmand et al. 2024), planned on the host, applied as a gather.

A live splat of opacity o that is joined by copies of itself, N in all, becomes N splats of opacity o' and
another scale, such that along a line through the mean the stack absorbs as much as the one did:

    1 - (1 - o')^N = o
    length factor = o / sum_{j=1..N} (-1)^(j-1) C(N, j) o'^j r_j
    r_j = I_j / I_1,   I_j = integral of kernel^j

The published double sum collapses to this single one (sum_{i<=N} C(i-1, j-1) = C(N, j)). For the Gaussian
r_j = 1/sqrt(j). It is a factor on *lengths* (ubc-vision/3dgs-mcmc#37). For the skew-normal r_j is that of the
peak-normalised kernel seen from the side, as a function of |m|, integrated numerically.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from .errors import InputError
from .plan import Plan
from .schema import Array
from .shapes import SKEW_MAX

# 3DGS-MCMC's constants.
MIN_OPACITY = 0.005  # at or below: dead, relocated
GROWTH = 1.05  # per call
N_MAX = 51  # copies are counted up to this

RULES = ("length", "opacity-only")

_SKEW_NODES = 257  # of the r_j table; linear interpolation between them errs by less than 2e-4

Reals = NDArray[np.float64]


def plan_relocation(
    opacity_logit: Array,
    log_scale: Array,
    rng: np.random.Generator,
    cap: int,
    growth: float = GROWTH,
    min_opacity: float = MIN_OPACITY,
    skew: Array | None = None,
    finite: NDArray[np.bool_] | None = None,
    rule: str = "length",
    pull: Array | None = None,
) -> Plan:
    """Move dead splats onto live ones and grow towards the cap.

    All copies are drawn at once, with replacement, in proportion to opacity. The plan depends on nothing
    but the arguments and the generator's state.

    Parameters
    ----------
    opacity_logit : (N,). log_scale : (N, 3). skew : m, (N, 3), for shapes that have it.
    rng : advanced by one draw per copy.
    cap : most splats that growth may reach; more than that are kept, not removed.
    growth : new count over old count, at least 1.
    min_opacity : splats at or below are dead.
    finite : (N,), False where some other parameter is not finite; such splats are relocated, as are those
        whose opacity, scale or skew is not finite.
    pull : (N,) at least 0, how much each splat is wanted elsewhere; copies are then drawn in proportion to
        opacity * pull.
    rule : "length" (opacity and scale, above) or "opacity-only" (scale kept; Deformable Beta Splatting).

    Raises
    ------
    InputError : unknown rule, growth below 1 or min_opacity outside (0, 1).
    """
    if rule not in RULES:
        raise InputError(f"unknown relocation rule {rule!r}: choose one of {', '.join(RULES)}")
    if not 1 <= growth < math.inf or not 0 < min_opacity < 1:
        raise InputError(f"growth {growth} must be at least 1 and min_opacity {min_opacity} between 0 and 1")
    n = len(opacity_logit)
    sound = np.isfinite(opacity_logit) & np.isfinite(log_scale).all(axis=1)
    if skew is not None:
        sound &= np.isfinite(skew).all(axis=1)
    if finite is not None:
        sound &= finite
    logit = np.where(sound, opacity_logit, -np.inf).astype(np.float64)
    thickness = np.logaddexp(0.0, logit)  # -log(1 - opacity), exact for opaque splats
    opacity = -np.expm1(-thickness)
    alive = opacity > min_opacity
    live = np.flatnonzero(alive)
    dead = np.flatnonzero(~alive)
    n_new = max(n, min(cap, math.ceil(growth * n - 1e-6)))  # 1.05 * 100 is a little above 105 in binary
    if len(live) == 0:  # nothing to copy from
        dead, n_new = live, n

    weights = opacity[live]
    if pull is not None and np.isfinite(pull[live]).all() and pull[live].any():
        weights = weights * pull[live].astype(np.float64)
    drawn = live[_draw(weights, len(dead) + n_new - n, rng)]
    source = np.arange(n_new, dtype=np.int64)
    source[dead] = drawn[: len(dead)]
    source[n:] = drawn[len(dead) :]

    copies = np.bincount(drawn, minlength=n)
    targets = np.flatnonzero(copies)
    skew_norm = None if skew is None else np.linalg.norm(skew[targets].astype(np.float64), axis=1)
    shared, factor = _share(thickness[targets], copies[targets] + 1, skew_norm, min_opacity)
    new_logit = opacity_logit.astype(np.float32)
    new_logit[targets] = np.log(np.expm1(shared))
    offset = np.zeros(n, np.float32)
    if rule == "length":
        offset[targets] = np.log(factor)

    fresh = np.zeros(n_new, np.bool_)
    fresh[:n] = (copies > 0) | ~sound
    fresh[n:] = True
    values = {"opacity_logit": new_logit[source],
              "log_scale": log_scale[source] + offset[source, None].astype(log_scale.dtype)}
    return Plan(source, values, fresh, relocated=len(dead), added=n_new - n)


def relocation(
    opacity: Array, ratio: NDArray[np.integer], skew_norm: Array | None = None, min_opacity: float = 0.0
) -> tuple[Reals, Reals]:
    """Opacity and length factor of each of `ratio` equal splats that replace one.

    Parameters
    ----------
    opacity : (N,) in (0, 1). ratio : (N,) at least 1, counted up to N_MAX.
    skew_norm : |m|, (N,); None for the Gaussian.
    min_opacity : floor of the new opacity.

    Returns
    -------
    new_opacity (N,), length_factor (N,).
    """
    shared, factor = _share(-np.log1p(-opacity.astype(np.float64)), ratio, skew_norm, min_opacity)
    return -np.expm1(-shared), factor


def _share(
    thickness: Reals, ratio: NDArray[np.integer], skew_norm: Array | None, min_opacity: float
) -> tuple[Reals, Reals]:
    """-log(1 - o') and length factor, given -log(1 - o)."""
    count = np.minimum(ratio, N_MAX)
    shared = np.maximum(thickness / count, -math.log1p(-min_opacity))
    new_opacity = -np.expm1(-shared)
    table = _power_integrals()
    nodes = len(table) - 1
    position = np.zeros(len(count)) if skew_norm is None else np.minimum(skew_norm / SKEW_MAX, 1.0) * nodes
    node = np.minimum(position.astype(np.int64), nodes - 1)
    weight = position - node

    # Term j is the last one times -(N - j + 1) / j o': no binomials, no powers of -1. Rows that have all
    # their terms drop out, so the cost is the number of splats made.
    order = np.argsort(-count, kind="stable")
    count, node, weight, new_opacity_by = count[order], node[order], weight[order], new_opacity[order]
    term = -np.ones(len(order))
    total = np.zeros(len(order))
    for j in range(1, int(count.max(initial=0)) + 1):
        rows = slice(0, int(np.searchsorted(-count, -j, side="right")))
        term[rows] *= -(count[rows] - j + 1) / j * new_opacity_by[rows]
        low, high = table[node[rows], j], table[node[rows] + 1, j]
        total[rows] += term[rows] * (low + weight[rows] * (high - low))
    factor = np.empty(len(order))
    factor[order] = -np.expm1(-thickness[order]) / total
    return shared, factor


def _draw(weights: Reals, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """`count` indices in proportion to `weights` (all above 0), with replacement."""
    if count == 0:
        return np.zeros(0, np.int64)
    cumulative = np.cumsum(weights)
    drawn = np.searchsorted(cumulative, rng.random(count) * cumulative[-1], side="right")
    last = len(weights) - 1  # random() * total may round up to the total
    indices: NDArray[np.int64] = np.minimum(drawn, last).astype(np.int64)
    return indices


@lru_cache(maxsize=1)
def _power_integrals() -> Reals:
    """r_j at [node, j] for |m| = SKEW_MAX node / (_SKEW_NODES - 1), j = 0..N_MAX (column 0 unused).

    From the side (t = |m|^2) the kernel is exp(-z^2/2) Phi(lambda z) / peak in standard units about the
    location, lambda^2 = k / (1 - k), k = (pi/2) t / (1 + t); widths cancel in r_j.
    """
    from scipy.special import log_ndtr  # lazy: the command line starts without scipy

    t = np.linspace(0.0, SKEW_MAX, _SKEW_NODES)[:, None] ** 2
    k = 0.5 * math.pi * t / (1.0 + t)
    slope = np.sqrt(k / (1.0 - k))
    mode = np.zeros_like(slope)
    for _ in range(30):  # Newton for -z + slope R(slope z) = 0, R = phi / Phi; concave log, converges from 0
        u = slope * mode
        inverse_mills = np.exp(-0.5 * u * u - 0.5 * math.log(2.0 * math.pi) - log_ndtr(u))
        mode -= (slope * inverse_mills - mode) / (-1.0 - slope**2 * inverse_mills * (inverse_mills + u))
    z = np.linspace(-9.0, 9.0, 1801)
    log_kernel = -0.5 * z**2 + log_ndtr(slope * z) + 0.5 * mode**2 - log_ndtr(slope * mode)
    kernel = np.exp(log_kernel)
    power = np.ones_like(kernel)
    table = np.ones((_SKEW_NODES, N_MAX + 1))
    for j in range(1, N_MAX + 1):
        power *= kernel  # the sum of equal steps is exact to rounding: smooth, and 0 at both ends
        table[:, j] = power.sum(axis=1)
    table[:, 1:] /= table[:, 1:2].copy()
    table.setflags(write=False)
    return table
