"""Forms of exp and Phi: each within its error, a Phi with the gradient of its own image; colour in half precision."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import MakeRenderer
from kernel_checks import BACKGROUND, SMOOTH, Case
from reference.scenes import random_camera, random_splats

from clsplat.device.device import SCHEDULES, Device, Schedule
from clsplat.errors import DeviceError, InputError
from clsplat.rendering.arithmetic import EXP_FORMS, PHI_FORMS, Arithmetic
from clsplat.rendering.renderer import Renderer
from clsplat.splats.splats import Splats

# Most that a pixel of a few splats may be off in double, some times the form's own error.
IMAGE_ERRORS = {"logistic-cubic": 1e-3, "tanh": 1e-3, "logistic": 0.05}
FORMS = [Arithmetic(phi=form) for form in PHI_FORMS[1:]]


def case(dtype: type = np.float64) -> Case:
    camera = random_camera(2, 41, 27)
    return Case(random_splats(2, 12, 3), camera, "skew-normal", dtype=dtype, thresholds=SMOOTH)


@pytest.mark.parametrize(
    "form", [pytest.param(form, marks=() if form.phi == "logistic" else pytest.mark.slow) for form in FORMS], ids=str
)
def test_a_form_has_the_gradient_of_its_own_image(device: Device, form: Arithmetic) -> None:
    """In double, along one direction of all parameters."""
    c = case()
    renderer = Renderer(device, "float64", arithmetic=form, **SMOOTH)
    exact = Renderer(device, "float64", **SMOOTH).render(c.splats, c.camera, BACKGROUND).color
    own = renderer.render(c.splats, c.camera, BACKGROUND).color
    error = np.abs(own - exact).max()
    if form.phi == "erfc":
        assert error < 1e-14
    else:
        bound = IMAGE_ERRORS[form.phi]
        assert bound / 3000 < error < bound, "as coarse as it says, and no more"
    v_color, v_alpha = c.weights
    rng = np.random.default_rng(3)
    direction = {name: rng.normal(size=value.shape) for name, value in c.values.items()}
    losses = []
    for step in (1e-5, -1e-5):
        moved = Splats(c.shape, {name: value + step * direction[name] for name, value in c.values.items()})
        image = renderer.render(moved, c.camera, BACKGROUND)
        losses.append((v_color * image.color).sum() + (v_alpha * image.alpha).sum())
    renderer.render(c.splats, c.camera, BACKGROUND)
    grads = renderer.backward(v_color, v_alpha)
    want = (losses[0] - losses[1]) / 2e-5
    assert abs(sum((grads[name] * direction[name]).sum() for name in grads) - want) < 1e-6 * abs(want)


@pytest.mark.slow
@pytest.mark.parametrize(("form", "error"), list(zip(EXP_FORMS[1:], (1e-5, 2e-4, 0.02), strict=True)))
def test_forms_of_exp_are_close(device: Device, form: str, error: float) -> None:
    c = case(np.float32)
    exact = Renderer(device, "float64").render(c.splats, c.camera, BACKGROUND).color
    for schedule in ("cpu16", "scalar"):
        renderer = Renderer(device, schedule=SCHEDULES[schedule], arithmetic=Arithmetic(exp=form))
        got = renderer.render(c.splats, c.camera, BACKGROUND)
        assert np.abs(got.color - exact).max() < error, schedule


def test_colour_in_half_precision_is_that_of_rounded_coefficients(device: Device) -> None:
    c = case(np.float32)
    values = dict(c.values)
    values["sh"] = values["sh"].astype(np.float16).astype(np.float32)
    want = Renderer(device).render(Splats(c.shape, values), c.camera).color
    half = Renderer(device, arithmetic=Arithmetic(half_sh=True))
    np.testing.assert_array_equal(half.render(c.splats, c.camera).color, want)
    v_color = c.weights[0]
    grads = half.backward(v_color)
    assert grads["sh"].dtype == np.float32
    assert np.any(grads["sh"])


def test_colour_beyond_half_precision_stays_finite(device: Device) -> None:
    c = case(np.float32)
    values = dict(c.values)
    values["sh"] = values["sh"].copy()
    values["sh"][0, 0, 0] = 1e6
    image = Renderer(device, arithmetic=Arithmetic(half_sh=True)).render(Splats(c.shape, values), c.camera)
    assert np.isfinite(image.color).all()


@pytest.mark.slow
@pytest.mark.parametrize("schedule", ["1x4x16", "1x64x16"])
def test_tiles_of_other_sizes_have_the_same_image(make_renderer: MakeRenderer, device: Device, schedule: str) -> None:
    camera = random_camera(5, 93, 71)
    splats = Splats("skew-normal", random_splats(5, 300, 2, np.float32))
    images, grads = [], []
    for name in ("1x16x16", schedule):
        renderer = make_renderer(device, "float32", Schedule.parse(name))
        images.append(renderer.render(splats, camera, BACKGROUND))
        grads.append(renderer.backward(np.ones((71, 93, 3))))
    np.testing.assert_array_equal(images[0].color, images[1].color)
    for name, value in grads[0].items():  # sums over other tiles
        assert np.abs(value - grads[1][name]).max() <= 2e-5 * np.abs(value).max(), name


def test_a_set_of_blocks_has_64_bits_at_most() -> None:
    with pytest.raises(DeviceError, match="at most 64 vectors"):
        Schedule.parse("1x128x8")


def test_unknown_forms_are_named() -> None:
    with pytest.raises(InputError, match="phi 'erf': choose one of polynomial, erfc"):
        Arithmetic(phi="erf")
