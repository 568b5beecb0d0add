"""Nearest Gaussians of skewed splats, and the .splat files that hold Gaussians."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from reference.renderer import render_reference
from reference.scenes import for_shape, random_camera, random_splats
from scipy.special import ndtr

from clsplat.errors import InputError
from clsplat.splats.approximate import line_fits, nearest_gaussians, nearest_of_shape
from clsplat.splats.convert import convert, longest_slant
from clsplat.splats.formats.dot_splat import RECORD
from clsplat.splats.harmonics import SH_C0
from clsplat.splats.shapes import SHAPES, SKEW_MAX, SLANT_MAX
from clsplat.splats.splats import Splats


def skewed(share: float = 0.9, shape: str = "skew-normal", n: int = 12) -> Splats:
    """Splats with a skew of `share` of its bound, but the fourth."""
    arrays = random_splats(7, n, 1)
    arrays["skew"] *= share * SKEW_MAX / np.linalg.norm(arrays["skew"], axis=1, keepdims=True)
    arrays["skew"][3] = 0.0
    splats = Splats("skew-normal", arrays)
    return splats if shape == splats.shape else convert(splats, shape)


def moment_matched(splats: Splats) -> Splats:
    arrays = splats.to_numpy()
    del arrays["skew"]
    return Splats("gaussian", arrays)


def test_fits_of_the_line_are_least_squares() -> None:
    """No other centre, width or height is nearer; without slant, or with equal opacities, there is nothing to fit."""
    z = np.linspace(-5, 6, 2001)
    last = line_fits().shape[1] - 1
    for ratio in range(last + 1):
        np.testing.assert_allclose(line_fits()[0, ratio], [0, 1, 0.5 + 0.5 * ratio / last], atol=1e-6)
    for slant in (1.0, 4.0, SLANT_MAX, np.inf):
        row = -1 if np.isinf(slant) else round(5 * slant)
        np.testing.assert_allclose(line_fits()[row, last], [0, 1, 1], atol=1e-6)
        for ratio in (0.0, 0.3, 0.8):
            side = np.heaviside(z, 0.5) if np.isinf(slant) else ndtr(slant * z)
            profile = np.exp(-z * z / 2) * (ratio + (1 - ratio) * side)

            def error(fit: np.ndarray, profile: np.ndarray = profile) -> float:
                return float(np.sum((fit[2] * np.exp(-0.5 * ((z - fit[0]) / fit[1]) ** 2) - profile) ** 2))

            best = line_fits()[row, round(ratio * last)]
            for place in range(3):
                for step in (-0.01, 0.01):
                    other = best.copy()
                    other[place] += step
                    assert error(other) > error(best)


@pytest.mark.parametrize("shape", ["skew-normal", "skew-normal-direct"])
def test_images_are_nearer_than_with_equal_moments(shape: str) -> None:
    """One splat at a time, seen across its skew and along it."""
    splats = skewed(0.95, shape)
    near, equal = nearest_gaussians(splats), moment_matched(convert(splats, "skew-normal"))
    assert near.shape == "gaussian"
    errors = np.zeros((2, len(splats)))
    for seed in (7, 8, 9):
        camera = random_camera(seed, 41, 27)
        for i in range(len(splats)):
            truth, *others = (
                render_reference(
                    model.select(np.arange(len(splats)) == i).arrays,
                    camera,
                    model.shape,
                    model.normalisation,
                    alpha_min=0.0,
                    t_min=0.0,
                ).alpha
                for model in (splats, near, equal)
            )
            errors[:, i] += [float(np.sum((other - truth) ** 2)) for other in others]
    assert errors[1].sum() > 0
    assert errors[0].sum() < 0.75 * errors[1].sum()


def test_splats_without_skew_keep_their_bits() -> None:
    splats = skewed()
    near = nearest_gaussians(splats)
    for name, values in near.arrays.items():
        np.testing.assert_array_equal(values[3], splats.arrays[name][3])
    np.testing.assert_array_equal(near.sh, splats.sh)
    none = Splats("skew-normal", splats.to_numpy() | {"skew": np.zeros((12, 3))})
    np.testing.assert_array_equal(nearest_gaussians(none).mean, splats.mean)


def image_errors(splats: Splats, others: list[Splats]) -> np.ndarray:
    """Summed squared differences of alpha, one splat at a time, over a few views."""
    errors = np.zeros(len(others))
    for seed in (7, 8):
        camera = random_camera(seed, 41, 27)
        for i in range(len(splats)):
            truth, *shown = (
                render_reference(
                    model.select(np.arange(len(splats)) == i).arrays,
                    camera,
                    model.shape,
                    model.normalisation,
                    alpha_min=0.0,
                    t_min=0.0,
                ).alpha
                for model in (splats, *others)
            )
            errors += [float(np.sum((image - truth) ** 2)) for image in shown]
    return errors


def plain(splats: Splats, opacity: np.ndarray) -> Splats:
    """The Gaussians of the same place, size and colour."""
    core = {name: splats.arrays[name] for name in ("mean", "quat", "log_scale", "sh")}
    return Splats("gaussian", core | {"opacity_logit": np.log(opacity) - np.log1p(-opacity)})


@pytest.mark.parametrize("shape", ["half-gaussian", "bisected-skew"])
def test_two_opacities_are_nearer_than_their_mean(shape: str) -> None:
    arrays = for_shape(random_splats(7, 10, 0), shape)
    arrays["opacity_minus_logit"] = arrays["opacity_logit"] + np.tile([-3.0, 3.0], 5)
    splats = Splats(shape, arrays)
    sides = [1 / (1 + np.exp(-arrays[name])) for name in ("opacity_logit", "opacity_minus_logit")]
    near, mean = image_errors(splats, [nearest_gaussians(splats), plain(splats, 0.5 * (sides[0] + sides[1]))])
    assert near < 0.6 * mean


@pytest.mark.parametrize(
    ("shape", "field", "values"),
    [
        ("generalised-exponential", "beta", [0.7, 1.2, 3.0, 6.0]),
        ("student-t", "nu", [1.0, 2.0, 4.0, 10.0]),
    ],
)
def test_round_profiles_are_nearer_than_the_plain_gaussian(shape: str, field: str, values: list[float]) -> None:
    arrays = for_shape(random_splats(7, 12, 0), shape)
    arrays["opacity_logit"] = np.linspace(0.3, 1.0, 12)  # signed or not
    splats = Splats(shape, arrays | {field: np.repeat(values, 3)})
    near, same = image_errors(
        splats, [nearest_gaussians(splats), plain(splats, SHAPES[shape].opacity(arrays["opacity_logit"]))]
    )
    assert near < 0.6 * same


def test_negative_opacities_are_left_out() -> None:
    arrays = for_shape(random_splats(7, 6, 1), "student-t")
    arrays["opacity_logit"] = np.array([0.5, -0.5, 0.2, 0.1, -1.0, 0.4])
    near = nearest_gaussians(Splats("student-t", arrays))
    np.testing.assert_array_equal(near.sh, arrays["sh"][arrays["opacity_logit"] > 0])


def test_what_has_an_equal_is_converted() -> None:
    splats = Splats("ges-modulation", for_shape(random_splats(7, 6, 1), "ges-modulation"))
    for name, values in convert(splats, "gaussian").arrays.items():
        np.testing.assert_array_equal(nearest_gaussians(splats).arrays[name], values)


def test_other_normalisations_are_refused() -> None:
    with pytest.raises(InputError, match="normalisation 'pdf'"):
        nearest_gaussians(Splats("skew-normal", random_splats(7, 3, 0), "pdf"))


def test_splat_file_holds_what_the_format_says(tmp_path: Path) -> None:
    splats, file = moment_matched(skewed()), tmp_path / "out.splat"
    splats.save(file)
    table = np.frombuffer(file.read_bytes(), RECORD)
    assert RECORD.itemsize == 32
    assert len(table) == 12
    opacity = 1 / (1 + np.exp(-splats.opacity_logit))
    order = np.argsort(-np.exp(splats.log_scale.sum(axis=1)) * opacity)
    np.testing.assert_allclose(table["position"], splats.mean[order], rtol=1e-6)
    np.testing.assert_allclose(table["scale"], np.exp(splats.log_scale[order]), rtol=1e-6)
    colour = np.clip(0.5 + SH_C0 * splats.sh[order, 0], 0, 1)
    np.testing.assert_allclose(table["colour"][:, :3] / 255, colour, atol=0.002)
    np.testing.assert_allclose(table["colour"][:, 3] / 255, opacity[order], atol=0.002)
    unit = splats.quat / np.linalg.norm(splats.quat, axis=1, keepdims=True)
    np.testing.assert_allclose(table["quaternion"] / 128.0 - 1, unit[order], atol=0.008)


def test_splat_file_takes_gaussians_only(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="hold Gaussians, not skew-normal"):
        skewed().save(tmp_path / "out.splat")
    assert not list(tmp_path.iterdir())


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("shape", ["skew-normal", "skew-normal-direct"])
def test_sizes_that_no_number_can_hold_spoil_nothing(tmp_path: Path, shape: str) -> None:
    """A damaged file may have any logarithm of a scale."""
    splats = skewed(shape=shape)
    arrays = splats.to_numpy()
    arrays["log_scale"][1], arrays["log_scale"][2, 0] = 1e30, -1e30
    damaged = nearest_gaussians(Splats(shape, arrays))
    damaged.save(tmp_path / "made.splat")
    others = np.delete(np.arange(len(splats)), [1, 2])
    for name, values in nearest_gaussians(splats).select(others).to_numpy().items():
        np.testing.assert_array_equal(damaged.select(others).to_numpy()[name], values, err_msg=name)


def test_the_nearest_of_another_shape_equals_the_nearest_gaussians() -> None:
    splats = skewed()
    other, differs = nearest_of_shape(splats, "student-t")
    assert (other.shape, differs) == ("student-t", True)
    back = convert(other, "gaussian")
    gaussians = nearest_gaussians(splats)
    for name, values in gaussians.arrays.items():
        np.testing.assert_allclose(back.arrays[name], values, rtol=1e-5, atol=1e-6, err_msg=name)
    assert not nearest_of_shape(skewed(), "skew-normal-direct")[1]
    assert not nearest_of_shape(gaussians, "half-gaussian")[1]
    signed = other.with_arrays(other.to_numpy() | {"opacity_logit": np.linspace(-1, 1, len(other))})
    assert len(nearest_of_shape(signed, "gaussian")[0]) == len(other) // 2


def test_a_skew_that_the_other_form_cannot_have_is_shortened_and_others_stay() -> None:
    direct = skewed(0.5, "skew-normal-direct")
    arrays = direct.to_numpy()
    arrays["skew"][2] *= 0.5 * (longest_slant() + SLANT_MAX) / np.linalg.norm(arrays["skew"][2])
    with pytest.raises(InputError, match="1 of 12 splats have a skew above"):
        convert(direct.with_arrays(arrays), "skew-normal")
    found, differs = nearest_of_shape(direct.with_arrays(arrays), "skew-normal")
    assert differs
    assert np.linalg.norm(found.skew[2]) == pytest.approx(SKEW_MAX, rel=1e-4)
    others, expected = np.arange(12) != 2, convert(direct, "skew-normal")
    for name, values in expected.arrays.items():
        np.testing.assert_allclose(found.arrays[name][others], values[others], rtol=1e-5, atol=1e-6, err_msg=name)
