"""Profiles of the kernels along one line, in NumPy. Relocation integrates them (training/density/relocation.py).

A profile is a function (z, fields) -> (n, S, K) with values up to 1. `fields` holds the arrays of n splats by name.
The line runs along the axis of the skew, which is seen from the side; without a skew, along any axis. z (K,) is the
distance from the location in standard deviations. S is the number of opacities of a splat, 1 or 2. The alpha is the
sum over s of opacity_s * profile[:, s].
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from .fields import Array, DoubleArray


def gaussian(z: Array, fields: Mapping[str, Array]) -> Array:
    """Return exp(-z^2/2)."""
    n = len(next(iter(fields.values())))
    return np.broadcast_to(np.exp(-0.5 * z * z), (n, 1, len(z)))


def skew_normal(z: Array, fields: Mapping[str, Array]) -> Array:
    """Return exp(-z^2/2) Phi(slope z) / peak with the slope of the centred form."""
    return _peak_normalised(z, centred_slope(fields))


def skew_normal_direct(z: Array, fields: Mapping[str, Array]) -> Array:
    """Return exp(-z^2/2) Phi(slope z) / peak with the slope of the direct form."""
    return _peak_normalised(z, direct_slope(fields))


def generalised_exponential(z: Array, fields: Mapping[str, Array]) -> Array:
    """Return exp(-(z^2/2)^(beta/2))."""
    beta = fields["beta"].astype(np.float64)[:, None]
    return np.exp(-((0.5 * z * z) ** (0.5 * beta)))[:, None]


def student_t(z: Array, fields: Mapping[str, Array]) -> Array:
    """Return (1 + z^2/nu)^(-(nu + 2)/2), the marginal in two dimensions."""
    nu = fields["nu"].astype(np.float64)[:, None]
    return np.exp(-0.5 * (nu + 2.0) * np.log1p(z * z / nu))[:, None]


def half_gaussian(z: Array, fields: Mapping[str, Array]) -> Array:
    """Return exp(-z^2/2) on each side of 0 and zero on the other; first for the side of `opacity_logit`."""
    above = np.where(z > 0, 1.0, np.where(z < 0, 0.0, 0.5))
    n = len(next(iter(fields.values())))
    return np.broadcast_to(np.exp(-0.5 * z * z) * np.stack([above, 1.0 - above]), (n, 2, len(z)))


def bisected_skew(z: Array, fields: Mapping[str, Array]) -> Array:
    """Return exp(-z^2/2) Phi(slope z) and exp(-z^2/2) Phi(-slope z), with slope = |eta|."""
    from scipy.special import ndtr  # imported late: slow to import

    u = direct_slope(fields)[:, None] * z
    parts: Array = np.exp(-0.5 * z * z) * np.stack([ndtr(u), ndtr(-u)], axis=1)
    return parts


def centred_slope(fields: Mapping[str, Array]) -> DoubleArray:
    """Return the slope of a skew m, (n,). With t = |m|^2 and k = (pi/2) t / (1 + t), slope^2 = k / (1 - k)."""
    t = np.sum(fields["skew"].astype(np.float64) ** 2, axis=1)
    k = 0.5 * math.pi * t / (1.0 + t)
    slope: DoubleArray = np.sqrt(k / (1.0 - k))
    return slope


def direct_slope(fields: Mapping[str, Array]) -> DoubleArray:
    """Return the slope of a slant eta, (n,): its length."""
    slope: DoubleArray = np.linalg.norm(fields["skew"].astype(np.float64), axis=1)
    return slope


def no_slope(fields: Mapping[str, Array]) -> DoubleArray:
    """Return the slope of all Gaussians: 0, (1,)."""
    return np.zeros(1)


def _peak_normalised(z: Array, slope: Array) -> Array:
    from scipy.special import log_ndtr

    slope = slope[:, None]
    mode = np.zeros_like(slope)
    # The mode solves -z + slope R(slope z) = 0 with R = phi / Phi. Newton's method converges from 0, because the
    # logarithm of the kernel is concave.
    for _ in range(30):
        u = slope * mode
        inverse_mills = np.exp(-0.5 * u * u - 0.5 * math.log(2.0 * math.pi) - log_ndtr(u))
        mode -= (slope * inverse_mills - mode) / (-1.0 - slope**2 * inverse_mills * (inverse_mills + u))
    log_kernel = -0.5 * z**2 + log_ndtr(slope * z) + 0.5 * mode**2 - log_ndtr(slope * mode)
    return np.exp(log_kernel)[:, None]


# The slope of each profile that equals exp(-z^2/2) Phi(slope z) / peak. It is the only number that such a profile uses.
SLOPES = {gaussian: no_slope, skew_normal: centred_slope, skew_normal_direct: direct_slope}
EVEN = (gaussian, generalised_exponential, student_t)  # profiles with one opacity and the same values at z and -z
SHORT = (gaussian, skew_normal, skew_normal_direct, half_gaussian, bisected_skew)  # below 1e-17 beyond REACH
REACH = 9.0
