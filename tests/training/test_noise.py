"""Noise: Philox's published vectors, the distribution of the normals, and Sigma xi in NumPy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from reference.noise import add_noise
from scipy import stats
from scipy.spatial.transform import Rotation

from clsplat.training.optim.noise import PUBLISHED_EXTENT, noise_amount, noise_gate, normal3, philox4x32

# Known answers of the Random123 library: counter, key, output.
KNOWN = [
    ("00000000 00000000 00000000 00000000", "00000000 00000000", "6627e8d5 e169c58d bc57ac4c 9b00dbd8"),
    ("ffffffff ffffffff ffffffff ffffffff", "ffffffff ffffffff", "408f276d 41c83b0e a20bc7c6 6d5451fd"),
    ("243f6a88 85a308d3 13198a2e 03707344", "a4093822 299f31d0", "d16cfe09 94fdcceb 5001e420 24126ea1"),
]


@pytest.mark.parametrize(("counter", "key", "expected"), KNOWN)
def test_philox_known_answers(counter: str, key: str, expected: str) -> None:
    words = [np.array([int(word, 16)], np.uint32) for word in counter.split()]
    k0, k1 = (int(word, 16) for word in key.split())
    got = philox4x32((words[0], words[1], words[2], words[3]), (k0, k1))
    assert [f"{int(word[0]):08x}" for word in got] == expected.split()


def test_normals_are_standard_and_independent() -> None:
    xi = normal3(seed=7, iteration=123, n=200_000).astype(np.float64)
    for column in xi.T:
        assert stats.kstest(column, "norm").pvalue > 1e-3
    np.testing.assert_allclose(np.cov(xi.T), np.eye(3), atol=0.02)
    np.testing.assert_allclose(np.corrcoef((xi**2).T), np.eye(3), atol=0.02)
    following = normal3(seed=7, iteration=124, n=200_000)
    assert abs(np.corrcoef(xi[:, 0], following[:, 0])[0, 1]) < 0.02
    assert abs(np.corrcoef(xi[:-1, 0], xi[1:, 0])[0, 1]) < 0.02


def test_a_normal_from_its_words() -> None:
    index, iteration, seed = 5, 9, (3 << 32) | 11
    words = philox4x32(tuple(np.array(w, np.uint32) for w in (index, iteration, 0, 0)), (11, 3))  # type: ignore[arg-type]
    u = [((int(word) >> 9) + 0.5) / 2**23 for word in words]
    r01, r2 = math.sqrt(-2 * math.log(u[0])), math.sqrt(-2 * math.log(u[2]))
    a01, a2 = 2 * math.pi * u[1], 2 * math.pi * u[3]
    expected = [r01 * math.cos(a01), r01 * math.sin(a01), r2 * math.cos(a2)]
    np.testing.assert_allclose(normal3(seed, iteration, 6)[index], expected, rtol=1e-6)


def test_normals_depend_on_each_of_seed_iteration_stream_and_index_only() -> None:
    base = normal3(1, 2, 50)
    np.testing.assert_array_equal(base, normal3(1, 2, 80)[:50])
    for other in (normal3(2, 2, 50), normal3(1 + (1 << 32), 2, 50), normal3(1, 3, 50), normal3(1, 2, 50, stream=1)):
        assert not np.any(np.all(base == other, axis=1))
    assert len(np.unique(base, axis=0)) == 50
    assert normal3(1, 2, 0).shape == (0, 3)


def test_gate_values() -> None:
    opacity = np.array([1e-12, 0.005, 0.05, 0.1, 0.3])
    gate = noise_gate(opacity)
    np.testing.assert_allclose(gate, [0.622, 0.5, 0.011, 7.5e-5, 1.54e-13], rtol=0.02)
    assert noise_gate(np.array([1], np.float32))[0] == pytest.approx(math.exp(-99.5))


def test_noise_is_the_covariance_times_the_normal() -> None:
    rng = np.random.default_rng(0)
    n = 20
    mean, quat = rng.standard_normal((n, 3)), rng.standard_normal((n, 4)) * 3
    log_scale, opacity = rng.normal(-1, 0.5, (n, 3)), rng.uniform(0, 0.03, n)
    moved = add_noise(mean, quat, log_scale, opacity, seed=4, iteration=8, amount=80.0)
    xi = normal3(4, 8, n).astype(np.float64)
    for i in range(n):
        rotation = Rotation.from_quat(quat[i], scalar_first=True).as_matrix()
        sigma = rotation @ np.diag(np.exp(log_scale[i]) ** 2) @ rotation.T
        gate = 1 / (1 + math.exp(-100 * ((1 - opacity[i]) - 0.995)))
        np.testing.assert_allclose(moved[i] - mean[i], sigma @ (xi[i] * gate) * 80.0, rtol=1e-9, atol=1e-12)


def test_opaque_splats_stay_and_the_dtype_is_kept() -> None:
    mean = np.ones((3, 3), np.float32)
    quat = np.tile(np.array([1, 0, 0, 0], np.float32), (3, 1))
    moved = add_noise(mean, quat, np.zeros((3, 3), np.float32), np.array([0.5, 0.9, 1e-4], np.float32), 0, 0, 80.0)
    assert moved.dtype == np.float32
    np.testing.assert_array_equal(moved[:2], 1)
    assert np.abs(moved[2] - 1).max() > 0.1


def test_noise_grows_with_the_scene_and_not_faster() -> None:
    """The step is covariance times amount, and the learning rate of the means contains the extent."""

    def step(extent: float) -> float:
        return extent**2 * noise_amount(5e5, 1e-4 * extent, extent)

    assert step(PUBLISHED_EXTENT) == pytest.approx(5e5 * 1e-4 * PUBLISHED_EXTENT**3)
    assert step(0.5 * PUBLISHED_EXTENT) == pytest.approx(step(PUBLISHED_EXTENT) / 8)
    assert step(1e3 * PUBLISHED_EXTENT) == pytest.approx(1e3 * step(PUBLISHED_EXTENT))
