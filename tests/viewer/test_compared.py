"""Two models with a divider, and points of a model's surface."""

from __future__ import annotations

import numpy as np
import pytest
from reference.scenes import for_shape, random_camera, random_splats

from clsplat.cameras.camera import Camera
from clsplat.rendering.colormaps import MODES
from clsplat.splats.splats import Splats
from clsplat.viewer.compared import ComparedSource
from clsplat.viewer.crop import CropBox
from clsplat.viewer.settings import Settings
from clsplat.viewer.source import ModelSource

BACKGROUND = (0.2, 0.4, 0.6)


def model(seed: int) -> Splats:
    return Splats("skew-normal", for_shape(random_splats(seed, 60, 2, np.float32), "skew-normal"))


@pytest.fixture(scope="module")
def both() -> tuple[ModelSource, ModelSource]:
    return ModelSource(model(3)), ModelSource(model(4))


@pytest.fixture(scope="module")
def compared(both: tuple[ModelSource, ModelSource]) -> ComparedSource:
    return ComparedSource(*both, ("a", "b"))


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("divider", [0.0, 0.3, 1.0])
def test_each_side_shows_its_model(
    both: tuple[ModelSource, ModelSource], compared: ComparedSource, mode: str, divider: float
) -> None:
    camera = random_camera(5, 96, 64)
    settings = Settings(mode=mode, background=BACKGROUND, divider=divider)
    shown = compared.view(camera, settings)
    assert shown.picture.shape == (64, 96, 3)
    first, second = (source.view(camera, settings).picture.astype(int) for source in both)
    at = round(divider * 96)
    tolerance = 40 if mode == "depth" and 0 < at < 96 else 3  # the colours of depths have one range for both sides
    for part, wanted in ((np.s_[:, :at], first), (np.s_[:, at + 1 :], second)):
        if wanted[part].size:
            assert np.abs(shown.picture[part] - wanted[part]).mean() < tolerance
    assert np.abs(first - second).mean() > 3, "the models differ"
    if 0 < at < 96:
        assert (shown.picture[:, at] == 255).all()
    assert (shown.near_far is None) == (mode != "depth")


def test_the_range_of_depths_is_that_of_both_sides(compared: ComparedSource) -> None:
    camera = random_camera(5, 96, 64)
    ends = [compared.view(camera, Settings(mode="depth", divider=share)).near_far for share in (0.0, 1.0, 0.5)]
    assert all(end is not None for end in ends)
    whole = [end for end in ends[:2] if end]
    assert ends[2] is not None
    assert min(near for near, _ in whole) - 0.3 < ends[2][0] < ends[2][1] < max(far for _, far in whole) + 0.3


def test_what_a_client_does_is_done_with_the_first(
    both: tuple[ModelSource, ModelSource], compared: ComparedSource
) -> None:
    assert compared.splats is both[0].splats
    assert compared.sides == ("a", "b")
    other = model(9).select(np.arange(10))
    before = compared.splats
    both[0].show(other)
    assert both[0].splats is other
    assert compared.n_splats == 60
    both[0].show(before)


@pytest.fixture(scope="module")
def wall() -> ModelSource:
    """Small opaque splats in the plane z = 4 + x / 2."""
    y, x = (axis.ravel() for axis in np.mgrid[-2:2:60j, -2:2:60j])
    n = x.size
    tilt = 0.5 * np.arctan(0.5)
    return ModelSource(
        Splats(
            "gaussian",
            {
                "mean": np.stack([x, y, 4 + 0.5 * x], axis=1).astype(np.float32),
                "quat": np.tile(np.float32([np.cos(tilt), 0, -np.sin(tilt), 0]), (n, 1)),
                "log_scale": np.tile(np.float32(np.log([0.06, 0.06, 1e-4])), (n, 1)),
                "opacity_logit": np.full(n, 6.0, np.float32),
                "sh": np.zeros((n, 1, 3), np.float32),
            },
        )
    )


@pytest.mark.parametrize("origin", [(0.0, 0.0, 0.0), (0.5, -1.0, 9.0)])
def test_a_ray_meets_the_surface(wall: ModelSource, origin: tuple[float, float, float]) -> None:
    rng = np.random.default_rng(0)
    for _ in range(10):
        x, y = rng.uniform(-1.5, 1.5, 2)
        wanted = np.array([x, y, 4 + 0.5 * x])
        found = wall.surface(np.array(origin), 3.0 * (wanted - origin), Settings())
        assert found is not None
        np.testing.assert_allclose(found, wanted, atol=0.06)  # the size of a splat


def test_a_ray_beside_the_surface_meets_nothing(wall: ModelSource) -> None:
    assert wall.surface(np.zeros(3), np.array([0.0, 0.0, -1.0]), Settings()) is None
    assert wall.surface(np.zeros(3), np.array([1.0, 0.0, 0.0]), Settings()) is None
    assert wall.surface(np.zeros(3), np.zeros(3), Settings()) is None
    assert wall.surface(np.array([np.nan, 0.0, 0.0]), np.ones(3), Settings()) is None


def test_a_ray_meets_only_what_is_shown(wall: ModelSource) -> None:
    """The wall at depth 4 may be cut away or not be drawn. In a comparison, the side counts on which a user clicks."""
    ahead, behind = np.array([0.0, 0.0, 1.0]), CropBox((0.0, 0.0, 9.0), (1.0, 0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
    assert wall.surface(np.zeros(3), ahead, Settings(crop=behind)) is None
    assert wall.surface(np.zeros(3), ahead, Settings(cap=0)) is None
    moved = wall.splats.to_numpy() | {"mean": wall.splats.mean + np.float32([0.0, 0.0, 3.0])}
    compared = ComparedSource(wall, ModelSource(wall.splats.with_arrays(moved)), ("near", "far"))
    for across, depth in ((0.1, 4.0), (0.29, 4.0), (0.31, 7.0), (0.9, 7.0)):
        found = compared.surface(np.zeros(3), ahead, Settings(divider=0.3), across)
        assert found is not None
        assert found[2] == pytest.approx(depth, abs=0.06)


def test_the_camera_of_a_side_has_its_columns(compared: ComparedSource, both: tuple[ModelSource, ModelSource]) -> None:
    """A side is rendered alone, so a divider costs no time."""
    sizes = []
    view = both[0].picture
    both[0].picture = lambda camera, settings: sizes.append(camera.width) or view(camera, settings)  # type: ignore
    try:
        compared.view(Camera(90, 60, 80, 80, 45, 30, np.eye(4)), Settings(divider=1 / 3))
    finally:
        del both[0].picture
    assert sizes == [30]
