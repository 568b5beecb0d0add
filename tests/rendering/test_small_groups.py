"""Devices with small work-groups, as Apple's CPU devices: groups of one in kernels with barriers, or everywhere.

The devices are real ones whose limits are pretended. A launch with a larger group fails as on the real device.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pyopencl as cl
import pytest

from clsplat.device.device import Device, open_device
from clsplat.device.memory import Pool, to_device, to_host
from clsplat.device.program import GROUP_ITEMS, build
from clsplat.device.schedule import SCHEDULES, default_schedule
from clsplat.errors import DeviceError
from clsplat.rendering import tuning
from clsplat.rendering.binning import ChunkBinner
from clsplat.rendering.build import KernelBuild
from clsplat.rendering.group_binner import GroupBinner, make_binner
from clsplat.rendering.radix_sort import Sorter, SortMemory, sort_group
from clsplat.scenes.scene import Scene
from clsplat.training.config import TrainConfig
from clsplat.training.loss_check import check_loss
from clsplat.training.programs import kernel_build
from clsplat.training.step_check import check_step
from clsplat.training.trainer import Trainer

# Kernels with barriers, apart from those of a schedule with groups.
WITH_BARRIERS = {
    "radix_histogram",
    "radix_scan",
    "radix_scatter",
    "count_isects",
    "scan_isects",
    "step_exposure",
}
IN_GROUPS = {"rasterize", "rasterize_vjp", "gather_isect_grads"}
Pretend = Callable[..., Device]


@pytest.fixture
def pretend(device: Device, monkeypatch: pytest.MonkeyPatch) -> Pretend:
    """pretend(barriers=1, **info): the device with groups of `barriers` in kernels with barriers, and this info."""
    enqueue = cl.enqueue_nd_range_kernel
    limit_of = cl.Kernel.get_work_group_info
    limits: dict[str, int] = {"barriers": 1, "max_group": 1}

    def limit(kernel: cl.Kernel) -> int:
        inside = WITH_BARRIERS if limits["barriers"] >= 32 else WITH_BARRIERS | IN_GROUPS
        return min(limits["max_group"], limits["barriers"] if kernel.function_name in inside else limits["max_group"])

    def info_of(kernel: cl.Kernel, param: int, of: cl.Device) -> Any:
        return limit(kernel) if param == cl.kernel_work_group_info.WORK_GROUP_SIZE else limit_of(kernel, param, of)

    def enqueued(queue: Any, kernel: cl.Kernel, size: Any, local: Any, *rest: Any, **more: Any) -> Any:
        if local is not None and (
            np.prod(local) > limit(kernel) or any(s % n for s, n in zip(size, local, strict=True))
        ):
            raise cl.LogicError("clEnqueueNDRangeKernel", cl.status_code.INVALID_WORK_GROUP_SIZE, kernel.function_name)
        return enqueue(queue, kernel, size, local, *rest, **more)

    def run(barriers: int = 1, **info: Any) -> Device:
        other = open_device(device.info.index)
        other.info = replace(other.info, **info)
        limits.update(barriers=barriers, max_group=other.info.max_group)
        monkeypatch.setattr(cl.Kernel, "get_work_group_info", info_of)
        monkeypatch.setattr(cl, "enqueue_nd_range_kernel", enqueued)
        return other

    return run


def calls(body: str, names: set[str]) -> bool:
    """Whether OpenCL C text calls a function or a macro."""
    return any(re.search(rf"\b{name}\(", body) for name in names)


def test_the_kernels_with_barriers_are_known() -> None:
    """The pretended limits are for these. All barriers of group.clh are in kernels that a schedule puts into groups."""
    cl_files = files("clsplat_cl")
    scans = (cl_files / "render" / "scan.clh").read_text(encoding="utf-8")
    with_barriers = set()
    for file in (file for folder in ("render", "train", "measure") for file in (cl_files / folder).iterdir()):
        if not file.name.endswith(".cl"):
            continue
        text = re.sub(r"//[^\n]*", "", scans + file.read_text(encoding="utf-8"))
        helpers = {"barrier"}
        for name, body in re.findall(r"static inline \w+\s+(\w+)\([^)]*\) \{(.*?)\n\}", text, re.S):
            helpers |= {name} if calls(body, helpers) else set()
        for name, body in re.findall(r"#define (\w+)\([^)]*\)((?:[^\n]*\\\n)+[^\n]*)", text):
            helpers |= {name} if calls(body, helpers) else set()
        for kernel in re.split(r"\bkernel\s+void\s+", text)[1:]:
            name, body = kernel.split("(", 1)
            if calls(body.split("\n}", 1)[0], helpers):
                with_barriers.add(name.strip())
    assert with_barriers == WITH_BARRIERS


@pytest.fixture
def nothing_chosen(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """No schedule is forced, and neither this process nor the cache has one."""
    monkeypatch.delenv(tuning.SCHEDULE_VARIABLE, raising=False)
    monkeypatch.setattr(tuning, "_chosen", {})
    monkeypatch.setattr(tuning, "cache_folder", lambda: tmp_path)


def require_groups_of_one(device: Device) -> None:
    if default_schedule(device.info).group > 1:
        pytest.skip("this device draws with groups")


RUNS: dict[str, dict[str, Any]] = {
    "adc": {"shape": "skew-normal", "strategy": "adc", "visible_adam": True},
    "mcmc": {"shape": "student-t", "strategy": "mcmc", "position_optimizer": "sghmc"},
}


@pytest.mark.usefixtures("nothing_chosen")
@pytest.mark.parametrize("max_group", [1, 1024], ids=["all kernels", "kernels with barriers"])
@pytest.mark.parametrize("name", RUNS)
def test_a_run_in_groups_of_one_has_the_same_bits(
    pretend: Pretend, device: Device, scene: Scene, monkeypatch: pytest.MonkeyPatch, name: str, max_group: int
) -> None:
    """The runs launch the kernels of both strategies and of all optimizers."""
    require_groups_of_one(device)
    monkeypatch.setenv(tuning.SCHEDULE_VARIABLE, str(default_schedule(device.info)))
    trained = []
    for make in (lambda: device, lambda: pretend(max_group=max_group)):
        config = TrainConfig(
            **{"shape": "skew-normal", "iterations": 12, "cap_max": 300, "densify_interval": 5, **RUNS[name]}
        )
        trainer = Trainer(scene, config, device=make())
        for _ in range(config.iterations):
            trainer.step()
        trained.append(trainer.snapshot().to_numpy())
    assert len(trained[0]["mean"]) > 50
    for field, values in trained[0].items():
        np.testing.assert_array_equal(trained[1][field], values, field)


@pytest.mark.usefixtures("nothing_chosen")
@pytest.mark.parametrize("barriers", [1, 32])
def test_exposures_are_found_in_groups_of_one(
    pretend: Pretend, device: Device, scene: Scene, monkeypatch: pytest.MonkeyPatch, barriers: int
) -> None:
    """The sums have another order, so the bits differ."""
    require_groups_of_one(device)
    monkeypatch.setenv(tuning.SCHEDULE_VARIABLE, str(default_schedule(device.info)))
    found = []
    for make in (lambda: device, lambda: pretend(barriers, max_group=1024)):
        trainer = Trainer(scene, TrainConfig(iterations=12, cap_max=300, exposure=True), device=make())
        for _ in range(12):
            trainer.step()
        found.append(trainer.exposure.exposures())
    assert np.abs(found[0] - np.eye(3, 4)).max() > 1e-3
    np.testing.assert_allclose(found[1], found[0], atol=1e-4)


OTHER = {"platform": "Acme", "type": "GPU"}  # neither wide lanes nor the binner of CPUs


@pytest.mark.slow
@pytest.mark.usefixtures("nothing_chosen")
@pytest.mark.parametrize("max_group", [1, 1024], ids=["all kernels", "kernels with barriers"])
def test_a_device_without_wide_lanes_works_in_groups_of_one(
    pretend: Pretend, monkeypatch: pytest.MonkeyPatch, max_group: int
) -> None:
    monkeypatch.setattr(tuning, "_REPEATS", 1)
    monkeypatch.setattr(tuning, "_MIN_TILES", 4)
    other = pretend(**OTHER, max_group=max_group)
    assert sort_group(other) == 0
    assert isinstance(make_binner(Pool(other), KernelBuild("gaussian", 0, SCHEDULES["scalar"])), ChunkBinner)
    schedule = tuning.schedule_for(other)  # its self-test compares an image and its gradients
    assert schedule == SCHEDULES["scalar"]
    kernels = kernel_build(TrainConfig(), schedule)
    check_loss(other, kernels, 0.2, 0.05)
    check_step(other, kernels, "adam")


def test_groups_of_medium_size_sort_in_groups(pretend: Pretend) -> None:
    other = pretend(64, **OTHER, max_group=1024)
    assert sort_group(other) == 64
    assert isinstance(make_binner(Pool(other), KernelBuild("gaussian", 0, SCHEDULES["scalar"])), GroupBinner)
    pool = Pool(other)
    keys = np.random.default_rng(0).integers(0, 1 << 32, 5000, np.uint32)
    buffer = other.alloc(keys.nbytes)
    to_device(other, buffer, keys)
    moved, places = (
        to_host(other, result, np.empty_like(keys))
        for result in Sorter(pool).sort(buffer, len(keys), 32, SortMemory(pool))
    )
    np.testing.assert_array_equal(moved, np.sort(keys))
    np.testing.assert_array_equal(keys[places], moved)
    assert sort_group(pretend(1024, **OTHER, max_group=100)) == 64


def test_the_default_schedule_has_groups_that_the_device_has(device: Device) -> None:
    expected = {1: "scalar", 31: "scalar", 32: "gpu32", 63: "gpu32", 64: "gpu64", 255: "gpu64", 256: "gpu256"}
    for max_group, name in expected.items():
        assert default_schedule(replace(device.info, **OTHER, max_group=max_group)) == SCHEDULES[name]


@pytest.mark.usefixtures("nothing_chosen")
@pytest.mark.parametrize(("barriers", "max_group"), [(1, 1024), (16, 16)])
def test_a_schedule_with_larger_groups_is_refused_in_one_line(
    pretend: Pretend, monkeypatch: pytest.MonkeyPatch, barriers: int, max_group: int
) -> None:
    monkeypatch.setenv(tuning.SCHEDULE_VARIABLE, "gpu64")
    other = pretend(barriers, max_group=max_group)
    with pytest.raises(DeviceError) as caught:
        tuning.schedule_for(other)
    assert str(caught.value) == (
        f"schedule 64x4x1: {other.info} has work-groups of {barriers} at most: "
        "choose a schedule with smaller groups, such as scalar or choose another device"
    )


@pytest.mark.parametrize(("driver", "expected"), [(None, 1024), (0, 1024), (48, 48), (4096, 1024)])
def test_a_kernel_knows_its_largest_group(
    device: Device, monkeypatch: pytest.MonkeyPatch, driver: int | None, expected: int
) -> None:
    """None: the driver cannot say it. Groups of kernels whose work-items share nothing are powers of two."""

    def answer(*_: object) -> int:
        if driver is None:
            raise cl.LogicError("clGetKernelWorkGroupInfo", cl.status_code.INVALID_VALUE, "")
        return driver

    other = open_device(device.info.index)
    other.info = replace(other.info, max_group=1024)
    monkeypatch.setattr(cl.Kernel, "get_work_group_info", answer)
    kernel = build(other, ("measure/smoke.cl",)).smoke
    assert kernel.max_group == expected
    assert kernel.item_group == (32 if driver == 48 else GROUP_ITEMS)
