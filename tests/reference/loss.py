"""Value and gradient of 3DGS's loss, (1 - weight) L1 + weight (1 - SSIM), by independent methods. L1 may be smooth.

SSIM is computed as in 3DGS (Wang et al. 2004): 11 x 11 Gaussian window of sigma 1.5, zero padding,
K = (.01, .03), data range 1, mean over pixels and channels. Dense banded matrices compute the means.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[Any]

WINDOW = 11
SIGMA = 1.5
C1, C2 = 0.01**2, 0.03**2
STEP = 1e-20  # the complex step; its square must vanish compared with 1


def blur_matrix(size: int) -> NDArray[np.float64]:
    """Return the (size, size) matrix that averages a line of pixels with the window. Pixels outside are zero."""
    offset = np.arange(size)[:, None] - np.arange(size)[None, :]
    window = np.exp(-0.5 * (np.arange(WINDOW) - WINDOW // 2) ** 2 / SIGMA**2)
    weight = np.exp(-0.5 * (offset / SIGMA) ** 2) / window.sum()
    return np.where(np.abs(offset) <= WINDOW // 2, weight, 0.0)


def ssim_map(image: Array, target: Array) -> Array:
    """Return the (H, W, 3) map of SSIM. `image` may be complex."""
    rows, columns = blur_matrix(image.shape[0]), blur_matrix(image.shape[1])

    def mean(values: Array) -> Array:
        # einsum, because threads of a BLAS compete with threads of OpenCL devices
        return np.einsum("ij,xjc->xic", columns, np.einsum("yx,xjc->yjc", rows, values))

    mu_x, mu_y = mean(image), mean(target)
    var_x = mean(image * image) - mu_x * mu_x
    var_y = mean(target * target) - mu_y * mu_y
    cov = mean(image * target) - mu_x * mu_y
    above = (2.0 * mu_x * mu_y + C1) * (2.0 * cov + C2)
    return above / ((mu_x * mu_x + mu_y * mu_y + C1) * (var_x + var_y + C2))


def smooth_l1(error: Array, beta: float) -> NDArray[np.float64]:
    """Return the integral of min(t / beta, 1) over t from 0 to each |error|; |error| if beta is 0."""
    size = np.abs(error)
    return size - beta / 2 + np.maximum(beta - size, 0.0) ** 2 / (2 * beta) if beta else size


def smooth_sign(error: Array, beta: float) -> NDArray[np.float64]:
    """Return the derivative of `smooth_l1`; 0 at 0."""
    return np.sign(error) * np.where(np.abs(error) < beta, np.abs(error) / (beta or 1.0), 1.0)


def reference_loss(image: ArrayLike, target: ArrayLike, weight: float = 0.2, beta: float = 0.0) -> float:
    """Return the loss of an image against its target, both (H, W, 3) in 0..1. `weight` is 3DGS's lambda_dssim."""
    x, y = np.asarray(image, dtype=np.float64), np.asarray(target, dtype=np.float64)
    return float((1.0 - weight) * smooth_l1(x - y, beta).mean() + weight * (1.0 - ssim_map(x, y).mean()))


def reference_loss_gradient(
    image: ArrayLike, target: ArrayLike, weight: float = 0.2, beta: float = 0.0
) -> NDArray[np.float64]:
    """Return the (H, W, 3) gradient of `reference_loss` with respect to the image.

    The gradient of L1 is 0 where image and target are equal. The method takes complex steps on every 11th pixel of
    every 11th row at once. Each window contains one of them, so each entry of the map depends on the one step in its
    window. 121 rounds reach all pixels.
    """
    x, y = np.asarray(image, dtype=np.float64), np.asarray(target, dtype=np.float64)
    height, width, channels = x.shape
    half = WINDOW // 2
    gradient = (1.0 - weight) * smooth_sign(x - y, beta) / x.size
    for row in range(min(WINDOW, height)):
        for column in range(min(WINDOW, width)):
            bumped = x.astype(np.complex128)
            bumped[row::WINDOW, column::WINDOW] += 1j * STEP
            padded = np.zeros((height + 4 * WINDOW, width + 4 * WINDOW, channels))
            padded[WINDOW : WINDOW + height, WINDOW : WINDOW + width] = ssim_map(bumped, y).imag / STEP
            corner = padded[WINDOW + row - half :, WINDOW + column - half :]
            n, m = len(range(row, height, WINDOW)), len(range(column, width, WINDOW))
            blocks = corner[: n * WINDOW, : m * WINDOW].reshape(n, WINDOW, m, WINDOW, channels)
            gradient[row::WINDOW, column::WINDOW] -= weight * blocks.sum((1, 3)) / x.size
    return gradient
