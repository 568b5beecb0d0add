"""The memory estimate covers all allocations of a run."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyopencl as cl
import pytest
from small_scene import write_garden

from clsplat.device.device import Device, open_device
from clsplat.device.schedule import SCHEDULES
from clsplat.errors import DeviceError
from clsplat.rendering.build import KernelBuild
from clsplat.rendering.frame import ImageLayout
from clsplat.rendering.splat_buffers import capacity_for
from clsplat.rendering.tuning import schedule_for
from clsplat.scenes.scene import load_scene
from clsplat.training.config import TrainConfig
from clsplat.training.memory_estimate import estimate, run_memory
from clsplat.training.trainer import Trainer

RUNS: dict[str, dict[str, Any]] = {
    "gaussian": {"shape": "gaussian"},
    "skew-normal with exposure": {"shape": "skew-normal", "strategy": "mcmc", "exposure": True},
    "lazy steps": {"shape": "gaussian", "visible_adam": True},
    "half moments": {"shape": "gaussian", "half_moments": True},
    "smooth depths": {"shape": "skew-normal", "depth_smoothness": 0.1},
    "context": {"shape": "skew-normal", "strategy": "adc", "opacity_reg": 0.0, "scale_reg": 0.0, "opacity_reset": 0},
    "momentum": {"shape": "student-t", "position_optimizer": "sghmc"},
}


@pytest.mark.parametrize("name", RUNS)
def test_a_run_allocates_at_most_its_estimate(
    device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """The test adds up all allocations, including those of buffers that are released again."""
    check_allocations(device, tmp_path, monkeypatch, name)


@pytest.mark.parametrize("name", RUNS)
def test_a_gpu_allocates_at_most_its_estimate(
    devices: list[Device], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    """A processor pretends to be a GPU, whose sorts have buffers of their own."""
    monkeypatch.setenv("CLSPLAT_SCHEDULE", "gpu64")
    device = open_device(devices[0].info.index)
    device.info = replace(device.info, type="GPU")
    check_allocations(device, tmp_path, monkeypatch, name)


def check_allocations(device: Device, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    live = peak = allocated = 0

    class CountedBuffer(cl.Buffer):
        """A buffer that is counted as long as it is alive."""

        def __init__(self, *args: Any, **more: Any) -> None:
            nonlocal live, peak, allocated
            super().__init__(*args, **more)
            live += self.size
            allocated += self.size
            peak = max(peak, live)

        def __del__(self) -> None:
            nonlocal live
            live -= self.size

    config = TrainConfig(iterations=24, cap_max=20_000, densify_interval=6, sh_degree=2, **RUNS[name])
    scene = load_scene(write_garden(tmp_path))
    schedule_for(device)  # the first use of a device allocates for its self-test
    context = None
    if name == "context":
        few = Trainer(scene, config, device=device).snapshot()
        context = few.select(np.arange(30_000) % len(few))
    monkeypatch.setattr(cl, "Buffer", CountedBuffer)
    trainer = Trainer(scene, config, device=device, context=context)
    for _ in range(config.iterations):
        trainer.step()
    trainer.device.finish()
    assert trainer.memory.total / 2 < peak <= trainer.memory.total
    if not (device.info.type == "GPU" and config.strategy == "mcmc"):  # sorts and moves release more there
        assert allocated <= trainer.memory.total


def test_training_allocates_no_depth(device: Device, tmp_path: Path) -> None:
    trainer = Trainer(load_scene(write_garden(tmp_path)), TrainConfig(iterations=1, cap_max=2000), device=device)
    assert trainer.step().images.depth is None


def small_device(device: Device, memory: int, buffer: int) -> Device:
    other = open_device(device.info.index)
    other.info = replace(other.info, global_mem_bytes=memory, max_alloc_bytes=buffer)
    return other


CONFIG = TrainConfig(iterations=1, cap_max=2_000_000)
KERNELS = KernelBuild("gaussian", 3, SCHEDULES["cpu16"])


@pytest.mark.parametrize(("memory", "buffer"), [(1 << 30, 1 << 30), (1 << 40, 100 << 20)])
def test_a_run_that_does_not_fit_names_the_number_that_fits(
    devices: list[Device], tmp_path: Path, memory: int, buffer: int
) -> None:
    """Too little memory, and too small a buffer. The number in the message fits, and 1024 more do not."""
    device, views = small_device(devices[0], memory, buffer), load_scene(write_garden(tmp_path)).train
    with pytest.raises(DeviceError, match="use fewer splats") as caught:
        run_memory(device, KERNELS, CONFIG, views)
    (number,) = (int(word) for word in re.findall(r"; up to (\d+) splats fit: ", str(caught.value)))
    assert 0 < number < CONFIG.cap_max
    needed = run_memory(device, KERNELS, CONFIG.replace(cap_max=number), views)
    assert needed.most_splats == number
    with pytest.raises(DeviceError):
        run_memory(device, KERNELS, CONFIG.replace(cap_max=number + 1024), views)


def test_images_that_do_not_fit_leave_no_number_of_splats(devices: list[Device], tmp_path: Path) -> None:
    device, views = small_device(devices[0], 1 << 20, 1 << 20), load_scene(write_garden(tmp_path)).train
    with pytest.raises(DeviceError, match="smaller images") as caught:
        run_memory(device, KERNELS, CONFIG, views)
    assert "splats fit" not in str(caught.value)
    assert "fewer splats" not in str(caught.value)


def test_the_run_says_what_it_needs_of_what_there_is(devices: list[Device], tmp_path: Path) -> None:
    device, views = small_device(devices[0], 4 * 10**9, 1 << 30), load_scene(write_garden(tmp_path)).train
    text = str(run_memory(device, KERNELS, CONFIG.replace(cap_max=1000), views))
    found = re.fullmatch(r"\d+ MB of 4000 MB of device memory \(.*\); up to (\d+) splats fit", text)
    assert found is not None
    assert int(found[1]) % 1024 == 0


def test_records_are_the_largest_buffer_without_harmonics() -> None:
    """A record has more reals than the colour of degree 0, or the geometry."""
    flat = KernelBuild("skew-normal", 0, SCHEDULES["cpu16"])
    layout = ImageLayout(64, 48)
    assert estimate(CONFIG, flat, layout, 0).largest_buffer == 4 * flat.record * capacity_for(CONFIG.cap_max)
    assert estimate(CONFIG, KERNELS, layout, 0).largest_buffer == 4 * 48 * capacity_for(CONFIG.cap_max)
