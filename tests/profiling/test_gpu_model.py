"""The model of the time on GPUs: its laws, its counts against compilers and a trace, and its table."""

from __future__ import annotations

from dataclasses import astuple, replace
from types import SimpleNamespace
from typing import Any

import gpu_model
import isa
import pytest
from device_schedules import as_kind

from clsplat.device.device import Device
from clsplat.device.schedule import SCHEDULES
from clsplat.device.trace import recorded
from clsplat.profiling.bench import bench_trainer
from clsplat.profiling.gpu_counts import (
    BACKWARD,
    FORWARD,
    GPU_SCHEDULES,
    SUM_ROUND,
    Shares,
    commands_of,
    counts_of,
    loops_of,
    sum_work,
)
from clsplat.profiling.gpu_model import HOST_US, Predicted, fastest_schedule, predict, total_ms
from clsplat.profiling.gpus import GPUS, Gpu, corrected, gpu_of
from clsplat.profiling.roofline import Roofline
from clsplat.profiling.stages import HOST, STAGES, Sizes, by_stage
from clsplat.rendering.build import KernelBuild
from clsplat.scenes.random_scene import synthetic_scene
from clsplat.splats.shapes import SHAPES

SIZES = Sizes(splats=1_000_000, isects=2_000_000, pixels=1920 * 1080, pairs=100_000_000, sh_degree=3)
GPU = GPUS[2]
GAUSSIAN = KernelBuild("gaussian", 3, SCHEDULES["gpu64"])


def by_name(stages: tuple[Predicted, ...]) -> dict[str, Predicted]:
    return {stage.stage: stage for stage in stages}


@pytest.mark.parametrize("schedule", GPU_SCHEDULES)
@pytest.mark.parametrize("gpu", GPUS, ids=lambda gpu: gpu.name)
def test_more_work_takes_no_less_time(gpu: Gpu, schedule: str) -> None:
    one = by_name(predict(GAUSSIAN, SIZES, gpu, SCHEDULES[schedule]))
    twice = by_name(predict(GAUSSIAN, replace(SIZES, isects=2 * SIZES.isects), gpu, SCHEDULES[schedule]))
    assert all(twice[name].ms >= one[name].ms for name in one)
    for name in ("binning", "tile sort", "rasterize", "rasterize_vjp", "gather"):
        assert twice[name].ms > one[name].ms
    for name in ("rasterize", "rasterize_vjp"):
        assert twice[name].instructions == pytest.approx(2 * one[name].instructions)
        assert twice[name].local == pytest.approx(2 * one[name].local)


def test_no_work_costs_the_launches() -> None:
    empty = predict(GAUSSIAN, Sizes(0, 0, 0, 0, 3), GPU)
    assert all(stage.ms == stage.launches and stage.bound == "launches" for stage in empty)
    no_splats = by_name(predict(GAUSSIAN, Sizes(0, 0, SIZES.pixels, 0, 3), GPU))
    for name in ("project", "depth sort", "binning", "gather", "project_vjp", "step"):
        assert no_splats[name].ms == no_splats[name].launches


def test_a_bound_follows_its_rate() -> None:
    """Twice the bandwidth halves a stage that bandwidth bounds, and leaves one that instructions bound."""
    before = by_name(predict(GAUSSIAN, SIZES, GPU, SCHEDULES["gpu32"]))
    after = by_name(predict(GAUSSIAN, SIZES, replace(GPU, bandwidth=2 * GPU.bandwidth), SCHEDULES["gpu32"]))
    assert before["step"].bound == "bandwidth"
    assert after["step"].ms - after["step"].launches == pytest.approx((before["step"].ms - before["step"].launches) / 2)
    assert before["rasterize_vjp"].bound == "instructions"
    assert after["rasterize_vjp"].ms == before["rasterize_vjp"].ms
    faster = by_name(predict(GAUSSIAN, SIZES, replace(GPU, clock=2 * GPU.clock), SCHEDULES["gpu32"]))
    assert faster["rasterize_vjp"].instructions == pytest.approx(before["rasterize_vjp"].instructions / 2)
    assert faster["step"].ms == before["step"].ms


def test_the_host_covers_what_the_device_does_not() -> None:
    small = predict(GAUSSIAN, Sizes(1000, 2000, 64 * 48, 1000, 3), GPU)
    commands = sum(commands_of(GAUSSIAN, 64 * 48).values())
    assert small[-1].stage == HOST
    assert total_ms(small) == pytest.approx(1e-3 * HOST_US * commands)
    assert predict(GAUSSIAN, SIZES, GPU)[-1].ms == 0


def test_the_tuned_schedule_is_the_fastest() -> None:
    totals = {name: total_ms(predict(GAUSSIAN, SIZES, GPU, SCHEDULES[name])) for name in GPU_SCHEDULES}
    assert total_ms(predict(GAUSSIAN, SIZES, GPU)) == min(totals.values())
    assert predict(GAUSSIAN, SIZES, GPU, SCHEDULES["cpu16"]) == predict(GAUSSIAN, SIZES, GPU)
    assert totals[fastest_schedule(GAUSSIAN, SIZES, GPU)] == min(totals.values())


@pytest.mark.parametrize("shape", SHAPES)
def test_every_shape_is_predicted(shape: str) -> None:
    """No shape costs less than the Gaussian; the counted and the estimated block differ by rounding."""
    plain, other = loops_of("gaussian"), loops_of(shape)
    for mine, gaussian in zip(other, plain, strict=True):
        assert mine.block > 0.99 * gaussian.block
        assert mine.single > 0.99 * gaussian.single
    kernels = KernelBuild(shape, 3, SCHEDULES["gpu64"])
    assert set(counts_of(kernels, SIZES, SCHEDULES["gpu32"], 100)) <= set(STAGES)


@pytest.mark.parametrize("shape", sorted(FORWARD))
def test_loops_are_those_of_the_compiler(shape: str) -> None:
    """An isect with eight blocks has four more than one with four blocks; what is left belongs to the isect."""
    stored = isa.read()

    def usage(schedule: str, kernel: str) -> Any:
        return stored[f"sm_90 | pixels {shape} {schedule} | {kernel}"]

    four, eight = (usage(name, "rasterize").loops[-1] for name in ("gpu64", "gpu32"))
    block = (eight - four) / 4
    assert (FORWARD[shape].block, FORWARD[shape].isect) == (block, four - 4 * block)
    place, unrolled = {"gaussian": (1, 4), "skew-normal": (0, 1)}[shape]  # of the loop; isects of a round of it
    assert FORWARD[shape].single == usage("gpu256", "rasterize").loops[place] / unrolled
    one, four, eight = (usage(name, "rasterize_vjp").loops[-1] for name in ("gpu256", "gpu64", "gpu32"))
    block = (eight - four) / 4  # the loop has a round of sums
    assert (BACKWARD[shape].block, BACKWARD[shape].isect) == (block, four - 4 * block - SUM_ROUND)
    assert BACKWARD[shape].single == one - SUM_ROUND


def test_sums_over_a_group_are_counted() -> None:
    """By hand: two isects of 9 sums over 32 items are 18 rows, a round of a warp. Each value is written once."""
    assert sum_work(9, 32) == (1 / 2, 9 + 32 / 2)
    assert sum_work(9, 256) == (3, 72 + 3 * 32 + 9), "a sum has eight parts, which one warp adds up"


def test_shares_scale_the_raster_stages() -> None:
    def instructions(shares: Shares) -> float:
        return counts_of(GAUSSIAN, SIZES, SCHEDULES["gpu32"], 100, shares)["rasterize"].instructions

    full = instructions(Shares(1.0, 1.0, 1.0, 1.0))
    assert full == SIZES.isects * 32 * (FORWARD["gaussian"].isect + 8 * FORWARD["gaussian"].block)
    assert instructions(Shares(0.5, 1.0, 1.0, 1.0)) == full / 2
    assert instructions(Shares(1.0, 0.5, 1.0, 1.0)) < full
    assert instructions(Shares(1.0, 1.0, 0.5, 1.0)) < full
    assert instructions(Shares(1.0, 1.0, 1.0, 0.5)) == full, "gpu32 has blocks of two rows"


@pytest.mark.parametrize("shape", ["gaussian", "skew-normal"])
def test_commands_are_those_of_a_step(devices: list[Device], monkeypatch: pytest.MonkeyPatch, shape: str) -> None:
    """The trace of a device that pretends to be a GPU."""
    monkeypatch.setenv("CLSPLAT_SCHEDULE", "gpu64")
    device = as_kind(devices[0], "GPU")
    scene, splats = synthetic_scene(300, 64, 48, shape)
    trainer = bench_trainer(scene, device, shape, splats)
    for _ in range(3):
        with recorded(device) as launches:
            trainer.step()
    found: dict[str, int] = {}
    for stage, _ in by_stage(launches):
        found[stage] = found.get(stage, 0) + 1
    assert found == commands_of(trainer.kernels, 64 * 48)


def pretended(name: str, type: str = "GPU", units: int = 40, clock: int = 2000) -> Any:
    info = SimpleNamespace(name=name, type=type, compute_units=units, global_mem_bytes=8 << 30)
    return SimpleNamespace(info=info, cl_device=SimpleNamespace(max_clock_frequency=clock))


@pytest.mark.parametrize(
    ("name", "known"),
    [
        ("NVIDIA GeForce RTX 3060", "RTX 3060"),
        ("NVIDIA H200", "H200"),
        ("NVIDIA H100 80GB HBM3", "H100 80GB HBM3"),
        ("NVIDIA H100 PCIe", None),
        ("AMD Radeon RX 7900 XTX (radeonsi, navi31, LLVM 17)", "RX 7900 XTX"),
        ("Intel(R) Arc(TM) A770 Graphics", "A770"),
        ("NVIDIA GeForce RTX 3060 Ti", None),
        ("NVIDIA GeForce RTX 4090 Laptop GPU", None),
        ("Intel(R) Arc(TM) A770M Graphics", None),
    ],
)
def test_a_gpu_is_known_by_its_name(name: str, known: str | None) -> None:
    found = gpu_of(pretended(name))
    assert found is not None
    assert found.name == (known or name)
    assert gpu_of(pretended(name, "CPU")) is None


def test_an_unknown_gpu_is_scaled() -> None:
    half, full = (gpu_of(pretended("Some GPU", units=units)) for units in (20, 40))
    assert half is not None
    assert full is not None
    assert (full.units, full.clock, full.memory) == (40, 2.0, 8 << 30)
    assert full.bandwidth == 2 * half.bandwidth
    assert full.instructions_per_ms == 2 * half.instructions_per_ms


def test_measured_limits_replace_stated_rates() -> None:
    limits = Roofline(copy=1e12, fma=2e13)
    gpu = corrected(GPU, limits)
    assert gpu.bytes_per_ms == pytest.approx(1e9)
    assert 2 * gpu.units * gpu.lanes * gpu.clock == pytest.approx(2e4)
    stated, fitted = (by_name(predict(GAUSSIAN, SIZES, one, SCHEDULES["gpu32"])) for one in (GPU, gpu))
    assert fitted["step"].ms > stated["step"].ms


def test_the_page_has_the_predictions() -> None:
    page = gpu_model.PAGE.read_text(encoding="utf-8")
    stored = gpu_model.read()
    assert [one.shape for one in stored[:2]] == list(gpu_model.SHAPES)
    for table in gpu_model.tables(stored):
        assert table in page, "run gpu_model.py --write"
    for one in stored:
        assert all(0 < share <= 1 for share in astuple(one.shares) if share is not None)
