"""Levels of detail (splats/merging.py): a merged pair against moments of its members, and parts that stay apart."""

from __future__ import annotations

import numpy as np
import pytest
from model_arrays import random_model

from clsplat.splats.merging import Level, level_of, merged
from clsplat.splats.quaternions import rotations
from clsplat.splats.shapes import GAUSSIAN


def model(n: int, seed: int = 0) -> dict[str, np.ndarray]:
    return random_model(GAUSSIAN, n, seed, sh_degree=2, dead=0)


def whole(n: int, seed: int = 0) -> Level:
    return level_of(model(n, seed), np.zeros(n, np.int64))


def areas(covariance: np.ndarray) -> np.ndarray:
    return np.sqrt(np.sort(np.linalg.eigvalsh(covariance), axis=1)[:, 1:].prod(axis=1))


def test_a_pair_keeps_its_moments() -> None:
    """Samples of both Gaussians, as many of each as it has opacity times area, have the moments of the merged one."""
    pair = whole(2, 4)
    one = merged(pair)
    assert len(one) == 1
    mass = pair.opacity * areas(pair.covariance)
    rng = np.random.default_rng(0)
    counts = np.rint(400_000 * mass / mass.sum()).astype(int)
    samples = np.concatenate(
        [rng.multivariate_normal(m, c, k) for m, c, k in zip(pair.mean, pair.covariance, counts, strict=True)]
    )
    spread = np.sqrt(np.trace(np.cov(samples.T)))
    np.testing.assert_allclose(one.mean[0], samples.mean(axis=0), atol=0.01 * spread)
    np.testing.assert_allclose(one.covariance[0], np.cov(samples.T), atol=0.01 * spread**2)
    np.testing.assert_allclose(one.sh[0], np.average(pair.sh, axis=0, weights=mass))
    assert one.opacity[0] == pytest.approx(min(mass.sum() / areas(one.covariance)[0], 1.0))


def test_arrays_are_those_of_the_covariances() -> None:
    level = merged(whole(40))
    arrays = level.arrays()
    frame = rotations(arrays["quat"].astype(np.float64)) * np.exp(arrays["log_scale"].astype(np.float64))[:, None]
    np.testing.assert_allclose(frame @ frame.transpose(0, 2, 1), level.covariance, rtol=1e-4, atol=1e-7)
    opacity = GAUSSIAN.opacity(arrays["opacity_logit"].astype(np.float64))
    np.testing.assert_allclose(opacity, np.clip(level.opacity, 1e-6, 1 - 1e-6), atol=1e-6)
    assert all(values.dtype == np.float32 for values in arrays.values())


def test_the_first_level_is_the_model() -> None:
    before = model(30)
    after = whole(30).arrays()
    np.testing.assert_array_equal(after["mean"], before["mean"])
    np.testing.assert_array_equal(after["sh"], before["sh"])
    np.testing.assert_allclose(np.sort(after["log_scale"], axis=1), np.sort(before["log_scale"], axis=1), atol=1e-5)


def test_each_level_has_about_half_of_the_splats_and_errors_grow() -> None:
    level, total = whole(1000), 0.0
    for _ in range(4):
        before = len(level)
        level = merged(level)
        assert 0.5 * before <= len(level) < 0.62 * before
        assert level.error.sum() > total
        total = level.error.sum()
        assert np.isfinite(level.covariance).all()
        assert ((level.opacity > 0) & (level.opacity <= 1)).all()


def test_only_splats_of_one_part_are_merged() -> None:
    n = 300
    group = np.arange(n) % 3
    level = level_of(model(n), group)
    coarse = merged(level)
    for number in range(3):
        mine, found = level.mean[group == number], coarse.mean[coarse.group == number]
        assert len(found) < 0.65 * len(mine)
        mass = (level.opacity * areas(level.covariance))[group == number]
        assert (found.max(axis=0) <= mine.max(axis=0)).all()
        assert mass.sum() > 0
    alone = level_of(model(3), np.arange(3))
    assert merged(alone) is alone, "there is no pair"


def test_alike_and_near_splats_are_merged_first() -> None:
    """Four splats in a row: the two red ones in the middle are farther from each other than from their neighbours."""
    arrays = model(4)
    arrays["mean"] = np.float32([[0, 0, 0], [1, 0, 0], [2.2, 0, 0], [3.2, 0, 0]])
    arrays["log_scale"][:], arrays["opacity_logit"][:], arrays["sh"][:] = -1.0, 0.0, 0.0
    arrays["sh"][1:3, 0, 0] = 3.0  # the two in the middle
    found = merged(level_of(arrays, np.zeros(4, np.int64)))
    assert sorted(found.mean[:, 0].round(6)) in ([0.0, 1.6, 3.2], [1.6, 1.6])


def test_equal_inputs_give_equal_levels_and_odd_values_no_faults() -> None:
    first, second = (merged(whole(200, 7)) for _ in range(2))
    np.testing.assert_array_equal(first.mean, second.mean)
    arrays = model(50)
    arrays["mean"][:] = 1.0  # all in one place
    arrays["log_scale"][:, 2] = -60.0  # flat
    arrays["opacity_logit"][:10] = -40.0
    level = merged(level_of(arrays, np.zeros(50, np.int64)))
    assert len(level) < 50
    assert all(np.isfinite(values).all() for values in level.arrays().values())
