"""Points without colours get those of the photos; points with colours keep them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from clsplat.cameras.seen import seen
from clsplat.scenes.colmap import Points
from clsplat.scenes.scene import Scene, View
from clsplat.training.config import TrainConfig
from clsplat.training.initialise import initial_splats
from clsplat.training.log import Progress
from clsplat.training.point_colors import with_colors
from clsplat.training.run import train


def without_colors(scene: Scene, value: int) -> Scene:
    return replace(scene, points=replace(scene.points, rgb=np.full_like(scene.points.rgb, value)))


@pytest.mark.parametrize("value", [0, 128])
def test_points_of_one_colour_get_about_their_own(scene: Scene, value: int) -> None:
    found = with_colors(without_colors(scene, value).points, scene.train).rgb.astype(int)
    error = np.abs(found - scene.points.rgb)
    assert np.median(error) < 25, "the photos show the points, and seldom something before them"
    assert np.median(np.abs(value - scene.points.rgb.astype(int))) > 40


def test_the_colour_is_the_median_of_the_pixels(scene: Scene) -> None:
    """Against a loop over points and photos. Masked and transparent pixels do not count, nor do unseen points."""
    far = Points(np.vstack([scene.points.xyz, [[1e6, 1e6, 1e6]]]), np.zeros((len(scene.points) + 1, 3), np.uint8), None)  # type: ignore[arg-type]
    views = []
    for number, view in enumerate(scene.train):
        image, half = np.asarray(view.image), np.zeros(view.image.shape[:2], np.bool_)
        half[:, : image.shape[1] // 2] = True
        mask = half if number == 0 else None
        alpha = np.where(half, 255, 100).astype(np.uint8) if number == 1 else None
        views.append(View(view.name, view.camera, image, mask, alpha))
    found = with_colors(far, views)
    for index, place in enumerate(far.xyz):
        pixels = []
        for view in views:
            at = seen(view.camera, place[None])
            if at.inside[0]:
                x, y = at.pixel[0].astype(int)
                if (view.mask is None or view.mask[y, x]) and (view.alpha is None or view.alpha[y, x] == 255):
                    pixels.append(view.image[y, x])
        expected = np.rint(np.median(pixels, axis=0)) if pixels else np.zeros(3)
        np.testing.assert_array_equal(found.rgb[index], expected)
    assert not found.rgb[-1].any()


def test_points_with_colours_keep_them(scene: Scene) -> None:
    assert with_colors(scene.points, scene.train) is scene.points
    one = Points(scene.points.xyz[:1], scene.points.rgb[:1], scene.points.track_length[:1])
    assert with_colors(one, scene.train) is one


def test_a_run_from_black_points_shows_something(scene: Scene) -> None:
    """A splat of an exactly black colour has no gradient, so such a run ended with no splat in sight."""
    said: list[str] = []

    def hear(progress: Progress) -> None:
        said.append(progress.message)

    model = train(without_colors(scene, 0), TrainConfig(iterations=60, cap_max=300, sh_degree=0), hear)
    assert any("with colours of the photos" in message for message in said)
    assert len(model.splats) > 50
    splats, message = initial_splats(without_colors(scene, 0), cap=300, opacity=0.1, scale_factor=1.0)
    assert "with colours of the photos" in message
    assert splats.sh.any()
