"""3DGS's loss, (1 - weight) L1 + weight (1 - SSIM), by an independent route: value and gradient.

SSIM as 3DGS computes it (Wang et al. 2004): 11 x 11 Gaussian window of sigma 1.5, zero padding,
K = (.01, .03), data range 1, mean over pixels and channels. Means are taken by dense banded matrices.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[Any]

WINDOW = 11
SIGMA = 1.5
C1, C2 = 0.01**2, 0.03**2
STEP = 1e-20  # of the complex step; its square must vanish beside 1


def blur_matrix(size: int) -> NDArray[np.float64]:
    """(size, size) matrix that averages a line of pixels with the window, zeros beyond its ends."""
    offset = np.arange(size)[:, None] - np.arange(size)[None, :]
    window = np.exp(-0.5 * (np.arange(WINDOW) - WINDOW // 2) ** 2 / SIGMA**2)
    weight = np.exp(-0.5 * (offset / SIGMA) ** 2) / window.sum()
    return np.where(np.abs(offset) <= WINDOW // 2, weight, 0.0)


def ssim_map(image: Array, target: Array) -> Array:
    """(H, W, 3) map of SSIM; `image` may be complex."""
    rows, columns = blur_matrix(image.shape[0]), blur_matrix(image.shape[1])

    def mean(values: Array) -> Array:
        # einsum, as threads of a BLAS and of OpenCL devices hinder one another
        return np.einsum("ij,xjc->xic", columns, np.einsum("yx,xjc->yjc", rows, values))

    mu_x, mu_y = mean(image), mean(target)
    var_x = mean(image * image) - mu_x * mu_x
    var_y = mean(target * target) - mu_y * mu_y
    cov = mean(image * target) - mu_x * mu_y
    above = (2.0 * mu_x * mu_y + C1) * (2.0 * cov + C2)
    return above / ((mu_x * mu_x + mu_y * mu_y + C1) * (var_x + var_y + C2))


def reference_loss(image: ArrayLike, target: ArrayLike, weight: float = 0.2) -> float:
    """Loss of an image against its target, both (H, W, 3) in 0..1; `weight` is 3DGS's lambda_dssim."""
    x, y = np.asarray(image, dtype=np.float64), np.asarray(target, dtype=np.float64)
    return float((1.0 - weight) * np.abs(x - y).mean() + weight * (1.0 - ssim_map(x, y).mean()))


def reference_loss_gradient(image: ArrayLike, target: ArrayLike, weight: float = 0.2) -> NDArray[np.float64]:
    """(H, W, 3) gradient of `reference_loss` with respect to the image; L1's is 0 where both are equal.

    Complex steps on every 11th pixel of every 11th row at once: each window sees one of them, so each
    entry of the map belongs to the one step in its window, and 121 rounds reach all pixels.
    """
    x, y = np.asarray(image, dtype=np.float64), np.asarray(target, dtype=np.float64)
    height, width, channels = x.shape
    half = WINDOW // 2
    gradient = (1.0 - weight) * np.sign(x - y) / x.size
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
