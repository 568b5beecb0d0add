"""Halves along an axis (training/density/halves.py) keep what the parent absorbed, its place, variance and sides."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from model_arrays import ALL_SHAPES, Arrays, random_model
from scipy.integrate import quad

from clsplat.splats import shapes
from clsplat.splats.optical_depth import opacity_names
from clsplat.splats.quaternions import rotations
from clsplat.splats.shapes import Shape
from clsplat.training.density.halves import DISTANCE, halves_along_axis, opacity_of_half, split_along_axis, twice

MIN_OPACITY = 0.005


def split(arrays: Arrays, shape: Shape, min_opacity: float = MIN_OPACITY) -> Arrays:
    """Return all fields of the halves, in float64."""
    changed = twice(arrays) | split_along_axis(arrays, shape, min_opacity)
    return {name: array.astype(np.float64) for name, array in changed.items()}


def strengths(shape: Shape, arrays: Arrays) -> np.ndarray:
    """Return |opacity| of each side, (N, sides)."""
    return np.stack([np.abs(shape.opacity(arrays[name].astype(np.float64))) for name in opacity_names(arrays)], axis=1)


@pytest.mark.parametrize("distance", [0.2, 0.5, DISTANCE, 0.95])
@pytest.mark.parametrize("opacity", [1e-9, 0.005, 0.3, 0.9, 1.0])
def test_a_pair_absorbs_as_much_along_the_line_as_a_gaussian(opacity: float, distance: float) -> None:
    """Integrate the absorption of both halves numerically, and compare it with the Gaussian's."""
    b = math.sqrt(1 - distance**2)
    half = float(opacity_of_half(np.array([opacity]), distance)[0])

    def absorbed(z: float) -> float:
        a, c = (half * math.exp(-0.5 * ((z + side * distance) / b) ** 2) for side in (-1, 1))
        return a + c - a * c  # 1 - (1 - a) (1 - c) without its rounding

    pair = 2 * quad(absorbed, 0, 12, points=[distance], epsabs=0, epsrel=1e-11, limit=200)[0]
    reached = opacity * math.sqrt(2 * math.pi)
    if half < 1:
        assert pair == pytest.approx(reached, rel=1e-9)
    else:  # even two opaque halves absorb less, because they are narrow
        assert half == 1
        assert pair < reached


def test_the_distance_in_use_needs_no_more_than_opaque_halves() -> None:
    opacity = np.linspace(0, 1, 1001)
    half = opacity_of_half(opacity, DISTANCE)
    assert (np.diff(half) > 0).all()
    assert half[-1] < 0.9


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), distance=st.floats(0.05, 0.95))
def test_mean_and_covariance_of_the_pair_are_the_parents(seed: int, distance: float) -> None:
    arrays = random_model(shapes.GAUSSIAN, 5, seed, dead=0)
    alone = {name: array.astype(np.float64) for name, array in arrays.items()}
    parents = twice(alone)
    changed = parents | halves_along_axis(alone, shapes.GAUSSIAN, distance)
    turn = rotations(parents["quat"])
    covariance = lambda of: np.einsum("nij,nj,nkj->nik", turn, np.exp(2 * of["log_scale"]), turn)  # noqa: E731
    first, second = changed["mean"][:5], changed["mean"][5:]
    middle, apart = (first + second) / 2, (first - second) / 2
    np.testing.assert_allclose(middle, parents["mean"][:5], rtol=0, atol=1e-9)
    within = (covariance(changed)[:5] + covariance(changed)[5:]) / 2
    both = within + np.einsum("ni,nj->nij", apart, apart)
    np.testing.assert_allclose(both, covariance(parents)[:5], rtol=1e-9, atol=1e-12)
    longest = parents["log_scale"][:5].argmax(axis=1)
    along = np.einsum("nji,nj->ni", turn[:5], apart)
    expected = np.zeros((5, 3))
    expected[np.arange(5), longest] = distance * np.exp(parents["log_scale"][:5].max(axis=1))
    np.testing.assert_allclose(along, expected, atol=1e-9)  # the first half lies on the positive side


@pytest.mark.parametrize("shape", ALL_SHAPES, ids=lambda s: s.name)
def test_opacities_of_every_shape(shape: Shape) -> None:
    """Each side has the root of its own equation after the sides were mixed. Signs stay, and rows do not mix."""
    arrays = random_model(shape, 40, 2, dead=0)
    names, halves = opacity_names(arrays), split(arrays, shape, 1e-30)
    mixed = twice(arrays) | halves_along_axis(arrays, shape, DISTANCE)
    np.testing.assert_allclose(
        strengths(shape, halves), opacity_of_half(strengths(shape, mixed), DISTANCE), rtol=2e-6, atol=1e-12
    )
    assert all(np.isfinite(array).all() for array in halves.values())
    for name in names:
        if shape.signed:
            np.testing.assert_array_equal(np.sign(halves[name]), np.sign(twice(arrays)[name]))
    alone = split({name: array[7:8] for name, array in arrays.items()}, shape, 1e-30)
    for name, array in alone.items():
        np.testing.assert_array_equal(array, halves[name][[7, 47]], err_msg=name)


@pytest.mark.parametrize("shape", ALL_SHAPES, ids=lambda s: s.name)
def test_halves_of_faint_and_of_opaque_splats(shape: Shape) -> None:
    arrays = random_model(shape, 4, 3, dead=0)
    for name in opacity_names(arrays):
        arrays[name][:] = shape.raw_opacity(np.array([0.0051, 0.0051, 0.5, 0.5]))
        arrays[name][3] = 60.0
    halves = split(arrays, shape)
    assert all(np.isfinite(array).all() for array in halves.values())
    strength = strengths(shape, halves).max(axis=1)
    np.testing.assert_allclose(strength[[0, 1, 4, 5]], MIN_OPACITY, rtol=1e-5)
    np.testing.assert_allclose(strength[[3, 7]], opacity_of_half(np.ones(1), DISTANCE)[0], rtol=1e-5)


def test_both_sides_of_a_faint_splat_grow_by_one_factor() -> None:
    shape = shapes.BISECTED_SKEW
    arrays = random_model(shape, 1, 0, dead=0)
    arrays["skew"][:] = 0  # both halves have the parent's opacities
    arrays["opacity_logit"][:], arrays["opacity_minus_logit"][:] = shape.raw_opacity(np.array([0.005, 0.001]))
    sides = strengths(shape, split(arrays, shape))
    np.testing.assert_allclose(sides, [[0.005, 0.001]] * 2, rtol=1e-3)
