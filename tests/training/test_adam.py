"""NumPy's Adam (training/optim/adam.py) agrees with its definition."""

from __future__ import annotations

import numpy as np
import pytest

from clsplat.training.optim.adam import NumpyAdam


def adam_by_definition(grads: list[np.ndarray], start: np.ndarray, lr: float) -> np.ndarray:
    """Compute Kingma & Ba's algorithm 1. The moments are explicit weighted sums over the whole history."""
    param = start.astype(np.float64)
    for t in range(1, len(grads) + 1):
        m = sum(0.1 * 0.9 ** (t - i) * grads[i - 1] for i in range(1, t + 1)) / (1 - 0.9**t)
        v = sum(0.001 * 0.999 ** (t - i) * grads[i - 1] ** 2 for i in range(1, t + 1)) / (1 - 0.999**t)
        param = param - lr * m / (np.sqrt(v) + 1e-15)
    return param


@pytest.mark.parametrize(("dtype", "rtol"), [(np.float64, 1e-12), (np.float32, 1e-5)])
def test_steps_follow_the_definition(dtype: type, rtol: float) -> None:
    rng = np.random.default_rng(0)
    start = rng.standard_normal((7, 3)).astype(dtype)
    grads = [(rng.standard_normal((7, 3)) * 10.0 ** rng.integers(-4, 3)).astype(dtype) for _ in range(12)]
    params = {"mean": start.copy()}
    adam = NumpyAdam(params)
    for grad in grads:
        adam.step(params, {"mean": grad}, {"mean": 0.01})
    assert params["mean"].dtype == dtype
    np.testing.assert_allclose(params["mean"], adam_by_definition(grads, start, 0.01), rtol=rtol, atol=rtol)


def test_first_step_has_the_size_of_the_rate_and_zero_gradients_do_nothing() -> None:
    params = {"x": np.zeros(3)}
    NumpyAdam(params).step(params, {"x": np.array([5.0, -1e-9, 0.0])}, {"x": 0.1})
    np.testing.assert_allclose(params["x"], [-0.1, 0.1, 0.0], rtol=1e-5)


def test_rates_broadcast() -> None:
    params = {"sh": np.zeros((4, 9, 3))}
    rates = np.linspace(1, 9, 9).reshape(1, 9, 1)
    NumpyAdam(params).step(params, {"sh": np.ones((4, 9, 3))}, {"sh": rates})
    np.testing.assert_allclose(params["sh"], -rates * np.ones((4, 1, 3)))


def test_a_gradient_of_another_shape_or_name() -> None:
    adam = NumpyAdam({"mean": np.zeros((2, 3))})
    with pytest.raises(ValueError, match="mean"):
        adam.direction("mean", np.zeros((3, 3)))
    with pytest.raises(KeyError):
        adam.direction("quat", np.zeros((2, 3)))
