"""Adam in NumPy (Kingma & Ba 2015) with the constants of 3DGS: the reference of the kernels.

All splats share one step count, as in 3DGS. So relocated splats get moments of zero, but their bias correction does not
restart.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...splats.fields import Array

BETA1, BETA2, EPS = 0.9, 0.999, 1e-15  # 3DGS
WAITS = 256  # one more than the largest number of skipped steps (optim/lazy.py)
DRIFT, DRIFT_MEAN, DRIFT_SKEW = range(3)  # kinds of drift during skipped steps (lazy.py)
DECAY_ROWS = 2  # rows before the drifts in the table of lazy.py


class NumpyAdam:
    """Adam over named arrays with one row per splat.

    Parameters
    ----------
    params : arrays with the shapes and dtypes of the parameters.

    Attributes
    ----------
    step_count : number of steps.
    first, second : first and second moments by name.
    """

    def __init__(
        self, params: Mapping[str, Array], beta1: float = BETA1, beta2: float = BETA2, eps: float = EPS
    ) -> None:
        self.beta1, self.beta2, self.eps = beta1, beta2, eps
        self.step_count = 0
        self.first = {name: np.zeros_like(param) for name, param in params.items()}
        self.second = {name: np.zeros_like(param) for name, param in params.items()}

    def advance(self) -> None:
        """Begin a step: raise the count, which the bias corrections depend on."""
        self.step_count += 1

    def direction(self, name: str, grad: Array, rows: slice | NDArray[np.int64] = slice(None)) -> Array:
        """Update the moments of `name` with a gradient of the splats `rows`, and return the direction of the step.

        Returns
        -------
        Bias-corrected direction; the caller multiplies it by a rate.

        Raises
        ------
        KeyError : unknown name. ValueError : the shape of the gradient is not that of the parameter.
        """
        m, v = self.first[name][rows], self.second[name][rows]
        if grad.shape != m.shape:
            raise ValueError(f"{name}: gradient {grad.shape}, parameter {m.shape}")
        m *= self.beta1
        m += (1.0 - self.beta1) * grad
        v *= self.beta2
        v += (1.0 - self.beta2) * (grad * grad)
        self.first[name][rows], self.second[name][rows] = m, v
        correction1 = 1.0 - self.beta1**self.step_count
        correction2 = math.sqrt(1.0 - self.beta2**self.step_count)
        ascent: Array = (m / correction1) / (np.sqrt(v) / correction2 + self.eps)
        return ascent

    def step(self, params: Mapping[str, Array], grads: Mapping[str, Array], lrs: Mapping[str, ArrayLike]) -> None:
        """Update every array of `params` in place.

        Parameters
        ----------
        params, grads : arrays by name; every parameter needs a gradient of its shape.
        lrs : rates by name; a rate broadcasts over the parameter.
        """
        self.advance()
        for name, param in params.items():
            rate = np.asarray(lrs[name], dtype=param.dtype)
            param -= rate * self.direction(name, grads[name])
