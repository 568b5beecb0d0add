"""A check of the training loss on a small image before a run, because a wrong compiler costs quality without a word.

Mesa 22.3 once read zeros where the kernels blur the columns. SSIM had no gradient, and runs ended 15 dB lower.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray

from ..device.device import Device
from ..device.memory import Pool
from ..device.program import wrong_numbers
from ..evaluation.metrics import ssim
from ..rendering.build import KernelBuild
from ..rendering.frame import DeviceImage, ImageLayout
from .loss import ImageLoss

_WIDTH, _HEIGHT = 40, 24  # more than two windows each way
_STEP = 1e-4
_TOLERANCE = 1e-3  # relative; float32 errors are 100 times smaller


def check_loss(device: Device, kernels: KernelBuild, weight: float, beta: float) -> None:
    """Compare the loss and its gradient with NumPy.

    Parameters
    ----------
    kernels : build of the run, whose program of the loss is checked.
    weight : lambda, the weight of 1 - SSIM.
    beta : error below which L1 is quadratic.

    Raises
    ------
    DeviceError : the device computes wrong numbers.
    """
    image, truth = _pair()
    layout, pool = ImageLayout(_WIDTH, _HEIGHT), Pool(device)
    loss = ImageLoss(pool, kernels, weight, beta)
    rendered = DeviceImage(pool, kernels.dtype, 3).write(layout, image)
    target = DeviceImage(pool, np.dtype(np.uint8), 3).write(layout, truth)
    result = loss.evaluate(layout, rendered, target)
    # Along the error, L1 and SSIM both grow, so neither hides in the other.
    along = float((loss.gradient(result, layout) * (image - truth / 255)).sum())
    value, slope = _expected(weight, beta)
    errors = (abs(loss.value(result).total / value - 1), abs(along / slope - 1))
    if not all(error < _TOLERANCE for error in errors):  # NaN is wrong, too
        raise wrong_numbers(device, f"loss off by {errors[0]:.1e}, its gradient by {errors[1]:.1e}")


@cache
def _pair() -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Return an image and a truth without equal pixels, where L1 would have a kink."""
    rng = np.random.default_rng(0)
    truth = rng.integers(80, 176, (_HEIGHT, _WIDTH, 3)).astype(np.uint8)
    sign = rng.choice([-1, 1, 1], truth.shape)  # more of one sign, so that a shift of all bytes changes the loss
    error = rng.uniform(0.01, 0.3, truth.shape) * sign
    return (truth / 255 + error).astype(np.float32), truth


@cache
def _expected(weight: float, beta: float) -> tuple[float, float]:
    """Return the loss, and its slope as the error grows."""
    image, truth = _pair()
    error = image - truth / 255

    def loss(factor: float) -> float:
        size = np.abs(factor * error)
        if beta:
            size = np.where(size < beta, size * size / (2 * beta), size - beta / 2)
        x = truth / 255 + factor * error
        return float((1 - weight) * size.mean()) + weight * (1 - ssim(x, truth / 255, "zero", rounded=False))

    return loss(1.0), (loss(1 + _STEP) - loss(1 - _STEP)) / (2 * _STEP)
