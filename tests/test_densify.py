"""densify.py: relocation against numerical integrals, and the laws of a plan."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.integrate import quad
from scipy.optimize import minimize_scalar
from scipy.special import ndtr

from clsplat.densify import MIN_OPACITY, N_MAX, Plan, plan_relocation, relocation
from clsplat.errors import InputError
from clsplat.shapes import SKEW_MAX


def side_kernel(skew: float) -> Callable[[float], float]:
    """The peak-normalised skew-normal of mean 0, variance 1 along its skew: the centred form as it stands."""
    t = skew**2
    h = math.sqrt((math.pi / 2) / ((1 + t) * (1 - (math.pi / 2 - 1) * t)))

    def raw(d: float) -> float:
        a = skew * d
        return float(np.exp(-0.5 * (d * d + (2 * a + t - a * a) / (1 + t))) * ndtr(h * (a + t)))

    peak = -minimize_scalar(lambda d: -raw(d), bounds=(-3, 3), method="bounded", options={"xatol": 1e-10}).fun
    return lambda d: raw(d) / peak


@pytest.mark.parametrize("skew", [0.0, 0.3, 0.77, 1.1, 0.99 * SKEW_MAX, SKEW_MAX])
@pytest.mark.parametrize(("opacity", "ratio"), [(0.5, 2), (0.02, 3), (0.9, 2), (0.95, 7), (0.999, 51)])
def test_a_stack_absorbs_as_much_as_the_splat_it_replaces(skew: float, opacity: float, ratio: int) -> None:
    kernel = side_kernel(skew)
    new, factor = relocation(np.array([opacity]), np.array([ratio]), np.array([skew]))
    one = quad(lambda d: opacity * kernel(d), -12, 12, limit=400, points=[0])[0]
    stack = quad(lambda d: 1 - (1 - new[0] * kernel(d)) ** ratio, -12, 12, limit=400, points=[0])[0]
    assert factor[0] * stack == pytest.approx(one, rel=1e-4 if skew else 1e-8)
    assert 1 - (1 - new[0]) ** ratio == pytest.approx(opacity, rel=1e-9)


def test_gaussian_formula_as_published() -> None:
    """3DGS-MCMC's double sum with explicit binomials."""
    for opacity, ratio in [(0.5, 2), (0.3, 5), (0.97, 12)]:
        new = 1 - (1 - opacity) ** (1 / ratio)
        total = sum(math.comb(i - 1, k) * (-1) ** k * new ** (k + 1) / math.sqrt(k + 1)
                    for i in range(1, ratio + 1) for k in range(i))
        got, factor = relocation(np.array([opacity]), np.array([ratio]))
        assert got[0] == pytest.approx(new, rel=1e-12)
        assert factor[0] == pytest.approx(opacity / total, rel=1e-10)
    assert relocation(np.array([0.5]), np.array([2]))[1][0] == pytest.approx(0.952, abs=5e-4)


@given(opacity=st.floats(0.001, 1 - 1e-7), ratio=st.integers(1, N_MAX), skew=st.floats(0, SKEW_MAX))
def test_relocation_is_finite_everywhere_and_one_is_none(opacity: float, ratio: int, skew: float) -> None:
    new, factor = relocation(np.array([opacity]), np.array([ratio]), np.array([skew]))
    assert 0 < new[0] <= opacity * (1 + 1e-12)
    assert 0.3 < factor[0] <= 1 + 1e-9
    if ratio == 1:
        assert factor[0] == pytest.approx(1, rel=1e-12)
        assert new[0] == pytest.approx(opacity, rel=1e-9)


def test_rows_do_not_mix() -> None:
    rng = np.random.default_rng(1)
    opacity, skew = rng.uniform(0.01, 0.99, 200), rng.uniform(0, SKEW_MAX, 200)
    ratio = rng.integers(1, 60, 200)
    together = np.stack(relocation(opacity, ratio, skew))
    alone = np.stack([np.concatenate(relocation(opacity[i : i + 1], ratio[i : i + 1], skew[i : i + 1]))
                      for i in range(200)], axis=1)
    np.testing.assert_allclose(together, alone, rtol=1e-12)


def model(n: int, seed: int, dead: float = 0.3) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    logit = np.where(rng.random(n) < dead, rng.uniform(-12, -5.5, n), rng.uniform(-4, 4, n))
    return logit.astype(np.float32), rng.normal(-3, 1, (n, 3)).astype(np.float32)


def opacity_of(logit: np.ndarray) -> np.ndarray:
    return 1 / (1 + np.exp(-logit.astype(np.float64)))


def equal(a: Plan, b: Plan) -> bool:
    names = ("source", "opacity_logit", "log_scale_offset", "fresh")
    return all(np.array_equal(getattr(a, name), getattr(b, name)) for name in names)


@settings(max_examples=60)
@given(n=st.integers(1, 300), seed=st.integers(0, 10_000), dead=st.floats(0, 1), growth=st.floats(1, 2),
       spare=st.integers(-50, 200), rule=st.sampled_from(["length", "opacity-only"]), skewed=st.booleans())
def test_laws_of_a_plan(
    n: int, seed: int, dead: float, growth: float, spare: int, rule: str, skewed: bool
) -> None:
    logit, log_scale = model(n, seed, dead)
    skew = np.random.default_rng(seed).uniform(-0.7, 0.7, (n, 3)).astype(np.float32) if skewed else None
    cap = max(1, n + spare)
    plan = plan_relocation(logit, log_scale, np.random.default_rng(seed), cap, growth, skew=skew, rule=rule)
    alive = opacity_of(logit) > MIN_OPACITY
    n_new = len(plan.source)

    if alive.any():
        assert n_new == max(n, min(cap, math.ceil(growth * n - 1e-6)))
        assert plan.relocated == np.sum(~alive)
        assert alive[plan.source].all()
    else:
        assert n_new == n
        assert plan.relocated == 0
    assert plan.added == n_new - n
    assert [a.dtype for a in (plan.source, plan.opacity_logit, plan.log_scale_offset, plan.fresh)] == [
        np.int64, np.float32, np.float32, np.bool_]
    assert len(plan.opacity_logit) == len(plan.log_scale_offset) == len(plan.fresh) == n_new
    np.testing.assert_array_equal(plan.source[plan.source], plan.source)
    assert np.isfinite(plan.opacity_logit).all()

    # Every member of a stack has the same new values; their number decides them; the rest is untouched.
    size = np.bincount(plan.source, minlength=n)[plan.source]
    moved = size > 1
    np.testing.assert_array_equal(plan.opacity_logit, plan.opacity_logit[plan.source])
    np.testing.assert_array_equal(plan.log_scale_offset, plan.log_scale_offset[plan.source])
    np.testing.assert_array_equal(plan.opacity_logit[~moved], logit[plan.source[~moved]])
    assert not plan.log_scale_offset[~moved].any()
    norm = None if skew is None else np.linalg.norm(skew[plan.source[moved]], axis=1)
    new, factor = relocation(opacity_of(logit[plan.source[moved]]), size[moved], norm, MIN_OPACITY)
    np.testing.assert_allclose(opacity_of(plan.opacity_logit[moved]), new, rtol=1e-5)
    expected = np.log(factor) if rule == "length" else np.zeros(moved.sum())
    np.testing.assert_allclose(plan.log_scale_offset[moved], expected, atol=1e-5)

    # Adam: the live row of each stack and the added rows start afresh, relocated rows keep their moments.
    old = np.arange(n)
    is_target = moved[:n] & (plan.source[:n] == old)
    np.testing.assert_array_equal(plan.fresh[:n], is_target)
    assert plan.fresh[n:].all()


def test_draws_are_in_proportion_to_opacity() -> None:
    n_dead = 200_000
    live = np.array([0.1, 0.2, 0.7])
    logit = np.concatenate([np.log(live / (1 - live)), np.full(n_dead, -20.0)])
    plan = plan_relocation(logit, np.zeros((len(logit), 3)), np.random.default_rng(5), cap=1)
    share = np.bincount(plan.source[3:], minlength=3) / n_dead
    np.testing.assert_allclose(share, live / live.sum(), atol=5 * 0.5 / math.sqrt(n_dead))


def test_same_generator_same_plan_and_another_differs() -> None:
    logit, log_scale = model(500, 0)
    plans = [plan_relocation(logit, log_scale, np.random.default_rng(seed), 1000) for seed in (1, 1, 2)]
    assert equal(plans[0], plans[1])
    assert not equal(plans[0], plans[2])


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("field", ["opacity_logit", "log_scale", "skew", "finite"])
def test_rows_that_are_not_finite_are_relocated_and_start_afresh(bad: float, field: str) -> None:
    n = 40
    logit = np.zeros(n, np.float32)
    log_scale, skew = np.zeros((2, n, 3), np.float32)
    finite = np.ones(n, np.bool_)
    rows = [3, 17]
    if field == "finite":
        finite[rows] = False
    else:
        {"opacity_logit": logit, "log_scale": log_scale[:, 1], "skew": skew[:, 2]}[field][rows] = bad
    plan = plan_relocation(logit, log_scale, np.random.default_rng(0), n, skew=skew, finite=finite)
    assert plan.relocated == 2
    assert not np.isin(plan.source, rows).any()
    assert plan.fresh[rows].all()
    assert np.isfinite(plan.opacity_logit).all()
    moved = plan.apply({"opacity_logit": logit, "log_scale": log_scale, "skew": skew})
    assert all(np.isfinite(array).all() for array in moved.values())


def test_apply_gathers_and_adds_the_offset_afterwards() -> None:
    logit, log_scale = model(50, 3)
    sh = np.random.default_rng(0).standard_normal((50, 4, 3)).astype(np.float32)
    plan = plan_relocation(logit, log_scale, np.random.default_rng(0), 60, growth=1.2)
    moved = plan.apply({"opacity_logit": logit, "log_scale": log_scale, "sh": sh})
    assert len(moved["sh"]) == 60
    for i, source in enumerate(plan.source):
        np.testing.assert_array_equal(moved["sh"][i], sh[source])
        expected = log_scale[source] + plan.log_scale_offset[i]
        np.testing.assert_allclose(moved["log_scale"][i], expected, rtol=1e-6)
        assert moved["opacity_logit"][i] == plan.opacity_logit[i]


def test_growth_does_not_overshoot_by_rounding_and_empty_models_pass() -> None:
    rng = np.random.default_rng(0)
    plan = plan_relocation(np.zeros(100), np.zeros((100, 3)), rng, 1000, growth=1.05)
    assert plan.added == 5
    empty = plan_relocation(np.zeros(0), np.zeros((0, 3)), rng, 10)
    assert len(empty.source) == 0


def test_extreme_opacities() -> None:
    logit = np.array([80.0, -80.0, 30.0, -20.0], np.float32)
    plan = plan_relocation(logit, np.zeros((4, 3)), np.random.default_rng(0), 8, growth=2)
    assert np.isfinite(plan.opacity_logit).all()
    assert np.isfinite(plan.log_scale_offset).all()


BAD_OPTIONS = [{"rule": "area"}, {"growth": 0.9}, {"growth": math.nan}, {"min_opacity": 0}]


@pytest.mark.parametrize("options", BAD_OPTIONS)
def test_bad_options(options: dict[str, object]) -> None:
    with pytest.raises(InputError):
        plan_relocation(np.zeros(3), np.zeros((3, 3)), np.random.default_rng(0), 5, **options)  # type: ignore[arg-type]
