"""SGHMC: SSS's formula, properties of the stable form, and both forms against their theory."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.linalg import solve_discrete_lyapunov

from clsplat.training.methods.sss import PublishedSghmc
from clsplat.training.optim.noise import covariance_times, noise_gate, normal3
from clsplat.training.optim.sghmc import SSS_EXTENT, STREAM, Coefficients, Sghmc, step

RATE = 1.6e-4  # learning rate of positions; the extent multiplies it
FRICTION, BURN_IN_FRICTION = 120.0, 5e5


def sghmc(extent: float = SSS_EXTENT, literal: bool = False, friction: float = FRICTION, burn_in: int = 5) -> Sghmc:
    return (PublishedSghmc if literal else Sghmc)(extent, friction, BURN_IN_FRICTION, burn_in)


def ends(options: Sghmc, iterations: int = 300, factor: float = 1.0, n: int = 64) -> np.ndarray:
    """Return (n, 3) means of nearly transparent splats after steps in random directions. Options have the extent."""
    rng = np.random.default_rng(0)
    extent = options.extent
    mean, momentum = extent * rng.standard_normal((n, 3)), np.zeros((n, 3))
    quat, log_scale = rng.standard_normal((n, 4)), np.log(0.01 * extent) + rng.normal(0, 0.3, (n, 3))
    strength = rng.uniform(0, 0.01, n)
    with np.errstate(all="ignore"):
        for iteration in range(1, iterations + 1):
            c = options.coefficients(iteration, RATE * extent, factor)
            direction, xi = rng.uniform(-1, 1, (n, 3)), normal3(3, iteration, n, STREAM)
            mean, momentum = step(mean, momentum, direction, xi, quat, log_scale, strength, c)
    return mean


def test_literal_coefficients_are_sss() -> None:
    rate, options = 1.2e-3, sghmc(literal=True)
    length = math.sqrt(rate)
    noise = math.sqrt(2 * length * BURN_IN_FRICTION)
    assert options.coefficients(5, rate, 1.0) == pytest.approx((length, length, 0, noise, True))
    noise = math.sqrt(2 * length * FRICTION)
    assert options.coefficients(6, rate, 1.0) == pytest.approx((length, length, 0, noise, False))  # p is 0 at first
    keep = 1 - length * FRICTION
    assert options.coefficients(7, rate, 1.0) == pytest.approx((length, length, keep, noise, False))
    # The factor of short runs multiplies only the gradient.
    assert options.coefficients(7, rate, 4.0) == pytest.approx((length, 4 * length, keep, noise, False))


def test_a_step_is_the_formula() -> None:
    rng = np.random.default_rng(1)
    mean, momentum, direction, xi, log_scale = rng.standard_normal((5, 7, 3))
    quat, strength = rng.standard_normal((7, 4)), rng.uniform(0, 0.02, 7)
    gate = noise_gate(strength)[:, None]
    for by_covariance in (False, True):
        spread = covariance_times(quat, log_scale, xi) if by_covariance else xi
        p = gate * 0.7 * momentum - 0.2 * direction + gate * 3.0 * spread
        got = step(
            mean, momentum, direction, xi, quat, log_scale, strength, Coefficients(0.5, 0.2, 0.7, 3.0, by_covariance)
        )
        np.testing.assert_allclose(got[1], p, rtol=1e-13)
        np.testing.assert_allclose(got[0], mean + 0.5 * p, rtol=1e-13)


@pytest.mark.parametrize("iteration", [1, 9])
def test_a_visible_splat_takes_adams_step(iteration: int) -> None:
    one = np.ones((1, 3))
    c = sghmc(literal=True).coefficients(iteration, 1e-3, 2.0)
    moved, _ = step(0 * one, one, 0.3 * one, one, np.eye(1, 4), -4 * one, np.array([0.5]), c)
    np.testing.assert_allclose(moved, -2e-3 * 0.3, rtol=1e-12)


def test_both_forms_agree_at_the_extent_of_sss() -> None:
    for rate in (1e-4, 1e-6):  # the second rate gives l C < 1
        for iteration in (1, 6, 7):
            forms = [sghmc(literal=literal).coefficients(iteration, rate, 3.0) for literal in (True, False)]
            assert forms[1]._replace(keep=0) == pytest.approx(forms[0]._replace(keep=0))
            assert forms[1].keep == pytest.approx(max(forms[0].keep, 0))


def test_the_stable_form_does_not_know_the_unit_of_length() -> None:
    small, large = (ends(sghmc(extent), 40) for extent in (2.0, 2000.0))
    np.testing.assert_allclose(large, 1000 * small, rtol=1e-9)
    literal = [ends(sghmc(extent, literal=True), 40) for extent in (2.0, 2.2)]
    assert np.abs(literal[1] - 1.1 * literal[0]).max() > 1e-2


@pytest.mark.parametrize("friction", [0.0, 120.0, 1e6])
@pytest.mark.parametrize("extent", [1e-3, SSS_EXTENT, 1e4])
def test_the_stable_form_stays_bounded(extent: float, friction: float) -> None:
    options = sghmc(extent, friction=friction)
    for iteration in (6, 7, 300):
        keep = options.coefficients(iteration, RATE * extent, 10.0).keep
        assert noise_gate(np.zeros(1))[0] * abs(keep) < 1
    late = ends(options, 1500, factor=10.0)
    assert np.abs(late).max() < 100 * extent


def test_the_literal_form_diverges_in_a_large_scene() -> None:
    with np.errstate(all="ignore"):
        assert not np.abs(ends(sghmc(200.0, literal=True), 1500)).max() < 1e6


def test_no_extent_is_no_motion() -> None:
    for iteration in (1, 7):
        c = sghmc(0.0).coefficients(iteration, 0.0, 3.0)
        assert np.isfinite(c).all()
        assert c.length == 0


def test_the_variance_in_a_quadratic_well_is_the_stationary_one() -> None:
    """The stationary variance solves the Lyapunov equation of this linear recurrence.

    x' = x + l p', p' = s keep p - drive x / width^2 + s noise xi
    """
    n, width = 6000, 0.05
    c = sghmc(3.0, friction=20.0).coefficients(100, 2e-3, 1.0)
    gate = noise_gate(np.zeros(1))[0]
    pull = c.drive / width**2
    drift = np.array([[1 - c.length * pull, c.length * gate * c.keep], [-pull, gate * c.keep]])
    kick = gate * c.noise * np.array([[c.length], [1.0]])
    expected = solve_discrete_lyapunov(drift, kick @ kick.T)
    mean, momentum = np.zeros((n, 3)), np.zeros((n, 3))
    quat, log_scale, strength = np.eye(1, 4).repeat(n, 0), np.zeros((n, 3)), np.zeros(n)
    for iteration in range(60):
        mean, momentum = step(
            mean, momentum, mean / width**2, normal3(1, iteration, n, STREAM), quat, log_scale, strength, c
        )
    np.testing.assert_allclose(np.cov(mean.ravel(), momentum.ravel()), expected, rtol=0.05, atol=0.02 * expected.min())
