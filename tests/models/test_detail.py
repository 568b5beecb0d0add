"""Levels of detail: what is near is the model itself, what is far has fewer splats, and pictures hardly change."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from looking_cameras import looking, ring
from model_arrays import random_model

from clsplat.cameras.camera import Camera
from clsplat.errors import InputError
from clsplat.evaluation.metrics import psnr
from clsplat.models import detail
from clsplat.models.detail import MAX_LEVELS, DetailLevels, DetailRenderer, farther
from clsplat.models.measure_detail import DISTANCES, measure_distances, measure_levels
from clsplat.rendering.renderer import Renderer
from clsplat.splats.shapes import SHAPES
from clsplat.splats.splats import Splats

MIDDLE = np.zeros(3)
BLACK = (0.0, 0.0, 0.0)


@pytest.fixture(autouse=True)
def small_leaves(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(detail, "_LEAF", 64)


def wall(n: int = 24, shape: str = "skew-normal") -> Splats:
    """A wall of small splats with waves of colour, 2 units wide."""
    x, z = (axis.ravel() for axis in np.meshgrid(np.linspace(-1, 1, n), np.linspace(-1, 1, n)))
    count = len(x)
    colour = np.stack([np.sin(2 * x), np.cos(2 * z), np.sin(x + z)], axis=1)[:, None]
    return Splats(
        "gaussian",
        {
            "mean": np.stack([x, np.zeros(count), z], axis=1),
            "quat": np.tile([1.0, 0, 0, 0], (count, 1)),
            "log_scale": np.full((count, 3), np.log(1.2 / n)),
            "opacity_logit": np.full(count, 2.0),
            "sh": colour,
        },
        antialiased=True,  # else small splats look thicker than their merged ones
    ).as_shape(shape)


def before_wall(distance: float) -> Camera:
    (camera,) = looking(np.array([[0.0, -distance, 0.0]]), MIDDLE)
    return camera


def test_the_first_level_is_the_model() -> None:
    splats = wall()
    levels = DetailLevels(splats)
    assert levels.whole(0) is splats
    assert levels.seen(before_wall(3.0), 0.0) is splats
    assert (levels.distances[0] == 0).all()


def test_negative_splats_stay_where_they_are_and_merge_with_each_other() -> None:
    """A wall of Student's t, and small negative splats before it, as SSS has them."""
    front = wall(24, "student-t")
    back = wall(24, "student-t")
    arrays = back.to_numpy()
    arrays["mean"][:, 1] -= 0.02
    arrays["opacity_logit"][:] = -0.1
    arrays["sh"][:] *= 0.5
    parts = {name: np.concatenate([front.arrays[name], array]) for name, array in arrays.items()}
    order = np.random.default_rng(0).permutation(len(parts["mean"]))
    splats = front.with_arrays({name: array[order] for name, array in parts.items()})
    levels = DetailLevels(splats, levels=3)
    assert levels.counts[0].sum() == len(splats)
    signs = [np.sort(np.sign(levels.whole(level).opacity_logit)) for level in range(3)]
    for sign in signs:
        assert 0.4 < np.mean(sign < 0) < 0.6
    # A mix of the first and the second level: the leaves of the first have their own splats.
    choice = np.arange(levels.counts.shape[1]) % 2
    rows = {row.tobytes() for row in splats.mean}
    own = sum(row.tobytes() in rows for row in levels.at(choice).mean)
    assert own == levels.counts[0, choice == 0].sum()
    renderer, camera = Renderer(), before_wall(4.0)
    images = [renderer.render(one, camera).color for one in (splats, levels.at(choice), levels.whole(1))]
    assert psnr(images[0], images[1], rounded=False) > 29
    assert psnr(images[0], images[2], rounded=False) > 26


def test_each_level_has_about_half_of_the_splats_and_wider_merges() -> None:
    levels = DetailLevels(wall(), levels=4)
    totals = levels.counts.sum(axis=1)
    assert totals[0] == 24 * 24
    assert all(0.45 * a < b < 0.65 * a for a, b in pairwise(totals))
    assert (np.diff(levels.distances, axis=0) >= 0).all()
    assert (levels.counts[0] <= 64).all()


def test_the_distance_is_that_of_the_merged_centres() -> None:
    """Two splats of equal weight: each centre is half of their distance from the merged one."""
    two = wall(24, "gaussian").select([0, 1])
    offset = float(np.linalg.norm(two.mean[0] - two.mean[1]))
    assert DetailLevels(two, levels=2).distances[1] == pytest.approx(offset / 2, rel=1e-4)


@pytest.mark.parametrize("shape", sorted(SHAPES))
def test_pictures_from_afar_hardly_change(shape: str) -> None:
    splats = wall(shape=shape)
    levels, renderer = DetailLevels(splats), Renderer()
    camera = before_wall(40.0)
    seen = levels.seen(camera, 0.25)
    assert len(seen) < 0.3 * len(splats)
    assert seen.shape == shape
    pictures = [renderer.render(one, camera).color for one in (splats, seen)]
    assert pictures[0].max() > 0.1
    assert psnr(*pictures, rounded=False) > 40


def test_each_part_is_as_coarse_as_the_pixels_allow() -> None:
    camera, pixels = before_wall(8.0), 0.5
    levels = DetailLevels(wall())
    outside = np.maximum(np.maximum(levels._low - camera.position, camera.position - levels._high), 0.0)
    apart = levels.distances * camera.fx / np.linalg.norm(outside, axis=1)
    for leaf, level in enumerate(levels.choose(camera, pixels)):
        assert 0 < level < len(levels) - 1
        assert apart[level, leaf] <= pixels < apart[level + 1, leaf]


def test_near_parts_are_finer_than_far_ones() -> None:
    places = np.array([[0.0, -0.3, -0.95]])  # in front of the lower edge, along the wall
    (camera,) = looking(places, np.array([0.05, 0.0, 1.0]), field=1.2)
    levels = DetailLevels(wall(48))
    chosen = levels.choose(camera, 0.5)
    middle = 0.5 * (levels._low + levels._high)
    distance = np.linalg.norm(middle - camera.position, axis=1)
    drawn = chosen >= 0
    assert len(set(chosen[drawn])) > 1
    assert np.corrcoef(distance[drawn], chosen[drawn])[0, 1] > 0.5


@pytest.mark.parametrize("seed", range(4))
def test_parts_outside_the_image_are_left_out_without_a_trace(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """With 0 pixels only leaves outside the image are left out."""
    monkeypatch.setattr(detail, "_LEAF", 8)
    rng, arrays = np.random.default_rng(seed), random_model(SHAPES["skew-normal"], 400, seed, dead=0)
    places, sizes = rng.uniform(-2, 2, (400, 3)), rng.uniform(0.02, 0.15, (400, 3))
    splats = Splats("skew-normal", {**arrays, "mean": places, "log_scale": np.log(sizes)})
    levels, renderer = DetailLevels(splats), Renderer()
    left_out = 0
    for camera in looking(ring(6, 1.0), np.array([0.3, 0.1, 0.2]), field=0.5):
        seen = levels.seen(camera, 0.0)
        left_out += len(splats) - len(seen)
        wanted = renderer.render(splats, camera)
        found = renderer.render(seen, camera)
        np.testing.assert_allclose(found.color, wanted.color, atol=1e-6)
        np.testing.assert_allclose(found.alpha, wanted.alpha, atol=1e-6)
    assert left_out > 0


def test_a_camera_that_moves_little_keeps_its_splats() -> None:
    levels = DetailLevels(wall())
    assert levels.seen(before_wall(40.0), 0.25) is levels.seen(before_wall(40.01), 0.25)


def test_the_renderer_draws_what_is_seen() -> None:
    levels, renderer = DetailLevels(wall()), Renderer()
    camera = before_wall(30.0)
    found = DetailRenderer(renderer, levels, 0.25).render(levels.splats, camera, (0.2, 0.3, 0.4)).color
    assert (found == renderer.render(levels.seen(camera, 0.25), camera, (0.2, 0.3, 0.4)).color).all()


def test_a_camera_farther_away_sees_the_same_point() -> None:
    (camera,) = looking(np.array([[1.0, -2.0, 0.5]]), MIDDLE)
    depth = float(np.linalg.norm(camera.position))
    for factor in DISTANCES:
        np.testing.assert_allclose(farther(camera, factor, depth).position, factor * camera.position, atol=1e-12)


def test_measures() -> None:
    levels = DetailLevels(wall(), levels=3)
    cameras = [before_wall(3.0), before_wall(4.0)]
    rows = list(measure_levels(levels, cameras, Renderer(), BLACK))
    assert [row.splats for row in rows] == levels.counts.sum(axis=1).tolist()
    assert rows[0].psnr == 100
    assert rows[0].psnr > rows[1].psnr > rows[2].psnr
    far = list(measure_distances(levels, 0.25, cameras, Renderer(), BLACK))
    assert [row.factor for row in far] == list(DISTANCES)
    assert far[0].splats > far[-1].splats
    assert all(row.ms > 0 and row.whole_ms > 0 for row in far)


@pytest.mark.parametrize("count", [0, MAX_LEVELS + 1])
def test_numbers_of_levels(count: int) -> None:
    with pytest.raises(InputError, match=f"{count} levels of detail: choose 1 to {MAX_LEVELS}"):
        DetailLevels(wall(), levels=count)


def test_levels_that_cannot_be() -> None:
    splats = wall()
    levels = DetailLevels(splats, 3)
    for level in (-1, 99, 0.5):
        with pytest.raises(InputError, match="the model has the levels 0 to"):
            levels.whole(level)  # type: ignore[arg-type]
    with pytest.raises(InputError, match="levels of detail: choose 1 to 12"):
        DetailLevels(splats, 2.5)  # type: ignore[arg-type]
    for pixels in (-1.0, float("nan")):
        with pytest.raises(InputError, match="give a number of pixels, at least 0"):
            levels.seen(before_wall(3.0), pixels)
