"""Relocation agrees with adaptive quadrature and published numbers. Its edits obey their rules for every shape."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from model_arrays import ALL_SHAPES, Arrays, random_model
from scipy.integrate import quad

from clsplat.errors import InputError, TrainingError
from clsplat.splats import shapes
from clsplat.splats.optical_depth import opacity_names
from clsplat.splats.shapes import BETA_BOUNDS, NU_BOUNDS, SKEW_MAX, SLANT_MAX, Shape
from clsplat.training.density.edit import DensifyEdit
from clsplat.training.density.halves import split_along_axis, twice
from clsplat.training.density.relocation import MIN_OPACITY, N_MAX, RULES, _draw, _stacked, plan_relocation, relocation
from clsplat.training.density.table import HostSplats

TWO_SIDED = [s for s in ALL_SHAPES if any(f.name == "opacity_minus_logit" for f in s.fields)]


def one(shape: Shape, opacity: float, own: float = 0.0, minus: float = 0.0) -> Arrays:
    """One splat of this opacity; `own` is its beta, its nu, or the length of its skew."""
    arrays = {field.name: np.zeros(1 if field.width == 1 else (1, field.width)) for field in shape.fields}
    if "skew" in arrays:
        arrays["skew"][0, 1] = own
    for name in {"beta", "nu"} & set(arrays):
        arrays[name][:] = own
    arrays["opacity_logit"] = shape.raw_opacity(np.array([opacity]))
    if "opacity_minus_logit" in arrays:
        arrays["opacity_minus_logit"] = shape.raw_opacity(np.array([minus]))
    return arrays


def integral(f: Callable[[float], float]) -> float:
    """Integrate over the line in pieces, because of heavy tails, cusps and steps at 0."""
    edges = [-np.inf, -100, -10, -3, -1, -0.1, 0, 0.1, 1, 3, 10, 100, np.inf]
    return sum(quad(f, a, b, limit=400, epsabs=1e-10, epsrel=1e-9)[0] for a, b in itertools.pairwise(edges))


# Shape, its own parameter, relative error (see _NODES in training/density/length_factor.py).
KERNELS = [
    (shapes.GAUSSIAN, 0.0, 1e-9),
    (shapes.GES_MODULATION, 3.0, 1e-9),
    (shapes.SKEW_NORMAL, 0.3, 1e-9),
    (shapes.SKEW_NORMAL, SKEW_MAX, 1e-9),
    (shapes.SKEW_NORMAL_DIRECT, 3.0, 1e-9),
    (shapes.SKEW_NORMAL_DIRECT, SLANT_MAX, 1e-9),
    (shapes.HALF_GAUSSIAN, 0.0, 1e-9),
    (shapes.BISECTED_SKEW, SLANT_MAX, 1e-9),
    (shapes.STUDENT_T, NU_BOUNDS[0], 2e-7),
    (shapes.STUDENT_T, 3.0, 1e-7),
    (shapes.STUDENT_T, NU_BOUNDS[1], 1e-7),
    (shapes.GENERALISED_EXPONENTIAL, BETA_BOUNDS[0], 1e-8),
    (shapes.GENERALISED_EXPONENTIAL, 1.0, 1e-8),
    (shapes.GENERALISED_EXPONENTIAL, BETA_BOUNDS[1], 1e-4),
]


@pytest.mark.parametrize(("shape", "own", "error"), KERNELS, ids=lambda v: getattr(v, "name", str(v)))
@pytest.mark.parametrize(("opacity", "ratio"), [(0.5, 2), (0.02, 3), (0.95, 7), (0.999, 51)])
def test_a_stack_absorbs_as_much_as_the_splat_it_replaces(
    shape: Shape, own: float, error: float, opacity: float, ratio: int
) -> None:
    arrays = one(shape, opacity, own, minus=0.3)
    raw, factor = relocation(shape, arrays, np.array([ratio]))
    old = np.array([shape.opacity(arrays[name])[0] for name in raw])
    new = np.array([shape.opacity(values)[0] for values in raw.values()])
    assert len(new) == (2 if shape in TWO_SIDED else 1)
    np.testing.assert_allclose(1 - (1 - new) ** ratio, old, rtol=1e-9)

    def alpha(z: float, opacities: np.ndarray) -> float:
        return float(opacities @ shape.profile(np.array([z]), arrays)[0, :, 0])

    before = integral(lambda z: alpha(z, old))
    after = integral(lambda z: 1 - (1 - alpha(z, new)) ** ratio)
    assert factor[0] * after == pytest.approx(before, rel=error)


def test_gaussian_formula_as_published() -> None:
    """Compute 3DGS-MCMC's double sum with explicit binomials."""
    for opacity, ratio in [(0.5, 2), (0.3, 5), (0.97, 12)]:
        new = 1 - (1 - opacity) ** (1 / ratio)
        total = sum(
            math.comb(i - 1, k) * (-1) ** k * new ** (k + 1) / math.sqrt(k + 1)
            for i in range(1, ratio + 1)
            for k in range(i)
        )
        raw, factor = relocation(shapes.GAUSSIAN, one(shapes.GAUSSIAN, opacity), np.array([ratio]))
        assert shapes.GAUSSIAN.opacity(raw["opacity_logit"])[0] == pytest.approx(new, rel=1e-9)
        assert factor[0] == pytest.approx(opacity / total, rel=1e-9)


@pytest.mark.parametrize(("slant", "published"), [(0, 0.900), (1, 0.911), (3, 0.931), (10, 0.945)])
def test_skewed_factors_against_the_table_for_half_the_opacity(slant: float, published: float) -> None:
    """The table is for exp(-z^2/2) Phi(slant z) without a factor, o = 0.5, N = 2.

    This is the bisected shape with opacities (0.5, 0).
    """
    shape = shapes.BISECTED_SKEW
    _, factor = relocation(shape, one(shape, 0.5, slant, minus=1e-12), np.array([2]))
    _, whole = relocation(shapes.GAUSSIAN, one(shapes.GAUSSIAN, 0.5), np.array([2]))
    assert whole[0] == pytest.approx(0.952, abs=5e-4)
    assert factor[0] == pytest.approx(published, abs=5e-4)


def test_neutral_shapes_get_the_gaussians_factor() -> None:
    _, gaussian = relocation(shapes.GAUSSIAN, one(shapes.GAUSSIAN, 0.7), np.array([4]))
    for shape, own in [
        (shapes.SKEW_NORMAL, 0.0),
        (shapes.SKEW_NORMAL_DIRECT, 0.0),
        (shapes.HALF_GAUSSIAN, 0.0),
        (shapes.BISECTED_SKEW, 2.0),
        (shapes.GENERALISED_EXPONENTIAL, 2.0),
    ]:
        _, factor = relocation(shape, one(shape, 0.7, own, minus=0.7), np.array([4]))
        assert factor[0] == pytest.approx(gaussian[0], rel=1e-9), shape.name
    _, factor = relocation(shapes.STUDENT_T, one(shapes.STUDENT_T, 0.7, 1e4), np.array([4]))
    assert factor[0] == pytest.approx(gaussian[0], rel=1e-3)


def test_negative_opacities_keep_their_sign_and_mirror_the_positive() -> None:
    shape = shapes.STUDENT_T
    up, down = (relocation(shape, one(shape, sign * 0.6, 5.0), np.array([3])) for sign in (1, -1))
    assert down[0]["opacity_logit"][0] == -up[0]["opacity_logit"][0] < 0
    assert down[1][0] == up[1][0]


@given(opacity=st.floats(0.001, 1 - 1e-7), ratio=st.integers(1, N_MAX), skew=st.floats(0, SKEW_MAX))
def test_relocation_is_finite_everywhere_and_one_is_none(opacity: float, ratio: int, skew: float) -> None:
    shape = shapes.SKEW_NORMAL
    raw, factor = relocation(shape, one(shape, opacity, skew), np.array([ratio]))
    new = shape.opacity(raw["opacity_logit"])
    assert 0 < new[0] <= opacity * (1 + 1e-9)
    assert 0.3 < factor[0] <= 1 + 1e-9
    if ratio == 1:
        assert factor[0] == 1
        assert new[0] == pytest.approx(opacity, rel=1e-9)


@pytest.mark.parametrize("shape", ALL_SHAPES, ids=lambda s: s.name)
def test_rows_do_not_mix(shape: Shape) -> None:
    arrays = random_model(shape, 30, 1, dead=0)
    ratio = np.random.default_rng(1).integers(1, 60, 30)
    raw, factor = relocation(shape, arrays, ratio, MIN_OPACITY)
    for i in (0, 7, 29):
        alone = relocation(shape, {name: a[i : i + 1] for name, a in arrays.items()}, ratio[i : i + 1], MIN_OPACITY)
        np.testing.assert_allclose(factor[i], alone[1][0], rtol=1e-12)
        for name in raw:
            assert raw[name][i] == alone[0][name][0]


def planned(arrays: Arrays, shape: Shape, rng: np.random.Generator, cap: int, **options: Any) -> DensifyEdit:
    return plan_relocation(HostSplats(shape, arrays), shape, rng, cap, **options)


def equal(a: DensifyEdit, b: DensifyEdit) -> bool:
    return (
        np.array_equal(a.source, b.source)
        and np.array_equal(a.fresh, b.fresh)
        and set(a.values) == set(b.values)
        and all(np.array_equal(a.values[name].rows, b.values[name].rows) for name in a.values)
        and all(np.array_equal(a.values[name].values, b.values[name].values) for name in a.values)
    )


@settings(max_examples=60, deadline=None)
@given(
    n=st.integers(1, 200),
    seed=st.integers(0, 10_000),
    dead=st.floats(0, 1),
    growth=st.floats(1, 2),
    spare=st.integers(-50, 200),
    rule=st.sampled_from(sorted(RULES)),
    shape=st.sampled_from(ALL_SHAPES),
)
def test_laws_of_a_plan(n: int, seed: int, dead: float, growth: float, spare: int, rule: str, shape: Shape) -> None:
    arrays = random_model(shape, n, seed, dead)
    cap = max(1, n + spare)
    edit = planned(arrays, shape, np.random.default_rng(seed), cap, growth=growth, rule=rule)
    alive = shape.strength(arrays) > MIN_OPACITY
    n_new = len(edit.source)

    if alive.any():
        assert n_new == max(n, min(cap, math.ceil(growth * n - 1e-6)))
        assert edit.relocated == np.sum(~alive)
        assert alive[edit.source].all()
    else:
        assert n_new == n
        assert edit.relocated == 0
    assert edit.added == n_new - n
    assert edit.source.dtype == np.int64
    assert edit.state_source is None
    np.testing.assert_array_equal(edit.source[edit.source], edit.source)
    moved = edit.apply(arrays)
    assert all(len(a) == n_new and a.dtype == np.float32 and np.isfinite(a).all() for a in moved.values())
    assert (shape.strength(moved) >= MIN_OPACITY * (1 - 1e-6)).all() or not alive.any()

    # All members of a stack have equal values, which their number determines. The other splats do not change.
    size = np.bincount(edit.source, minlength=n)[edit.source]
    names = opacity_names(arrays)
    for name, values in moved.items():
        np.testing.assert_array_equal(values, values[edit.source])
        np.testing.assert_array_equal(values[size == 1], arrays[name][edit.source[size == 1]])
        if name not in (*names, "log_scale"):
            np.testing.assert_array_equal(values, arrays[name][edit.source])
    stack = size > 1
    rows = {name: a[edit.source[stack]] for name, a in arrays.items()}
    raw, factor = relocation(shape, rows, size[stack], MIN_OPACITY)
    for name in names:
        np.testing.assert_allclose(moved[name][stack], raw[name], rtol=1e-5, atol=1e-5)
    expected = rows["log_scale"] + RULES[rule] * np.log(factor)[:, None]
    np.testing.assert_allclose(moved["log_scale"][stack], expected, rtol=1e-5, atol=1e-5)

    # Optimizer states: the live row of each stack and the added rows have new states. Relocated rows keep theirs.
    np.testing.assert_array_equal(edit.fresh[:n], stack[:n] & (edit.source[:n] == np.arange(n)))
    assert edit.fresh[n:].all()


@settings(max_examples=40, deadline=None)
@given(
    n=st.integers(1, 200),
    seed=st.integers(0, 10_000),
    growth=st.floats(1, 2),
    rule=st.sampled_from(sorted(RULES)),
    shape=st.sampled_from(ALL_SHAPES),
)
def test_with_long_axis_a_single_copy_makes_two_halves_and_more_make_a_stack(
    n: int, seed: int, growth: float, rule: str, shape: Shape
) -> None:
    arrays = random_model(shape, n, seed, 0.3)
    plans = [
        planned(arrays, shape, np.random.default_rng(seed), 2 * n, growth=growth, rule=rule, split=split)
        for split in ("published", "long-axis")
    ]
    piled, halved = plans
    np.testing.assert_array_equal(halved.source, piled.source)
    np.testing.assert_array_equal(halved.fresh, piled.fresh)
    assert (halved.relocated, halved.added) == (piled.relocated, piled.added)
    before, after = piled.apply(arrays), halved.apply(arrays)
    size = np.bincount(piled.source, minlength=n)[piled.source]
    own = piled.source == np.arange(len(size))
    for name, array in after.items():
        np.testing.assert_array_equal(array[size != 2], before[name][size != 2], err_msg=name)
    first, copies = np.flatnonzero((size == 2) & own), np.flatnonzero((size == 2) & ~own)
    copies = copies[np.argsort(piled.source[copies])]
    assert len(copies) == len(first)
    parents = {name: array[first] for name, array in arrays.items()}
    for name, array in (twice(parents) | split_along_axis(parents, shape, MIN_OPACITY)).items():
        np.testing.assert_array_equal(after[name][np.concatenate([first, copies])], array.astype(np.float32))


def gaussians(logit: np.ndarray) -> Arrays:
    logit = np.asarray(logit, np.float32)
    return {
        "mean": np.zeros((len(logit), 3), np.float32),
        "log_scale": np.zeros((len(logit), 3), np.float32),
        "opacity_logit": logit,
    }


def test_draws_are_in_proportion_to_the_strength() -> None:
    n_dead = 200_000
    live = np.array([0.1, -0.2, 0.7])
    arrays = gaussians(np.concatenate([np.arctanh(live), np.zeros(n_dead)]))
    arrays["nu"] = np.full(len(arrays["mean"]), 5.0)
    edit = planned(arrays, shapes.STUDENT_T, np.random.default_rng(5), cap=1)
    share = np.bincount(edit.source[3:], minlength=3) / n_dead
    np.testing.assert_allclose(share, np.abs(live), atol=5 * 0.5 / math.sqrt(n_dead))


def test_small_gradients_beside_a_large_one_are_drawn() -> None:
    n = 20_000
    arrays = gaussians(np.linspace(0, 1, n))
    gradient = np.ones(n, np.float32)
    gradient[n // 2] = 2**24  # 1 more is not a float32
    edit = planned(arrays, shapes.GAUSSIAN, np.random.default_rng(0), n, turnover=0.5, gradient=gradient)
    places = edit.source[: edit.relocated]
    late = np.count_nonzero(places > n // 2)
    expected = len(places) * (n / 2) / (2**24 + n / 2)
    assert abs(late - expected) < 4 * math.sqrt(expected)
    assert late > 0


def test_with_a_turnover_the_faintest_move_to_high_gradients_once_nothing_grows() -> None:
    arrays = gaussians(np.arange(20.0) - 4)  # none is dead
    gradient = np.zeros(20)
    gradient[[2, 9, 15]] = (5.0, 1.0, np.inf)

    def plan(cap: int, turnover: float, of: np.ndarray | None = gradient) -> DensifyEdit:
        rng = np.random.default_rng(0)
        return planned(arrays, shapes.GAUSSIAN, rng, cap, growth=1.05, turnover=turnover, gradient=of)

    edit = plan(20, 0.25)
    assert (edit.relocated, edit.added) == (5, 0)
    assert edit.source.tolist() == [9] * 5 + list(range(5, 20))  # row 2 is faint itself; a gradient must be finite
    assert plan(20, 0.04).relocated == 0  # less than one splat
    assert plan(20, 0.25, None).source[:5].min() >= 5  # by strength
    assert plan(20, 0.25, np.zeros(20)).source[:5].min() >= 5
    growing = plan(21, 0.25)
    assert (growing.relocated, growing.added) == (0, 1)
    assert equal(growing, plan(21, 0.0, None))
    dead = gaussians(np.array([-9.0, -9.0, 1.0, 2.0]))
    edit = planned(dead, shapes.GAUSSIAN, np.random.default_rng(0), 4, turnover=0.5)
    assert edit.relocated == 2, "the dead ones are the faintest"


@pytest.mark.parametrize("limit", [0.0, 0.05, 0.3, 1.0])
def test_a_limit_takes_the_weakest_first(limit: float) -> None:
    logit = np.concatenate([np.zeros(50), np.linspace(-6, -12, 50)])
    edit = planned(gaussians(logit), shapes.GAUSSIAN, np.random.default_rng(0), 100, limit=limit)
    count = min(int(limit * 100), 50)
    assert edit.relocated == count
    np.testing.assert_array_equal(np.flatnonzero(edit.source != np.arange(100)), np.arange(100 - count, 100))


def test_a_splat_of_exactly_the_smallest_opacity_is_dead() -> None:
    arrays = gaussians(np.array([0.0, -5.0]))
    faintest = float(shapes.GAUSSIAN.strength(arrays)[1])
    for least, moved in ((np.nextafter(faintest, 0), 0), (faintest, 1)):
        edit = planned(arrays, shapes.GAUSSIAN, np.random.default_rng(0), 2, min_opacity=float(least))
        assert edit.relocated == moved


def test_one_side_of_a_two_sided_splat_keeps_it_alive_and_the_other_stays_faint() -> None:
    shape = shapes.HALF_GAUSSIAN
    arrays = random_model(shape, 2, 0, dead=0)
    arrays["opacity_logit"][:] = (-20.0, -9.0)
    arrays["opacity_minus_logit"][:] = (1.0, -9.0)
    edit = planned(arrays, shape, np.random.default_rng(0), 2)
    assert edit.source.tolist() == [0, 0]
    opacity = shape.opacity(edit.after("opacity_logit", arrays["opacity_logit"]).astype(np.float64))
    np.testing.assert_allclose(opacity, math.exp(-20) / 2, rtol=1e-3)


def test_same_generator_same_plan_and_another_differs() -> None:
    arrays = random_model(shapes.SKEW_NORMAL, 500, 0)
    edits = [planned(arrays, shapes.SKEW_NORMAL, np.random.default_rng(seed), 1000) for seed in (1, 1, 2)]
    assert equal(edits[0], edits[1])
    assert not equal(edits[0], edits[2])


@pytest.mark.parametrize("limit", [0.0, 1.0])
@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("field", ["opacity_logit", "opacity_minus_logit", "log_scale", "skew", "mean", "sh"])
def test_rows_that_are_not_finite_are_relocated_and_start_afresh(bad: float, field: str, limit: float) -> None:
    shape = shapes.BISECTED_SKEW
    arrays = random_model(shape, 40, 0, dead=0)
    rows = [3, 17]
    arrays[field].reshape(40, -1)[rows, -1] = bad
    edit = planned(arrays, shape, np.random.default_rng(0), 40, limit=limit)
    assert edit.relocated == 2
    assert not np.isin(edit.source, rows).any()
    assert edit.fresh[rows].all()
    assert all(np.isfinite(array).all() for array in edit.apply(arrays).values())


def test_what_is_not_finite_goes_even_where_nothing_is_alive() -> None:
    arrays = gaussians(np.full(20, -9.0))
    arrays["mean"][3] = np.nan
    edit = planned(arrays, shapes.GAUSSIAN, np.random.default_rng(0), 40, growth=2)
    assert (edit.relocated, edit.added) == (1, 0)
    assert np.isfinite(edit.apply(arrays)["mean"]).all()
    arrays["mean"][:] = np.nan
    with pytest.raises(TrainingError, match="no splat has finite parameters"):
        planned(arrays, shapes.GAUSSIAN, np.random.default_rng(0), 40)


def test_growth_does_not_overshoot_by_rounding_and_empty_models_pass() -> None:
    rng = np.random.default_rng(0)
    assert planned(gaussians(np.zeros(100)), shapes.GAUSSIAN, rng, 1000, growth=1.05).added == 5
    assert len(planned(gaussians(np.zeros(0)), shapes.GAUSSIAN, rng, 10).source) == 0


@pytest.mark.parametrize("shape", ALL_SHAPES, ids=lambda s: s.name)
def test_extreme_opacities(shape: Shape) -> None:
    arrays = random_model(shape, 5, 0)
    extreme = np.array([80.0, -80.0, 1e30, -1e30, 0.0], np.float32)
    for name in opacity_names(arrays):
        arrays[name] = extreme
    edit = planned(arrays, shape, np.random.default_rng(0), 20, growth=4)
    assert all(np.isfinite(array).all() for array in edit.apply(arrays).values())


BAD_OPTIONS = [{"rule": "area"}, {"growth": 0.9}, {"growth": math.nan}, {"min_opacity": 0}, {"limit": 1.5}]


@pytest.mark.parametrize("options", BAD_OPTIONS)
def test_bad_options(options: dict[str, object]) -> None:
    with pytest.raises(InputError):
        planned(gaussians(np.zeros(3)), shapes.GAUSSIAN, np.random.default_rng(0), 5, **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("count", [0, 1, 40, 3000])
def test_stacks_of_the_drawn_splats_are_those_of_unique(count: int) -> None:
    rng = np.random.default_rng(count)
    drawn, order = _draw(rng.random(50) ** 4, count, rng)
    for found, expected in zip(
        _stacked(drawn, order), np.unique(drawn, return_inverse=True, return_counts=True), strict=True
    ):
        np.testing.assert_array_equal(found, expected)
