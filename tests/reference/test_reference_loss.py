"""The reference loss agrees with SSIM by loops over windows, and its gradient agrees with differences."""

from __future__ import annotations

import numpy as np
import pytest

from reference.loss import C1, C2, blur_matrix, reference_loss, reference_loss_gradient, ssim_map
from reference.tolerances import DIFFERENCES


def random_pair(height: int, width: int):
    """Return an image and a correlated target, both in 0..1."""
    rng = np.random.default_rng(height * 1000 + width)
    target = rng.uniform(0.0, 1.0, (height, width, 3))
    return np.clip(target + rng.normal(0.0, 0.2, target.shape), 0.0, 1.0), target


def test_ssim_by_loops_over_windows():
    image, target = random_pair(14, 12)
    window = np.array([np.exp(-((i - 5) ** 2 + (j - 5) ** 2) / 4.5) for i in range(11) for j in range(11)])
    window /= window.sum()
    padded = [np.pad(values, ((5, 5), (5, 5), (0, 0))) for values in (image, target)]
    got = ssim_map(image, target)
    for row, column, channel in [(0, 0, 0), (7, 6, 1), (13, 11, 2), (0, 6, 2)]:
        x, y = (p[row : row + 11, column : column + 11, channel].ravel() for p in padded)
        mx, my = window @ x, window @ y
        vx, vy, cov = window @ (x - mx) ** 2, window @ (y - my) ** 2, window @ ((x - mx) * (y - my))
        want = (2 * mx * my + C1) * (2 * cov + C2) / ((mx * mx + my * my + C1) * (vx + vy + C2))
        assert got[row, column, channel] == pytest.approx(want, rel=1e-12)


def test_blur_keeps_a_constant_inside_and_darkens_the_border():
    row_sums = blur_matrix(20).sum(1)
    assert row_sums[5:15] == pytest.approx(1.0)
    assert row_sums[0] < 0.7


def test_loss_of_equal_images_is_zero():
    _, target = random_pair(9, 16)
    assert reference_loss(target, target) == pytest.approx(0.0, abs=1e-15)
    assert np.abs(reference_loss_gradient(target, target)).max() < 1e-15


def test_weight_chooses_between_the_terms():
    image, target = random_pair(9, 16)
    assert reference_loss(image, target, 0.0) == pytest.approx(np.abs(image - target).mean())
    assert reference_loss(image, target, 1.0) == pytest.approx(1.0 - ssim_map(image, target).mean())


@pytest.mark.parametrize(("height", "width"), [(7, 5), (11, 11), (12, 23), (25, 13)])
@pytest.mark.parametrize("weight", [0.0, 0.2, 1.0])
def test_gradient_agrees_with_central_differences(height, width, weight):
    image, target = random_pair(height, width)
    got = reference_loss_gradient(image, target, weight)
    rng = np.random.default_rng(0)
    for _ in range(30):
        index = tuple(rng.integers(size) for size in image.shape)
        sides = []
        for step in (1e-5, -1e-5):
            bumped = image.copy()
            bumped[index] += step
            sides.append(reference_loss(bumped, target, weight))
        assert abs((sides[0] - sides[1]) / 2e-5 - got[index]) < DIFFERENCES * np.abs(got).max()
