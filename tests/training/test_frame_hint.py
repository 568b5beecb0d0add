"""Pixels that never change get a hint if the scene goes on there; backgrounds of objects and usual photos do not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from clsplat.cameras.seen import sampled, seen
from clsplat.scenes.colmap import Points
from clsplat.scenes.scene import Scene, View
from clsplat.training.config import TrainConfig
from clsplat.training.frame_hint import frame_hint
from clsplat.training.log import Progress
from clsplat.training.run import train


def barred(scene: Scene, rows: int = 4, color: int = 0, transparent: bool = False) -> Scene:
    """Return the scene with bars above and below in all photos."""
    views = []
    for view in scene.views:
        image = np.asarray(view.image).copy()
        alpha = np.full(image.shape[:2], 255, np.uint8)
        for part in (slice(None, rows), slice(-rows, None)):
            image[part], alpha[part] = color, 0
        views.append(View(view.name, view.camera, image, None, alpha if transparent else None))
    return replace(scene, views=views)


def near_the_middle(scene: Scene, share: float) -> Points:
    """Return the points of the scene, drawn together to their middle but for a share of them."""
    xyz = scene.points.xyz.copy()
    middle = np.median(xyz, axis=0)
    moved = np.random.default_rng(0).random(len(xyz)) >= share
    xyz[moved] = middle + 0.01 * (xyz[moved] - middle)
    return replace(scene.points, xyz=xyz)


@pytest.mark.parametrize("color", [0, 90])
def test_bars(scene: Scene, color: int) -> None:
    hint = frame_hint(barred(scene, color=color))
    assert hint is not None
    assert "22% of the pixels are the same in all photos, but points of the scene lie there" in hint
    assert hint.endswith("leave them out with masks, or crop the photos")


def test_transparent_rims(scene: Scene) -> None:
    hint = frame_hint(barred(scene, transparent=True))
    assert hint is not None
    assert "22% of the pixels are transparent in all photos" in hint
    assert hint.endswith("the option alpha=mask leaves them out")


def test_what_gets_no_hint(scene: Scene) -> None:
    assert frame_hint(scene) is None, "usual photos"
    few_in_bars = near_the_middle(scene, 0.3)
    assert frame_hint(replace(barred(scene), points=few_in_bars)) is not None
    assert frame_hint(replace(barred(scene, rows=14), points=few_in_bars)) is None, "much of the photo: a background"
    nothing = Points(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros(0, np.int64))
    assert frame_hint(replace(barred(scene), points=nothing)) is None
    bars = barred(scene)
    assert frame_hint(replace(bars, points=near_the_middle(scene, 0.0))) is None, "no point lies in the bars"
    for n_views, found in ((5, False), (6, True)):
        some = replace(bars, views=bars.train[:n_views], test_names=frozenset())
        assert (frame_hint(some) is not None) == found, "few photos agree by chance"
    masked = []
    for view in bars.views:
        mask = np.ones(view.image.shape[:2], np.bool_)
        mask[:4], mask[-4:] = False, False
        masked.append(replace(view, mask=mask))
    assert frame_hint(replace(bars, views=masked)) is None, "they are left out already"


def test_few_points_in_a_rim_are_enough(scene: Scene) -> None:
    """Points gather in the middle of photos: a rim may hold less than a hundredth of them."""
    cameras = [view.camera for view in scene.train]
    xyz = np.repeat(near_the_middle(scene, 0.16).xyz, 5, axis=0)  # about as many points as usual scenes have
    rows = [seen(camera, sampled(xyz)).rows_and_columns[0] for camera in cameras]
    in_bars = [(row < 4) | (row >= camera.height - 4) for row, camera in zip(rows, cameras, strict=True)]
    assert 0.0067 < np.concatenate(in_bars).mean() < 0.01, "of the points, for 22 % of the pixels"
    many = Points(xyz, np.zeros(xyz.shape, np.uint8), np.zeros(len(xyz), np.int64))
    assert frame_hint(replace(barred(scene), points=many)) is not None


def test_transparency_that_differs_is_around_an_object(scene: Scene) -> None:
    """All photos are transparent at the sides, where points of the scene lie, and around an object as well."""
    bars = barred(scene, transparent=True)
    views = []
    for number, view in enumerate(bars.views):
        assert view.alpha is not None
        alpha = view.alpha.copy()
        alpha[:, 4 * (number % 6) : 4 * (number % 6) + 8] = 0
        views.append(replace(view, alpha=alpha))
    assert frame_hint(bars) is not None
    assert frame_hint(replace(bars, views=views)) is None


def test_a_run_says_it_once(scene: Scene) -> None:
    said: list[str] = []

    def hear(progress: Progress) -> None:
        said.append(progress.message)

    train(barred(scene), TrainConfig(iterations=3, cap_max=50, sh_degree=0), hear)
    assert sum("are the same in all photos" in message for message in said) == 1
