"""The number of commands of a training step on a GPU: a small scene waits for the host, which enqueues them."""

from __future__ import annotations

from pathlib import Path

import pytest
from device_schedules import as_kind
from small_scene import write_garden

from clsplat.device.device import Device
from clsplat.device.trace import recorded
from clsplat.rendering.radix_sort import radix_passes
from clsplat.scenes.scene import load_scene
from clsplat.training.config import TrainConfig
from clsplat.training.trainer import Trainer

LIMIT = 40
TILE_BITS_1080P = (-(-1920 // 16) * -(-1080 // 16) - 1).bit_length()


@pytest.mark.parametrize(
    ("shape", "visible_adam"), [("gaussian", False), ("skew-normal", False), ("skew-normal", True)]
)
def test_a_step_has_few_commands(
    device: Device, monkeypatch: pytest.MonkeyPatch, shape: str, visible_adam: bool, tmp_path: Path
) -> None:
    """Count the commands of a step on a small image, and the further passes of the tile sort of a large one.

    Steps of visible splats need two more: the table of skipped steps, and the selection of splats.
    """
    monkeypatch.setenv("CLSPLAT_SCHEDULE", "gpu64")
    gpu = as_kind(device, "GPU")
    scene = load_scene(write_garden(tmp_path))
    config = TrainConfig(
        iterations=30, cap_max=200, shape=shape, densify_interval=50, opacity_reg=0.0, visible_adam=visible_adam
    )
    trainer = Trainer(scene, config, device=gpu)
    trainer.step()  # the first step clears statistics
    with recorded(gpu) as commands:
        frame = trainer.step()
    names = [command.name for command in commands]
    small = radix_passes(max((frame.layout.n_tiles - 1).bit_length(), 1))
    assert len(names) + 3 * (radix_passes(TILE_BITS_1080P) - small) <= LIMIT + 2 * visible_adam, names
