"""Nearest Gaussians of skewed splats, and the .splat files that hold Gaussians."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from reference import render_reference
from reference_scenes import for_shape, random_camera, random_splats
from scipy.special import ndtr

from clsplat.convert import convert
from clsplat.errors import InputError
from clsplat.nearest import line_fits, nearest_gaussians
from clsplat.shapes import SKEW_MAX, SLANT_MAX
from clsplat.splat_file import RECORD, write_splat
from clsplat.splats import SH_C0, Splats


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
    """No other centre, width or height is nearer; without slant nothing changes."""
    z = np.linspace(-5, 6, 2001)
    np.testing.assert_allclose(line_fits()[0], [0, 1, 1], atol=1e-6)
    for slant in (1.0, 4.0, SLANT_MAX):
        profile = np.exp(-z * z / 2) * ndtr(slant * z)
        profile /= profile.max()

        def error(fit: np.ndarray, profile: np.ndarray = profile) -> float:
            return float(np.sum((fit[2] * np.exp(-0.5 * ((z - fit[0]) / fit[1]) ** 2) - profile) ** 2))

        best = line_fits()[round(10 * slant)]
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
            truth, *others = (render_reference(model.select(np.arange(len(splats)) == i).arrays, camera, model.shape,
                                               model.normalisation, alpha_min=0.0, t_min=0.0).alpha
                              for model in (splats, near, equal))
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


def test_other_shapes_and_normalisations_are_refused() -> None:
    with pytest.raises(InputError, match="half-gaussian splats have no nearest"):
        nearest_gaussians(Splats("half-gaussian", for_shape(random_splats(7, 3, 0), "half-gaussian")))
    with pytest.raises(InputError, match="normalisation 'pdf'"):
        nearest_gaussians(Splats("skew-normal", random_splats(7, 3, 0), "pdf"))


def test_splat_file_holds_what_the_format_says(tmp_path: Path) -> None:
    splats, file = moment_matched(skewed()), tmp_path / "out.splat"
    write_splat(file, splats)
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
        write_splat(tmp_path / "out.splat", skewed())
    assert not list(tmp_path.iterdir())
