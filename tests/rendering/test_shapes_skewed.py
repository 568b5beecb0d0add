"""Each skewed or two-sided shape is the projection of its 3D kernel, and the shapes are limits of one another."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import MakeRenderer
from kernel_checks import BACKGROUND, Arrays, Case
from numpy.typing import NDArray
from reference import shape as reference_shape
from reference import skewed as reference_skewed
from reference.formulas import jacobian
from reference.renderer import axes_of, kernel_values, project, projected_point, render_reference
from reference.scenes import for_shape, random_camera, random_splats
from reference.tolerances import GRADIENT_FLOAT32, IMAGE_FLOAT32, ROUNDING, relative_error
from scipy.special import ndtr

from clsplat.cameras.camera import Camera
from clsplat.device.device import Device
from clsplat.splats.shapes import SLANT_MAX
from clsplat.splats.splats import Splats

SIDED = pytest.mark.parametrize("shape", ["skew-normal-direct", "half-gaussian", "bisected-skew"])
SEEDS = pytest.mark.parametrize("seed", range(5))
Reals = NDArray[np.float64]


def one_splat(seed: int, shape: str) -> Arrays:
    """A splat whose two sides differ."""
    arrays = random_splats(seed, 2, 0)
    arrays["opacity_logit"] = np.array([1.5, -1.0])
    return {name: value[:1] for name, value in for_shape(arrays, shape).items()}


def side_of(arrays: Arrays, shape: str) -> tuple[Reals, Reals, Reals]:
    """Return both sides' opacities, and the vector in the splat's unit frame that points to the first side."""
    plus = 1.0 / (1.0 + np.exp(-arrays["opacity_logit"][0]))
    if shape == "skew-normal-direct":
        return plus, 0.0, arrays["skew"][0]
    minus = 1.0 / (1.0 + np.exp(-arrays["opacity_minus_logit"][0]))
    return plus, minus, arrays["normal" if shape == "half-gaussian" else "skew"][0]


@SIDED
@SEEDS
def test_screen_kernel_is_the_integral_along_rays(monkeypatch: pytest.MonkeyPatch, shape: str, seed: int) -> None:
    """Screen kernels are integrals of the 3D kernel exp(-y'y/2) (o_minus + (o_plus - o_minus) Phi(eta'y)) along rays.

    The rays are parallel, and y is in the unit frame. The half-Gaussian has a step at n'y = 0 in place of Phi.
    Integrals are relative to the Gaussian's integral through the location.
    """
    monkeypatch.setattr(reference_shape, "LOW_PASS", 0.0)
    arrays, camera = one_splat(seed, shape), random_camera(seed)
    world, axes = projected_point(arrays, shape), axes_of(arrays)[0]
    affine = (jacobian(world @ camera.rotation.T + camera.translation, camera) @ camera.rotation)[0]
    kernel = project(arrays, camera, shape, "none").kernel
    d = np.random.default_rng(seed).multivariate_normal([0.0, 0.0], kernel.scale2d[0], 8)
    got = kernel_values(kernel, kernel.location[0][:, None] + d.T)[0]

    start = d @ np.linalg.pinv(affine).T @ np.linalg.inv(axes).T  # points and direction of the rays in the unit frame
    line = np.linalg.inv(axes) @ np.linalg.svd(affine)[2][2]
    line /= np.linalg.norm(line)
    plus, minus, along = side_of(arrays, shape)
    nodes, weights = np.polynomial.legendre.leggauss(400)
    want = []
    for y0 in start:
        middle = -y0 @ line
        crossing = np.clip(-(along @ y0) / (along @ line), middle - 9.0, middle + 9.0)
        total = 0.0
        for low, high in ((middle - 9.0, crossing), (crossing, middle + 9.0)):
            y = y0 + (0.5 * (low + high) + 0.5 * (high - low) * nodes)[:, None] * line
            above = np.heaviside(y @ along, 0.5) if shape == "half-gaussian" else ndtr(y @ along)
            density = np.exp(-0.5 * (y * y).sum(1)) * (minus + (plus - minus) * above)
            total += 0.5 * (high - low) * (weights * density).sum()
        want.append(total / np.sqrt(2.0 * np.pi))
    assert relative_error(got, want) < 1e-9


@SIDED
@SEEDS
def test_low_pass_is_a_convolution(monkeypatch: pytest.MonkeyPatch, shape: str, seed: int) -> None:
    """The low-pass convolves with the normal of its variance, scaled so that the peak of a Gaussian stays 1."""
    arrays, camera = one_splat(seed, shape), random_camera(seed)
    arrays["log_scale"] = arrays["log_scale"] + 1.0
    soft = project(arrays, camera, shape, "none").kernel
    nodes, weights = np.polynomial.hermite.hermgauss(120)
    steps = np.sqrt(2.0 * reference_shape.LOW_PASS) * np.stack(np.meshgrid(nodes, nodes)).reshape(2, -1)
    monkeypatch.setattr(reference_shape, "LOW_PASS", 0.0)
    sharp = project(arrays, camera, shape, "none").kernel
    d = np.random.default_rng(seed).multivariate_normal([0.0, 0.0], soft.scale2d[0], 6)
    for point in soft.location[0] + d:
        blurred = kernel_values(sharp, point[:, None] - steps)[0] @ np.outer(weights, weights).ravel() / np.pi
        blurred *= np.sqrt(np.linalg.det(soft.scale2d[0]) / np.linalg.det(sharp.scale2d[0]))
        assert kernel_values(soft, point[:, None])[0, 0] == pytest.approx(blurred, abs=1e-6)


# ---- limits ----------------------------------------------------------------------------------------------------


def images(shape: str, arrays: Arrays, camera: Camera, normalisation: str = "peak") -> Reals:
    """Return the alphas of each splat alone, (N, H W), without thresholds."""
    kernel = project(arrays, camera, shape, normalisation).kernel
    y, x = np.mgrid[: camera.height, : camera.width] + 0.5
    return kernel_values(kernel, np.stack([x.ravel(), y.ravel()]))


def scene(shape: str, **fields: object) -> Arrays:
    arrays = for_shape(random_splats(3, 12, 1), shape)
    for name, value in fields.items():
        arrays[name] = np.broadcast_to(np.asarray(value, np.float64), arrays[name].shape).copy()
    return arrays


@pytest.mark.parametrize("shape", ["half-gaussian", "bisected-skew"])
def test_equal_opacities_are_the_gaussian(make_renderer: MakeRenderer, device: Device, shape: str) -> None:
    camera, arrays = random_camera(3, 41, 27), scene(shape)
    arrays["opacity_minus_logit"] = arrays["opacity_logit"].copy()
    gaussian = {name: arrays[name] for name in ("mean", "quat", "log_scale", "opacity_logit", "sh")}
    want = render_reference(gaussian, camera, "gaussian", background=BACKGROUND)
    case = Case(arrays, camera, "gaussian")
    splats = Splats(shape, {name: value.astype(np.float32) for name, value in arrays.items()})
    got = make_renderer(device).render(splats, camera, BACKGROUND)
    assert np.abs(got.color - want.color)[case.decided].max() < IMAGE_FLOAT32


def test_bisected_skew_of_one_side_is_the_direct_skew_normal() -> None:
    """The published form has normalisation `none`.

    The camera is far away, as one shape is linearised at the location and the other at the centroid.
    """
    near = random_camera(3, 41, 27)
    pose = near.cam_from_world.copy()
    pose[2, 3] += 4e6
    zoom = pose[2, 3] / near.cam_from_world[2, 3]
    camera = Camera(41, 27, near.fx * zoom, near.fy * zoom, near.cx, near.cy, pose)
    direct = scene("skew-normal-direct")
    bisected = {**direct, "opacity_minus_logit": np.full(12, -60.0)}
    want = images("skew-normal-direct", direct, camera, "none")
    assert np.abs(images("bisected-skew", bisected, camera) - want).max() < 2e-6
    assert np.abs(images("skew-normal-direct", direct, camera, "peak") - want).max() > 0.1


def test_growing_slants_converge_to_the_half_gaussian(monkeypatch: pytest.MonkeyPatch) -> None:
    """The difference falls as the square of the slant, the width of the band. The reference's bound is lifted."""
    monkeypatch.setattr(reference_skewed, "SLANT_MAX", 1e9)
    camera, half = random_camera(3, 41, 27), scene("half-gaussian")
    want = images("half-gaussian", half, camera)
    normal = half["normal"] / np.linalg.norm(half["normal"], axis=1, keepdims=True)
    errors = []
    for length in (10.0, 100.0, 1000.0):
        bisected = {**half, "skew": length * normal}
        errors.append(np.abs(images("bisected-skew", bisected, camera) - want).max())
    assert errors[0] > 1e-4
    assert errors[1] < 0.03 * errors[0]
    assert errors[2] < 0.03 * errors[1]


@SIDED
def test_sides_are_those_of_the_field(shape: str) -> None:
    """Seen from the side, alpha is higher on the side that the vector points to."""
    camera = Camera(41, 27, 400.0, 400.0, 20.5, 13.5, np.eye(4))
    arrays = one_splat(0, shape)
    arrays |= {
        "mean": np.array([[0.0, 0.0, 20.0]]),
        "quat": np.array([[1.0, 0.0, 0.0, 0.0]]),
        "log_scale": np.full((1, 3), -1.2),
        "opacity_logit": np.array([2.0]),
    }
    arrays |= {name: np.array([[5.0, 0.0, 0.0]]) for name in ("skew", "normal") if name in arrays}
    if "opacity_minus_logit" in arrays:
        arrays["opacity_minus_logit"] = np.array([-2.0])
    alpha = render_reference(arrays, camera, shape).alpha
    assert alpha[13, 23] > 3.0 * alpha[13, 17]
    want = 1.0 / (1.0 + np.exp(-2.0))
    assert alpha.max() == pytest.approx(want, abs=0.1)


def test_long_slants_act_as_the_bound(make_renderer: MakeRenderer, device: Device) -> None:
    """The kernel limits the slant itself, because training may exceed the bound in float32's last digits."""
    camera, arrays = random_camera(3, 41, 27), scene("bisected-skew")
    unit = arrays["skew"] / np.linalg.norm(arrays["skew"], axis=1, keepdims=True)
    renderer = make_renderer(device, "float64")
    drawn = [
        renderer.render(Splats("bisected-skew", {**arrays, "skew": unit * SLANT_MAX * factor}), camera).color
        for factor in (1.0, 1.0 + 9e-6)
    ]
    assert np.abs(drawn[0] - drawn[1]).max() < ROUNDING
    gradient = renderer.backward(np.ones((27, 41, 3)))["skew"]
    assert np.abs((gradient * unit).sum(1)).max() < ROUNDING * np.abs(gradient).max()
    assert np.abs(gradient).max() > 1e-3


@pytest.mark.parametrize("shape", ["skew-normal", "skew-normal-direct"])
def test_splats_without_skew_take_the_short_way_and_get_the_same(
    device: Device, make_renderer: MakeRenderer, shape: str
) -> None:
    """Half of the splats have no skew. The reference has one formula for all splats, and the results are equal."""
    arrays = random_splats(11, 16, 2)
    arrays["skew"][::2] = 0.0
    case = Case(arrays, random_camera(11, 37, 29), shape)
    case.check(make_renderer(device), IMAGE_FLOAT32, GRADIENT_FLOAT32)
