"""Brute-force checks of the closed forms of the skew-normal splat: quadrature, grids, and other libraries."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from reference.formulas import (
    CLAMP_MARGIN,
    SKEW_MAX,
    bounded,
    direct_form,
    inverse_2x2,
    jacobian,
    normal_cdf,
    peak,
    rotation,
    sh_basis,
    slope_of,
)
from reference.renderer import alpha_maps, project
from reference.scenes import random_camera, random_splats
from reference.shape import LOW_PASS
from reference.tolerances import ROUNDING, relative_error
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation
from scipy.special import erfc, factorial, lpmv, ndtr

from clsplat.splats import shapes

SEEDS = st.integers(0, 2**32 - 1)
FEW = settings(max_examples=7, deadline=None)


def random_moments(seed: int, largest: float = SKEW_MAX):
    """Return axes R S (3, 3), skew m (3,) and an affine map (2, 3) to pixels. Scales are within a factor of 4."""
    rng = np.random.default_rng(seed)
    axes = Rotation.random(rng=rng).as_matrix() * rng.uniform(0.5, 2.0, 3)
    skew = rng.normal(size=3)
    skew *= rng.uniform(0.0, largest) / np.linalg.norm(skew)
    return axes, skew, rng.normal(size=(2, 3)) * 2.0


def direct_density(x, scale, slope):
    """Return 2 N(x; 0, scale) Phi(slope' x) at points x (..., D)."""
    q = np.einsum("...i,ij,...j->...", x, np.linalg.inv(scale), x)
    norm = np.sqrt(np.linalg.det(2.0 * np.pi * scale))
    return 2.0 * np.exp(-0.5 * q) / norm * ndtr(x @ slope)


def slope_3d(scale, delta):
    """Return the slope of a 3D skew-normal with this scale matrix and skew displacement."""
    weighted = np.linalg.solve(scale, delta)
    return weighted / np.sqrt(1.0 - delta @ weighted)


def test_skew_max_is_the_package_s():
    assert pytest.approx(shapes.SKEW_MAX, rel=1e-15) == SKEW_MAX


@FEW
@given(SEEDS)
def test_direct_form_has_the_given_moments_in_3d(seed):
    axes, skew, _ = random_moments(seed)
    scale, delta = direct_form(axes @ axes.T, axes @ skew)
    fine, coarse = np.arange(-8.0, 13.0, 0.1), np.arange(-7.7, 7.7, 0.7)  # standard deviations from the mean
    grid = np.stack(np.meshgrid(fine, coarse, coarse, indexing="ij"), -1).reshape(-1, 3)
    length = np.linalg.norm(skew)
    turn = np.linalg.qr(np.column_stack([skew, np.eye(3)[:, :2]]))[0]
    turn[:, 0] = skew / length  # the fine axis is parallel to the skew
    y = grid @ turn.T
    x = (y + skew) @ axes.T  # relative to the location, where the density is centred
    weight = direct_density(x, scale, slope_3d(scale, delta)) * abs(np.linalg.det(axes)) * 0.1 * 0.7**2
    assert weight.sum() == pytest.approx(1.0, abs=1e-8)
    assert np.abs(weight @ y).max() < 1e-8
    assert np.abs((y * weight[:, None]).T @ y - np.eye(3)).max() < 1e-8
    assert weight @ (y @ skew / length) ** 3 == pytest.approx((4.0 - np.pi) / 2.0 * length**3, abs=1e-7)


@FEW
@given(SEEDS)
def test_projection_is_the_integral_along_lines(seed):
    axes, skew, affine = random_moments(seed)
    scale, delta = direct_form(axes @ axes.T, axes @ skew)
    scale2d = affine @ scale @ affine.T
    slope, _ = slope_of(scale2d, affine @ delta)
    line = np.linalg.svd(affine)[2][2]  # direction that projects to 0
    lift = np.linalg.pinv(affine)
    d = np.random.default_rng(seed + 1).multivariate_normal([0.0, 0.0], scale2d, 6)
    s = np.arange(-30.0, 30.0, 0.02)
    points = (d @ lift.T)[:, None, :] + s[:, None] * line
    integral = direct_density(points, scale, slope_3d(scale, delta)).sum(1) * 0.02
    integral /= np.sqrt(np.linalg.det(affine @ affine.T))
    assert relative_error(direct_density(d, scale2d, slope), integral) < 1e-9


@FEW
@given(SEEDS)
def test_low_pass_only_adds_to_the_scale_matrix(seed):
    axes, skew, affine = random_moments(seed, 0.9 * SKEW_MAX)
    scale, delta = direct_form(axes @ axes.T, axes @ skew)
    delta2d, sharp = affine @ delta, affine @ scale @ affine.T + 0.2 * np.eye(2)
    nodes, weights = np.polynomial.hermite.hermgauss(60)
    steps = np.sqrt(2.0 * LOW_PASS) * np.stack(np.meshgrid(nodes, nodes), -1).reshape(-1, 2)
    d = np.random.default_rng(seed + 1).multivariate_normal([0.0, 0.0], sharp, 6)
    blurred = direct_density(d[:, None] - steps, sharp, slope_of(sharp, delta2d)[0])
    blurred = blurred @ np.outer(weights, weights).ravel() / np.pi
    soft = sharp + LOW_PASS * np.eye(2)
    assert relative_error(direct_density(d, soft, slope_of(soft, delta2d)[0]), blurred) < 1e-8


@FEW
@given(SEEDS)
def test_screen_kernel_has_the_gaussian_s_moments(seed):
    """The projection has the projected mean and the covariance A Sigma A' + low-pass, for every skew."""
    arrays = random_splats(seed, 1, 0)
    screen = project(arrays, random_camera(seed), "skew-normal", "pdf")
    gaussian = project(arrays, random_camera(seed), "gaussian")
    root = np.linalg.cholesky(gaussian.kernel.scale2d[0])
    line = np.arange(-13.0, 13.0, 0.05)
    y = np.stack(np.meshgrid(line, line), -1).reshape(-1, 2)
    x = y @ root.T + gaussian.mean_px[0]
    weight = direct_density(x - screen.kernel.location[0], screen.kernel.scale2d[0], screen.kernel.slope[0])
    weight *= np.linalg.det(root) * 0.05**2
    assert weight.sum() == pytest.approx(1.0, abs=1e-8)
    assert np.abs(weight @ y).max() < 1e-8
    assert np.abs((y * weight[:, None]).T @ y - np.eye(2)).max() < 1e-7


@FEW
@given(SEEDS, st.sampled_from(["peak", "pdf", "none"]))
def test_centred_pixel_formula_is_the_direct_form(seed, normalisation):
    """alpha = o/peak exp(-(d'Cd + (2a + t - a²)/(1 + t))/2) Phi(h (a + t)), with quantities relative to the mean."""
    arrays, camera = random_splats(seed, 4, 0), random_camera(seed)
    screen = project(arrays, camera, "skew-normal", normalisation)
    gaussian = project(arrays, camera, "gaussian")
    axes = rotation(arrays["quat"]) * np.exp(arrays["log_scale"])[:, None, :]
    point = arrays["mean"] @ camera.rotation.T + camera.translation
    affine = jacobian(point, camera) @ camera.rotation
    v = np.einsum("bij,bjk,bk->bi", affine, axes, arrays["skew"])
    conic = np.linalg.inv(gaussian.kernel.scale2d)
    u = np.einsum("bij,bj->bi", conic, v)
    t = (u * v).sum(1)[:, None]
    h = np.sqrt(np.pi / 2.0 / ((1.0 + t) * (1.0 - (np.pi / 2.0 - 1.0) * t)))
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    d = np.stack([x.ravel(), y.ravel()], -1) - gaussian.mean_px[:, None]
    a = np.einsum("bpi,bi->bp", d, u)
    q = np.einsum("bpi,bij,bpj->bp", d, conic, d) + (2.0 * a + t - a * a) / (1.0 + t)
    k = np.pi / 2.0 * t / (1.0 + t)
    factor = {"peak": 1.0 / peak(k / (1.0 - k)), "pdf": 2.0, "none": 1.0}[normalisation]
    alpha = factor * gaussian.kernel.amplitude[:, None] * np.exp(-0.5 * q) * ndtr(h * (a + t))
    assert relative_error(alpha_maps(screen, camera, 0.0, np.inf), alpha) < ROUNDING


@FEW
@given(SEEDS)
def test_zero_skew_is_the_gaussian(seed):
    arrays, camera = random_splats(seed, 4, 0), random_camera(seed)
    arrays["skew"][:] = 0.0
    skewed = alpha_maps(project(arrays, camera, "skew-normal"), camera)
    assert relative_error(skewed, alpha_maps(project(arrays, camera, "gaussian"), camera)) < ROUNDING


@FEW
@given(SEEDS)
def test_peak_normalised_splat_reaches_its_opacity(seed):
    """The highest alpha in the plane equals the opacity, on the line through the mode and on a grid."""
    screen = project(random_splats(seed, 1, 0), random_camera(seed), "skew-normal")
    opacity = project(random_splats(seed, 1, 0), random_camera(seed), "gaussian").kernel.amplitude[0]
    conic, slope = inverse_2x2(screen.kernel.scale2d)[0], screen.kernel.slope[0]

    def alpha(d):
        return screen.kernel.amplitude[0] * np.exp(-0.5 * np.einsum("...i,ij,...j", d, conic, d)) * ndtr(d @ slope)

    along = screen.kernel.scale2d[0] @ slope
    along /= np.sqrt(along @ conic @ along)
    best = minimize_scalar(lambda x: -alpha(x * along), bounds=(-1.0, 2.0), method="bounded")
    assert -best.fun == pytest.approx(opacity, rel=1e-9)
    line = np.arange(-4.0, 4.0, 0.02)
    plane = np.stack(np.meshgrid(line, line), -1).reshape(-1, 2) @ np.linalg.cholesky(screen.kernel.scale2d[0]).T
    assert opacity * (1.0 - 2e-3) < alpha(plane).max() <= opacity * (1.0 + 1e-12)


def test_peak_is_the_highest_value_of_a_dense_search():
    """The peak is also 1/2 for slope 0, and 1/2 + c/(2 pi) to first order."""
    slopes = np.array([0.0, 0.25, 0.5, 1.0, 2.0, 3.0, 5.0, 8.0, 10.0])
    x = np.linspace(0.0, 1.0, 200_001)
    dense = [(np.exp(-0.5 * x * x) * ndtr(slope * x)).max() for slope in slopes]
    assert np.abs(peak(slopes**2) - dense).max() < 1e-10
    assert peak(np.array([1e-6]))[0] - 0.5 == pytest.approx(1e-6 / (2.0 * np.pi), rel=1e-5)


def test_peak_s_complex_step_is_its_derivative():
    c = np.array([1e-3, 0.1, 1.0, 10.0, 60.0])
    h = 1e-4 * c
    difference = (peak(c + h) - peak(c - h)) / (2.0 * h)
    assert np.abs(peak(c + 1e-20j).imag / 1e-20 / difference - 1.0).max() < 1e-7
    assert peak(np.array([0.0 + 1e-20j])).imag[0] / 1e-20 == pytest.approx(1.0 / (2.0 * np.pi), rel=1e-12)


def test_normal_cdf_s_complex_step_is_that_of_the_complex_function():
    x = np.linspace(-6.0, 6.0, 49) + 1e-9j
    entire = 0.5 * erfc(-x / np.sqrt(2.0))
    assert np.abs(normal_cdf(x).imag / entire.imag - 1.0).max() < 1e-9
    assert np.abs(normal_cdf(x).real / entire.real - 1.0).max() < 1e-9


@FEW
@given(SEEDS)
def test_rotation_is_scipy_s(seed):
    quat = random_splats(seed, 5)["quat"]
    assert np.abs(rotation(quat) - Rotation.from_quat(quat[:, [1, 2, 3, 0]]).as_matrix()).max() < 1e-14


def test_sh_basis_is_built_from_legendre_functions():
    """Y_lm = sqrt(2) K P_l^m(cos theta) cos(m phi), with sin(|m| phi) for m < 0. P has the Condon-Shortley phase."""
    direction = np.random.default_rng(5).normal(size=(40, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    phi = np.arctan2(direction[:, 1], direction[:, 0])
    want = []
    for degree in range(4):
        for m in range(-degree, degree + 1):
            n = abs(m)
            ratio = factorial(degree - n) / factorial(degree + n)
            legendre = np.sqrt((2 * degree + 1) / (4.0 * np.pi) * ratio) * lpmv(n, degree, direction[:, 2])
            wave = np.sqrt(2.0) * (np.cos(m * phi) if m > 0 else np.sin(n * phi)) if m else 1.0
            want.append(legendre * wave)
    for degree in range(4):
        got = sh_basis(direction, degree)
        assert got.shape == (40, (degree + 1) ** 2)
        assert np.abs(got - np.stack(want, -1)[:, : got.shape[1]]).max() < 1e-14


def test_jacobian_is_the_projection_s_derivative_within_the_clamp():
    camera = random_camera()
    point = np.array([[0.1, -0.2, 2.0], [-0.3, 0.25, 1.5]])
    for axis in range(3):
        z = point + 1e-20j * np.eye(3)[axis]
        pixel = z[:, :2] / z[:, 2:] * [camera.fx, camera.fy] + [camera.cx, camera.cy]
        assert np.abs(jacobian(point, camera)[:, :, axis] - pixel.imag / 1e-20).max() < 1e-13


def test_jacobian_s_tangent_is_clamped_at_the_margin():
    camera = random_camera()
    margin = CLAMP_MARGIN * 0.5 * camera.width / camera.fx
    left, right = -camera.cx / camera.fx - margin, (camera.width - camera.cx) / camera.fx + margin
    got = jacobian(np.array([[-9.0, 0.0, 2.0], [9.0, 0.0, 2.0]]), camera)[:, 0, 2]
    assert got == pytest.approx([-camera.fx * left / 2.0, -camera.fx * right / 2.0])


def test_long_skews_are_shortened_in_their_direction():
    skew = np.array([[3.0, -4.0, 0.0], [0.3, 0.1, -0.2], [0.0, 0.0, 0.0]])
    want = np.array([[0.6 * SKEW_MAX, -0.8 * SKEW_MAX, 0.0], skew[1], skew[2]])
    assert np.abs(bounded(skew) - want).max() < 1e-15
