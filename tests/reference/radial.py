"""The reference's kernels that depend on q alone, with a learned falloff.

They compute powers directly, whereas the OpenCL kernels use logarithms. reference/formulas.py explains the complex
step.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from reference.shape import Array, Geometry, Kernel, ShapeReference, logistic


def student_t(arrays: Mapping[str, Array], geometry: Geometry, normalisation: str) -> Kernel:
    """Return the kernel (1 + q/nu)^-((nu + 2)/2), with an opacity of either sign."""
    nu = arrays["nu"][:, None]

    def falloff(q: Array) -> Array:
        return (1.0 + q / nu) ** (-0.5 * (nu + 2.0))

    return Kernel(geometry.point_px, geometry.matrix2d(), np.tanh(arrays["opacity_logit"]), falloff=falloff)


def generalised_exponential(arrays: Mapping[str, Array], geometry: Geometry, normalisation: str) -> Kernel:
    """Return the kernel exp(-(q/2)^(beta/2)). It is 1 at q = 0 for every beta."""
    beta = arrays["beta"][:, None]

    def falloff(q: Array) -> Array:
        at_centre = q.real <= 0.0
        return np.where(at_centre, 1.0, np.exp(-(np.where(at_centre, 1.0, 0.5 * q) ** (0.5 * beta))))

    return Kernel(geometry.point_px, geometry.matrix2d(), logistic(arrays["opacity_logit"]), falloff=falloff)


def ges_modulation(arrays: Mapping[str, Array], geometry: Geometry, normalisation: str) -> Kernel:
    """Return the Gaussian whose scales are multiplied by 2 sigma(0.1 (beta - 2))."""
    size = 2.0 * logistic(0.1 * (arrays["beta"] - 2.0))
    low_pass = geometry.low_pass * np.eye(2)
    scale2d = (size * size)[:, None, None] * (geometry.matrix2d() - low_pass) + low_pass
    return Kernel(geometry.point_px, scale2d, logistic(arrays["opacity_logit"]))


RADIAL: dict[str, ShapeReference] = {
    "generalised-exponential": ShapeReference(("beta",), generalised_exponential),
    "ges-modulation": ShapeReference(("beta",), ges_modulation),
    "student-t": ShapeReference(("nu",), student_t, signed=True),
}
