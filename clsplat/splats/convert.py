"""Exact conversion of a model to another shape with the same images.

Both forms of the skew-normal describe the same kernels. One has mean and covariance, the other location and scale
matrix (Azzalini & Capitanio 1999). All other conversions go through the Gaussian, which every shape of the package
contains. Student-t contains it up to 4e-5 of alpha, at the largest nu. Registered shapes contain it only if their
profile with neutral fields is a Gaussian. Their splats are Gaussians only if all fields are neutral.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .checks import LIMIT_SLACK
from .fields import Array, DoubleArray, Field, scale_of
from .optical_depth import optical_depth, raw_of_optical_depth
from .quaternions import of_rotations, rotations
from .shapes import GAUSSIAN, PACKAGE_SHAPES, SKEW_MAX, SKEW_NORMAL, SLANT_MAX, Shape, shape_named
from .splats import Splats

ArraysByField = dict[str, DoubleArray]

EQUAL = 1e-6  # two raw opacities that differ by less are equal up to the rounding of float32


def convert(splats: Splats, shape: str) -> Splats:
    """Return the splats as another shape with equal images, up to the rounding of their dtype.

    The normalisation is kept if both shapes have one. Otherwise it is "peak".

    Raises
    ------
    InputError : the shape is unknown, or it has no equal kernel for some splats. The message says how many and why.
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
    arrays = {name: values.astype(dtype) for name, values in model.items()}
    return splats.like(shape, arrays, normalisation)


def as_one_of(splats: Splats, shapes: Sequence[str], holder: str) -> Splats:
    """Return splats with equal images and one of the shapes: theirs, or the Gaussian, or the skew-normal.

    holder : what holds only these shapes, with its verb, for the message.

    Raises
    ------
    InputError : some splats have no equal of these shapes.
    """
    if splats.shape in shapes:
        return splats
    reason = ""
    for target in (GAUSSIAN.name, SKEW_NORMAL.name):
        try:
            if target in shapes:
                return convert(splats, target)
        except InputError as error:
            reason = str(error)
    if len(shapes) == 1:
        raise InputError(reason)
    raise InputError(f"{holder} {', '.join(shapes[:-1])} and {shapes[-1]} splats, not {splats.shape}: {reason}")


def _refuse(bad: NDArray[np.bool_], target: Shape, why: str, remedy: str) -> None:
    """Raise InputError if the mask `bad` has any splats."""
    if bad.any():
        count = f"{np.count_nonzero(bad)} of {len(bad)} splats"
        raise InputError(f"convert: {count} {why}, which {target.name} does not support: {remedy}")


# ---- the two forms of the skew-normal ------------------------------------------------------------------------------


def direct_form(model: ArraysByField, target: Shape) -> ArraysByField:
    """Convert the centred form: scale matrix = covariance + shift shift', location = mean - shift."""
    m = _bounded(model["skew"], SKEW_MAX)
    t = np.sum(m * m, axis=1, keepdims=True)
    k = _displaced(t)
    shift = to_world(model, m)
    frame, turned = restretched(model, m, np.sqrt(1.0 + t))
    unit = turned / np.sqrt(np.maximum(t, 1e-300))
    return model | frame | {"mean": model["mean"] - shift, "skew": unit * np.sqrt(k / (1.0 - k))}


def _centred(model: ArraysByField, target: Shape) -> ArraysByField:
    """Convert the direct form: covariance = scale matrix - shift shift', mean = location + shift."""
    slant = _bounded(model["skew"], SLANT_MAX)
    squared = np.sum(slant * slant, axis=1, keepdims=True)
    removed = (
        2.0 / math.pi * squared / (1.0 + squared)
    )  # the share of the variance along the slant that the skew removes
    length = np.sqrt(removed / (1.0 - removed))
    too_long = length[:, 0] > SKEW_MAX * (1.0 + LIMIT_SLACK)
    _refuse(too_long, target, f"have a skew above {longest_slant():.3f}", "shorten it")
    unit = slant / np.sqrt(np.maximum(squared, 1e-300))
    frame, turned = restretched(model, unit, np.sqrt(1.0 - removed))
    shift = to_world(model, unit * np.sqrt(removed))
    return model | frame | {"mean": model["mean"] + shift, "skew": turned * np.minimum(length, SKEW_MAX)}


def longest_slant() -> float:
    """Return the largest skew of the direct form that the centred form can have, too."""
    k = _displaced(SKEW_MAX**2)
    return float(math.sqrt(k / (1.0 - k)))


def _displaced(t: DoubleArray | float) -> DoubleArray | float:
    """Return |delta|^2 = |eta|^2 / (1 + |eta|^2) of a shift m with |m|^2 = t."""
    return 0.5 * math.pi * t / (1.0 + t)


_SKEW_FORMS: dict[str, Callable[[ArraysByField, Shape], ArraysByField]] = {"centred": _centred, "direct": direct_form}


def _bounded(vectors: DoubleArray, limit: float) -> DoubleArray:
    """Shorten vectors (N, 3) to at most `limit`, as the kernels do."""
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors * np.minimum(limit / np.maximum(lengths, 1e-300), 1.0)


def to_world(model: ArraysByField, vectors: DoubleArray) -> DoubleArray:
    """Return the vectors R S v (N, 3): from the unit frame of each splat to the world."""
    return np.einsum("nij,nj->ni", rotations(model["quat"]), scale_of(model["log_scale"]) * vectors)


def restretched(model: ArraysByField, along: DoubleArray, factor: DoubleArray) -> tuple[ArraysByField, DoubleArray]:
    """Stretch splats by `factor` (N, 1) along the vectors `along` (N, 3) of their unit frames.

    Returns
    -------
    Rotation and scale of R S H H' S R', where H is the stretch, and the vectors in the new unit frames. With the
    singular values S H = U L W' the new rotation is R U and the new scale L. A vector H v of the old frame is W'v in
    the new one. Splats with a zero vector keep their bits.
    """
    frame = {name: model[name].copy() for name in ("quat", "log_scale")}
    turned = along.copy()
    stretched = np.flatnonzero(np.any(along != 0.0, axis=1))
    if stretched.size == 0:
        return frame, turned
    unit = along[stretched] / np.linalg.norm(along[stretched], axis=1, keepdims=True)
    stretch = np.eye(3) + (factor[stretched, :, None] - 1.0) * unit[:, :, None] * unit[:, None, :]
    log_scale = model["log_scale"][stretched]
    largest = log_scale.max(axis=1, keepdims=True)
    u, singular, w = np.linalg.svd(np.exp(log_scale - largest)[:, :, None] * stretch)
    mirrored = np.linalg.det(u) < 0.0
    u[mirrored, :, 2] *= -1.0
    w[mirrored, 2, :] *= -1.0
    frame["quat"][stretched] = of_rotations(rotations(model["quat"][stretched]) @ u)
    frame["log_scale"][stretched] = np.log(np.maximum(singular, 1e-300)) + largest
    turned[stretched] = np.einsum("nij,nj->ni", w, along[stretched])
    return frame, turned


# ---- through the Gaussian --------------------------------------------------------------------------------------


def _gaussian(model: ArraysByField, normalisation: str, source: Shape, target: Shape) -> ArraysByField:
    """Return the core fields of splats of `source` that are Gaussians, for splats of `target`."""
    core = {name: model[name] for name in ("mean", "quat", "log_scale", "opacity_logit", "sh")}
    for shape in (source, target):
        if not shape.holds_gaussian():
            raise InputError(
                f"convert: {source.name} splats have no equal among {target.name} splats, because no "
                f"{shape.name} splat is a Gaussian: keep {source.name}"
            )
    if source.signed and not target.signed:
        _refuse(core["opacity_logit"] < 0.0, target, "have a negative opacity", "remove them")
    for field in source.fields:
        if source.name in PACKAGE_SHAPES and field.name in _EQUALS:
            core |= _EQUALS[field.name](model, normalisation, source, target)
        else:
            _refuse_other_values(model, field, target)
    if source.signed != target.signed:
        raw = core["opacity_logit"]
        core["opacity_logit"] = raw_of_optical_depth(target, optical_depth(source, raw), np.ones_like(raw))
    return core


def _refuse_other_values(model: Mapping[str, DoubleArray], field: Field, target: Shape) -> None:
    """Refuse splats whose values of a field are not the neutral ones, which make the shape a Gaussian."""
    values = model[field.name].reshape(len(model["mean"]), -1)
    if field.neutral_from is None:
        neutral, named = np.array([field.neutral]), ", ".join(f"{value:g}" for value in field.neutral)
    else:
        neutral, named = model[field.neutral_from].reshape(len(values), -1), field.neutral_from
    other = np.any(np.abs(values - neutral) > EQUAL * np.maximum(1.0, np.abs(neutral)), axis=1)
    _refuse(other, target, f"have {field.name} other than {named}", f"set it to {named}")


def _without_skew(model: Mapping[str, DoubleArray], normalisation: str, source: Shape, target: Shape) -> ArraysByField:
    if not source.normalised:
        return {}  # _of_equal_opacities handles this skew
    skewed = np.any(model["skew"] != 0.0, axis=1)
    _refuse(skewed, target, "are skewed", "set their skew to 0, or choose a skewed shape")
    if normalisation != "none":
        return {}
    # Without normalisation the kernel is exp Phi, half the Gaussian at zero skew.
    return {"opacity_logit": _raw_of(source, 0.5 * source.opacity(model["opacity_logit"]))}


def _of_equal_opacities(
    model: Mapping[str, DoubleArray], normalisation: str, source: Shape, target: Shape
) -> ArraysByField:
    """Convert two opacities to one. They must be equal, or the skew must be 0, so that both sides mix evenly."""
    plus, minus = model["opacity_logit"], model["opacity_minus_logit"]
    equal = np.abs(plus - minus) <= EQUAL * np.maximum(1.0, np.abs(plus))
    mixed = np.all(model["skew"] == 0.0, axis=1) if "skew" in model else np.zeros(len(plus), np.bool_)
    _refuse(~equal & ~mixed, target, "have two different opacities", "make them equal")
    mean = _raw_of(source, 0.5 * (source.opacity(plus) + source.opacity(minus)))
    return {"opacity_logit": np.where(equal, plus, mean)}


def _raw_of(shape: Shape, opacity: Array) -> DoubleArray:
    """Return finite raw values of opacities, also for 0 and 1."""
    with np.errstate(divide="ignore"):
        return np.clip(shape.raw_opacity(opacity), -80.0, 80.0)


def _of_neutral_nu(model: Mapping[str, DoubleArray], normalisation: str, source: Shape, target: Shape) -> ArraysByField:
    (neutral,) = next(field.neutral for field in source.fields if field.name == "nu")
    finite = model["nu"] < neutral * (1.0 - LIMIT_SLACK)
    _refuse(finite, target, f"have nu below {neutral:g}", "raise it")
    return {}


def _of_beta(model: Mapping[str, DoubleArray], normalisation: str, source: Shape, target: Shape) -> ArraysByField:
    if source.name == "ges-modulation":  # a Gaussian with other scales at every beta
        return {"log_scale": model["log_scale"] - np.log(0.5 + 0.5 * np.exp(-0.1 * (model["beta"] - 2.0)))[:, None]}
    _refuse(np.abs(model["beta"] - 2.0) > EQUAL, target, "have a beta that is not 2", "set it to 2")
    return {}


_EQUALS: dict[str, Callable[[Mapping[str, DoubleArray], str, Shape, Shape], ArraysByField]] = {
    "skew": _without_skew,
    "opacity_minus_logit": _of_equal_opacities,
    "nu": _of_neutral_nu,
    "beta": _of_beta,
    "normal": lambda model, normalisation, source, target: {},  # without effect if both opacities are equal
}
