"""rotations.py: against SciPy, and the gradient against central differences."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from clsplat.splats.quaternions import rotations, rotations_vjp


def test_matrices_are_scipys_and_keep_the_dtype() -> None:
    quat = 3 * np.random.default_rng(0).standard_normal((9, 4))
    expected = Rotation.from_quat(quat, scalar_first=True).as_matrix()
    np.testing.assert_allclose(rotations(quat), expected, atol=1e-14)
    assert rotations(quat.astype(np.float32)).dtype == np.float32


def test_gradient_is_the_differences() -> None:
    rng = np.random.default_rng(1)
    quat, v = 3 * rng.standard_normal((5, 4)), rng.standard_normal((5, 3, 3))
    expected = np.empty_like(quat)
    for axis in range(4):
        h = 1e-5 * np.eye(4)[axis]
        expected[:, axis] = np.sum(v * (rotations(quat + h) - rotations(quat - h)), axis=(1, 2)) / 2e-5
    got = rotations_vjp(quat, v)
    np.testing.assert_allclose(got, expected, atol=1e-9)
    np.testing.assert_allclose(np.sum(got * quat, axis=1), 0, atol=1e-14)  # the norm has no effect


def test_a_zero_quaternion_is_finite() -> None:
    zero = np.zeros((1, 4), np.float32)
    assert np.isfinite(rotations(zero)).all()
    assert np.isfinite(rotations_vjp(zero, np.ones((1, 3, 3), np.float32))).all()
