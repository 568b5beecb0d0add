"""Importance of splats agrees with images rendered without each splat, without its skew, or with other colours."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from conftest import MakeRenderer

from clsplat.compression.importance import Importance, _per_opacity, lower_bands, measure_importance
from clsplat.device.device import Device
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.scene import Scene
from clsplat.splats.shapes import SHAPES
from clsplat.splats.splats import Splats

N, SEEDS = 12, 48


@pytest.fixture(scope="module")
def renderer(devices: list[Device], make_renderer: MakeRenderer) -> Renderer:
    return make_renderer(devices[0])


def some_splats(scene: Scene, shape: str) -> Splats:
    """A few large splats in front of the cameras, with bright colours that are not clamped."""
    rng = np.random.default_rng(5)
    points = scene.points.xyz[rng.choice(len(scene.points.xyz), N, replace=False)]
    splats = Splats.from_points(points, np.full((N, 3), 0.6), shape=shape, sh_degree=1)
    arrays = splats.to_numpy()
    arrays["sh"] += rng.normal(size=arrays["sh"].shape).astype(np.float32) * 0.1
    arrays["opacity_logit"] = rng.uniform(-1, 1, N).astype(np.float32)
    if "skew" in arrays:
        arrays["skew"] = rng.normal(size=(N, 3)).astype(np.float32) * 0.4
    if "beta" in arrays:
        arrays["beta"] = rng.uniform(1.8, 2.2, N).astype(np.float32)
    return Splats(shape, arrays)


def mean_importance(renderer: Renderer, splats: Splats, scene: Scene) -> Importance:
    """Return the mean over many seeds. A single seed gives an estimate of it."""
    every = [measure_importance(renderer, splats, scene.train[:2], seed=seed) for seed in range(SEEDS)]
    colour = np.mean([importance.colour for importance in every if importance.colour is not None], axis=0)
    fields = {name: np.mean([importance.fields[name] for importance in every], axis=0) for name in every[0].fields}
    return Importance(np.mean([importance.removal for importance in every], axis=0), fields, colour)


def change(renderer: Renderer, splats: Splats, scene: Scene, without: Callable[[int], Splats]) -> np.ndarray:
    """Return (N,) squared changes of the images, if one splat at a time has its other form."""
    views = scene.train[:2]
    whole = [renderer.render(splats, view.camera).color.astype(np.float64) for view in views]
    return np.array(
        [
            sum(
                float(np.sum((renderer.render(without(i), view.camera).color - image) ** 2))
                for view, image in zip(views, whole, strict=True)
            )
            for i in range(len(splats))
        ]
    )


@pytest.mark.parametrize(
    "shape",
    [
        "skew-normal",
        pytest.param("bisected-skew", marks=pytest.mark.slow),
        pytest.param("student-t", marks=pytest.mark.slow),
    ],
)
def test_removal_is_the_change_of_the_images(renderer: Renderer, scene: Scene, shape: str) -> None:
    splats = some_splats(scene, shape)
    true = change(renderer, splats, scene, lambda i: splats.select(np.arange(N) != i))
    found = mean_importance(renderer, splats, scene).removal
    shown = true > 1e-3 * true.max()
    assert shown.sum() >= N // 2
    # 48 seeds: each estimate has a relative deviation of at most sqrt(2 / 48) = 0.2.
    np.testing.assert_allclose(found[shown], true[shown], rtol=0.6)
    assert np.median(found[shown] / true[shown]) == pytest.approx(1, abs=0.2)


@pytest.mark.parametrize(
    ("shape", "field"),
    [("skew-normal", "skew"), pytest.param("generalised-exponential", "beta", marks=pytest.mark.slow)],
)
def test_fields_are_ranked_by_the_change_of_the_images(
    renderer: Renderer, scene: Scene, shape: str, field: str
) -> None:
    splats = some_splats(scene, shape)
    neutral = splats.schema[field].neutral

    def without(i: int) -> Splats:
        arrays = splats.to_numpy()
        arrays[field][i] = neutral if len(neutral) > 1 else neutral[0]
        return Splats(shape, arrays)

    true = change(renderer, splats, scene, without)
    found = mean_importance(renderer, splats, scene).fields[field]
    shown = true > 1e-2 * true.max()
    assert np.corrcoef(np.log(found[shown]), np.log(true[shown]))[0, 1] > 0.8


@pytest.mark.slow
def test_the_direct_forms_skew_is_not_a_field_to_drop(renderer: Renderer, scene: Scene) -> None:
    assert measure_importance(renderer, some_splats(scene, "skew-normal-direct"), scene.train[:1]).fields == {}


def test_lower_degrees_lose_what_they_say(renderer: Renderer, scene: Scene) -> None:
    splats = some_splats(scene, "skew-normal")
    importance = mean_importance(renderer, splats, scene)
    assert importance.colour is not None
    lower, lost = lower_bands(splats.sh, importance.colour)
    assert lower[0].shape == (N, 1, 3)
    assert not lost[:, 1].any()

    def constant(i: int) -> Splats:
        arrays = splats.to_numpy()
        arrays["sh"][i, 0], arrays["sh"][i, 1:] = lower[0][i, 0], 0
        return Splats(splats.shape, arrays)

    def cut(i: int) -> Splats:
        arrays = splats.to_numpy()
        arrays["sh"][i, 1:] = 0
        return Splats(splats.shape, arrays)

    true = change(renderer, splats, scene, constant)
    shown = true > 1e-2 * true.max()
    np.testing.assert_allclose(lost[shown, 0], true[shown], rtol=0.6)
    simply = change(renderer, splats, scene, cut)
    assert np.median(true[shown] / simply[shown]) < 0.7, "the constant takes over what it can"


def test_lower_degrees_are_least_squares() -> None:
    """The result agrees with a least-squares solver that uses every view separately."""
    rng = np.random.default_rng(1)
    n, views, coefficients = 5, 40, 9
    basis, weight = rng.normal(size=(n, views, coefficients)), rng.random((n, views))
    sh = rng.normal(size=(n, coefficients, 3)).astype(np.float32)
    rows, columns = np.triu_indices(coefficients)
    full = np.einsum("nv,nvk,nvl->nkl", weight, basis, basis)
    lower, lost = lower_bands(sh, full[:, rows, columns].astype(np.float32))
    for i in range(n):
        root = np.sqrt(weight[i])[:, None]
        best, left, *_ = np.linalg.lstsq(root * basis[i, :, :4], root * (basis[i] @ sh[i].astype(np.float64)))
        np.testing.assert_allclose(lower[1][i], best, atol=0.02)  # tolerance for the ridge
        assert lost[i, 1] == pytest.approx(left.sum(), rel=1e-3)
    assert (lost[:, 0] >= lost[:, 1]).all()


def test_a_lower_degree_never_loses_less() -> None:
    """The ridge of a degree can cost more than the degree gains, if the weights of its bands differ by far."""
    rng = np.random.default_rng(0)
    n, views, coefficients = 50, 7, 9
    basis = rng.normal(size=(n, views, coefficients)) * 10 ** rng.uniform(-2, 2, (n, 1, coefficients))
    sh = (rng.normal(size=(n, coefficients, 3)) * 10 ** rng.uniform(-2, 2, (n, coefficients, 1))).astype(np.float32)
    rows, columns = np.triu_indices(coefficients)
    products = np.einsum("nvk,nvl->nkl", basis, basis)[:, rows, columns].astype(np.float32)
    lost = lower_bands(sh, products)[1]
    assert (np.diff(lost, axis=1) <= 0).all()
    assert (lost >= 0).all()


@pytest.mark.parametrize("shape", ["gaussian", "student-t"])
def test_the_factor_of_the_opacity_is_its_value_over_its_slope(shape: str) -> None:
    """I - o dI/do is the image without the splat. So the raw gradient is multiplied by o / (do/draw)."""
    raw, step = np.linspace(-3, 3, 7), 1e-6
    opacity = SHAPES[shape].opacity
    slope = (opacity(raw + step) - opacity(raw - step)) / (2 * step)
    np.testing.assert_allclose(_per_opacity(SHAPES[shape], raw), opacity(raw) / slope, rtol=1e-6, atol=1e-9)


def test_splats_that_no_view_sees_need_nothing_and_keep_their_colour(renderer: Renderer, scene: Scene) -> None:
    arrays = some_splats(scene, "skew-normal").to_numpy()
    arrays["mean"][3] = scene.train[0].camera.position - 5 * (
        scene.points.xyz.mean(axis=0) - scene.train[0].camera.position
    )
    splats = Splats("skew-normal", arrays)
    importance = measure_importance(renderer, splats, scene.train[:1])
    assert importance.colour is not None
    assert importance.removal[3] == 0 == importance.fields["skew"][3]
    lower, lost = lower_bands(splats.sh, importance.colour)
    np.testing.assert_array_equal(lower[0][3], splats.sh[3, :1])
    assert lost[3, 0] == 0
    assert importance.removal[np.arange(N) != 3].max() > 0


@pytest.mark.slow
def test_every_shape_is_measured(renderer: Renderer, scene: Scene) -> None:
    for shape in SHAPES:
        importance = measure_importance(renderer, some_splats(scene, shape), scene.train[:1])
        assert np.isfinite(importance.removal).all()
        assert importance.removal.max() > 0, shape
