"""A model as another shape that shows the same images, where there is one: exactly, or not at all.

Both forms of the skew-normal are the same family of kernels: mean and covariance of one against location and scale
matrix of the other (Azzalini & Capitanio 1999). Everything else goes through the Gaussian, which all shapes contain
(student-t to 4e-5 of alpha, at the largest nu).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .checks import LIMIT_SLACK
from .fields import Array, DoubleArray
from .optical_depth import raw_of_thickness, thickness
from .quaternions import rotations
from .shapes import SKEW_MAX, SLANT_MAX, Shape, shape_named
from .splats import Splats

Mask = NDArray[np.bool_]
Model = dict[str, DoubleArray]

EQUAL = 1e-6  # two opacities are the same where their raw values differ by no more: float32's rounding


def convert(splats: Splats, shape: str) -> Splats:
    """`splats` as `shape`, with equal images (to the rounding of their dtype).

    A shape with a normalisation keeps that of another with one, else it is "peak".

    Raises
    ------
    InputError : an unknown shape, or splats that have no equal in it; it says how many and why.
    """
    source, target = shape_named(splats.shape), shape_named(shape)
    if source is target:
        return splats
    model = {name: values.astype(np.float64) for name, values in splats.arrays.items()}
    if source.normalised and target.normalised:
        model, normalisation = _SKEW_FORMS[target.skew_form or ""](model, target), splats.normalisation
    else:
        model, normalisation = _gaussian(model, splats.normalisation, source, target), "peak"
    dtype = splats.mean.dtype
    return Splats(
        shape, {name: values.astype(dtype) for name, values in model.items()}, normalisation, splats.antialiased
    )


def _refuse(bad: Mask, target: Shape, why: str, mend: str) -> None:
    if bad.any():
        count = f"{np.count_nonzero(bad)} of {len(bad)} splats"
        raise InputError(f"convert: {count} {why}, which {target.name} has no equal of: {mend}")


# ---- the skew-normal's two forms ------------------------------------------------------------------------------


def direct_form(model: Model, target: Shape) -> Model:
    """From mean, covariance and shift m: scale matrix = covariance + shift shift', location = mean - shift."""
    m = _bounded(model["skew"], SKEW_MAX)
    t = np.sum(m * m, axis=1, keepdims=True)
    k = _displaced(t)
    shift = to_world(model, m)
    frame, turned = restretched(model, m, np.sqrt(1.0 + t))
    unit = turned / np.sqrt(np.maximum(t, 1e-300))
    return model | frame | {"mean": model["mean"] - shift, "skew": unit * np.sqrt(k / (1.0 - k))}


def _centred(model: Model, target: Shape) -> Model:
    """From location, scale matrix and slant: covariance = scale matrix - shift shift', mean = location + shift."""
    slant = _bounded(model["skew"], SLANT_MAX)
    squared = np.sum(slant * slant, axis=1, keepdims=True)
    part = 2.0 / math.pi * squared / (1.0 + squared)  # of the variance along the slant, by which the skew reduces it
    length = np.sqrt(part / (1.0 - part))
    k = _displaced(SKEW_MAX**2)
    longest = math.sqrt(k / (1.0 - k))
    _refuse(length[:, 0] > SKEW_MAX * (1.0 + LIMIT_SLACK), target, f"have a skew above {longest:.3f}", "shorten it")
    unit = slant / np.sqrt(np.maximum(squared, 1e-300))
    frame, turned = restretched(model, unit, np.sqrt(1.0 - part))
    shift = to_world(model, unit * np.sqrt(part))
    return model | frame | {"mean": model["mean"] + shift, "skew": turned * np.minimum(length, SKEW_MAX)}


def _displaced(t: DoubleArray | float) -> DoubleArray | float:
    """|delta|^2 = |eta|^2 / (1 + |eta|^2) where the shift m has |m|^2 = t."""
    return 0.5 * math.pi * t / (1.0 + t)


_SKEW_FORMS: dict[str, Callable[[Model, Shape], Model]] = {"centred": _centred, "direct": direct_form}


def _bounded(vectors: DoubleArray, limit: float) -> DoubleArray:
    """As the kernels take them: longer ones (N, 3) are shortened to `limit`."""
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    short: DoubleArray = vectors * np.minimum(limit / np.maximum(lengths, 1e-300), 1.0)
    return short


def to_world(model: Model, vectors: DoubleArray) -> DoubleArray:
    """R S v (N, 3)."""
    moved: DoubleArray = np.einsum("nij,nj->ni", rotations(model["quat"]), np.exp(model["log_scale"]) * vectors)
    return moved


def restretched(model: Model, along: DoubleArray, factor: DoubleArray) -> tuple[Model, DoubleArray]:
    """Rotation and scale of R S H H' S R', H = I but `factor` (N, 1) along the vectors `along` (N, 3); and the vectors
    in the new unit frame.

    With the singular values S H = U L W': R U and L, and a vector H v of the old frame is W'v in the new one. Splats
    without such a vector keep all bits.
    """
    frame = {name: model[name].copy() for name in ("quat", "log_scale")}
    turned = along.copy()
    some = np.flatnonzero(np.any(along != 0.0, axis=1))
    if some.size == 0:
        return frame, turned
    unit = along[some] / np.linalg.norm(along[some], axis=1, keepdims=True)
    stretch = np.eye(3) + (factor[some, :, None] - 1.0) * unit[:, :, None] * unit[:, None, :]
    log_scale = model["log_scale"][some]
    largest = log_scale.max(axis=1, keepdims=True)
    u, singular, w = np.linalg.svd(np.exp(log_scale - largest)[:, :, None] * stretch)
    mirrored = np.linalg.det(u) < 0.0
    u[mirrored, :, 2] *= -1.0
    w[mirrored, 2, :] *= -1.0
    frame["quat"][some] = _quaternions(rotations(model["quat"][some]) @ u)
    frame["log_scale"][some] = np.log(np.maximum(singular, 1e-300)) + largest
    turned[some] = np.einsum("nij,nj->ni", w, along[some])
    return frame, turned


def _quaternions(matrices: DoubleArray) -> DoubleArray:
    """w, x, y, z (N, 4) of rotation matrices (N, 3, 3)."""
    from scipy.spatial.transform import Rotation  # lazy: a third of a second to import

    xyzw: DoubleArray = Rotation.from_matrix(matrices).as_quat()
    return xyzw[:, [3, 0, 1, 2]]


# ---- through the Gaussian --------------------------------------------------------------------------------------


def _gaussian(model: Model, normalisation: str, source: Shape, target: Shape) -> Model:
    """The core fields and `target`'s own that make Gaussians of it, for splats of `source` that are Gaussians."""
    core = {name: model[name] for name in ("mean", "quat", "log_scale", "opacity_logit", "sh")}
    if source.signed and not target.signed:
        _refuse(core["opacity_logit"] < 0.0, target, "have a negative opacity", "remove them")
    for field in ("skew", "opacity_minus_logit", "nu", "beta"):
        if field in model:
            core |= _EQUALS[field](model, normalisation, source, target)
    if source.signed != target.signed:
        raw = core["opacity_logit"]
        core["opacity_logit"] = raw_of_thickness(target, thickness(source, raw), np.ones_like(raw))
    return core


def _without_skew(model: Mapping[str, DoubleArray], normalisation: str, source: Shape, target: Shape) -> Model:
    if not source.normalised:
        return {}  # a matter of the two opacities
    skewed: Mask = np.any(model["skew"] != 0.0, axis=1)
    _refuse(skewed, target, "are skewed", "set their skew to 0, or choose a skewed shape")
    if normalisation != "none":
        return {}
    # exp Phi is half the Gaussian at zero skew
    return {"opacity_logit": _raw_of(source, 0.5 * source.opacity(model["opacity_logit"]))}


def _of_equal_opacities(model: Mapping[str, DoubleArray], normalisation: str, source: Shape, target: Shape) -> Model:
    """Also where the two sides mix alike everywhere, as the skew is 0."""
    plus, minus = model["opacity_logit"], model["opacity_minus_logit"]
    equal = np.abs(plus - minus) <= EQUAL * np.maximum(1.0, np.abs(plus))
    mixed = np.all(model["skew"] == 0.0, axis=1) if "skew" in model else np.zeros(len(plus), np.bool_)
    _refuse(~equal & ~mixed, target, "have two different opacities", "make them equal")
    mean = _raw_of(source, 0.5 * (source.opacity(plus) + source.opacity(minus)))
    return {"opacity_logit": np.where(equal, plus, mean)}


def _raw_of(shape: Shape, opacity: Array) -> DoubleArray:
    """Raw values of opacities, those of 0 and 1 too."""
    with np.errstate(divide="ignore"):
        raw: DoubleArray = np.clip(shape.raw_opacity(opacity), -80.0, 80.0)
    return raw


def _of_neutral_nu(model: Mapping[str, DoubleArray], normalisation: str, source: Shape, target: Shape) -> Model:
    (neutral,) = next(field.neutral for field in source.fields if field.name == "nu")
    finite: Mask = model["nu"] < neutral * (1.0 - LIMIT_SLACK)
    _refuse(finite, target, f"have nu below {neutral:g}", "raise it")
    return {}


def _of_beta(model: Mapping[str, DoubleArray], normalisation: str, source: Shape, target: Shape) -> Model:
    if source.name == "ges-modulation":  # a Gaussian of other scales at every beta
        return {"log_scale": model["log_scale"] - np.log(0.5 + 0.5 * np.exp(-0.1 * (model["beta"] - 2.0)))[:, None]}
    _refuse(np.abs(model["beta"] - 2.0) > EQUAL, target, "have a beta that is not 2", "set it to 2")
    return {}


_EQUALS: dict[str, Callable[[Mapping[str, DoubleArray], str, Shape, Shape], Model]] = {
    "skew": _without_skew,
    "opacity_minus_logit": _of_equal_opacities,
    "nu": _of_neutral_nu,
    "beta": _of_beta,
}
