"""Conversions between shapes: equal images, or an error that counts the splats without an equal."""

from __future__ import annotations

import numpy as np
import pytest
from kernel_checks import BACKGROUND, Case
from reference.renderer import render_reference
from reference.scenes import Arrays, for_shape, random_camera, random_splats
from reference.tolerances import IMAGE_FLOAT32, ROUNDING

from clsplat.errors import InputError
from clsplat.splats.convert import convert
from clsplat.splats.shapes import NORMALISATIONS, SHAPES, SKEW_LIMIT, SLANT_MAX
from clsplat.splats.splats import Splats

FORMS = [("skew-normal", "skew-normal-direct"), ("skew-normal-direct", "skew-normal")]


def some(shape: str, normalisation: str = "peak", dtype: type = np.float64, **fields: object) -> Splats:
    """12 splats, some fields replaced; skew up to 9.4 as a slant, so that either form can hold it."""
    arrays: Arrays = random_splats(7, 12, 2)
    arrays["skew"] *= 0.99
    arrays["skew"][3] = 0.0
    arrays = for_shape(arrays, shape)
    for name, value in fields.items():
        arrays[name] = np.broadcast_to(np.asarray(value, np.float64), arrays[name].shape)
    return Splats(shape, {name: value.astype(dtype) for name, value in arrays.items()}, normalisation)


def neutral(shape: str, dtype: type = np.float64) -> Splats:
    """Splats of `shape` that are Gaussians."""
    return Splats(
        shape,
        {name: value.astype(dtype) for name, value in random_splats(7, 12, 2).items() if name != "skew"}
        | logit(shape, dtype),
    )


def logit(shape: str, dtype: type) -> dict[str, np.ndarray]:
    return {"opacity_logit": np.linspace(0.1, 2.0, 12).astype(dtype)} if SHAPES[shape].signed else {}


def assert_equal_images(got: Splats, want: Splats, tolerance: float) -> None:
    for seed in (7, 8):
        images = [
            render_reference(
                splats.arrays,
                random_camera(seed, 41, 27),
                splats.shape,
                splats.normalisation,
                BACKGROUND,
                alpha_min=0.0,
                t_min=0.0,
            )
            for splats in (got, want)
        ]
        for name in ("color", "alpha", "depth"):
            difference = np.abs(getattr(images[0], name) - getattr(images[1], name)).max()
            assert difference < tolerance, f"{name}: off by {difference:.1e}"
        assert images[1].alpha.max() > 0.3


@pytest.mark.parametrize("normalisation", NORMALISATIONS)
@pytest.mark.parametrize(("source", "target"), FORMS)
def test_the_skew_normal_s_forms_are_one_family(source: str, target: str, normalisation: str) -> None:
    splats = some(source, normalisation)
    converted = convert(splats, target)
    assert (converted.shape, converted.normalisation) == (target, normalisation)
    assert_equal_images(converted, splats, ROUNDING)
    back = convert(converted, source)
    assert np.abs(back.mean - splats.mean).max() < ROUNDING
    assert np.abs(np.linalg.norm(back.skew, axis=1) - np.linalg.norm(splats.skew, axis=1)).max() < 1e-8
    assert_equal_images(back, splats, ROUNDING)


@pytest.mark.parametrize(("source", "target"), FORMS)
def test_skew_moves_what_is_stored(source: str, target: str) -> None:
    """Guards the test above: the forms do store different things, and splats without skew keep all bits."""
    splats = some(source)
    converted = convert(splats, target)
    moved = np.linalg.norm(converted.mean - splats.mean, axis=1)
    assert np.median(moved) > 0.03
    for name in ("mean", "quat", "log_scale"):
        assert np.array_equal(converted.arrays[name][3], splats.arrays[name][3])


@pytest.mark.parametrize(("source", "target"), FORMS)
def test_float32_and_the_kernels_agree(make_renderer, device, source: str, target: str) -> None:
    splats = some(source, dtype=np.float32)
    converted = convert(splats, target)
    assert converted.mean.dtype == np.float32
    camera = random_camera(7, 41, 27)
    decided = Case(splats.arrays, camera, "gaussian").decided  # rounding may cross a threshold
    renderer = make_renderer(device, alpha_min=1e-7, t_min=1e-9)
    images = [renderer.render(model, camera, BACKGROUND).color for model in (splats, converted)]
    assert np.abs(images[0] - images[1])[decided].max() < 2 * IMAGE_FLOAT32


def test_long_skews_and_needles() -> None:
    """At the kernels' bound, and with scales of one to a million: the centred form holds a slant of 9.5 at most."""
    long = some("skew-normal", skew=np.array([0.0, 0.6, 0.8]) * SKEW_LIMIT, log_scale=[-8.0, -1.0, -2.0])
    converted = convert(long, "skew-normal-direct")
    assert np.linalg.norm(converted.skew, axis=1) == pytest.approx(9.47, abs=0.01)
    assert_equal_images(converted, long, 1e-7)
    too_long = some("skew-normal-direct", skew=np.where(np.arange(12)[:, None] < 5, SLANT_MAX / 3**0.5, 0.1))
    message = r"5 of 12 splats have a skew above 9.4\d\d, which skew-normal does not support"
    with pytest.raises(InputError, match=message):
        convert(too_long, "skew-normal")


@pytest.mark.parametrize(
    ("source", "target"),
    [
        *(("gaussian", name) for name in SHAPES),
        *((name, "gaussian") for name in SHAPES),
        ("bisected-skew", "half-gaussian"),
        ("student-t", "skew-normal-direct"),
    ],
)
def test_every_shape_holds_the_gaussian(source: str, target: str) -> None:
    splats = neutral(source)
    converted = convert(splats, target)
    assert converted.shape == target
    assert set(converted.arrays) == set(SHAPES[target].schema(2).names)
    # the largest nu is not infinite: 4e-5 a splat, times the depth
    assert_equal_images(converted, splats, 1e-3 if "student-t" in (source, target) else ROUNDING)


def test_modulated_scales_are_scales() -> None:
    splats = some("ges-modulation")
    assert np.ptp(splats.arrays["beta"]) > 3.0
    assert_equal_images(convert(splats, "gaussian"), splats, ROUNDING)


def test_unnormalised_skew_of_zero_is_half_as_opaque() -> None:
    splats = some("skew-normal", "none", skew=0.0)
    converted = convert(splats, "gaussian")
    assert converted.normalisation == "peak"
    assert_equal_images(converted, splats, ROUNDING)


def test_two_sides_without_skew_mix() -> None:
    splats = some("bisected-skew", skew=0.0)
    assert np.abs(splats.arrays["opacity_minus_logit"] - splats.opacity_logit).min() > 1e-3
    assert_equal_images(convert(splats, "gaussian"), splats, ROUNDING)


@pytest.mark.parametrize(
    ("source", "target", "message"),
    [
        ("skew-normal", "gaussian", "11 of 12 splats are skewed"),
        ("skew-normal-direct", "bisected-skew", "11 of 12 splats are skewed"),
        ("half-gaussian", "gaussian", "12 of 12 splats have two different opacities"),
        ("bisected-skew", "half-gaussian", "11 of 12 splats have two different opacities"),
        ("generalised-exponential", "gaussian", "12 of 12 splats have a beta that is not 2"),
        ("student-t", "gaussian", "4 of 12 splats have a negative opacity"),
    ],
)
def test_splats_without_an_equal_are_counted(source: str, target: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        convert(some(source), target)
    assert "\n" not in str(caught.value)


def test_a_finite_nu_is_no_gaussian() -> None:
    with pytest.raises(InputError, match="12 of 12 splats have nu below 10000"):
        convert(some("student-t", opacity_logit=0.5, nu=500.0), "gaussian")


def test_nothing_and_the_same() -> None:
    splats = some("skew-normal")
    assert convert(splats, "skew-normal") is splats
    assert len(convert(splats.select([]), "skew-normal-direct")) == 0
    with pytest.raises(InputError, match="unknown shape 'ball'"):
        convert(splats, "ball")
