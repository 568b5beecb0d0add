"""Kernels that depend on q alone obey their laws: student-t, generalised exponential and GES's modulation.

test_renderer.py and test_gradients.py also compare images and gradients of these shapes with the reference.
"""

from __future__ import annotations

from functools import cache, cached_property

import numpy as np
import pytest
from conftest import MakeRenderer
from kernel_checks import BACKGROUND, SMOOTH, Arrays, Case
from numpy.typing import NDArray
from reference.formulas import rotation
from reference.radial import RADIAL
from reference.renderer import prepared, project
from reference.scenes import for_shape, random_camera, random_splats
from reference.tolerances import DIFFERENCES, GRADIENT_FLOAT32, IMAGE_FLOAT32, ROUNDING, SAME_FLOAT32, relative_error
from rendering.test_footprint import kernel_boxes

from clsplat.cameras.camera import Camera
from clsplat.device.device import Device
from clsplat.device.memory import to_device, to_host
from clsplat.device.program import build_text, source
from clsplat.device.schedule import default_schedule
from clsplat.rendering.build import ALPHA_MAX, ALPHA_MIN
from clsplat.rendering.renderer import Renderer
from clsplat.splats.low_pass import LOW_PASS
from clsplat.splats.shapes import BETA_BOUNDS, NU_BOUNDS, SHAPES
from clsplat.splats.splats import Splats

EVERY = pytest.mark.parametrize("shape", RADIAL)
PEAKED_TO_FLAT = np.geomspace(*BETA_BOUNDS, 9)
HEAVY_TO_GAUSSIAN = np.geomspace(*NU_BOUNDS, 9)
OWN = {
    "student-t": ("nu", HEAVY_TO_GAUSSIAN),
    "generalised-exponential": ("beta", PEAKED_TO_FLAT),
    "ges-modulation": ("beta", PEAKED_TO_FLAT),
}
FACING = Camera(31, 23, 300.0, 300.0, 15.3, 11.6, np.eye(4))


def one_splat(shape: str, opacity: float = 0.8, **fields: object) -> Arrays:
    """A splat of `shape` about 4 pixels wide on the axis of FACING. `fields` replace its default values."""
    arrays = random_splats(4, 1, 0)
    arrays["mean"], arrays["log_scale"] = np.array([[0.0, 0.0, 5.0]]), np.log([[0.05, 0.09, 0.07]])
    arrays = for_shape(arrays, shape)
    arrays["opacity_logit"] = np.atleast_1d(SHAPES[shape].raw_opacity(np.float64(opacity)))
    for name, value in fields.items():
        arrays[name] = np.broadcast_to(np.asarray(value, np.float64), arrays[name].shape).copy()
    return arrays


def render(renderer: Renderer, shape: str, arrays: Arrays, camera: Camera = FACING) -> NDArray[np.float64]:
    """Return alpha (H, W), over a black background."""
    return np.float64(renderer.render(Splats(shape, arrays), camera).alpha)


# ---- logarithms --------------------------------------------------------------------------------------------

LOGARITHMS = """
kernel void logarithms(global const real *restrict x, global real *restrict out, uint n) {
    const uint i = get_global_id(0) * LANES;
    if (i >= n) return;
    const vreal v = lanes_load(x + i), log_1p = lanes_log1p(v);
    lanes_store(lanes_log(v), out + i);
    lanes_store(log_1p, out + n + i);
    lanes_store(lanes_log1p_gap(v, log_1p - v / ((vreal)1 + v)), out + 2 * n + i);
}
"""


@pytest.mark.parametrize("lanes", [1, 8, 16])
def test_logarithms_in_float32(device: Device, lanes: int) -> None:
    """Check relative errors. log(x) is near x - 1 at 1, up to rounding; log(1+x) - x/(1+x) is near x^2/2 at 0."""
    x = np.float32(np.concatenate([np.geomspace(1e-30, 1e30, 8000), np.geomspace(0.5, 2.0, 8192)]))
    program = build_text(device, source("math/lanes.clh", "math/approx.clh") + LOGARITHMS, {"LANES": lanes})
    buffers = [device.alloc(size) for size in (x.nbytes, 3 * x.nbytes)]
    to_device(device, buffers[0], x)
    program.logarithms((len(x) // lanes,), None, x=buffers[0], out=buffers[1], n=len(x))
    log, log1p, gap = to_host(device, buffers[1], np.empty((3, len(x)), np.float32)).astype(np.float64)
    exact = x.astype(np.float64)
    assert np.abs(log - np.log(exact)).max() <= 1e-7 * np.abs(np.log(exact)).max()
    near_1 = np.abs(exact - 1.0) < 0.4
    assert np.abs(log / np.where(exact == 1.0, 1.0, np.log(exact)) - 1.0)[near_1 & (exact != 1.0)].max() < 2.5e-7
    assert np.abs(log1p / np.log1p(exact) - 1.0).max() < 2.5e-7
    visible = (exact > 1e-12) & (exact < 1e4)
    small = exact < 1e-3
    want = np.where(small, exact**2 * (0.5 - exact * (2 / 3 - 0.75 * exact)), np.log1p(exact) - exact / (1.0 + exact))
    assert np.abs(gap / want - 1.0)[visible].max() < 3e-5


# ---- student-t ---------------------------------------------------------------------------------------------


@pytest.mark.parametrize("nu", [1.0, 2.5, 30.0, 1e4])
def test_student_t_is_the_line_integral_of_its_3d_kernel(
    make_renderer: MakeRenderer, device: Device, nu: float
) -> None:
    """Return (1 + q3/nu)^-((nu+3)/2) integrated along z, relative to the integral through the centre.

    On the axis, the linearised projection is f/z times x and y. The low-pass belongs to the 3D scale matrix.
    """
    arrays = one_splat("student-t", nu=nu)
    axes = rotation(arrays["quat"])[0] * np.exp(arrays["log_scale"][0])
    scale = axes @ axes.T
    to_px = FACING.fx / 5.0
    scale[:2, :2] += LOW_PASS / to_px**2 * np.eye(2)
    inverse = np.linalg.inv(scale)
    y, x = np.mgrid[: FACING.height, : FACING.width] + 0.5
    across = np.stack([x.ravel() - FACING.cx, y.ravel() - FACING.cy]) / to_px
    across = np.concatenate([across, [[0.0], [0.0]]], axis=1)  # the last one passes through the centre

    # q3 = least + inverse_zz (z - z_least)^2. The substitution z - z_least = width sinh(t) makes the integrand decay
    # doubly exponentially.
    least = np.einsum("ip,ij,jp->p", across, np.linalg.inv(scale[:2, :2]), across)
    t, step = np.linspace(-14.0, 14.0, 1401, retstep=True)
    width = np.sqrt(1.0 / inverse[2, 2])
    q3 = least[:, None] + inverse[2, 2] * (width * np.sinh(t)) ** 2
    integral = np.sum(np.exp(-0.5 * (nu + 3.0) * np.log1p(q3 / nu)) * np.cosh(t), axis=1) * step
    want = 0.8 * integral[:-1] / integral[-1]
    got = render(make_renderer(device, "float64", **SMOOTH), "student-t", arrays)
    assert np.abs(got.ravel() - want).max() < 1e-10


@pytest.mark.parametrize("nu", [1.5, 3.0, 30.0, 100.0, 3000.0])
def test_the_derivative_of_nu_changes_its_sign(make_renderer: MakeRenderer, device: Device, nu: float) -> None:
    """As nu grows, the shoulders hold more mass and the tails less. Differences and the gradient both show it."""
    double, single = (make_renderer(device, precision, **SMOOTH) for precision in ("float64", "float32"))
    steps = [(k, render(double, "student-t", one_splat("student-t", nu=nu * (1.0 + 1e-3 * k)))) for k in (-2, -1, 1, 2)]
    weights = {-2: 1, -1: -8, 1: 8, 2: -1}
    want = sum(weights[k] * image for k, image in steps) / (12.0 * 1e-3 * nu)
    size = np.abs(want).max()
    assert want.max() > 0.2 * size
    assert want.min() < -0.01 * size
    picked = [np.unravel_index(place, want.shape) for place in (want.argmax(), want.argmin(), np.abs(want).argmin())]
    for renderer, tolerance in ((double, DIFFERENCES), (single, GRADIENT_FLOAT32)):
        render(renderer, "student-t", one_splat("student-t", nu=nu))
        for pixel in picked:
            v_alpha = np.zeros(want.shape)
            v_alpha[pixel] = 1.0
            got = renderer.backward(np.zeros((*want.shape, 3)), v_alpha)["nu"][0]
            assert abs(got - want[pixel]) < tolerance * size


def test_negative_alpha_is_clamped_cut_off_and_takes_light_away(make_renderer: MakeRenderer, device: Device) -> None:
    """Transmittance rises above 1, to at most 1.99 for one splat. The splat brightens everything behind it."""
    renderer = make_renderer(device, "float64")
    hole = one_splat("student-t", -(1.0 - 1e-9), nu=3.0)
    alpha = render(renderer, "student-t", hole)
    raw = render(make_renderer(device, "float64", **SMOOTH), "student-t", hole)
    assert raw.min() < -ALPHA_MAX
    assert alpha.min() == -ALPHA_MAX
    assert np.array_equal(alpha == 0.0, np.abs(raw) < ALPHA_MIN)
    assert (alpha == 0.0).any()
    clamped = np.clip(raw, -ALPHA_MAX, ALPHA_MAX)
    assert np.abs(alpha - clamped)[alpha != 0.0].max() < ROUNDING

    front, back = one_splat("student-t", -0.7, nu=3.0), one_splat("student-t", 0.6, nu=20.0, mean=[0.0, 0.0, 5.5])
    both = {name: np.concatenate([front[name], back[name]]) for name in front}
    image = renderer.render(Splats("student-t", both), FACING, BACKGROUND)
    before = 1.0 - render(renderer, "student-t", front)
    behind = render(renderer, "student-t", back)
    assert before.max() > 1.6
    assert np.abs(1.0 - image.alpha - before * (1.0 - behind)).max() < ROUNDING


@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_stacks_of_both_signs_agree_with_the_reference(
    make_renderer: MakeRenderer, device: Device, precision: str
) -> None:
    """Test saturated opacities of both signs, transmittances far above 1, and pixels that finish."""
    arrays = for_shape(random_splats(3, 40, 1), "student-t")
    arrays["opacity_logit"] = np.where(np.arange(40) % 3, 1.0, -1.0) * np.tile([0.2, 1.0, 2.8, 3.5], 10)
    arrays["mean"] *= 0.5
    arrays["log_scale"] += 1.0
    case = SignedCase(arrays, random_camera(3, 25, 19), "student-t", dtype=np.dtype(precision).type)
    assert case.image.alpha.min() < -0.5
    assert case.image.alpha.max() > 0.9
    tolerances = (ROUNDING, 1e-8) if precision == "float64" else (10 * IMAGE_FLOAT32, GRADIENT_FLOAT32)
    case.check(make_renderer(device, precision), *tolerances)


class SignedCase(Case):
    """A case whose opacities already have their signs."""

    @cached_property
    def values(self) -> Arrays:
        return {name: value.astype(self.dtype) for name, value in self.arrays.items()}


def test_an_opacity_of_zero_has_a_gradient(make_renderer: MakeRenderer, device: Device) -> None:
    """At opacity 0 the sign changes: alpha is 0 and its derivative is the kernel."""
    renderer = make_renderer(device, "float64", **SMOOTH)
    full = render(renderer, "student-t", one_splat("student-t", 0.5, nu=4.0))
    assert not render(renderer, "student-t", one_splat("student-t", 0.0, nu=4.0)).any()
    got = renderer.backward(np.zeros((*full.shape, 3)), np.ones(full.shape))
    assert got["opacity_logit"][0] == pytest.approx(full.sum() / 0.5, rel=1e-12)
    assert not got["nu"].any()


# ---- neutral values, cusps, sizes --------------------------------------------------------------------------


@EVERY
def test_neutral_values_are_the_gaussian(make_renderer: MakeRenderer, device: Device, shape: str) -> None:
    """At nu = 1e4 they differ by |alpha| (q^2/4 - q) / nu < 1e-4, and at beta = 2 only by rounding."""
    field = SHAPES[shape].fields[0]
    arrays, camera = random_splats(2, 24, 1), random_camera(2, 41, 27)
    gaussian = Splats("gaussian", {name: arrays[name] for name in ("mean", "quat", "log_scale", "opacity_logit", "sh")})
    arrays = for_shape({**arrays, field.name: np.full(24, field.neutral[0])}, shape)
    arrays["opacity_logit"] = SHAPES[shape].raw_opacity(SHAPES["gaussian"].opacity(gaussian.opacity_logit))
    for precision, tolerance in (("float32", SAME_FLOAT32), ("float64", 1e-12)):
        renderer = make_renderer(device, precision, **SMOOTH)  # a pixel at a threshold would change abruptly
        want = renderer.render(gaussian, camera, BACKGROUND).color
        got = renderer.render(Splats(shape, arrays), camera, BACKGROUND).color
        assert np.abs(got - want).max() < (1e-4 if shape == "student-t" else tolerance)


def test_modulation_is_the_gaussian_of_other_scales(make_renderer: MakeRenderer, device: Device) -> None:
    arrays, camera = for_shape(random_splats(2, 24, 1), "ges-modulation"), random_camera(2, 41, 27)
    factor = 2.0 / (1.0 + np.exp(-0.1 * (arrays["beta"] - 2.0)))
    assert factor.min() < 0.95
    assert factor.max() > 1.2
    scaled = {**arrays, "log_scale": arrays["log_scale"] + np.log(factor)[:, None]}
    del scaled["beta"]
    renderer = make_renderer(device, "float64")
    got = renderer.render(Splats("ges-modulation", arrays), camera, BACKGROUND)
    want = renderer.render(Splats("gaussian", scaled), camera, BACKGROUND)
    assert np.abs(got.color - want.color).max() < 1e-12
    v_color = np.random.default_rng(0).normal(size=want.color.shape)
    gradients = renderer.backward(v_color)
    renderer.render(Splats("ges-modulation", arrays), camera, BACKGROUND)
    for name, value in renderer.backward(v_color).items():
        if name == "beta":  # beta acts as all three log scales together
            by_beta = gradients["log_scale"].sum(1) * 0.1 * (1.0 - 0.5 * factor)
            assert relative_error(value, by_beta) < ROUNDING
        else:
            assert relative_error(value, gradients[name]) < ROUNDING, name


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("beta", [0.5, 1.0, 1.9, 2.0, 8.0])
def test_nothing_breaks_at_the_centre(make_renderer: MakeRenderer, device: Device, beta: float, precision: str) -> None:
    """At a pixel exactly on the mean, alpha is the opacity. Only the opacity has a gradient there."""
    camera = Camera(3, 3, 300.0, 300.0, 1.5, 1.5, np.eye(4))
    renderer = make_renderer(device, precision)
    alpha = render(renderer, "generalised-exponential", one_splat("generalised-exponential", beta=beta), camera)
    assert alpha[1, 1] == pytest.approx(0.8, rel=1e-6)
    v_alpha = np.zeros((3, 3))
    v_alpha[1, 1] = 1.0
    for name, value in renderer.backward(np.zeros((3, 3, 3)), v_alpha).items():
        want = 0.16 if name == "opacity_logit" else 0.0
        assert np.abs(value - want).max() < 1e-5, name


# ---- boxes -------------------------------------------------------------------------------------------------


def of_every_falloff(shape: str, n: int) -> Arrays:
    """Splats of every opacity above the cutoff (many just above it), with nu or beta over its whole range."""
    rng = np.random.default_rng(8)
    name, values = OWN[shape]
    arrays = random_splats(8, n, 3)
    arrays = for_shape({**arrays, name: np.resize(values, n)}, shape)
    opacity = np.exp(rng.uniform(np.log(1.02 * ALPHA_MIN), np.log(0.99), n))
    if SHAPES[shape].signed:
        opacity *= np.where(np.arange(n) % 2, 1.0, -1.0)
    arrays["opacity_logit"] = SHAPES[shape].raw_opacity(opacity)
    return arrays


@cache
def single_splats(shape: str, dtype: type) -> list[SignedCase]:
    """One splat per image, so that no other splat hides a missing pixel. Tile borders cross the splats anywhere."""
    many = of_every_falloff(shape, 54)
    many["log_scale"] -= 1.0
    ones = [{name: value[i : i + 1] for name, value in many.items()} for i in range(54)]
    return [SignedCase(one, random_camera(i, 53, 39), shape, dtype=dtype) for i, one in enumerate(ones)]


@EVERY
@pytest.mark.parametrize(("precision", "tolerance"), [("float32", IMAGE_FLOAT32), ("float64", ROUNDING)])
def test_no_pixel_is_lost(
    make_renderer: MakeRenderer, device: Device, shape: str, precision: str, tolerance: float
) -> None:
    """A lost pixel would be an error of at least 1/255 in alpha."""
    renderer, covered = make_renderer(device, precision), 0
    for case in single_splats(shape, np.dtype(precision).type):
        case.check_image(case.render(renderer), tolerance)
        covered += np.count_nonzero(case.image.alpha)
    assert covered > 54 * 20


@EVERY
def test_boxes_are_exact(device: Device, shape: str) -> None:
    """Level sets are ellipses q = const. Bisection of the falloff gives their size, and boxes are no larger."""
    n, size = 180, 1024
    arrays = of_every_falloff(shape, n)
    arrays["mean"] *= 0.2
    arrays["log_scale"] -= 2.5
    pose = np.eye(4)
    pose[2, 3] = 4.0
    camera = Camera(size, size, 1.0 * size, 1.1 * size, 0.52 * size, 0.49 * size, pose)
    kernel = project(prepared(arrays, shape), camera, shape).kernel
    low, high = np.zeros((n, 1)), np.full((n, 1), 1e5)
    for _ in range(80):
        q = 0.5 * (low + high)
        inside = np.abs(kernel.amplitude[:, None]) * kernel.falloff(q) >= ALPHA_MIN
        low, high = np.where(inside, q, low), np.where(inside, high, q)
    reach = np.sqrt(low * np.diagonal(kernel.scale2d, axis1=1, axis2=2))
    first, last = kernel.location - reach, kernel.location + reach
    inner = (reach[:, 1] < 500.0) & (first > 1.0).all(1) & (last < size - 1.0).all(1)
    assert inner.mean() > 0.6
    some = inner & (np.floor(last - 0.5) >= np.ceil(first - 0.5)).all(1)
    written = (
        inner if default_schedule(device.info).lanes > 1 else some
    )  # a splat without a pixel has no record of its own
    rows, tiles = kernel_boxes(device, shape, arrays, camera)
    slack = 1e-5 * np.maximum(reach, 100.0)  # float32 rounding of an extent [px]
    assert (rows[:, 0] <= np.ceil(first[:, 1] - 0.5 + slack[:, 1]))[written].all()
    assert (rows[:, 1] >= np.floor(last[:, 1] - 0.5 - slack[:, 1]))[written].all()
    assert (rows[:, 0] >= np.ceil(first[:, 1] - 0.5 - slack[:, 1]))[written].all()
    assert (rows[:, 1] <= np.floor(last[:, 1] - 0.5 + slack[:, 1]))[written].all()
    exact = np.ceil(first[:, 0] - 0.5) // 16, np.floor(last[:, 0] - 0.5) // 16 + 1
    columns = np.abs(tiles[:, 0] - exact[0])[some], np.abs(tiles[:, 2] - exact[1])[some]
    assert np.count_nonzero(columns) <= 2  # a tile border may lie within rounding
