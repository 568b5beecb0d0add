"""Two halves in place of one splat: drawn as in 3DGS, or side by side along the longest axis.

Halves along an axis preserve these properties of the parent, at any distance d between 0 and 1:

    place    mean +- d s along the axis, where s is the parent's standard deviation along it
    scale    s sqrt(1 - d^2) along the axis, so that the pair has the variance of the parent
    skew     the part across the axis stays. The part along it is halved, because a piece of a skewed density is less
             skewed than the whole. The opacities and colours of the halves learn the difference.
    two opacities    each half takes the opacity of its side of the plane, if the plane faces the axis. In general,
             the optical depths are mixed, with the square of delta's component along the axis as the weight. delta is
             the unit normal of the plane, or eta / sqrt(1 + |eta|^2) for a soft plane. A soft plane without skew
             changes neither opacity.

3DSGS (arXiv 2605.18334) splits along the longest axis and does not define the halves. There, d is 1/2 and the opacity
is the parent's. `split_along_axis` has d = 4/5, and also preserves the absorption of a Gaussian along the axis.

In the direct form of skew, "mean" is the centroid, location + sqrt(2/pi) R S delta.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from ...splats.fields import Array, DoubleArray
from ...splats.optical_depth import opacity_names, optical_depth, raw_of_optical_depth
from ...splats.quaternions import rotations
from ...splats.shapes import Shape

SPLIT_SHRINK = 1.6  # 3DGS: the drawn halves are smaller by this factor
PUBLISHED_DISTANCE = 0.5  # 3DSGS
DISTANCE = 0.8  # of `split_along_axis`
_CHUNK = 8192  # number of splats that are turned at once: their matrices stay in the cache of a processor


def twice(arrays: Mapping[str, Array]) -> dict[str, Array]:
    """Return all rows, and then all rows again: the parents of first and of second halves."""
    return {name: np.concatenate([array, array]) for name, array in arrays.items()}


def drawn_halves(parents: Mapping[str, Array], shape: Shape, rng: np.random.Generator) -> dict[str, Array]:
    """Return the changed fields of the halves of 3DGS: smaller scales, and places drawn from the parents' Gaussians.

    parents : public arrays of N parents, without the colour, here and below.

    The arrays that are returned have 2 N rows, here and below: the first halves of all parents, then the second ones.
    """
    shift = rng.standard_normal((2, *parents["mean"].shape))
    changed = {"log_scale": parents["log_scale"] - math.log(SPLIT_SHRINK)}
    return twice(changed) | {"mean": _places(parents, shape, shift, changed)}


def halves_along_axis(parents: Mapping[str, Array], shape: Shape, distance: float) -> dict[str, Array]:
    """Return the changed fields of the halves along the longest axis, without a change of the absorption.

    The first halves are at +d s, the second ones at -d s.

    distance : d, above 0 and below 1.
    """
    row, axis = np.arange(len(parents["mean"])), parents["log_scale"].argmax(axis=1)
    shift = np.zeros((2, len(row), 3))
    shift[0, row, axis] = distance
    shift[1, row, axis] = -distance
    changed = {"log_scale": parents["log_scale"].copy()}
    changed["log_scale"][row, axis] += 0.5 * math.log1p(-(distance**2))
    if "skew" in parents:
        changed["skew"] = parents["skew"].copy()
        changed["skew"][row, axis] *= 0.5
    names, opacities = opacity_names(parents), {}
    if len(names) == 2:
        delta = _delta(parents)[row, axis]
        thick = [optical_depth(shape, parents[name]) for name in names]
        beyond = [np.where(side * delta > 0, thick[0], thick[1]) for side in (1.0, -1.0)]
        for name, depth in zip(names, thick, strict=True):
            mixed = [raw_of_optical_depth(shape, depth + delta**2 * (of - depth), parents[name]) for of in beyond]
            opacities[name] = np.concatenate(mixed)
    return twice(changed) | opacities | {"mean": _places(parents, shape, shift, changed)}


def split_along_axis(parents: Mapping[str, Array], shape: Shape, min_opacity: float) -> dict[str, Array]:
    """Return the changed fields of halves side by side, which absorb together as much as the parent did.

    min_opacity : minimum of the new |opacity|. With two opacities, it is the minimum of the larger one.
    """
    changed = halves_along_axis(parents, shape, DISTANCE)
    names = opacity_names(parents)
    parted = len(names) == 2  # else both halves have the parent's opacity
    before = {name: changed[name] if parted else parents[name] for name in names}
    old = np.stack([optical_depth(shape, raw) for raw in before.values()], axis=1)
    opacity = opacity_of_half(-np.expm1(-old), DISTANCE)
    largest = opacity.max(axis=1, keepdims=True)
    opacity = np.where(largest < min_opacity, opacity * (min_opacity / np.maximum(largest, 1e-300)), opacity)
    depth = -np.log1p(-opacity)  # halves at this distance are never opaque
    new = {name: raw_of_optical_depth(shape, depth[:, side], before[name]) for side, name in enumerate(names)}
    return changed | (new if parted else twice(new))


def opacity_of_half(opacity: DoubleArray, distance: float) -> DoubleArray:
    """Return the opacity of two halves that absorb as much as a Gaussian along the line through all three centres.

    With o' the opacity of a half, b = sqrt(1 - d^2) and e = exp(-d^2 / b^2), the integrals along the line, over
    s sqrt(2 pi), are o for the Gaussian and 2 b o' - b e o'^2 / sqrt(2) for the pair. The smaller root is o'.
    """
    b = math.sqrt(1.0 - distance**2)
    e = math.exp(-((distance / b) ** 2)) / math.sqrt(2.0)
    # In this form of the root, small opacities keep their digits.
    root: DoubleArray = opacity / (b * (1.0 + np.sqrt(np.maximum(1.0 - e * opacity / b, 0.0))))
    return np.minimum(root, 1.0)


def _places(parents: Mapping[str, Array], shape: Shape, shift: DoubleArray, changed: Mapping[str, Array]) -> Array:
    """Return the means of the halves, (2 N, 3), whose centroids move by `shift`.

    shift : (2, N, 3), in the parents' deviations along their axes. changed : the fields that both halves have.
    """
    old = np.exp(parents["log_scale"].astype(np.float64))
    if _has_centroid(parents, shape):
        new = np.exp(changed["log_scale"].astype(np.float64))
        step = old * (shift + _centroid(parents)) - new * _centroid({**parents, **changed})
    else:
        step = old * shift
    places = np.empty_like(step)
    for first in range(0, len(old), _CHUNK):
        rows = slice(first, first + _CHUNK)
        turn = rotations(parents["quat"][rows].astype(np.float64))
        x, y, z = (step[:, rows, column, None] for column in range(3))
        # np.einsum adds in this order, too, and takes three times as long.
        places[:, rows] = parents["mean"][rows] + (turn[..., 0] * x + turn[..., 2] * z + turn[..., 1] * y)
    return places.reshape(-1, 3)


def _delta(arrays: Mapping[str, Array]) -> DoubleArray:
    """Return delta of the direct form in the frame of the splat, (N, 3), from a slant or from a plane's normal."""
    if "normal" in arrays:
        normal = arrays["normal"].astype(np.float64)
        unit: DoubleArray = normal / np.linalg.norm(normal, axis=1, keepdims=True)
        return unit
    slant = arrays["skew"].astype(np.float64)
    delta: DoubleArray = slant / np.sqrt(1.0 + np.sum(slant**2, axis=1, keepdims=True))
    return delta


def _has_centroid(arrays: Mapping[str, Array], shape: Shape) -> bool:
    """Return whether the centroid of a splat may lie beside its stored position.

    Splats with two opacities count as without, because their halves are placed relative to the plane.
    """
    return shape.skew_form == "direct" and len(opacity_names(arrays)) == 1


def _centroid(arrays: Mapping[str, Array]) -> DoubleArray:
    """Return the vector from the stored position to the centroid, (N, 3), in deviations along the axes of the splat."""
    return math.sqrt(2.0 / math.pi) * _delta(arrays)
