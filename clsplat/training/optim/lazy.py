"""Adam where splats were seen: what dense Adam would have done in the steps that the others sat out, in closed form.

A splat outside of the image has gradients of zero, but momentum moves it on. k steps after step t of its block

    m <- beta1^k m,   v <- beta2^k v,   value <- value - m / (sqrt(v) + eps) sum_j rate(t+j) r^j c(t+j),   j = 1..k,
    r = beta1 / sqrt(beta2),   c(t) = sqrt(1 - beta2^t) / (1 - beta1^t),

with m and v as they were after step t. The sums are kept by k, so corrections and changing rates are exact. Two things
are not: rounding (one here, k in dense Adam), and eps, which dense Adam holds against a falling v: at most eps/sqrt(v)
of the drift, 3e-5 for gradients of 1e-9. What is stepped in the logarithm drifts there; it drifts one way, so its
bounds act as well at the end.

A vector of splats, LANES of them, waits until one of them is seen or it has sat out WAITS - 1 steps; then it catches up
and steps. An image sees what waits as it was left: a splat that comes into view shows its drift an iteration late.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...splats.fields import Array
from .adam import BETA1, BETA2, EPS, WAITS

Steps = tuple[int, int]  # counts of steps: of everything but the skew, and of the skew
DRIFT, DRIFT_MEAN, DRIFT_SKEW = range(3)
_AGES = np.arange(WAITS)
_DECAYS = np.stack([BETA1**_AGES, BETA2**_AGES])
_RATIO = (BETA1 / np.sqrt(BETA2)) ** _AGES


class Drifts:
    """The sums above up to the present step.

    Attributes
    ----------
    sums : (3, WAITS) float64, by kind (DRIFT: of rate 1, DRIFT_MEAN: the positions', rates included, DRIFT_SKEW: of
        rate 1, in the skew's own steps) and by the number of steps sat out.
    """

    def __init__(self) -> None:
        self.sums = np.zeros((3, WAITS))

    def advance(self, learns: tuple[bool, bool], steps: Steps, mean_lr: float) -> None:
        """One step more of the blocks that learn (blocks.Blocks); `steps` of both, with it; rate of the means in it."""
        if learns[0]:
            self._add(DRIFT, steps[0], 1.0)
            self._add(DRIFT_MEAN, steps[0], mean_lr)
        if learns[1]:
            self._add(DRIFT_SKEW, steps[1], 1.0)

    @property
    def table(self) -> NDArray[np.float64]:
        """(2 + 3, WAITS): what is left of m, of v, and the sums; `waits` of cl/train/adam.clh."""
        return np.concatenate([_DECAYS, self.sums])

    def _add(self, kind: int, step: int, rate: float) -> None:
        weight = rate * np.sqrt(1 - BETA2**step) / (1 - BETA1**step)
        self.sums[kind, 1:] = self.sums[kind, :-1] + weight * _RATIO[1:]


def woken(seen: NDArray[np.bool_], last: NDArray[np.integer], steps: Steps, lanes: int) -> NDArray[np.bool_]:
    """Which vectors of splats step, (V,): wake_vectors of cl/train/lazy.cl.

    Parameters
    ----------
    seen : (N,) splats. last : (2, V) counts of steps that each vector was brought up to. steps : the counts now.
    lanes : splats of a vector.
    """
    padded = np.zeros(last.shape[1] * lanes, bool)
    padded[: len(seen)] = seen
    overdue = (np.array(steps)[:, None] - last >= WAITS - 1).any(axis=0)
    due: NDArray[np.bool_] = padded.reshape(-1, lanes).any(axis=1) | overdue
    return due


def ascent(first: Array, second: Array) -> Array:
    """m / (sqrt(v) + eps): which way a value drifts."""
    direction: Array = first / (np.sqrt(second) + first.dtype.type(EPS))
    return direction
