"""Photos that disagree with all others: which they are, when a run leaves them out, and how it goes on."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from clsplat.cameras.camera import Camera
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.demo.scene import write_capture
from clsplat.scenes.scene import Scene, View, load_scene
from clsplat.training import outliers as outliers_module
from clsplat.training.config import TrainConfig
from clsplat.training.log import Progress
from clsplat.training.outliers import FEWEST_VIEWS, Likeness, likeness, outliers
from clsplat.training.presets import preset
from clsplat.training.run import train
from clsplat.training.trainer import Trainer
from clsplat.training.view_sampler import ViewSampler

OPTIONS: dict[str, Any] = {"iterations": 1000, "cap_max": 1500, "densify_interval": 20, "sh_degree": 0}
WRONG = (3, 11, 19, 27)  # training views with wrong poses


def turned(camera: Camera, degrees: float) -> Camera:
    """Return the camera, turned in its place."""
    pose = camera.cam_from_world.copy()
    pose[:3] = Rotation.from_euler("y", degrees, degrees=True).as_matrix() @ pose[:3]
    return camera.posed(pose)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Scene:
    """A capture with enough photos to say which disagree."""
    return load_scene(write_capture(tmp_path_factory.mktemp("more") / "yard", 48, 36, 40))


@pytest.fixture
def misplaced(scene: Scene) -> Scene:
    """The small capture with wrong poses of four training views."""
    names = {scene.train[index].name for index in WRONG}
    views = [replace(view, camera=turned(view.camera, 180.0)) if view.name in names else view for view in scene.views]
    return replace(scene, views=views)


def names_of(scene: Scene, indices: tuple[int, ...] = WRONG) -> list[str]:
    return [scene.train[index].name for index in indices]


def test_likeness_agrees_with_numpy(scene: Scene) -> None:
    splats = Trainer(scene, TrainConfig(**OPTIONS)).snapshot()
    renderer, view = Renderer(), scene.train[0]
    mask = np.ones(view.image.shape[:2], np.bool_)
    mask[:, :20] = False
    alpha = np.full(view.image.shape[:2], 255, np.uint8)
    alpha[:10] = 0
    kept = np.zeros_like(mask)
    kept[10:, 20:] = True
    found = likeness(renderer, splats, View(view.name, view.camera, view.image, mask, alpha), (0.0, 0.0, 0.0))
    photo = np.asarray(view.image, float)[kept].mean(axis=1) / 255
    shown = np.clip(renderer.render(splats, view.camera).color.astype(float), 0, 1)[kept].mean(axis=1)
    assert found.unlike == pytest.approx(1 - np.corrcoef(photo, shown)[0, 1], abs=1e-4)
    assert found.error == pytest.approx(np.mean((photo - shown) ** 2), rel=1e-4)
    nothing = View(view.name, view.camera, view.image, np.zeros_like(mask))
    assert likeness(renderer, splats, nothing, (0.0, 0.0, 0.0)) == Likeness(0.0, 0.0)


def beside(n: int) -> np.ndarray:
    """The four photos around each of n in a row, (n, 4)."""
    first = np.clip(np.arange(n) - 2, 0, n - 5)
    return np.array([[other for other in range(start, start + 5) if other != one] for one, start in enumerate(first)])


def outliers_of(photos: list[Likeness]) -> frozenset[int]:
    return outliers(photos, beside(len(photos)))


def test_which_views_are_outliers() -> None:
    usual = [Likeness(0.02 + 0.001 * index, 1e-3) for index in range(18)]
    assert outliers_of([*usual, Likeness(0.2, 0.01)]) == {18}
    assert not outliers_of([*usual, Likeness(0.2, 0.003)]), "a plain wall: its error is small"
    blurred = [Likeness(0.05 + 0.001 * index, 1e-3) for index in range(18)]
    assert not outliers_of([*blurred, Likeness(0.25, 0.01)]), "four times what is usual: a hard photo"
    assert not outliers_of([Likeness(0.001 * (1 + index / 18), 1e-5) for index in range(18)] + [Likeness(0.05, 0.01)])
    wide = [Likeness(0.02 * 1.12 ** (index - 9), 1e-3) for index in range(18)]
    assert not outliers_of([*wide, Likeness(0.16, 0.01)]), "eight times what is usual, where photos differ much"
    assert outliers_of([*wide, Likeness(1.2, 0.01)]) == {18}
    among_easy = [*wide[:9], Likeness(0.19, 0.01), *wide[9:]]
    assert outliers_of(among_easy) == {9}, "photos from nearby are easy"
    assert not outliers_of([*wide[:9], Likeness(0.075, 0.01), *wide[9:]]), "four times those from nearby, but little"
    many = [Likeness(0.5, 0.1)] * 6
    assert outliers_of([*usual, *many]) == {18, 19, 20, 21, 22, 23}
    assert not outliers_of([*usual, *many, many[0]]), "too many to say which are right"


def test_a_run_goes_on_without_photos_of_wrong_poses(misplaced: Scene) -> None:
    said: list[Progress] = []
    config = TrainConfig(**OPTIONS)
    trainer = Trainer(misplaced, config, progress=said.append)
    trainer.run()
    assert trainer.outliers.left_out == names_of(misplaced)
    messages = [progress.message for progress in said if "disagree" in progress.message]
    assert len(messages) == len(set(messages)) > 0, "each choice is said once"
    n, first = len(misplaced.train), ", ".join(names_of(misplaced)[:3])
    assert messages[-1] == (
        f"{len(WRONG)} of {n} photos disagree with all others, as with wrong poses: {first}, ...; the run goes on "
        "without them (outlier_check=False keeps them)"
    )
    kept = Trainer(misplaced, config.replace(outlier_check=False))
    kept.run()
    assert not kept.outliers.left_out
    test = misplaced.test
    assert trainer.evaluate(test).psnr > kept.evaluate(test).psnr + 0.2, (
        "0.3 to 0.5 dB, by the rounding of the schedule"
    )


def test_photos_that_a_later_check_takes_back_are_reported(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    found = iter([frozenset({1}), frozenset({1})])
    monkeypatch.setattr(outliers_module, "outliers", lambda measured, near: next(found, frozenset()))
    said: list[str] = []
    config = TrainConfig(iterations=1000, cap_max=200, sh_degree=0)
    model = train(scene, config, lambda progress: said.append(progress.message), output=tmp_path / "m")
    assert model.left_out == ()
    lines = [json.loads(line) for line in (tmp_path / "m" / "log.jsonl").read_text().splitlines()]
    logged = [(line["iteration"], len(line["left_out"])) for line in lines if "left_out" in line]
    assert logged == [(100, 1), (200, 1), (300, 0)]
    assert sum("photos disagree" in message for message in said) == 1
    assert sum("goes on with all of them" in message for message in said) == 1


def test_a_usual_capture_is_not_changed(scene: Scene) -> None:
    """No photo is left out, and the splats have the same bits as without the check."""
    config = TrainConfig(**OPTIONS | {"iterations": 300})
    first, second = (train(scene, config.replace(outlier_check=on)).splats for on in (True, False))
    for name, values in first.arrays.items():
        np.testing.assert_array_equal(values, second.arrays[name])


def test_the_sampler_passes_over_views(scene: Scene) -> None:
    def drawn(left_out: tuple[int, ...]) -> list[int]:
        sampler = ViewSampler(scene.train, 100, False, np.random.default_rng(0), [], None, left_out)
        return [sampler.next(1, 1)[0] for _ in range(3 * len(scene.train))]

    kept = [index for index in drawn(()) if index not in (2, 5)]
    some = drawn((2, 5))
    assert some[: len(kept)] == kept, "the order of the others is the same"
    assert not {2, 5} & set(some)


def test_a_resumed_run_leaves_out_the_same(misplaced: Scene, tmp_path: Path) -> None:
    config = TrainConfig(**OPTIONS, checkpoint_interval=0)
    whole = train(misplaced, config, output=tmp_path / "whole")

    def stop_at(trainer: Trainer, stop: object) -> None:
        if trainer.iteration == 600:
            stop.set()  # type: ignore[attr-defined]

    train(misplaced, config, output=tmp_path / "parts", visit=stop_at)
    rest = train(misplaced, config, output=tmp_path / "parts", resume=True)
    for name, values in whole.splats.arrays.items():
        np.testing.assert_array_equal(values, rest.splats.arrays[name])
    lines = [json.loads(line) for line in (tmp_path / "parts" / "log.jsonl").read_text().splitlines()]
    named = [line for line in lines if "left_out" in line]
    assert named[-1] == {"iteration": 300, "left_out": names_of(misplaced)}


def test_when_it_looks(scene: Scene) -> None:
    def due(options: dict[str, Any], views: int = 100) -> list[int]:
        some = replace(scene, views=[*scene.train[:views]], test_names=frozenset())
        trainer = Trainer(some, TrainConfig(**(OPTIONS | options)))
        return [it for it in range(1, 1001) if trainer.outliers.is_due(it)]

    assert due({}) == [100, 200, 300]
    assert due({"outlier_check": False}) == []
    assert due(preset("3dgs") | OPTIONS) == [], "published systems learn from all photos"
    assert due({}, FEWEST_VIEWS) == [100, 200, 300]
    for iterations, expected in ((400, [80, 120]), (250, [50]), (150, [])):
        assert due({"iterations": iterations}) == expected, "a check of 35 photos takes the time of 12 iterations"
    assert due({}, FEWEST_VIEWS - 1) == []
