"""The mean over the last part of a run: what it is the mean of, and how it passes through checkpoints and files."""

from __future__ import annotations

import json
import threading
from pathlib import Path

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.evaluation.evaluate import evaluate
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.scene import Scene
from clsplat.splats.fields import Array
from clsplat.splats.splats import Splats
from clsplat.training.average import SAMPLES, ParameterAverage
from clsplat.training.checkpoint import Checkpoint
from clsplat.training.config import TrainConfig
from clsplat.training.presets import PRESETS, with_preset
from clsplat.training.run import train
from clsplat.training.trainer import Trainer

CONFIG = TrainConfig(
    shape="skew-normal",
    iterations=60,
    cap_max=400,
    sh_degree=1,
    average_last=0.4,
    densify_interval=10,
    checkpoint_interval=50,
)
SAMPLED = range(37, 61)  # the last 24 iterations


class Crash(Exception):
    """The end of a run between two iterations."""


class Steps:
    """Keeps the parameters after each iteration."""

    def __init__(self) -> None:
        self.after: dict[int, dict[str, Array]] = {}

    def __call__(self, trainer: Trainer, stop: threading.Event) -> None:
        self.after[trainer.iteration] = dict(trainer.optimizer.read())

    def mean(self, iterations: range) -> dict[str, Array]:
        names = self.after[iterations[0]]
        return {name: np.mean([self.after[it][name].astype(np.float64) for it in iterations], axis=0) for name in names}


def sampled(average: ParameterAverage, iterations: int) -> list[int]:
    return [iteration for iteration in range(1, iterations + 1) if average.is_due(iteration)]


@pytest.mark.parametrize("changes", [{}, {"visible_adam": True}, {"optimizer": "numpy"}, {"strategy": "mcmc"}], ids=str)
def test_the_model_is_the_mean_of_the_last_part(scene: Scene, changes: dict[str, object]) -> None:
    config, steps = CONFIG.replace(**{"densify_until": 0.5, **changes}), Steps()
    model = train(scene, config, visit=steps)
    expected = steps.mean(SAMPLED)
    for name, array in model.splats.to_numpy().items():
        np.testing.assert_allclose(array, expected[name], rtol=2e-5, atol=2e-6, err_msg=name)
    moved = max(np.abs(expected[name] - steps.after[60][name]).max() for name in expected)
    assert moved > 1e-3, "the mean is not the last step"


def test_without_a_part_the_model_is_the_last_step(scene: Scene) -> None:
    steps = Steps()
    model = train(scene, CONFIG.replace(average_last=0.0), visit=steps)
    for name, array in model.splats.to_numpy().items():
        np.testing.assert_array_equal(array, steps.after[60][name])


@pytest.mark.parametrize(
    ("iterations", "densify_last", "expected"),
    [
        (1000, 500, [*range(952, 1001, 2)]),  # 50 iterations, every second
        (30_000, 15_000, [*range(28_575, 30_001, 75)]),
        (100, 50, [96, 97, 98, 99, 100]),
        (100, 98, [99, 100]),  # never before the last densification
        (100, 100, []),
        (1, 0, []),
    ],
)
def test_samples_are_the_end_of_the_run(iterations: int, densify_last: int, expected: list[int]) -> None:
    average = ParameterAverage(TrainConfig(iterations=iterations, average_last=0.05), densify_last)
    assert sampled(average, iterations) == expected
    assert len(expected) < 2 * SAMPLES


def test_a_run_that_densifies_until_its_end_has_no_mean(scene: Scene) -> None:
    """The splats of the last iterations are different ones, and have no mean."""
    steps = Steps()
    model = train(scene, CONFIG.replace(densify_until=1.0, strategy="mcmc"), visit=steps)
    for name, array in model.splats.to_numpy().items():
        np.testing.assert_array_equal(array, steps.after[60][name])


def test_a_crash_in_the_last_part_resumes_to_the_same_mean(scene: Scene, tmp_path: Path) -> None:
    def crash(trainer: Trainer, stop: threading.Event) -> None:
        if trainer.iteration == 55:
            raise Crash

    whole = train(scene, CONFIG, output=tmp_path / "whole")
    with pytest.raises(Crash):
        train(scene, CONFIG, output=tmp_path / "m", visit=crash)
    stored = Checkpoint.load(tmp_path / "m" / "checkpoint.npz")
    assert stored.iteration == 50
    assert stored.average["count"] == [14]
    resumed = train(scene, CONFIG, output=tmp_path / "m", resume=True)
    for name, array in resumed.splats.to_numpy().items():
        np.testing.assert_array_equal(array, whole.splats.to_numpy()[name])
    saved = Splats.load(tmp_path / "m" / "point_cloud" / "iteration_60" / "point_cloud.ply")
    np.testing.assert_array_equal(saved.mean, whole.splats.mean)


def test_a_model_before_the_end_is_that_of_its_step(scene: Scene) -> None:
    def compare(trainer: Trainer, stop: threading.Event) -> None:
        if trainer.iteration == 59:
            np.testing.assert_array_equal(trainer.snapshot().mean, trainer.optimizer.read()["mean"])

    assert train(scene, CONFIG, visit=compare).finished


def test_a_finished_run_resumes_to_its_mean(scene: Scene, tmp_path: Path) -> None:
    whole = train(scene, CONFIG, output=tmp_path)
    again = train(scene, CONFIG, output=tmp_path, resume=True)
    np.testing.assert_array_equal(again.splats.mean, whole.splats.mean)


def test_a_longer_run_continues_from_the_last_step(scene: Scene, tmp_path: Path) -> None:
    steps = Steps()
    train(scene, CONFIG, output=tmp_path, visit=steps)
    longer = Trainer(scene, CONFIG.replace(iterations=120), Checkpoint.load(tmp_path / "checkpoint.npz"))
    np.testing.assert_array_equal(longer.snapshot().mean, steps.after[60]["mean"])
    assert longer.average.count == 0, "the last part of the longer run is another one"


def test_metrics_and_the_model_at_the_end_are_those_of_the_mean(scene: Scene, tmp_path: Path) -> None:
    model = train(scene, CONFIG.replace(test_iterations=(60,)), output=tmp_path)
    measured = evaluate(Renderer(), model.splats, scene.test, CONFIG.background)
    assert model.evaluations[60].psnr == pytest.approx(measured.psnr, abs=1e-6)
    lines = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert next(line["test_psnr"] for line in lines if "test_psnr" in line) == pytest.approx(measured.psnr, abs=1e-6)


def test_published_systems_have_no_mean() -> None:
    assert {TrainConfig(**with_preset(name, {})).optim.average_last for name in PRESETS} == {0.0}


@pytest.mark.parametrize(
    "damaged", [{"mean": np.zeros((3, 3), np.float32)}, {"count": np.zeros(1, np.int64)}, {"count": np.zeros((1, 2))}]
)
def test_a_damaged_mean_is_refused(scene: Scene, tmp_path: Path, damaged: dict[str, Array]) -> None:
    train(scene, CONFIG, output=tmp_path)
    path = tmp_path / "checkpoint.npz"
    with np.load(path) as stored:
        arrays = {name: stored[name] for name in stored.files}
    arrays |= {f"average.{name}": values for name, values in damaged.items()}
    with path.open("wb") as stream:
        np.savez(stream, **arrays)  # type: ignore[arg-type]
    with pytest.raises(InputError, match=r"checkpoint\.npz: not a readable checkpoint \(its average"):
        train(scene, CONFIG, output=tmp_path, resume=True)
