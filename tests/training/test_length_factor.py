"""The polynomials of length factors agree with the quadrature, and relocation uses them."""

from __future__ import annotations

import numpy as np
import pytest
from model_arrays import ALL_SHAPES, random_model

from clsplat.splats import profiles, shapes
from clsplat.splats.shapes import SKEW_MAX, SLANT_MAX, Shape
from clsplat.training.density import length_factor as module
from clsplat.training.density.length_factor import by_quadrature, length_factor
from clsplat.training.density.relocation import N_MAX, plan_relocation, relocation
from clsplat.training.density.table import HostSplats

# Relative errors of the polynomials: of all stacks whose opacity is at most 1 - 1e-6, and of stacks of opaque copies.
ERROR, ERROR_OPAQUE = 1e-9, 1e-8

SHORT_WAY = [shape for shape in ALL_SHAPES if shape.profile in profiles.SLOPES]
LARGEST = {"centred": SKEW_MAX, "direct": SLANT_MAX}
OPACITIES = np.concatenate([np.geomspace(0.005, 0.5, 20), 1 - np.geomspace(0.5, 1e-6, 20)])


def test_these_shapes_have_the_short_way() -> None:
    expected = [shapes.GAUSSIAN, shapes.SKEW_NORMAL, shapes.SKEW_NORMAL_DIRECT, shapes.GES_MODULATION]
    assert expected == SHORT_WAY


def skewed(shape: Shape, opacity: np.ndarray, share: np.ndarray) -> dict[str, np.ndarray]:
    """Splats of these opacities. Skews have a share of the largest length; Gaussians have no skew."""
    arrays = {"opacity_logit": shape.raw_opacity(opacity)}
    if shape.skew_form is not None:
        direction = np.random.default_rng(0).standard_normal((len(opacity), 3))
        direction /= np.linalg.norm(direction, axis=1, keepdims=True)
        arrays["skew"] = direction * (share * LARGEST[shape.skew_form])[:, None]
    return arrays


@pytest.mark.parametrize("shape", SHORT_WAY, ids=lambda shape: shape.name)
def test_polynomials_equal_the_quadrature_over_the_whole_range(shape: Shape) -> None:
    shares = np.concatenate([[0.0, 1e-6], np.random.default_rng(1).random(6), [0.999, 1.0]])
    count, opacity, share = (
        grid.ravel() for grid in np.meshgrid(np.arange(2, N_MAX + 1), OPACITIES, shares, indexing="ij")
    )
    arrays = skewed(shape, opacity, share)
    depth = -np.log1p(-opacity)[:, None]
    found = length_factor(shape.profile, arrays, depth, depth / count[:, None], count)
    for rows in np.array_split(np.arange(len(count)), 20):
        part = {name: array[rows] for name, array in arrays.items()}
        new = -np.expm1(-depth[rows] / count[rows, None])
        expected = by_quadrature(shape.profile, part, opacity[rows, None], new, count[rows])
        np.testing.assert_allclose(found[rows], expected, rtol=ERROR)


@pytest.mark.parametrize("shape", SHORT_WAY, ids=lambda shape: shape.name)
@pytest.mark.parametrize("least", [0.005, 0.3, 0.9])
def test_a_minimum_of_the_opacity_counts(shape: Shape, least: float) -> None:
    opacity, count = np.array([0.006, 0.04, 0.5, 0.95]), np.array([2, 51, 3, 7])
    arrays = skewed(shape, opacity, np.array([0.1, 0.4, 0.8, 1.0]))
    raw, factor = relocation(shape, arrays, count, least)
    new = shape.opacity(raw["opacity_logit"])
    assert np.isclose(new, least).any()
    expected = by_quadrature(shape.profile, arrays, opacity[:, None], new[:, None], count)
    np.testing.assert_allclose(factor, expected, rtol=ERROR_OPAQUE)


def test_transparent_and_opaque_splats_and_steep_slopes() -> None:
    shape = shapes.SKEW_NORMAL_DIRECT
    arrays = skewed(shape, np.full(6, 0.5), np.array([0.2, 0.2, 0.2, 1.0, 1.5, 100.0]))
    depth = np.array([1e-37, 1e-9, 1e30, 1.0, 1.0, 1.0])[:, None]
    factor = length_factor(shape.profile, arrays, depth, depth / 4, np.full(6, 4))
    opaque = by_quadrature(shape.profile, arrays, np.ones((6, 1)), np.ones((6, 1)), np.full(6, 4))
    np.testing.assert_allclose(factor[:3], [1.0, 1.0, opaque[2]], rtol=ERROR_OPAQUE)
    assert factor[3] == factor[4] == factor[5], "kernels bound the slope"


@pytest.mark.parametrize("shape", ALL_SHAPES, ids=lambda shape: shape.name)
def test_a_plan_integrates_only_when_a_number_of_copies_is_new(shape: Shape, monkeypatch: pytest.MonkeyPatch) -> None:
    splats = HostSplats(shape, random_model(shape, 3000, 2))

    def plan() -> np.ndarray:
        edit = plan_relocation(splats, shape, np.random.default_rng(0), 4000, growth=1.3)
        assert edit.relocated > 100
        return edit.values["log_scale"].values

    def no_integral(*arguments: object) -> np.ndarray:
        raise AssertionError("the quadrature is slow")

    module._coefficients.cache_clear()
    first = plan()
    monkeypatch.setattr(module, "by_quadrature", no_integral)
    if shape in SHORT_WAY:
        np.testing.assert_array_equal(plan(), first)
        module._coefficients.cache_clear()
    with pytest.raises(AssertionError, match="slow"):
        plan()


def test_memory_is_limited_and_parts_do_not_mix(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(4)
    for shape in (shapes.SKEW_NORMAL, shapes.STUDENT_T):
        arrays, count = random_model(shape, 500, 1, dead=0), rng.integers(1, 6, 500)
        whole = relocation(shape, arrays, count)[1]
        with monkeypatch.context() as patch:
            patch.setattr(module, "_CHUNK", 64)
            np.testing.assert_allclose(relocation(shape, arrays, count)[1], whole, rtol=1e-12)
