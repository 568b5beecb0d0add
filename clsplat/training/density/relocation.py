"""Relocation and growth of 3DGS-MCMC (Kheradmand et al. 2024), for any shape, edited on the host.

A live splat of opacity o that is joined by copies of itself, N in all, becomes N splats of opacity o' and
another scale, such that along a line through it the stack absorbs as much as the one did. With g the profile of the
kernel (profiles.py):

    1 - (1 - o')^N = o
    length factor = integral of o g  /  integral of 1 - (1 - o' g)^N

Both integrals are numerical, which holds for every profile. For the Gaussian this is the published double sum. It
is a factor on *lengths* (ubc-vision/3dgs-mcmc#37); Student splatting squares it, which is the rule "length-squared".
Of a splat with two opacities each becomes o', and the line crosses the plane between them. Of a negative opacity
(Student splatting's scooping) all this holds for |o|, and the sign stays.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError, TrainingError
from ...splats.fields import Array, DoubleArray
from ...splats.optical_depth import finite_rows, opacity_names, optical_depth, raw_of_optical_depth
from ...splats.shapes import Shape
from ..methods import sss
from .edit import DensifyEdit

# 3DGS-MCMC's constants.
MIN_OPACITY = 0.005  # at or below: dead, relocated
GROWTH = 1.05  # per call
N_MAX = 51  # copies are counted up to this

# Power of the length factor by which scales are multiplied. "opacity-only" is the rule of Deformable Beta Splatting.
RULES = {"length": 1.0, "length-squared": sss.RELOCATION_POWER, "opacity-only": 0.0}

# Nodes on each side of 0 at z = _KNEE sinh(asinh(_FARTHEST / _KNEE) u^3), u the midpoints of equal cells. A step or a
# cusp at 0 does no harm: each side is smooth in u, and the cube brings the nodes to the cusp of
# exp(-|z|^beta), beta < 1. Against adaptive quadrature: 1e-13 for Gaussian profiles, 1e-7 for Student's t at nu = 1
# (of the tail beyond _FARTHEST), 1e-5 for beta = 8 and opacities up to 0.9999.
_NODES = 96
_KNEE = 3.0
_FARTHEST = 4e3
_CHUNK = 2048  # splats integrated at once: some MB of work space


def plan_relocation(
    arrays: Mapping[str, Array],
    shape: Shape,
    rng: np.random.Generator,
    cap: int,
    *,
    growth: float = GROWTH,
    min_opacity: float = MIN_OPACITY,
    rule: str = "length",
    limit: float = 1.0,
) -> DensifyEdit:
    """Move dead splats onto live ones and grow towards the cap.

    Splats with a parameter that is not finite are relocated like dead ones. All copies are drawn at once, with
    replacement, in proportion to strength (the larger |opacity|). The edit depends on nothing but the arguments and
    the generator's state. Where no splat is alive, nothing grows and the dead stay.

    Parameters
    ----------
    arrays : all public arrays of the model.
    rng : advanced by one draw per copy.
    cap : most splats that growth may reach; more than that are kept, not removed.
    growth : new count over old count, at least 1.
    min_opacity : splats at or below are dead; floor of the new opacities (of the larger one of two).
    rule : "length" (opacity and scale, above), "length-squared" (Student splatting as released), or "opacity-only"
        (scale kept; Deformable Beta Splatting).
    limit : most dead splats relocated, as a fraction of all: the weakest. Those not finite are relocated in any case.

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
    n = len(arrays["mean"])
    sound = finite_rows(arrays)
    if n and not sound.any():
        raise TrainingError("no splat has finite parameters any more: lower the learning rates")
    names = opacity_names(arrays)
    strength = np.where(sound, shape.strength(arrays), 0.0)
    alive = strength > min_opacity
    donors, dead = np.flatnonzero(alive), np.flatnonzero(sound & ~alive)
    n_new = max(n, min(cap, math.ceil(growth * n - 1e-6)))  # 1.05 * 100 is a little above 105 in binary
    if not len(donors):
        donors, dead, n_new = np.flatnonzero(sound), dead[:0], n
    weakest = np.argsort(strength[dead], kind="stable")[: int(limit * n)]
    moving = np.sort(np.concatenate([np.flatnonzero(~sound), dead[weakest]]))

    weights = strength[donors] if strength[donors].any() else np.ones(len(donors))
    drawn = donors[_draw(weights, len(moving) + n_new - n, rng)]
    source = np.arange(n_new, dtype=np.int64)
    source[moving] = drawn[: len(moving)]
    source[n:] = drawn[len(moving) :]

    copies = np.bincount(drawn, minlength=n)
    targets = np.flatnonzero(copies)
    raw, factor = relocation(
        shape, {name: array[targets] for name, array in arrays.items()}, copies[targets] + 1, min_opacity
    )
    values = {}
    for name in names:
        values[name] = arrays[name].copy()
        values[name][targets] = raw[name]
        values[name] = values[name][source]
    if RULES[rule]:
        log_scale = arrays["log_scale"].copy()
        log_scale[targets] += (RULES[rule] * np.log(factor))[:, None].astype(log_scale.dtype)
        values["log_scale"] = log_scale[source]

    fresh = np.zeros(n_new, np.bool_)
    fresh[:n] = (copies > 0) | ~sound
    fresh[n:] = True
    return DensifyEdit(source, values, fresh, relocated=len(moving), added=n_new - n)


def relocation(
    shape: Shape, arrays: Mapping[str, Array], ratio: NDArray[np.integer], min_opacity: float = 0.0
) -> tuple[dict[str, DoubleArray], DoubleArray]:
    """What each of `ratio` equal splats has that replace one.

    Parameters
    ----------
    arrays : public arrays of N splats. ratio : (N,) at least 1, counted up to N_MAX.
    min_opacity : floor of the new |opacity|, of the larger one where there are two (their ratio stays).

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
    factor = np.ones(len(count))
    for first in range(0, len(count), _CHUNK):
        rows = slice(first, first + _CHUNK)
        part = {name: array[rows] for name, array in arrays.items()}
        factor[rows] = _length_factor(shape, part, -np.expm1(-old[rows]), -np.expm1(-shared[rows]), count[rows])
    raw = {name: raw_of_optical_depth(shape, shared[:, side], arrays[name]) for side, name in enumerate(names)}
    return raw, factor


def _length_factor(
    shape: Shape,
    arrays: Mapping[str, Array],
    opacity: DoubleArray,
    new_opacity: DoubleArray,
    count: NDArray[np.integer],
) -> DoubleArray:
    """Integral of the one over integral of the stack; opacities are (N, S)."""
    z, weight = _nodes()
    profile = shape.profile(z, arrays)  # (N, S, K)
    one = np.einsum("nsk,ns,k->n", profile, opacity, weight)
    alpha = np.minimum(np.einsum("nsk,ns->nk", profile, new_opacity), 1.0)
    with np.errstate(divide="ignore"):  # alpha = 1 of an opaque splat: the stack is opaque too
        stack = -np.expm1(count[:, None] * np.log1p(-alpha)) @ weight
    factor: DoubleArray = one / np.maximum(stack, 1e-300)
    return np.where(count > 1, factor, 1.0)


@lru_cache(maxsize=1)
def _nodes() -> tuple[DoubleArray, DoubleArray]:
    """Nodes and weights of integrals over a line, (2 _NODES,) each, symmetric about 0."""
    u = (np.arange(_NODES) + 0.5) / _NODES
    reach = math.asinh(_FARTHEST / _KNEE)
    z = _KNEE * np.sinh(reach * u**3)
    weight = _KNEE * np.cosh(reach * u**3) * reach * 3.0 * u**2 / _NODES
    nodes, weights = np.concatenate([-z[::-1], z]), np.concatenate([weight[::-1], weight])
    for array in (nodes, weights):
        array.setflags(write=False)
    return nodes, weights


def _draw(weights: DoubleArray, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """`count` indices in proportion to `weights` (at least 0, not all 0), with replacement."""
    if count == 0:
        return np.zeros(0, np.int64)
    cumulative = np.cumsum(weights)
    drawn = np.searchsorted(cumulative, rng.random(count) * cumulative[-1], side="right")
    last = np.flatnonzero(weights)[-1]  # random() * total may round up to the total
    indices: NDArray[np.int64] = np.minimum(drawn, last).astype(np.int64)
    return indices
