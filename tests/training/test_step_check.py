"""A device whose optimizer steps wrongly is refused before a run, with one line."""

from __future__ import annotations

import pytest

from clsplat.device import program
from clsplat.device.device import Device, open_device
from clsplat.device.schedule import Schedule, default_schedule
from clsplat.errors import DeviceError
from clsplat.scenes.scene import Scene
from clsplat.training.config import TrainConfig
from clsplat.training.programs import kernel_build
from clsplat.training.step_check import check_step
from clsplat.training.trainer import Trainer

CONFIGS = [
    {},
    {"shape": "gaussian"},
    {"shape": "skew-normal-direct", "skew_map": "polar"},
    {"shape": "bisected-skew", "skew_map": "coupled", "bisect_reg": 3.0},
    {"shape": "student-t", "position_optimizer": "sghmc-sss"},
    {"shape": "generalised-exponential"},
    {"shape": "half-gaussian", "position_optimizer": "sghmc"},
]
# What a compiler may do to the text of the optimizer: its old part, its new part, and the field that shows it first.
FAULTS = {
    "no bias correction": ("m * correct1 /", "m /", "mean"),
    "no square root": ("(sqrt(v * correct2)", "(v * correct2", "mean"),
    "moments are lost": ("lanes_store(v, v_at);", "", "mean"),
    "wrong rate": ("part == PART_MEAN ? mean_lr", "part == PART_QUAT ? mean_lr", "mean"),
}


@pytest.mark.parametrize("options", CONFIGS, ids=str)
def test_every_optimizer_passes(device: Device, options: dict[str, object]) -> None:
    config = TrainConfig(**options)
    check_step(device, kernel_build(config, default_schedule(device.info)), config.sghmc.position_optimizer)


def test_every_schedule_passes(scheduled: tuple[Device, Schedule]) -> None:
    config = TrainConfig()
    check_step(scheduled[0], kernel_build(config, scheduled[1]), "adam")


@pytest.mark.parametrize("fault", FAULTS)
def test_a_wrong_step_is_refused(device: Device, fault: str, monkeypatch: pytest.MonkeyPatch) -> None:
    old, new, field = FAULTS[fault]
    source, changed = program.source, []

    def changing(*names: str) -> str:
        text = source(*names)
        changed.extend([old] * (old in text))
        return text.replace(old, new)

    monkeypatch.setattr(program, "source", changing)
    config = TrainConfig()
    kernels = kernel_build(config, default_schedule(device.info))
    with pytest.raises(DeviceError, match=rf"computes wrong numbers \(step of {field} off by ") as caught:
        check_step(open_device(device.info.index), kernels, "adam")
    assert changed, "the kernels have this text"
    assert "\n" not in str(caught.value)


def test_no_run_starts_with_a_wrong_step(scene: Scene, device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    source = program.source
    monkeypatch.setattr(program, "source", lambda *names: source(*names).replace("m * correct1 /", "m /"))
    with pytest.raises(DeviceError, match="computes wrong numbers"):
        Trainer(scene, TrainConfig(iterations=1), device=open_device(device.info.index))
