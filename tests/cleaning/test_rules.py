"""Each rule names the splats that it is about, and no others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from clsplat.cameras.camera import Camera
from clsplat.cleaning.rules import candidates_without_views, inner_extent, is_faint, is_outside
from clsplat.scenes.scene import View
from clsplat.splats.shapes import SHAPES, shape_named
from clsplat.splats.splats import Splats

N = 60


def cloud(shape: str = "gaussian", opacity: float = 0.5) -> Splats:
    """Return splats in a ball of radius 1."""
    points = np.random.default_rng(3).normal(size=(N, 3))
    points *= np.random.default_rng(4).random((N, 1)) ** (1 / 3) / np.linalg.norm(points, axis=1, keepdims=True)
    return Splats.from_points(points, np.full((N, 3), 0.5), shape, 0, opacity=opacity, scale_factor=0.3)


def changed(splats: Splats, name: str, index: int, value: object) -> Splats:
    arrays = splats.to_numpy()
    arrays[name][index] = value
    return splats.with_arrays(arrays)


def test_a_sound_cloud_has_no_candidates() -> None:
    assert not any(mask.any() for mask in candidates_without_views(cloud()).values())


@pytest.mark.parametrize("shape", SHAPES)
def test_faint_splats_of_every_shape_are_named(shape: str) -> None:
    splats = cloud(shape)
    for opacity, faint in ((0.9 / 255, True), (1.1 / 255, False)):
        arrays = splats.to_numpy()
        for name in ("opacity_logit", "opacity_minus_logit"):
            if name in arrays:
                arrays[name][7] = shape_named(shape).raw_opacity(np.array(opacity))
        found = is_faint(splats.with_arrays(arrays))
        assert found.tolist() == [faint and place == 7 for place in range(N)]


def test_other_normalisations_have_no_faint_splats() -> None:
    splats = cloud("skew-normal", 1e-3)
    assert is_faint(splats).all()
    assert not is_faint(Splats("skew-normal", splats.arrays, "pdf")).any()


def test_a_splat_longer_than_the_scene_is_oversized() -> None:
    splats = cloud()
    extent = inner_extent(splats)
    assert 0.8 < extent < 1.0
    long = changed(splats, "log_scale", 5, [np.log(1.05 * extent), -5, -5])
    assert np.flatnonzero(candidates_without_views(long)["oversized"]).tolist() == [5]
    assert not candidates_without_views(long, 1.1 * extent)["oversized"].any()


def test_a_lonely_splat_is_isolated_unless_it_reaches_the_others() -> None:
    lonely = changed(cloud(), "mean", 9, [40.0, 0.0, 0.0])
    assert np.flatnonzero(candidates_without_views(lonely)["isolated"]).tolist() == [9]
    reaching = changed(lonely, "log_scale", 9, np.log(20.0))
    assert not candidates_without_views(reaching)["isolated"].any()


def view(alpha: np.ndarray | None, turns: float) -> View:
    """Return a view of the origin from a distance of 4, turned about the vertical axis."""
    c, s = np.cos(turns), np.sin(turns)
    pose = np.array([[c, 0, -s, 0], [0, 1, 0, 0], [s, 0, c, 4.0], [0, 0, 0, 1]])
    return View(
        str(turns), Camera(100, 80, 100.0, 100.0, 50.0, 40.0, pose), np.zeros((80, 100, 3), np.uint8), None, alpha
    )


def test_splats_outside_the_hull_of_two_photos_are_named() -> None:
    alpha = np.zeros((80, 100), np.uint8)
    alpha[30:50, 40:60] = 255  # the object is within 0.4 of the axes
    points = [[0, 0, 0], [0.3, 0.3, 0.3], [1.0, 0, 0], [0, 1.0, 0], [0, 0, 30.0], [0.43, 0, 0]]
    splats = Splats.from_points(np.array(points, float), np.full((6, 3), 0.5), "gaussian", 0)
    views = [view(alpha, 0.0), view(alpha, 0.5)]
    # The one at [1, 0, 0] is beside the object in both views; the far one is behind it in one. The margin is 2 px.
    assert np.flatnonzero(is_outside(splats, views)).tolist() == [2, 3]
    assert np.flatnonzero(is_outside(splats, [views[0], replace(views[1], alpha=None)])).tolist() == []
    assert is_outside(splats, [replace(one, alpha=np.full_like(alpha, 255)) for one in views]).tolist() == [
        False
    ] * len(splats)
    assert is_outside(splats, [replace(one, alpha=None) for one in views]) is None
