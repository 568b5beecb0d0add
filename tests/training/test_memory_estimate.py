"""The memory estimate covers all allocations of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from small_scene import write_garden

from clsplat.device.device import Device
from clsplat.device.opencl import Buffer
from clsplat.scenes.scene import load_scene
from clsplat.training.config import TrainConfig
from clsplat.training.trainer import Trainer

RUNS: dict[str, dict[str, Any]] = {
    "gaussian": {"shape": "gaussian"},
    "skew-normal with exposure": {"shape": "skew-normal", "strategy": "mcmc", "exposure": True},
    "lazy steps": {"shape": "gaussian", "visible_adam": True},
    "momentum": {"shape": "student-t", "position_optimizer": "sghmc"},
}


@pytest.mark.parametrize("name", RUNS)
def test_a_run_allocates_at_most_its_estimate(
    device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """The test adds up all allocations, including those of buffers that are released again."""
    alloc, sizes = Device.alloc, []

    def counted(self: Device, nbytes: int) -> Buffer:
        buffer = alloc(self, nbytes)
        sizes.append(buffer.size)
        return buffer

    config = TrainConfig(iterations=24, cap_max=20_000, densify_interval=6, sh_degree=2, **RUNS[name])
    scene = load_scene(write_garden(tmp_path))
    monkeypatch.setattr(Device, "alloc", counted)
    trainer = Trainer(scene, config, device=device)
    for _ in range(config.iterations):
        trainer.step()
    trainer.device.queue.finish()
    assert trainer.memory.total / 2 < sum(sizes) <= trainer.memory.total


def test_training_allocates_no_depth(device: Device, tmp_path: Path) -> None:
    trainer = Trainer(load_scene(write_garden(tmp_path)), TrainConfig(iterations=1, cap_max=2000), device=device)
    assert trainer.step().images.depth is None
