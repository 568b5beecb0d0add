"""Validation views of a run: what is held out, when it is measured, and which model is kept."""

from __future__ import annotations

import json
import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import clsplat
from clsplat.errors import InputError
from clsplat.evaluation.evaluate import Evaluation, evaluate
from clsplat.models.model import load_model
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.demo.scene import write_capture
from clsplat.scenes.scene import Scene, View, load_scene
from clsplat.scenes.split import hold_out, with_validation
from clsplat.training import validation as validation_module
from clsplat.training.config import TrainConfig
from clsplat.training.decisions import decide
from clsplat.training.folder import ModelFolder
from clsplat.training.log import Progress
from clsplat.training.run import train
from clsplat.training.trainer import Trainer

CONFIG = TrainConfig(iterations=41, cap_max=300, sh_degree=0, shape="gaussian", validate=True, checkpoint_interval=15)
MEASURED = [*range(2, 41, 2), 41]  # the length of the run is not a multiple of the interval


class Crash(Exception):
    """The end of a run between two iterations."""


def logged(folder: Path) -> dict[int, float]:
    """Return the PSNR of the validation views by iteration."""
    lines = [json.loads(line) for line in (folder / "log.jsonl").read_text().splitlines()]
    return {line["iteration"]: line["validation_psnr"] for line in lines if "validation_psnr" in line}


@pytest.fixture
def falling(monkeypatch: pytest.MonkeyPatch) -> dict[int, float]:
    """Let the PSNR of the n-th measurement be 30 - |n - 7|, so that the 7th is the best; return it by iteration."""
    measure, made = validation_module.evaluate, iter(range(1, 1000))

    def made_up(*args: Any) -> Evaluation:
        return replace(measure(*args), psnr=30.0 - abs(next(made) - 7))

    monkeypatch.setattr(validation_module, "evaluate", made_up)
    return {iteration: 30.0 - abs(n - 7) for n, iteration in enumerate(MEASURED, 1)}


def test_validation_views_are_neither_trained_nor_tested(scene: Scene) -> None:
    split = with_validation(scene)
    assert [view.name for view in split.validation] == [view.name for view in hold_out(scene).test]
    assert split.test_names == scene.test_names
    parts = [{view.name for view in views} for views in (split.train, split.validation, split.test)]
    assert set().union(*parts) == set(scene.names)
    assert sum(map(len, parts)) == len(scene.names)


def test_a_run_holds_them_out_and_measures_them(scene: Scene, tmp_path: Path) -> None:
    trained: set[str] = set()
    said: list[str] = []

    def visit(trainer: Trainer, stop: threading.Event) -> None:
        trained.update(view.name for view in trainer.targets.views)

    model = train(scene, CONFIG, lambda progress: said.append(progress.message), output=tmp_path / "m", visit=visit)
    expected = with_validation(scene)
    assert trained == {view.name for view in expected.train}
    values = logged(tmp_path / "m")
    assert list(values) == MEASURED
    own = evaluate(Renderer(), model.splats, expected.validation, CONFIG.background).psnr
    assert values[41] == pytest.approx(own, abs=1e-9)
    assert model.best_iteration == max(values, key=values.__getitem__)
    ending = f"{len(expected.validation)} validation views: PSNR {own:.2f} dB at the end"
    assert said[-1].startswith(ending)
    train(scene, CONFIG, lambda progress: said.append(progress.message), output=tmp_path / "m", resume=True)
    assert said[-1].startswith(ending), "a finished run has measured them before"

    loaded = load_model(tmp_path / "m")
    names = {view.name for view in expected.validation}
    assert loaded.validation_names == names
    stored = loaded.load_scene()
    assert {view.name for view in stored.validation} == names
    assert {view.name for view in stored.train} == trained
    options = clsplat.EvaluationOptions(view_set="validation", report=False)
    assert clsplat.evaluate(tmp_path / "m", options).result["PSNR"] == pytest.approx(own, abs=1e-6)
    assert len(loaded.read_cameras()) == len(scene.views)
    for view_set, views in (("validation", expected.validation), ("train", expected.train), ("test", expected.test)):
        rendered = clsplat.render_views(
            tmp_path / "m", clsplat.RenderOutput(tmp_path / view_set), clsplat.ViewChoice(view_set=view_set)
        )
        assert len(rendered.views) == len(views), view_set


def test_the_best_model_is_kept_besides_the_last(scene: Scene, tmp_path: Path, falling: dict[int, float]) -> None:
    said: list[Progress] = []
    model = train(scene, CONFIG.replace(save_iterations=(6,)), said.append, output=tmp_path / "m")
    assert logged(tmp_path / "m") == falling
    assert model.best_iteration == 14
    assert ModelFolder(tmp_path / "m").iterations() == [6, 14, 41], "the 6th was asked for"
    assert "30.00 dB after iteration 14 was the best, and is kept in point_cloud/iteration_14" in said[-1].message
    assert load_model(tmp_path / "m").iteration == 41


def test_test_views_choose_nothing(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The chosen iteration and all bits are the same if the test views show something else."""
    measure, seen = validation_module.evaluate, set()

    def watched(renderer: Renderer, splats: Any, views: list[View], *rest: Any) -> Evaluation:
        seen.update(view.name for view in views)
        return measure(renderer, splats, views, *rest)

    monkeypatch.setattr(validation_module, "evaluate", watched)
    train(scene, CONFIG, output=tmp_path / "m")
    assert seen
    assert seen.isdisjoint(scene.test_names)


def test_a_resumed_run_keeps_the_best(scene: Scene, tmp_path: Path, falling: dict[int, float]) -> None:
    def crash(trainer: Trainer, stop: threading.Event) -> None:
        if trainer.iteration == 19:
            raise Crash

    with pytest.raises(Crash):
        train(scene, CONFIG, output=tmp_path / "m", visit=crash)
    assert ModelFolder(tmp_path / "m").iterations() == [14]
    model = train(scene, CONFIG, output=tmp_path / "m", resume=True)
    assert model.best_iteration == 14
    assert list(logged(tmp_path / "m")) == MEASURED
    assert ModelFolder(tmp_path / "m").iterations() == [14, 41]


def test_interruptions_leave_no_point_clouds_behind(scene: Scene, tmp_path: Path, falling: dict[int, float]) -> None:
    """The run stops after each of its first best iterations. Only the last best one stays."""
    for stop_at in (7, 11, 19):

        def stop(trainer: Trainer, event: threading.Event, stop_at: int = stop_at) -> None:
            if trainer.iteration == stop_at:
                event.set()

        train(scene, CONFIG, output=tmp_path / "m", visit=stop, resume=stop_at > 7)
        assert ModelFolder(tmp_path / "m").iterations()[0] == min(stop_at // 2 * 2, 14)
    train(scene, CONFIG, output=tmp_path / "m", resume=True)
    assert ModelFolder(tmp_path / "m").iterations() == [14, 41]


def test_decisions_are_made_on_what_the_run_learns_from(tmp_path: Path) -> None:
    """The training photos without the validation views are few enough for the options of few photos."""
    few = load_scene(write_capture(tmp_path / "yard", 48, 36, 16))
    assert len(few.train) == 14
    decided = [decide(few, TrainConfig(validate=validate)).config for validate in (False, True)]
    assert [bool(config.views.depth_smoothness) for config in decided] == [False, True]
    assert decided[1] == decide(with_validation(few), TrainConfig(validate=True)).config


def test_a_longer_run_does_not_remove_the_shorter_one(scene: Scene, tmp_path: Path) -> None:
    short = CONFIG.replace(iterations=20)
    assert train(scene, short, output=tmp_path / "m").best_iteration == 20
    longer = train(scene, CONFIG, output=tmp_path / "m", resume=True)
    assert longer.best_iteration > 20
    assert {20, 41} <= set(ModelFolder(tmp_path / "m").iterations())


def test_two_training_views_are_too_few(scene: Scene) -> None:
    few = Scene(scene.name, scene.path, scene.train[:2], scene.points)
    with pytest.raises(InputError, match="has 2 training views; at least 3"):
        Trainer(few, CONFIG)


def test_without_it_no_view_is_held_out(scene: Scene, tmp_path: Path) -> None:
    model = train(scene, CONFIG.replace(validate=False, iterations=4), output=tmp_path / "m")
    assert model.best_iteration == 0
    assert logged(tmp_path / "m") == {}
    assert load_model(tmp_path / "m").validation_names == frozenset()
    with pytest.raises(InputError, match="has no validation views"):
        clsplat.evaluate(tmp_path / "m", clsplat.EvaluationOptions(view_set="validation"))
    with pytest.raises(InputError, match="no validation views are known"):
        clsplat.render_views(
            tmp_path / "m", clsplat.RenderOutput(tmp_path / "out"), clsplat.ViewChoice(view_set="validation")
        )
