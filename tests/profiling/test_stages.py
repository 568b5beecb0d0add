"""Stages: every kernel has a stage, a step has all stages, and the counts are correct."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from device_schedules import schedule_on
from kernel_checks import Case
from reference.renderer import alpha_maps, prepared, project, visible_order
from reference.scenes import random_camera, random_splats

from clsplat.device.device import Device
from clsplat.device.program import parse_signatures, source
from clsplat.device.schedule import SCHEDULES
from clsplat.device.trace import Launch
from clsplat.errors import InputError
from clsplat.profiling.bench import Report, bench_trainer, measure_render, measure_training
from clsplat.profiling.roofline import Roofline
from clsplat.profiling.stages import HOST, SHARED, STAGE_OF, STAGES, Sizes, Work, by_stage, work_of
from clsplat.rendering.build import T_MIN, KernelBuild
from clsplat.rendering.overdraw import count_pairs
from clsplat.rendering.pipeline import Pipeline
from clsplat.rendering.splat_buffers import SplatBuffers
from clsplat.scenes.random_scene import synthetic_scene
from clsplat.splats.fields import Group

OTHER_PROGRAMS = {"measure/smoke.cl", "measure/roofline.cl", "measure/count.cl"}  # not part of an iteration


def test_every_kernel_has_one_stage() -> None:
    folder = Path(__file__).resolve().parents[2] / "cl"
    files = {str(path.relative_to(folder)) for path in folder.rglob("*.cl")}
    defines = KernelBuild("gaussian", 1, SCHEDULES["cpu16"]).defines() | {
        "LAZY": 1,
        "HALF_MOMENTS": 0,
        "FULL_MOMENTS": 1,
    }
    kernels = {name for file in files - OTHER_PROGRAMS for name in parse_signatures(source(file), "float", defines)}
    assert len(kernels) > 20
    assert kernels <= set(STAGE_OF) | set(SHARED), "a kernel without a stage in clsplat/profiling/stages.py"
    listed = [kernel for names in STAGES.values() for kernel in names] + list(SHARED)
    assert len(listed) == len(set(listed))


def test_shared_kernels_belong_to_the_stage_before_them() -> None:
    names = [
        "project_splats",
        "copy",
        "radix_histogram",
        "radix_scan",
        "radix_scatter",
        "count_isects",
        "scan_isects",
        "emit_isects",
        "radix_scatter",
        "find_tile_ranges",
        "rasterize",
    ]
    stages = [stage for stage, _ in by_stage(Launch(name, (1,), None) for name in names)]
    assert stages == ["project", "transfers", *["depth sort"] * 3, *["binning"] * 3, *["tile sort"] * 2, "rasterize"]
    with pytest.raises(KeyError):
        list(by_stage([Launch("unheard_of", (1,), None)]))


# Schedules with 16 lanes, 8 lanes and one lane; alpha of both signs.
@pytest.mark.parametrize(
    ("shape", "schedule"),
    [
        ("gaussian", "cpu16"),
        ("gaussian", "cpu8"),
        ("gaussian", "scalar"),
        ("skew-normal", "cpu16"),
        ("student-t", "cpu16"),
    ],
)
def test_useful_pairs_are_those_of_the_reference(shape: str, schedule: str, devices: list[Device]) -> None:
    """A pair counts if |alpha| reaches the cutoff and no splat in front of it has finished the pixel."""
    arrays = random_splats(5, 40) | {"opacity_logit": np.random.default_rng(6).uniform(0, 4, 40)}
    case = Case(arrays, random_camera(5, 37, 21), shape)
    values = prepared(case.values, case.shape)
    order = visible_order(values, case.camera, case.shape)
    screen = project({name: value[order] for name, value in values.items()}, case.camera, case.shape)
    pixels = case.camera.width * case.camera.height
    transmittance, finished, useful = np.ones(pixels), np.zeros(pixels, bool), np.zeros(pixels, int)
    for alpha in alpha_maps(screen, case.camera).real:
        useful += (alpha != 0) & ~finished
        after = transmittance * (1 - alpha)
        finished |= (alpha != 0) & (after <= T_MIN)
        transmittance = np.where(finished, transmittance, after)
    assert finished.any() == (shape != "student-t"), "negative alphas increase the transmittance again"
    kernels = KernelBuild(shape, 2, schedule_on(devices[0], schedule)).for_rendering()
    pipeline = Pipeline(devices[0], kernels)
    frame = pipeline.forward(SplatBuffers.of(devices[0], case.splats, kernels.dtype), case.camera)
    undecided = int((~case.decided).sum())  # each of these pixels may differ by one
    assert abs(count_pairs(pipeline, frame) - int(useful.sum())) <= undecided


SIZES = Sizes(splats=1024, isects=5000, pixels=512, pairs=100_000, sh_degree=1)


def test_work_grows_with_what_a_stage_handles() -> None:
    """Pairs cost operations and no bytes, isects cost bytes and no operations, twice of all costs twice as much."""
    kernels = KernelBuild("gaussian", 1, SCHEDULES["cpu16"])
    work = work_of(kernels, SIZES, is_cpu=True)
    assert set(work) < set(STAGES)
    assert all(each.bytes > 0 for each in work.values())
    more_pairs = work_of(kernels, replace(SIZES, pairs=2 * SIZES.pairs), is_cpu=True)
    changed = {name for name in work if more_pairs[name] != work[name]}
    assert changed == {"rasterize", "rasterize_vjp"}
    for name in changed:
        assert more_pairs[name] == replace(work[name], flops=2 * work[name].flops)
    more_isects = work_of(kernels, replace(SIZES, isects=2 * SIZES.isects), is_cpu=True)
    changed = {name for name in work if more_isects[name] != work[name]}
    assert changed == {"tile sort", "rasterize", "rasterize_vjp", "gather"}
    assert all(more_isects[name].flops == work[name].flops for name in work)
    twice = Sizes(2 * SIZES.splats, 2 * SIZES.isects, 2 * SIZES.pixels, 2 * SIZES.pairs, SIZES.sh_degree)
    for name, each in work_of(kernels, twice, is_cpu=True).items():
        assert each == Work(2 * work[name].bytes, 2 * work[name].flops), name


def test_work_reads_the_buffers_of_the_splats(devices: list[Device]) -> None:
    """A full buffer of splats is read whole by the projection, and its moments are read and written by the step."""
    kernels = KernelBuild("skew-normal", 1, SCHEDULES["cpu16"])
    buffers = SplatBuffers(devices[0], kernels.schema, SIZES.splats, kernels.dtype)
    assert buffers.capacity == SIZES.splats
    geometry, colour = (buffers.group_bytes(group) for group in Group)
    screen = SIZES.splats * (kernels.dtype.itemsize * kernels.record + 4 + 16)  # record, depth key, tile rectangle
    work = work_of(kernels, SIZES, is_cpu=True)
    assert work["project"].bytes == geometry + colour + screen
    # Values and two moments are read and written; the gradient is read, and colour has a compact one.
    assert work["step"].bytes == 7 * geometry + 6 * colour + 6 * SIZES.splats * kernels.dtype.itemsize


def test_a_skewed_splat_costs_more_and_pixels_cost_the_same() -> None:
    plain, skewed = (
        work_of(KernelBuild(shape, 1, SCHEDULES["cpu16"]), SIZES, is_cpu=False) for shape in ("gaussian", "skew-normal")
    )
    for name in ("rasterize", "rasterize_vjp"):
        assert skewed[name].flops > plain[name].flops
        assert skewed[name].bytes > plain[name].bytes
    assert skewed["loss"] == plain["loss"]
    assert skewed["tile sort"] == plain["tile sort"]


def test_a_step_and_an_image_have_their_stages(devices: list[Device]) -> None:
    scene, splats = synthetic_scene(400, 48, 32, "skew-normal")
    trainer = bench_trainer(scene, devices[0], "skew-normal", splats)
    limits = Roofline(1e9, 1e9)
    training, render = measure_training(trainer, limits, 2), measure_render(trainer, limits, 2)
    assert [stage.stage for stage in training.stages] == [
        *(name for name in STAGES if name != "strategy"),
        "strategy",
        HOST,
    ]
    assert [stage.stage for stage in render.stages] == [
        "project",
        "depth sort",
        "binning",
        "tile sort",
        "rasterize",
        "transfers",
        HOST,
    ]
    for report in (training, render):
        sizes = report.sizes
        assert (sizes.splats, sizes.pixels, sizes.sh_degree) == (400, 48 * 32, 3)
        assert 0 < sizes.pairs < 256 * sizes.isects
        assert 0 < report.useful < 1
        assert all(stage.ms >= 0 for stage in report.stages)
        assert all((stage.of_copy is not None) == (stage.bytes > 0) for stage in report.stages)
        counted = {stage.stage for stage in report.stages if stage.of_fma}
        assert counted <= {"rasterize", "loss", "rasterize_vjp", "step"}
        rasterize = next(stage for stage in report.stages if stage.stage == "rasterize")
        assert rasterize.flops == pytest.approx(sizes.pairs * 62, rel=0.2)  # medians of two
        assert Report.from_json(json.loads(json.dumps(report.to_json()))) == report
    with pytest.raises(InputError, match="1 to 1000"):
        measure_render(trainer, limits, 0)


@pytest.mark.parametrize("values", [{}, {"sizes": {}, "stages": []}, {"sizes": 3, "stages": 4}])
def test_other_values_are_not_a_report(values: dict[str, object]) -> None:
    with pytest.raises(InputError, match="not a report"):
        Report.from_json(values)
