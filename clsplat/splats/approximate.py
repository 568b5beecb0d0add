"""Approximation of a model by Gaussians, for programs that support no other shape: the nearest one for each splat.

*Lopsided splats.* Take the location of the splat as origin and its scale matrix as unit. The splat is then its greater
opacity times exp(-z'z / 2) (r + (1 - r) Phi(lambda u'z)). Here r is the ratio of the two opacities, or 0 for
skew-normals, and lambda is infinite for a cut by a plane. The profile across u is already Gaussian. The profile along u
is replaced by the Gaussian with the least squared difference on that line. Its centre, width and height depend only on
lambda and r. It is nearer to the profile than the Gaussian of equal moments. But it absorbs less than the splat, which
shows where splats hide each other. Skew-normals get the Gaussian halfway between both. Two or three Gaussians for a
splat are nearer on the line but not in images: the low-pass filter widens each of them, and along u they hide each
other.

*Round profiles* (with an exponent, degrees of freedom, or the number of a registered shape) get the Gaussian with the
least squared difference on the plane. Only the part counts where alpha of an opaque splat is at least 1/255. No
Gaussian has a negative opacity, so such splats are left out.

docs/decisions.md has the measured differences of the images.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .convert import convert, direct_form, longest_slant, restretched, to_world
from .fields import DoubleArray, Field
from .shapes import GAUSSIAN, NORMALISATIONS, PACKAGE_SHAPES, SLANT_MAX, Shape, shape_named
from .splats import Splats

_PEAK = NORMALISATIONS[0]
_LINE = np.linspace(-5.0, 6.0, 441)
_SLANTS = np.append(np.linspace(0.0, SLANT_MAX, 51), np.inf)
_RATIOS = np.linspace(0.0, 1.0, 11)
_RADII = np.linspace(0.0, 40.0, 1601)
_PARAMETERS = 100  # nodes of the table over the parameter of a round profile
_MIN_ALPHA = 1.0 / 255.0
_SOME = 100  # splats of a registered shape whose profile is looked at
_STEPS = 60  # limit of Gauss-Newton steps
_CONVERGED = 1e-9  # Gauss-Newton ends at a smaller step
_RAW_MAX = 80.0  # the logistic function of a larger raw opacity is 1 in float64


def nearest_of_shape(splats: Splats, shape: str) -> tuple[Splats, bool]:
    """Return the nearest splats of another shape, and whether their images differ.

    Without an equal of all splats, skews that the other form of the skew-normal cannot have are shortened. Other splats
    become the splats of the shape that equal their nearest Gaussians. Those of negative opacity are left out then.

    Raises
    ------
    InputError : the shape is unknown, or has no Gaussians among its kernels. Or the normalisation of skew-normals is
        not "peak". Or a registered shape has several fields, or a profile that is not round.
    """
    try:
        return convert(splats, shape), False
    except InputError:
        if shape_named(splats.shape).normalised and shape_named(shape).normalised:
            return convert(_with_short_skews(splats), shape), True
        return convert(nearest_gaussians(splats), shape), True


def _with_short_skews(splats: Splats) -> Splats:
    """Return splats of the direct form, with skews no longer than those that the centred form can have."""
    length = np.linalg.norm(splats.skew.astype(np.float64), axis=1, keepdims=True)
    short = np.minimum(1.0, longest_slant() / np.maximum(length, 1e-300)) * splats.skew
    return splats.with_arrays(splats.to_numpy() | {"skew": short.astype(splats.skew.dtype)})


def nearest_gaussians(splats: Splats) -> Splats:
    """Return the nearest Gaussian of each splat; splats of negative opacity are left out.

    Raises
    ------
    InputError : the normalisation of skew-normals is not "peak", or a registered shape has a profile that is not round
        or has several fields.
    """
    source = shape_named(splats.shape)
    if source.normalised and splats.normalisation != _PEAK:
        raise InputError(
            f"normalisation {splats.normalisation!r}: the height of such a splat changes with "
            f"the view, and that of a Gaussian does not; train with {_PEAK!r}"
        )
    if source.signed:
        splats = splats.select(splats.opacity_logit >= 0.0)
    try:
        return convert(splats, GAUSSIAN.name)
    except InputError:  # some splats are not Gaussians
        pass
    if not _is_known(source):
        _check_round(splats, source)
    arrays = {field.name: splats.arrays[field.name].copy() for field in GAUSSIAN.schema(splats.sh_degree)}
    changed = np.any(splats.skew != 0.0, axis=1) if source.normalised else np.ones(len(splats), np.bool_)
    model = {name: values[changed].astype(np.float64) for name, values in splats.arrays.items()}
    if not _is_known(source):
        fitted = _by_profile(model, source)
    else:
        parameter = next((field for field in source.fields if field.bounds is not None), None)
        fitted = _lopsided(model, source) if parameter is None else _round(model, source, parameter)
    for name, values in fitted.items():
        arrays[name][changed] = values
    return splats.like(GAUSSIAN.name, arrays, _PEAK)


def _lopsided(model: dict[str, DoubleArray], source: Shape) -> dict[str, DoubleArray]:
    """Return mean, rotation, scale and opacity of the Gaussians nearest to splats with a skew or a plane."""
    direct = direct_form(model, source) if source.skew_form == "centred" else model
    if source.skew_form is None:  # a plane cuts the splat
        towards = direct["normal"] / np.linalg.norm(direct["normal"], axis=1, keepdims=True)
        slant = np.full(len(towards), np.inf)
    else:
        slant = np.linalg.norm(direct["skew"], axis=1)
        towards = direct["skew"] / np.maximum(slant, 1e-300)[:, None]
    greater = source.opacity(direct["opacity_logit"])
    ratio, opacity = np.zeros_like(slant), greater
    if "opacity_minus_logit" in direct:
        lesser = source.opacity(direct["opacity_minus_logit"])
        towards = np.where((lesser > greater)[:, None], -towards, towards)
        opacity = np.maximum(greater, lesser)
        ratio = np.minimum(greater, lesser) / np.maximum(opacity, 1e-300)
    centre, width, height = _between(_halfway() if source.normalised else line_fits(), slant, ratio).T
    if source.normalised:  # the opacity is that of the peak
        height = height / _between(_line_peaks()[..., None], slant, ratio)[:, 0]
    frame, _ = restretched(direct, towards, width[:, None])
    mean = direct["mean"] + to_world(direct, towards * centre[:, None])
    return frame | {"mean": mean, "opacity_logit": _raw(height * opacity)}


def _round(model: dict[str, DoubleArray], source: Shape, parameter: Field) -> dict[str, DoubleArray]:
    """Return scale and opacity of the Gaussians nearest to splats with a round profile."""
    values, fits = _round_fits(source, parameter)
    width, height = (np.interp(np.log(model[parameter.name]), np.log(values), column) for column in fits.T)
    return _resized(model, source, width, height)


def _is_known(source: Shape) -> bool:
    """Return whether it is a shape of the package with a skew, a plane, or a number with bounds."""
    described = source.skew_form or any(field.name == "normal" or field.bounds for field in source.fields)
    return source.name in PACKAGE_SHAPES and bool(described)


def _check_round(splats: Splats, source: Shape) -> None:
    """Raise InputError if another shape has several parameters, several opacities or a lopsided profile."""
    why = ""
    if len(source.fields) > 1 or any(field.width > 1 for field in source.fields):
        why = "it has more than one number of its own"
    else:
        some = {name: values[:_SOME] for name, values in splats.arrays.items()}
        ahead, back = (np.asarray(source.profile(sign * _RADII, some), np.float64) for sign in (1.0, -1.0))
        if ahead.shape[1] > 1 or not np.allclose(ahead, back, atol=1e-6):
            why = "its profile is not round"
    if why:
        raise InputError(f"approximate: the nearest Gaussians of {source.name} are not known, because {why}: keep it")


def _by_profile(model: dict[str, DoubleArray], source: Shape) -> dict[str, DoubleArray]:
    """Return scale and opacity of the Gaussians nearest to splats with a round profile of at most one number."""
    if source.fields:
        values = model[source.fields[0].name]
        nodes = np.unique(np.quantile(values, np.linspace(0.0, 1.0, _PARAMETERS)))
        fields = {source.fields[0].name: nodes}
    else:
        values, nodes = np.zeros(len(model["mean"])), np.zeros(1)
        fields = {"opacity_logit": nodes}
    fits = _plane_fits(source, fields)
    width, height = (np.interp(values, nodes, column) for column in fits.T)
    return _resized(model, source, width, height)


def _resized(
    model: dict[str, DoubleArray], source: Shape, width: DoubleArray, height: DoubleArray
) -> dict[str, DoubleArray]:
    return {
        "log_scale": model["log_scale"] + np.log(width)[:, None],
        "opacity_logit": _raw(height * source.opacity(model["opacity_logit"])),
    }


def _raw(opacity: DoubleArray) -> DoubleArray:
    """Return raw values; the fit to a flat profile may be higher than 1."""
    with np.errstate(divide="ignore"):
        return np.clip(GAUSSIAN.raw_opacity(np.clip(opacity, 0.0, 1.0)), -_RAW_MAX, _RAW_MAX)


def _between(table: DoubleArray, slant: DoubleArray, ratio: DoubleArray) -> DoubleArray:
    """Interpolate rows (N, ...) of a table over _SLANTS and _RATIOS; infinite slants have a node of their own."""
    last = len(_SLANTS) - 2
    s = np.where(np.isinf(slant), last + 1.0, np.minimum(slant, SLANT_MAX) / SLANT_MAX * last)
    r = np.clip(ratio, 0.0, 1.0) * (len(_RATIOS) - 1)
    s0, r0 = np.minimum(s.astype(int), last), np.minimum(r.astype(int), len(_RATIOS) - 2)
    a, b = (s - s0)[:, None], (r - r0)[:, None]
    return (1 - a) * ((1 - b) * table[s0, r0] + b * table[s0, r0 + 1]) + a * (
        (1 - b) * table[s0 + 1, r0] + b * table[s0 + 1, r0 + 1]
    )


def _lines() -> DoubleArray:
    """Return the profiles (slants, ratios, points)."""
    from scipy.special import ndtr  # lazy: a slow import

    with np.errstate(invalid="ignore"):  # infinity times 0 is a point on the plane
        side = np.nan_to_num(ndtr(_SLANTS[:, None] * _LINE), nan=0.5)[:, None]
    ratio = _RATIOS[:, None]
    return np.exp(-0.5 * _LINE**2) * (ratio + (1.0 - ratio) * side)


@cache
def line_fits() -> NDArray[np.float64]:
    """Return centre, width and height (slants, ratios, 3) of the nearest Gaussian on the line."""
    lines = _lines()
    flat = lines.reshape(-1, len(_LINE))
    return _fits(_LINE, flat, np.ones_like(flat), True).reshape(*lines.shape[:2], 3)


@cache
def _halfway() -> NDArray[np.float64]:
    """Return centre, width and height halfway between the nearest Gaussian and the one of equal moments and peak."""
    lines = _lines()
    mass = lines.sum(axis=2)
    centre = np.sum(lines * _LINE, axis=2) / mass
    variance = np.sum(lines * (_LINE - centre[..., None]) ** 2, axis=2) / mass
    near = line_fits()
    return np.stack(
        [
            0.5 * (near[..., 0] + centre),
            np.sqrt(0.5 * (near[..., 1] ** 2 + variance)),
            0.5 * (near[..., 2] + lines.max(axis=2)),
        ],
        axis=2,
    )


@cache
def _line_peaks() -> NDArray[np.float64]:
    """Return the maximum (slants, ratios) of each profile."""
    return _lines().max(axis=2)


@cache
def _round_fits(source: Shape, parameter: Field) -> tuple[DoubleArray, DoubleArray]:
    """Return values (P,) of the parameter, and width and height (P, 2) of the nearest Gaussian in the plane."""
    assert parameter.bounds is not None
    values = np.geomspace(*parameter.bounds, _PARAMETERS)
    return values, _plane_fits(source, {parameter.name: values})


def _plane_fits(source: Shape, fields: dict[str, DoubleArray]) -> DoubleArray:
    """Return width and height (P, 2) of the Gaussians nearest to round profiles in the plane."""
    profiles = np.asarray(source.profile(_RADII, fields)[:, 0], np.float64)
    return _fits(_RADII, profiles, _RADII * (profiles >= _MIN_ALPHA), False)[:, 1:]


def _fits(x: DoubleArray, profiles: DoubleArray, weights: DoubleArray, moves: bool) -> DoubleArray:
    """Return centre, width and height (M, 3) of the Gaussians nearest to profiles (M, X), by weighted least squares.

    The centre is 0 unless `moves` is set.
    """
    mass = np.sum(weights * profiles, axis=1)
    centre = np.sum(weights * profiles * x, axis=1) / mass if moves else np.zeros(len(profiles))
    spread = np.sum(weights * profiles * (x - centre[:, None]) ** 2, axis=1) / mass
    fit = np.stack([centre, np.sqrt(spread if moves else 0.5 * spread), profiles.max(axis=1)], axis=1)
    free = np.array([moves, True, True])
    for _ in range(_STEPS):
        c, w, h = (fit[:, i, None] for i in range(3))
        from_centre = (x - c) / w
        bell = np.exp(-0.5 * from_centre**2)
        slopes = np.stack([h * bell * from_centre / w, h * bell * from_centre**2 / w, bell], axis=1)[:, free]
        matrix = np.einsum("max,mbx,mx->mab", slopes, slopes, weights)
        right = np.einsum("max,mx->ma", slopes, weights * (profiles - h * bell))
        step = np.zeros_like(fit)
        step[:, free] = np.linalg.solve(matrix, right[..., None])[..., 0]
        # A step is at most a fifth of the width: a full step from the moments can leave the valley of the minimum.
        step *= np.minimum(1.0, 0.2 * w / np.maximum(np.abs(step[:, :2]).max(axis=1, keepdims=True), 1e-300))
        fit = fit + step
        if np.abs(step).max() < _CONVERGED:
            break
    return fit
