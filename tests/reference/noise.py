"""The noise step of 3DGS-MCMC in NumPy, which the kernel must reproduce."""

from __future__ import annotations

import math

import numpy as np

from clsplat.splats.fields import Array
from clsplat.training.optim.noise import covariance_times, noise_gate, normal3


def add_noise(
    mean: Array,
    quat: Array,
    log_scale: Array,
    strength: Array,
    seed: int,
    iteration: int,
    amount: float,
    reach: float = math.inf,
) -> Array:
    """Return the means after the noise step: mean + Sigma (xi gate amount), moved by at most `reach`.

    Parameters
    ----------
    mean (N, 3), quat (N, 4) wxyz of any norm above 0, log_scale (N, 3) : raw values.
    strength : (N,) the largest |opacity| of each splat (Shape.strength).
    amount : noise learning rate (5e5 in 3DGS-MCMC) times the mean's learning rate of this iteration.

    Returns
    -------
    (N, 3) of the mean's dtype.
    """
    xi = normal3(seed, iteration, len(mean)).astype(np.float64)
    step = xi * (noise_gate(strength) * amount)[:, None]
    shift = covariance_times(quat, log_scale, step)
    length = np.maximum(np.linalg.norm(shift, axis=1, keepdims=True), 1e-15)
    return (mean + shift * np.minimum(reach / length, 1.0)).astype(mean.dtype)
