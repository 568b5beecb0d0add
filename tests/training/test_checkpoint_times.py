"""Checkpoints by iterations and by the clock, which do not change the model."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import pytest

from clsplat.scenes.scene import Scene
from clsplat.training import trainer as trainer_module
from clsplat.training.checkpoint import Checkpoint
from clsplat.training.checkpoint_times import CheckpointTimes
from clsplat.training.config import TrainConfig
from clsplat.training.options.groups import OutputConfig
from clsplat.training.run import train


class Clock:
    """A clock that goes on by `step` seconds when it is read."""

    def __init__(self, step: float = 0.0) -> None:
        self.now, self.step = 1000.0, step

    def __call__(self) -> float:
        self.now += self.step
        return self.now


def test_minutes_count_from_the_last_checkpoint() -> None:
    clock = Clock()
    times = CheckpointTimes(OutputConfig(checkpoint_interval=100, checkpoint_minutes=2), clock)
    clock.now += 119
    assert not times.is_due(3)
    assert times.is_due(200)
    clock.now += 1
    assert times.is_due(4)
    times.saved()
    clock.now += 119
    assert not times.is_due(5)


def test_zero_means_never() -> None:
    clock = Clock()
    times = CheckpointTimes(OutputConfig(checkpoint_interval=0, checkpoint_minutes=0), clock)
    clock.now += 1e6
    assert not any(times.is_due(iteration) for iteration in range(1, 3000))


def test_checkpoints_by_time_keep_the_bits(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An iteration takes 20 seconds here, so every third one of a minute saves a checkpoint."""
    config = TrainConfig(iterations=11, cap_max=300, sh_degree=1, checkpoint_interval=0, checkpoint_minutes=1)
    saved: list[int] = []
    save = Checkpoint.save

    def spy(checkpoint: Checkpoint, path: Path) -> None:
        saved.append(checkpoint.iteration)
        save(checkpoint, path)

    monkeypatch.setattr(Checkpoint, "save", spy)
    models = []
    for name, step in (("often", 20.0), ("never", 0.0)):
        monkeypatch.setattr(trainer_module, "CheckpointTimes", partial(CheckpointTimes, clock=Clock(step)))
        train(scene, config, output=tmp_path / name)
        models.append((tmp_path / name / "point_cloud" / "iteration_11" / "point_cloud.ply").read_bytes())
    assert saved == [3, 6, 9, 11, 11]
    assert models[0] == models[1]
