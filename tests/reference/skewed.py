"""The reference's Gaussian and skewed kernels. All have location, scale matrix and slope, unlike the OpenCL kernels.

delta is the skew displacement in the unit frame (|delta| < 1, or = 1 for a plane). With delta2d = A R S delta and
C = A R S S R' A' + low-pass, slope = C^-1 delta2d / sqrt(1 - k). The matrix determinant lemma gives
1 - k = det(C - delta2d delta2d') / det(C), and C - delta2d delta2d' = A R S (I - delta delta') S R' A' + low-pass.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from reference.formulas import SLANT_MAX, bounded, determinant, direct_form, inverse_2x2, peak, slope_of
from reference.shape import Array, Geometry, Kernel, ShapeReference, logistic


def normalised(opacity: Array, c: Array, normalisation: str) -> Array:
    """Return the factor before exp and Phi of a skew-normal."""
    return opacity * {"peak": 1.0 / peak(c), "pdf": 2.0, "none": 1.0}[normalisation]


def displacement(slant: Array) -> Array:
    """Return delta = eta / sqrt(1 + |eta|²) for slants (B, 3), which are bounded first."""
    slant = bounded(slant, SLANT_MAX)
    return slant / np.sqrt(1.0 + (slant * slant).sum(-1, keepdims=True))


def unit(vector: Array) -> Array:
    return vector / np.sqrt((vector * vector).sum(-1, keepdims=True))


def slope_and_c(geometry: Geometry, delta: Array) -> tuple[Array, Array]:
    """Return slope (B, 2) and c = k / (1 - k), for the skew displacement `delta` (B, 3) in the unit frame."""
    scale2d = geometry.matrix2d()
    rest = geometry.matrix2d(np.eye(3) - delta[:, :, None] * delta[:, None, :])
    one_minus_k = determinant(rest) / determinant(scale2d)
    weighted = np.einsum("bij,bj->bi", inverse_2x2(scale2d), geometry.vector2d(delta))
    return weighted / np.sqrt(one_minus_k)[:, None], 1.0 / one_minus_k - 1.0


def gaussian(arrays: Mapping[str, Array], geometry: Geometry, normalisation: str) -> Kernel:
    return Kernel(geometry.point_px, geometry.matrix2d(), logistic(arrays["opacity_logit"]))


def skew_normal(arrays: Mapping[str, Array], geometry: Geometry, normalisation: str) -> Kernel:
    """Convert mean and covariance to the direct form in 3D, and project that."""
    shift = bounded(arrays["skew"])
    identity = np.broadcast_to(np.eye(3), (len(shift), 3, 3))
    inner, delta = direct_form(identity, shift)
    delta2d, scale2d = geometry.vector2d(delta), geometry.matrix2d(inner)
    slope, c = slope_of(scale2d, delta2d)
    amplitude = normalised(logistic(arrays["opacity_logit"]), c, normalisation)
    return Kernel(geometry.point_px - np.sqrt(2.0 / np.pi) * delta2d, scale2d, amplitude, slope)


def skew_normal_direct(arrays: Mapping[str, Array], geometry: Geometry, normalisation: str) -> Kernel:
    """Linearise at the centroid, which is sqrt(2/pi) delta from the location, in 3D and on the screen."""
    delta = displacement(arrays["skew"])
    slope, c = slope_and_c(geometry, delta)
    amplitude = normalised(logistic(arrays["opacity_logit"]), c, normalisation)
    location = geometry.point_px - np.sqrt(2.0 / np.pi) * geometry.vector2d(delta)
    return Kernel(location, geometry.matrix2d(), amplitude, slope)


def two_sided(arrays: Mapping[str, Array], geometry: Geometry, delta: Array) -> Kernel:
    slope, _ = slope_and_c(geometry, delta)
    plus, minus = logistic(arrays["opacity_logit"]), logistic(arrays["opacity_minus_logit"])
    return Kernel(geometry.point_px, geometry.matrix2d(), plus, slope, minus)


def half_gaussian(arrays: Mapping[str, Array], geometry: Geometry, normalisation: str) -> Kernel:
    return two_sided(arrays, geometry, unit(arrays["normal"]))


def bisected_skew(arrays: Mapping[str, Array], geometry: Geometry, normalisation: str) -> Kernel:
    return two_sided(arrays, geometry, displacement(arrays["skew"]))


SKEWED = {
    "gaussian": ShapeReference((), gaussian),
    "skew-normal": ShapeReference(("skew",), skew_normal),
    "skew-normal-direct": ShapeReference(
        ("skew",), skew_normal_direct, lambda arrays: np.sqrt(2.0 / np.pi) * displacement(arrays["skew"]), direct=True
    ),
    "half-gaussian": ShapeReference(("opacity_minus_logit", "normal"), half_gaussian),
    "bisected-skew": ShapeReference(("opacity_minus_logit", "skew"), bisected_skew, direct=True),
}
