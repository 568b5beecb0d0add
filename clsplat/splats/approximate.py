"""Gaussians in place of other splats, for programs that know no others: each splat's nearest one.

*Lopsided splats.* With its location as origin and its scale matrix as unit, such a splat is its greater opacity times
exp(-z'z / 2) (r + (1 - r) Phi(lambda u'z)): r is 0 for skew-normals and else the ratio of the two opacities, lambda
infinite where a plane cuts. Across u it is a Gaussian already. Along u it gets the Gaussian of least squared
difference over the line, whose centre, width and height depend on lambda and r alone. It is nearer to the profile
than the Gaussian of equal moments: for half-Gaussian edges (lambda = 10, r = 0) 26 % of its norm away instead of 36
%. Two or three Gaussians for a splat are nearer yet (12 and 5 %), but not in images: each is widened by the low-pass
for itself, and seen along u they stand one behind the other. On kitchen (20 000 splats, |m| 0.91 of its limit in the
median) the images' PSNR against the skewed model is 35.7 dB with equal moments, 36.4 dB with the nearest Gaussian,
36.6 dB at best with two for the large splats, and 34 to 36 dB with three.

*Round profiles* (an exponent or degrees of freedom) get the Gaussian of least squared difference over the plane, down
to where an opaque splat's alpha is 1/255. A negative opacity is in no Gaussian: such splats are left out.

Images of fox (20 000 splats, 1000 iterations) against the model's own, and in brackets with nothing fitted (the mean of
two opacities, else the same columns) [dB]: half-gaussian 36.8 (34.8), bisected-skew 40.5 (36.6),
generalised-exponential 35.7 (32.2), student-t, a tenth of it negative, 33.2 (33.0).
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .convert import convert, direct_form, restretched, to_world
from .fields import DoubleArray, Field
from .shapes import GAUSSIAN, NORMALISATIONS, SLANT_MAX, Shape, shape_named
from .splats import Splats

_PEAK = NORMALISATIONS[0]
_LINE = np.linspace(-5.0, 6.0, 441)
_SLANTS = np.append(np.linspace(0.0, SLANT_MAX, 51), np.inf)
_RATIOS = np.linspace(0.0, 1.0, 11)
_RADII = np.linspace(0.0, 40.0, 1601)
_PARAMETERS = 100  # of a table over a round profile's parameter
_FAINTEST = 1.0 / 255.0
_STEPS = 60  # of Gauss-Newton, at most
_SETTLED = 1e-9  # the largest step that is none
_RAW_MAX = 80.0  # of an opacity: its logistic function is 1 to float64


def nearest_gaussians(splats: Splats) -> Splats:
    """A Gaussian for each splat, its equal where there is one; none for splats of negative opacity.

    Raises
    ------
    InputError : skew-normals of a normalisation other than "peak".
    """
    source = shape_named(splats.shape)
    if source.normalised and splats.normalisation != _PEAK:
        raise InputError(
            f"convert: normalisation {splats.normalisation!r}: the height of such a splat changes with "
            f"the view, and that of a Gaussian does not; train with {_PEAK!r}"
        )
    if source.signed:
        splats = splats.select(splats.opacity_logit >= 0.0)
    try:
        return convert(splats, GAUSSIAN.name)
    except InputError:  # some have no equal
        pass
    arrays = {field.name: splats.arrays[field.name].copy() for field in GAUSSIAN.schema(splats.sh_degree)}
    changed = np.any(splats.skew != 0.0, axis=1) if source.normalised else np.ones(len(splats), np.bool_)
    model = {name: values[changed].astype(np.float64) for name, values in splats.arrays.items()}
    parameter = next((field for field in source.fields if field.bounds is not None), None)
    fitted = _lopsided(model, source) if parameter is None else _round(model, source, parameter)
    for name, values in fitted.items():
        arrays[name][changed] = values
    return Splats(GAUSSIAN.name, arrays, antialiased=splats.antialiased)


def _lopsided(model: dict[str, DoubleArray], source: Shape) -> dict[str, DoubleArray]:
    """Mean, rotation, scale and opacity of the Gaussians nearest to splats with a skew or a plane."""
    direct = direct_form(model, source) if source.skew_form == "centred" else model
    if source.skew_form is None:  # a plane
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
    centre, width, height = _between(line_fits(), slant, ratio).T
    if source.normalised:  # their opacity is the peak's
        height = height / _between(_line_peaks()[..., None], slant, ratio)[:, 0]
    frame, _ = restretched(direct, towards, width[:, None])
    mean = direct["mean"] + to_world(direct, towards * centre[:, None])
    return frame | {"mean": mean, "opacity_logit": _raw(height * opacity)}


def _round(model: dict[str, DoubleArray], source: Shape, parameter: Field) -> dict[str, DoubleArray]:
    """Scale and opacity of the Gaussians nearest to splats of a round profile."""
    values, fits = _round_fits(source, parameter)
    width, height = (np.interp(np.log(model[parameter.name]), np.log(values), column) for column in fits.T)
    return {
        "log_scale": model["log_scale"] + np.log(width)[:, None],
        "opacity_logit": _raw(height * source.opacity(model["opacity_logit"])),
    }


def _raw(opacity: DoubleArray) -> DoubleArray:
    """Raw values; a fit may be higher than 1, where a profile is flatter than a Gaussian."""
    with np.errstate(divide="ignore"):
        return np.clip(GAUSSIAN.raw_opacity(np.clip(opacity, 0.0, 1.0)), -_RAW_MAX, _RAW_MAX)


def _between(table: DoubleArray, slant: DoubleArray, ratio: DoubleArray) -> DoubleArray:
    """Rows (N, ...) of a table over _SLANTS and _RATIOS, linear between its nodes; infinite slants have their own."""
    last = len(_SLANTS) - 2
    s = np.where(np.isinf(slant), last + 1.0, np.minimum(slant, SLANT_MAX) / SLANT_MAX * last)
    r = np.clip(ratio, 0.0, 1.0) * (len(_RATIOS) - 1)
    s0, r0 = np.minimum(s.astype(int), last), np.minimum(r.astype(int), len(_RATIOS) - 2)
    a, b = (s - s0)[:, None], (r - r0)[:, None]
    mixed: DoubleArray = (1 - a) * ((1 - b) * table[s0, r0] + b * table[s0, r0 + 1]) + a * (
        (1 - b) * table[s0 + 1, r0] + b * table[s0 + 1, r0 + 1]
    )
    return mixed


def _lines() -> DoubleArray:
    """(slants, ratios, points) the profiles themselves."""
    from scipy.special import ndtr  # lazy: the command line starts without scipy

    with np.errstate(invalid="ignore"):  # infinity times 0: the plane itself
        side = np.nan_to_num(ndtr(_SLANTS[:, None] * _LINE), nan=0.5)[:, None]
    ratio = _RATIOS[:, None]
    lines: DoubleArray = np.exp(-0.5 * _LINE**2) * (ratio + (1.0 - ratio) * side)
    return lines


@cache
def line_fits() -> NDArray[np.float64]:
    """(slants, ratios, 3) centre, width and height of the nearest Gaussian on the line."""
    lines = _lines()
    flat = lines.reshape(-1, len(_LINE))
    return _fits(_LINE, flat, np.ones_like(flat), True).reshape(*lines.shape[:2], 3)


@cache
def _line_peaks() -> NDArray[np.float64]:
    """(slants, ratios) the greatest value of each profile."""
    peaks: NDArray[np.float64] = _lines().max(axis=2)
    return peaks


@cache
def _round_fits(source: Shape, parameter: Field) -> tuple[DoubleArray, DoubleArray]:
    """(P,) values of a profile's parameter, and (P, 2) width and height of the nearest Gaussian in the plane."""
    assert parameter.bounds is not None
    values = np.geomspace(*parameter.bounds, _PARAMETERS)
    profiles = np.asarray(source.profile(_RADII, {parameter.name: values})[:, 0], np.float64)
    return values, _fits(_RADII, profiles, _RADII * (profiles >= _FAINTEST), False)[:, 1:]


def _fits(x: DoubleArray, profiles: DoubleArray, weights: DoubleArray, moves: bool) -> DoubleArray:
    """(M, 3) centre, width and height of the Gaussians nearest to profiles (M, X), by weighted least squares.

    moves : whether the centre may; else it is 0.
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
        # No more than a fifth of the width at a time: from the moments a whole step can pass the valley.
        step *= np.minimum(1.0, 0.2 * w / np.maximum(np.abs(step[:, :2]).max(axis=1, keepdims=True), 1e-300))
        fit = fit + step
        if np.abs(step).max() < _SETTLED:
            break
    return fit
