"""skew_map.py: bounds, round trips, and gradients against central differences."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from clsplat.errors import InputError
from clsplat.shapes import SKEW_LIMIT, SKEW_MAX
from clsplat.skew_map import R_FLOOR, SKEW_MAPS, SkewMap

maps = pytest.mark.parametrize("skew_map", [SkewMap(name) for name in SKEW_MAPS], ids=SKEW_MAPS)
vectors = hnp.arrays(np.float64, (4, 3), elements=st.floats(-50, 50, allow_subnormal=False))


@maps
@given(s=vectors)
def test_length_stays_below_the_bound_and_direction_is_kept(skew_map: SkewMap, s: np.ndarray) -> None:
    m = skew_map.forward(s)
    assert np.all(np.linalg.norm(m, axis=1) <= SKEW_MAX * (1 + 1e-12))
    np.testing.assert_allclose(np.cross(s, m), 0, atol=1e-8)
    assert np.all(np.sum(s * m, axis=1) >= 0)


@pytest.mark.parametrize(("name", "expected"), [("cube-root", SKEW_MAX * np.tanh(0.7) ** (1 / 3)),
                                                ("linear", SKEW_MAX * np.tanh(0.7))])
def test_length_is_the_documented_function(name: str, expected: float) -> None:
    s = 0.7 * np.array([[2.0, -1.0, 2.0]]) / 3
    assert np.linalg.norm(SkewMap(name).forward(s)) == pytest.approx(expected, rel=1e-14)


@maps
@pytest.mark.parametrize("length", [1e-8, 1e-7, 3e-6, 1e-3, 0.3, 2.0, 6.0])
def test_vjp_agrees_with_central_differences(skew_map: SkewMap, length: float) -> None:
    rng = np.random.default_rng(3)
    s = rng.standard_normal((5, 3))
    s *= length / np.linalg.norm(s, axis=1, keepdims=True)
    v_m = rng.standard_normal((5, 3))
    h = 1e-4 * length
    expected = np.empty_like(s)
    for axis in range(3):
        step = np.zeros(3)
        step[axis] = h
        slope = (skew_map.forward(s + step) - skew_map.forward(s - step)) / (2 * h)
        expected[:, axis] = np.sum(v_m * slope, axis=1)
    got = skew_map.vjp(s, v_m)
    scale = np.abs(expected).max(axis=1, keepdims=True)
    np.testing.assert_allclose(got / scale, expected / scale, atol=1e-6)


@maps
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_zero_and_extremes_are_finite(skew_map: SkewMap, dtype: type) -> None:
    s = np.array([[0, 0, 0], [1e-30, 0, 0], [R_FLOOR, 0, 0], [100, 100, 100], [0, 1e6, 0]], dtype)
    v_s = skew_map.vjp(s, np.ones_like(s))
    for array in (skew_map.forward(s), v_s, skew_map.inverse(skew_map.forward(s))):
        assert array.dtype == dtype
        assert np.isfinite(array).all()
    assert np.all(v_s[0] > 0)  # a zero vector can leave zero
    np.testing.assert_array_equal(skew_map.forward(s)[0], 0)
    np.testing.assert_array_equal(skew_map.inverse(np.zeros((1, 3), dtype)), 0)


@maps
@given(length=st.floats(1e-9, 0.9999), seed=st.integers(0, 99))
def test_inverse_returns_to_m(skew_map: SkewMap, length: float, seed: int) -> None:
    m = np.random.default_rng(seed).standard_normal((1, 3))
    m *= length * SKEW_MAX / np.linalg.norm(m)
    np.testing.assert_allclose(skew_map.forward(skew_map.inverse(m)), m, rtol=1e-9, atol=1e-300)


@maps
def test_inverse_of_a_skew_beyond_the_bound_is_just_below_it_and_can_still_learn(skew_map: SkewMap) -> None:
    m = np.array([[0, SKEW_LIMIT, 0]], np.float32)
    s = skew_map.inverse(m)
    assert np.linalg.norm(skew_map.forward(s)) == pytest.approx(SKEW_MAX, rel=2e-4)
    assert abs(skew_map.vjp(s, m)[0, 1]) > 1e-5


def test_unknown_name() -> None:
    with pytest.raises(InputError, match="cube-root, linear"):
        SkewMap("quadratic")
