"""Adam in NumPy: the reference that the fused device step is compared with, and the one to read.

Kingma & Ba 2015 with 3DGS's constants. The step count is one for all splats, as in 3DGS: relocated splats get
zero moments but no fresh bias correction.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import InputError
from .schema import Array, Schema

BETA1, BETA2, EPS = 0.9, 0.999, 1e-15  # 3DGS
SH_REST_FACTOR = 1.0 / 20.0  # 3DGS: bands above the constant learn 20 times slower


def learning_rates(schema: Schema, mean: float) -> dict[str, ArrayLike]:
    """Adam's rate per field, shaped to broadcast over the public arrays.

    Parameters
    ----------
    schema : fields with their rates.
    mean : the mean's rate of this iteration (scene extent and decay included) [world units].

    Returns
    -------
    Field name to float, but for `sh` to a (1, K, 1) array.
    """
    rates: dict[str, ArrayLike] = {field.name: field.lr for field in schema}
    rates["mean"] = mean
    sh = np.full((1, schema["sh"].width // 3, 1), schema["sh"].lr)
    sh[:, 1:] *= SH_REST_FACTOR
    rates["sh"] = sh
    return rates


class NumpyAdam:
    """Adam over named arrays whose first axis is the splat.

    Attributes
    ----------
    step_count : steps taken.
    first, second : name to first and second moments, of the parameters' shapes and dtypes.
    """

    def __init__(self, beta1: float = BETA1, beta2: float = BETA2, eps: float = EPS) -> None:
        self.beta1, self.beta2, self.eps = beta1, beta2, eps
        self.step_count = 0
        self.first: dict[str, Array] = {}
        self.second: dict[str, Array] = {}

    def step(
        self, params: Mapping[str, Array], grads: Mapping[str, Array], lrs: Mapping[str, ArrayLike]
    ) -> None:
        """Update every array of `params` in place.

        Parameters
        ----------
        params, grads : name to array; every parameter needs a gradient of its shape.
        lrs : name to rate, a number or anything that broadcasts over the parameter.

        Raises
        ------
        KeyError : a parameter without gradient or rate. ValueError : shapes differ.
        """
        self.step_count += 1
        correction1 = 1.0 - self.beta1**self.step_count
        correction2 = math.sqrt(1.0 - self.beta2**self.step_count)
        for name, param in params.items():
            grad = grads[name]
            if grad.shape != param.shape:
                raise ValueError(f"{name}: gradient {grad.shape}, parameter {param.shape}")
            m = self.first.setdefault(name, np.zeros_like(param))
            v = self.second.setdefault(name, np.zeros_like(param))
            m *= self.beta1
            m += (1.0 - self.beta1) * grad
            v *= self.beta2
            v += (1.0 - self.beta2) * (grad * grad)
            rate = np.asarray(lrs[name], dtype=param.dtype)
            param -= rate * (m / correction1) / (np.sqrt(v) / correction2 + self.eps)

    def reset(self, rows: ArrayLike) -> None:
        """Zero the moments of `rows` (indices, or a boolean mask)."""
        for moment in (*self.first.values(), *self.second.values()):
            moment[np.asarray(rows)] = 0

    def relocate(self, fresh: NDArray[np.bool_]) -> None:
        """Follow a densify.Plan: append zero moments up to len(fresh) rows and zero the fresh ones."""
        for moments in (self.first, self.second):
            for name, moment in moments.items():
                grown = np.zeros((len(fresh), *moment.shape[1:]), moment.dtype)
                grown[: len(moment)] = moment
                grown[fresh] = 0
                moments[name] = grown

    def state_dict(self) -> dict[str, NDArray[np.generic]]:
        """Copies of everything needed to go on: `step`, `<name>.first`, `<name>.second`."""
        state: dict[str, NDArray[np.generic]] = {"step": np.array(self.step_count, np.int64)}
        for name in self.first:
            state[f"{name}.first"] = self.first[name].copy()
            state[f"{name}.second"] = self.second[name].copy()
        return state

    def load_state_dict(self, state: Mapping[str, NDArray[np.generic]]) -> None:
        """Take over a `state_dict`; raises InputError naming a missing or unpaired entry."""
        names = {key.rpartition(".")[0] for key in state if key != "step"}
        wanted = {"step"} | {f"{name}.{part}" for name in names for part in ("first", "second")}
        if odd := sorted(wanted ^ set(state)):
            raise InputError(f"optimizer state: missing or unknown entry {odd[0]!r}")
        self.step_count = int(state["step"])
        self.first = {name: np.array(state[f"{name}.first"]) for name in sorted(names)}
        self.second = {name: np.array(state[f"{name}.second"]) for name in sorted(names)}
