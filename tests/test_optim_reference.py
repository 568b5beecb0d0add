"""optim_reference.py: Adam against its definition written out, and its state."""

from __future__ import annotations

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.optim_reference import NumpyAdam, learning_rates
from clsplat.shapes import shape_named


def adam_by_definition(grads: list[np.ndarray], start: np.ndarray, lr: float) -> np.ndarray:
    """Kingma & Ba's algorithm 1 with the moments as explicit weighted sums over the whole history."""
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
    adam, params = NumpyAdam(), {"mean": start.copy()}
    for grad in grads:
        adam.step(params, {"mean": grad}, {"mean": 0.01})
    assert params["mean"].dtype == dtype
    np.testing.assert_allclose(params["mean"], adam_by_definition(grads, start, 0.01), rtol=rtol, atol=rtol)


def test_first_step_has_the_size_of_the_rate_and_zero_gradients_do_nothing() -> None:
    params = {"x": np.zeros(3)}
    NumpyAdam().step(params, {"x": np.array([5.0, -1e-9, 0.0])}, {"x": 0.1})
    np.testing.assert_allclose(params["x"], [-0.1, 0.1, 0.0], rtol=1e-5)


def test_rates_broadcast_and_follow_3dgs() -> None:
    rates = learning_rates(shape_named("skew-normal").schema(2), mean=1e-3)
    assert rates["mean"] == 1e-3
    assert rates["opacity_logit"] == 0.05
    assert rates["skew"] == shape_named("skew-normal").schema(0)["skew"].lr
    params = {"sh": np.zeros((4, 9, 3))}
    NumpyAdam().step(params, {"sh": np.ones((4, 9, 3))}, rates)
    np.testing.assert_allclose(params["sh"][:, 0], -2.5e-3)
    np.testing.assert_allclose(params["sh"][:, 1:], -1.25e-4)


def trained() -> tuple[NumpyAdam, dict[str, np.ndarray]]:
    adam, params = NumpyAdam(), {"a": np.ones((4, 2)), "b": np.ones(4)}
    for i in range(3):
        adam.step(params, {"a": params["a"] + i, "b": params["b"]}, {"a": 0.1, "b": 0.1})
    return adam, params


def test_reset_zeroes_only_the_rows() -> None:
    adam, _ = trained()
    adam.reset([1, 3])
    for moment in (*adam.first.values(), *adam.second.values()):
        assert not moment[[1, 3]].any()
        assert np.all(moment[[0, 2]] != 0)


def test_relocate_appends_and_zeroes() -> None:
    adam, _ = trained()
    kept = adam.first["a"][2].copy()
    adam.relocate(np.array([True, False, False, False, True, True]))
    assert adam.first["a"].shape == (6, 2)
    assert adam.second["b"].shape == (6,)
    assert not adam.first["a"][[0, 4, 5]].any()
    np.testing.assert_array_equal(adam.first["a"][2], kept)


def test_state_goes_round_and_continues_identically() -> None:
    adam, params = trained()
    other, others = NumpyAdam(), {name: value.copy() for name, value in params.items()}
    other.load_state_dict(adam.state_dict())
    for optimizer, values in ((adam, params), (other, others)):
        optimizer.step(values, values, {"a": 0.1, "b": 0.2})
    for name in params:
        np.testing.assert_array_equal(params[name], others[name])
    assert other.step_count == 4


def test_state_is_a_copy() -> None:
    adam, _ = trained()
    state = adam.state_dict()
    adam.reset([0, 1, 2, 3])
    assert state["a.first"].any()


@pytest.mark.parametrize("missing", ["step", "a.second", "b.first"])
def test_incomplete_state_is_named(missing: str) -> None:
    adam, _ = trained()
    state = adam.state_dict()
    del state[missing]
    with pytest.raises(InputError, match=missing):
        NumpyAdam().load_state_dict(state)


def test_gradient_of_another_shape() -> None:
    with pytest.raises(ValueError, match="mean"):
        NumpyAdam().step({"mean": np.zeros((2, 3))}, {"mean": np.zeros((3, 3))}, {"mean": 0.1})
