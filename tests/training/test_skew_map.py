"""Skew maps: bounds, round trips, and gradients against central differences."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from scipy.spatial.transform import Rotation

from clsplat.errors import InputError
from clsplat.splats.shapes import SKEW_LIMIT, SKEW_MAX, SLANT_MAX
from clsplat.training.optim.skew_map import MAPS, R_FLOOR, SKEW_MAPS, SkewMap, check_map, map_named

maps = pytest.mark.parametrize("skew_map", [SkewMap(name) for name in SKEW_MAPS], ids=SKEW_MAPS)
vectors = hnp.arrays(np.float64, (4, 3), elements=st.floats(-50, 50, allow_subnormal=False))
LENGTH = {  # length of the skew at |s| = 0.7
    "cube-root": SKEW_MAX * np.tanh(0.7) ** (1 / 3),
    "coupled": SLANT_MAX * np.tanh(0.7 / SLANT_MAX),
}


def some_quats(n: int) -> np.ndarray:
    return 2 * np.random.default_rng(n).standard_normal((n, 4))


def with_length(skew_map: SkewMap, s: np.ndarray, length: float) -> np.ndarray:
    """Return s with this magnitude. With "polar", the first component is the magnitude and the direction stays."""
    if skew_map.name == "polar":
        return np.concatenate([np.full((len(s), 1), length), s[:, 1:]], axis=1)
    return s * (length / np.linalg.norm(s, axis=1, keepdims=True))


@settings(deadline=None, max_examples=50)
@given(s=vectors)
def test_cube_root_keeps_the_direction_of_s(s: np.ndarray) -> None:
    skew = SkewMap("cube-root").forward(s, some_quats(4))
    np.testing.assert_allclose(np.cross(s, skew), 0, atol=1e-8)
    assert np.all(np.sum(s * skew, axis=1) >= 0)


@maps
@settings(deadline=None, max_examples=50)
@given(s=hnp.arrays(np.float64, (4, 4), elements=st.floats(-500, 500, allow_subnormal=False)))
def test_length_stays_below_the_bound(skew_map: SkewMap, s: np.ndarray) -> None:
    skew = skew_map.forward(s[:, : skew_map.width], some_quats(4))
    assert np.all(np.linalg.norm(skew, axis=1) <= skew_map.limit * (1 + 1e-12))


@pytest.mark.parametrize("name", LENGTH)
def test_length_is_the_documented_function(name: str) -> None:
    s = 0.7 * np.array([[2.0, -1.0, 2.0]]) / 3
    assert np.linalg.norm(SkewMap(name).forward(s, some_quats(1))) == pytest.approx(LENGTH[name], rel=1e-14)


def test_polar_is_a_magnitude_and_a_direction_of_any_length() -> None:
    eta = SkewMap("polar").forward(np.array([[4.0, 0, 0, 7.0], [-4.0, 0, 0, 0.1]]), some_quats(2))
    length = SLANT_MAX * np.tanh(4.0 / SLANT_MAX)
    np.testing.assert_allclose(eta, [[0, 0, length], [0, 0, -length]], atol=1e-14)


def test_coupled_is_a_slant_in_the_worlds_frame() -> None:
    """A rotation of the splat does not change the skew vector in the world."""
    s, quat = np.random.default_rng(1).standard_normal((6, 3)), some_quats(6)
    eta = SkewMap("coupled").forward(s, quat)
    r = np.linalg.norm(s, axis=1, keepdims=True)
    in_world = s / r * SLANT_MAX * np.tanh(r / SLANT_MAX)
    np.testing.assert_allclose(Rotation.from_quat(quat, scalar_first=True).apply(eta), in_world, atol=1e-13)


@maps
@pytest.mark.parametrize("length", [1e-8, 1e-7, 3e-6, 1e-3, 0.3, 2.0, 6.0])
def test_vjp_agrees_with_central_differences(skew_map: SkewMap, length: float) -> None:
    rng = np.random.default_rng(3)
    s = with_length(skew_map, rng.standard_normal((5, skew_map.width)), length)
    quat, v_skew = some_quats(5), rng.standard_normal((5, 3))

    def differences(x: np.ndarray, quats: bool, h: float) -> np.ndarray:
        columns = []
        for axis in range(x.shape[1]):
            step = h * np.eye(x.shape[1])[axis]
            ends = [skew_map.forward(s, x + d) if quats else skew_map.forward(x + d, quat) for d in (step, -step)]
            columns.append(np.sum(v_skew * (ends[0] - ends[1]), axis=1) / (2 * h))
        return np.stack(columns, axis=1)

    v_s, v_quat = skew_map.vjp(s, quat, v_skew)
    h = 1e-5 if skew_map.name == "polar" else 1e-4 * length
    expected = differences(s, False, h)
    scale = np.abs(expected).max(axis=1, keepdims=True)
    np.testing.assert_allclose(v_s / scale, expected / scale, atol=1e-6)
    np.testing.assert_allclose(v_quat / length, differences(quat, True, 1e-5) / length, atol=1e-8)
    assert v_quat.any() == skew_map.rotates


@maps
@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_zero_and_extremes_are_finite(skew_map: SkewMap, dtype: type) -> None:
    s = np.array([[0, 0, 0], [1e-30, 0, 0], [R_FLOOR, 0, 0], [100, 100, 100], [0, 1e6, 0]], dtype)
    if skew_map.name == "polar":  # with and without a direction
        s = np.concatenate([np.concatenate([s[:, 1:2], s], axis=1), np.pad(s[:, 1:2], ((0, 0), (0, 3)))])
    quat = some_quats(len(s)).astype(dtype)
    v_skew = np.ones((len(s), 3), dtype)
    v_s, v_quat = skew_map.vjp(s, quat, v_skew)
    skew = skew_map.forward(s, quat)
    for array in (skew, v_s, v_quat, skew_map.inverse(skew, quat)):
        assert array.dtype == dtype
        assert np.isfinite(array).all()
    np.testing.assert_array_equal(skew[0], 0)
    np.testing.assert_array_equal(skew_map.forward(skew_map.inverse(0 * skew, quat), quat), 0)
    if skew_map.name != "polar":
        assert v_s[0].all()  # a zero vector has a gradient, so it can change
    else:  # the magnitude has a gradient, if there is a direction
        assert skew_map.vjp(skew_map.inverse(0 * skew, quat), quat, v_skew)[0][:, 0].all()


@maps
@settings(deadline=None, max_examples=50)
@given(length=st.floats(1e-9, 0.9999), seed=st.integers(0, 99))
def test_inverse_returns_to_the_skew(skew_map: SkewMap, length: float, seed: int) -> None:
    skew = np.random.default_rng(seed).standard_normal((1, 3))
    skew *= length * skew_map.limit / np.linalg.norm(skew)
    quat = some_quats(1)
    s = skew_map.inverse(skew, quat)
    assert s.shape == (1, skew_map.width)
    np.testing.assert_allclose(skew_map.forward(s, quat), skew, rtol=1e-9, atol=1e-14)


@maps
def test_inverse_of_a_skew_beyond_the_bound_is_just_below_it_and_can_still_learn(skew_map: SkewMap) -> None:
    skew, quat = np.array([[0, skew_map.limit * SKEW_LIMIT / SKEW_MAX, 0]], np.float32), np.eye(1, 4, dtype=np.float32)
    s = skew_map.inverse(skew, quat)
    assert np.linalg.norm(skew_map.forward(s, quat)) == pytest.approx(skew_map.limit, rel=2e-4)
    along = 0 if skew_map.name == "polar" else 1
    assert abs(skew_map.vjp(s, quat, skew)[0][0, along]) > 1e-5


@maps
def test_follow_finds_s_anew_only_where_values_changed(skew_map: SkewMap) -> None:
    rng = np.random.default_rng(6)
    quat, s = some_quats(5), rng.standard_normal((5, skew_map.width))
    before = {"skew": skew_map.forward(s, quat), "quat": quat}
    after = {name: array.copy() for name, array in before.items()}
    after["skew"][1] = [0.1, 0.2, 0.3]
    after["quat"][3] = [1, 0, 0, 0]
    followed = skew_map.follow(s, before, after)
    np.testing.assert_array_equal(followed[[0, 2, 4]], s[[0, 2, 4]])
    np.testing.assert_allclose(skew_map.forward(followed, after["quat"]), after["skew"], rtol=1e-12)
    if not skew_map.rotates:
        np.testing.assert_array_equal(followed[3], s[3])


def test_names() -> None:
    with pytest.raises(InputError, match="choose one of cube-root, polar, coupled"):
        SkewMap("quadratic")
    assert [map_named("auto", form) for form in (*MAPS, None)] == ["cube-root", "polar", ""]
    assert map_named("coupled", "direct") == "coupled"
    check_map("polar", "direct")
    with pytest.raises(InputError, match="centred form of skew: choose auto or one of cube-root"):
        check_map("polar", "centred")
