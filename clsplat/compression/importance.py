"""Importance of each part of a splat: how far the training images would change without it.

An image is an affine function of each splat's opacity, and a linear function of each of its colours (if neither is
clamped). Without splat i it is I - o_i dI/do_i. The squared change, summed over pixels and channels, is
o_i^2 |dI/do_i|^2 = E[(o_i e.dI/do_i)^2] for random signs e at each pixel and channel (Hutchinson 1989). So one backward
pass with such signs, in place of the gradient of the loss, gives an unbiased estimate for all splats at once. The same
holds for colours, and to first order for a field that is set to its neutral value.

For colours, the passes sum A = w b b' over the views for each splat. b is the SH basis in the direction of the view,
and w the sum of the squared weights of the splat's pixels. A change x of the coefficients changes the images by x'A x,
so the best lower degree has a closed form. Let l be the coefficients that stay, and h those that are removed. Then l
increases by (A_ll)^-1 A_lh h, and the loss is h'(A_hh - A_hl (A_ll)^-1 A_lh) h.

Changes of many splats add up only if the splats do not overlap; prune.py therefore tests thresholds on images.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..rendering.renderer import Renderer
from ..scenes.scene import View
from ..splats.color import BLACK, Color
from ..splats.fields import Array, DoubleArray, Field, sh_coefficients, sh_degree_of
from ..splats.formats.ply_compact import movable
from ..splats.harmonics import SH_C0, sh_basis
from ..splats.optical_depth import opacity_names
from ..splats.shapes import Shape, shape_named
from ..splats.splats import Splats

_RIDGE = 1e-3  # share of the mean diagonal of A_ll: coefficients that no view determines keep their values
_CHUNK = 8192  # splats whose linear systems are solved together


@dataclass(frozen=True)
class Importance:
    """Squared changes of the images, summed over pixels, channels and views (0..1 is black to white).

    Parameters
    ----------
    removal : (N,) change without the splat.
    fields : (N,) change with the neutral value of a shape-specific field, by name; see `droppable`.
    colour : (N, K (K + 1) / 2) upper triangle of A, row by row; None if only whole splats were measured.
    """

    removal: DoubleArray
    fields: dict[str, DoubleArray]
    colour: NDArray[np.float32] | None


def measure_importance(
    renderer: Renderer,
    splats: Splats,
    views: Sequence[View],
    background: Color = BLACK,
    seed: int = 0,
    parts: bool = True,
) -> Importance:
    """Measure the importance of all splats, with one render and one backward pass for each view.

    Parameters
    ----------
    views : the training views. seed : seed of the signs. parts : False measures whole splats only.
    """
    rng = np.random.default_rng(seed)
    shape, arrays, n = shape_named(splats.shape), splats.arrays, len(splats)
    opacities = {name: _per_opacity(shape, arrays[name]) for name in opacity_names(arrays)}
    fields = droppable(splats) if parts else []
    coefficients = sh_coefficients(splats.sh_degree)
    rows, columns = np.triu_indices(coefficients)
    removal, dropped = np.zeros(n), {field.name: np.zeros(n) for field in fields}
    colour = np.zeros((n, len(rows)), np.float32) if parts else None
    names = [*opacities, *dropped, *(["sh"] if parts else [])]
    for view in views:
        image = renderer.render(splats, view.camera, background)
        signs = rng.choice(np.array([-1.0, 1.0]), size=image.color.shape)
        grads = renderer.backward(signs, names=names)
        removal += np.sum([factor * grads[name] for name, factor in opacities.items()], axis=0) ** 2
        for field in fields:
            dropped[field.name] += _first_order(field, arrays[field.name], grads[field.name]) ** 2
        if colour is not None:
            weight = np.mean((grads["sh"][:, 0].astype(np.float64) / SH_C0) ** 2, axis=1)
            basis = sh_basis(_directions(splats, view), splats.sh_degree).astype(np.float32)
            # Most splats are visible in a few views only.
            seen = np.flatnonzero(weight)
            basis = basis[seen]
            colour[seen] += weight[seen, None].astype(np.float32) * (basis[:, rows] * basis[:, columns])
    return Importance(removal, dropped, colour)


def droppable(splats: Splats) -> list[Field]:
    """Return the shape-specific fields whose neutral value gives the best splat without them.

    The skew of the direct form is left out, because it also moves and shrinks the splat (convert such a model first).
    """
    form = shape_named(splats.shape).skew_form
    return [field for field in movable(splats.schema) if field.name != "skew" or form == "centred"]


def lower_bands(sh: Array, colour: NDArray[np.float32]) -> tuple[list[Array], DoubleArray]:
    """Return the best colours of each lower degree on the views of `colour`, and their losses.

    Parameters
    ----------
    sh : (N, K, 3). colour : see `Importance`.

    Returns
    -------
    Coefficients (N, (degree + 1)^2, 3) for each degree below that of `sh`, and losses (N, degree of `sh` + 1).
    """
    degree = sh_degree_of(sh.shape[1])
    lower = [np.empty((len(sh), sh_coefficients(d), 3), sh.dtype) for d in range(degree)]
    lost = np.zeros((len(sh), degree + 1))
    for first in range(0, len(sh), _CHUNK):
        part = slice(first, first + _CHUNK)
        a, full = _square(colour[part], sh.shape[1]), sh[part].astype(np.float64)
        for d, out in enumerate(lower):
            kept = sh_coefficients(d)
            change = -full
            low = a[:, :kept, :kept]
            ridge = _RIDGE * np.trace(low, axis1=1, axis2=2) / kept + np.finfo(np.float32).tiny
            low = low + ridge[:, None, None] * np.eye(kept)
            change[:, :kept] = np.linalg.solve(low, a[:, :kept, kept:] @ full[:, kept:])
            out[part] = full[:, :kept] + change[:, :kept]
            lost[part, d] = np.sum(change * (a @ change), axis=(1, 2))
    # A lower degree never loses less, but rounding can suggest it.
    return lower, np.maximum.accumulate(np.maximum(lost, 0.0)[:, ::-1], axis=1)[:, ::-1]


def _per_opacity(shape: Shape, raw: Array) -> DoubleArray:
    """Return o / (do/draw). Times the gradient of the raw opacity, this is the image's change without the splat."""
    wide = raw.astype(np.float64)
    if shape.signed:  # tanh: o / (1 - o^2)
        return 0.5 * np.sinh(np.clip(2.0 * wide, -60.0, 60.0))
    return 1.0 + np.exp(np.minimum(wide, 60.0))  # logistic: 1 / (1 - o)


def _first_order(field: Field, values: Array, grads: Array) -> DoubleArray:
    """Return the image's change if a field moves to its neutral value; bounded fields move in their logarithm."""
    wide, neutral = values.astype(np.float64), np.asarray(field.neutral)
    path = wide * np.log(wide / neutral) if field.bounds is not None else wide - neutral
    return (path * grads).reshape(len(values), field.width).sum(axis=1)


def _directions(splats: Splats, view: View) -> DoubleArray:
    """Return (N, 3) unit vectors from the camera to the splats."""
    away = splats.mean.astype(np.float64) - view.camera.position
    return away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)


def _square(triangle: NDArray[np.float32], coefficients: int) -> DoubleArray:
    """Return (N, K, K) symmetric matrices from their upper triangles."""
    rows, columns = np.triu_indices(coefficients)
    full = np.zeros((len(triangle), coefficients, coefficients))
    full[:, rows, columns] = triangle
    full[:, columns, rows] = triangle
    return full
