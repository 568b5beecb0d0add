"""Points of another coordinate system than the poses are left out; others are kept, whatever their colours."""

from __future__ import annotations

import os
import signal
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_scene import with_points_elsewhere

from clsplat.cameras.seen import seen
from clsplat.scenes.colmap import NO_POINTS, Points
from clsplat.scenes.scene import Scene, View
from clsplat.training.config import TrainConfig
from clsplat.training.log import Progress
from clsplat.training.point_fit import point_fit, with_fitting_points
from clsplat.training.run import train
from clsplat.training.trainer import Trainer


def random_colors(scene: Scene) -> Scene:
    rgb = np.random.default_rng(0).integers(0, 256, scene.points.rgb.shape, np.uint8)
    return replace(scene, points=replace(scene.points, rgb=rgb))


def test_points_that_fit_are_kept(scene: Scene) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = with_fitting_points(scene)
    assert found.points is scene.points
    assert found.points_fit
    assert not scene.points_fit


def test_points_elsewhere_are_left_out_with_a_warning(scene: Scene) -> None:
    wrong = with_points_elsewhere(scene)
    shown = np.mean([seen(view.camera, wrong.points.xyz).inside.mean() for view in wrong.train])
    assert shown > 0.1, "some of them lie in the photos by chance"
    with pytest.warns(UserWarning, match=r"do not show the colours of its \d+ points .* check that both have one"):
        found = with_fitting_points(wrong)
    assert len(found.points) == 0
    assert found.views is wrong.views


def test_a_scene_is_looked_at_once(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also if the points are left out."""
    looked: list[int] = []

    def fit(views: object, points: Points) -> tuple[float, float]:
        looked.append(len(points))
        return 0.0, 0.0

    monkeypatch.setattr("clsplat.training.point_fit.point_fit", fit)
    with pytest.warns(UserWarning, match="they are left out") as warned:
        found = with_fitting_points(scene)
    assert with_fitting_points(found) is found
    assert looked == [len(scene.points)]
    assert len(warned) == 1


@pytest.mark.parametrize("change", ["random", "one colour"])
def test_colours_alone_are_no_reason(scene: Scene, change: str) -> None:
    """Points have colours of their own in some programs. The photos agree where such points lie."""
    grey = replace(scene, points=replace(scene.points, rgb=np.full_like(scene.points.rgb, 90)))
    changed = random_colors(scene) if change == "random" else grey
    assert with_fitting_points(changed).points is changed.points


@pytest.mark.parametrize("fit", [(0.3, 0.0), (0.0, 0.3), None])
def test_one_sign_is_enough(scene: Scene, monkeypatch: pytest.MonkeyPatch, fit: tuple[float, float] | None) -> None:
    monkeypatch.setattr("clsplat.training.point_fit.point_fit", lambda views, points: fit)
    assert with_fitting_points(scene).points is scene.points


def test_points_in_other_rooms_do_not_count(scene: Scene) -> None:
    """In a large building, walls hide most of the points that are in the image of a camera."""
    n, center = len(scene.points), np.mean([view.camera.position for view in scene.train], axis=0)
    xyz = np.concatenate([center + factor * (scene.points.xyz - center) for factor in (1, *range(4, 24))])
    rgb = np.random.default_rng(3).integers(0, 256, (len(xyz), 3), np.uint8)
    rgb[:n] = scene.points.rgb
    building = replace(scene, points=replace(scene.points, xyz=xyz, rgb=rgb, track_length=np.ones(len(xyz), np.int64)))
    assert np.mean(np.flatnonzero(seen(scene.train[0].camera, xyz).inside) < n) < 0.5, "most of them are others"
    fit = point_fit(scene.train, building.points)
    assert fit is not None
    assert fit[0] > 0.45
    assert with_fitting_points(building).points is building.points


def test_both_numbers_are_those_of_a_loop(scene: Scene) -> None:
    """Masked and transparent pixels do not count."""
    rng, views = np.random.default_rng(1), []
    for number, view in enumerate(scene.train):
        image, half = np.asarray(view.image), np.zeros(view.image.shape[:2], np.bool_)
        half[:, : image.shape[1] // 2] = True
        alpha = np.where(half, 255, 100).astype(np.uint8) if number == 1 else None
        views.append(View(view.name, view.camera, image, half if number == 0 else None, alpha))
    rows = rng.permutation(len(scene.points))[:2000]
    points = replace(scene.points, xyz=scene.points.xyz[rows], rgb=scene.points.rgb[rows], track_length=rows)
    pairs, contrasts = [], [[] for _ in rows]
    for view in views:
        at = seen(view.camera, points.xyz)
        nearest: dict[tuple[int, int], int] = {}
        for number in np.flatnonzero(at.inside):
            x, y = at.pixel[number].astype(int)
            cell = y * 16 // view.camera.height, x * 16 // view.camera.width
            if cell not in nearest or at.depth[number] < at.depth[nearest[cell]]:
                nearest[cell] = int(number)
        for number in nearest.values():
            x, y = at.pixel[number].astype(int)
            if (view.mask is None or view.mask[y, x]) and (view.alpha is None or view.alpha[y, x] == 255):
                grey = np.pad(np.asarray(view.image).mean(axis=2), 2, "edge")[y : y + 5, x : x + 5]
                pairs.append((points.rgb[number].mean(), grey[2, 2]))
                contrasts[number].append(np.log(grey[2, 2] + 10) - np.log(grey + 10).mean())
    groups = [np.array(each) for each in contrasts if len(each) > 1]
    within = sum(((group - group.mean()) ** 2).sum() for group in groups) / sum(len(group) - 1 for group in groups)
    expected = np.corrcoef(np.array(pairs).T)[0, 1], 1.0 - within / np.concatenate(groups).var()
    assert point_fit(views, points) == pytest.approx(expected, rel=1e-9)


def test_few_points_and_few_photos_say_nothing(scene: Scene) -> None:
    few = replace(
        scene.points, xyz=scene.points.xyz[:50], rgb=scene.points.rgb[:50], track_length=scene.points.track_length[:50]
    )
    assert point_fit(scene.train, few) is None
    assert point_fit(scene.train[:1], scene.points) is None
    assert point_fit(scene.train, NO_POINTS) is None
    assert point_fit([], scene.points) is None


def test_a_run_goes_on_without_them(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The extent of the scene, by which rates are scaled, depends on its points."""
    config, wrong, counts = TrainConfig(iterations=6, cap_max=300, sh_degree=0), with_points_elsewhere(scene), []

    def interrupt(trainer: Trainer, _: object) -> None:
        if trainer.iteration == 3:
            os.kill(os.getpid(), signal.SIGINT)

    def trainer(scene: Scene, *others: object, **more: object) -> Trainer:
        counts.append(len(scene.points))
        return Trainer(scene, *others, **more)  # type: ignore[arg-type]

    monkeypatch.setattr("clsplat.training.run.Trainer", trainer)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a program in the background ignores it
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            assert not train(wrong, config, visit=interrupt, output=tmp_path / "model").finished
    finally:
        signal.signal(signal.SIGINT, before)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert train(wrong, config, output=tmp_path / "model", resume=True).finished
    assert counts == [0, 0]


def test_a_run_starts_without_them_and_gives_no_wrong_hint(scene: Scene) -> None:
    messages: list[str] = []

    def hear(progress: Progress) -> None:
        messages.append(progress.message)

    with pytest.warns(UserWarning, match="do not fit the poses"):
        train(with_points_elsewhere(scene), TrainConfig(iterations=2, cap_max=300, sh_degree=0), hear)
    assert any("the scene has no points" in message for message in messages)
    assert not any("exposure" in message for message in messages)
