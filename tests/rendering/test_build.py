"""Every kernel builds without a warning, at every value of every option."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace
from importlib.resources import files
from pathlib import Path

import pytest
from kernel_checks import KERNELS

from clsplat.device.device import Device
from clsplat.device.program import build
from clsplat.device.schedule import SCHEDULES
from clsplat.profiling.roofline import CHAINS, roofline_program
from clsplat.rendering.binning import CHUNK_FILES, ORDER_DEFINES
from clsplat.rendering.build import KernelBuild
from clsplat.rendering.group_binner import group_binning_program
from clsplat.rendering.radix_sort import sort_program
from clsplat.splats.shapes import DEFAULT_SHAPE, SHAPES
from clsplat.training.optim.skew_map import SKEW_MAPS
from clsplat.training.programs import (
    columns_program,
    depth_program,
    dropout_program,
    exposure_program,
    lazy_program,
    loss_program,
    optim_program,
)

REALS = ("float", "double")


def all_builds() -> Iterator[KernelBuild]:
    """Yield all options that change a program. Only two shapes vary the degree, because only projection uses it."""
    for (shape, normalisation), schedule, real in itertools.product(KERNELS, SCHEDULES.values(), REALS):
        yield KernelBuild(shape, 3, schedule, normalisation, real).for_rendering()
    for shape, degree, schedule in itertools.product(("gaussian", DEFAULT_SHAPE), (0, 1, 2, 3), SCHEDULES.values()):
        yield KernelBuild(shape, degree, schedule)  # as training builds it
    for skew_map, schedule in itertools.product(SKEW_MAPS, SCHEDULES.values()):
        yield KernelBuild("skew-normal", 3, schedule, skew_map=skew_map)


def some_builds() -> Iterator[KernelBuild]:
    """Yield all shapes and precisions on one CPU and one GPU schedule, and each other option at each of its values."""
    cpu = SCHEDULES["cpu16"]
    for shape, schedule, real in itertools.product(SHAPES, (cpu, SCHEDULES["gpu256"]), REALS):
        yield KernelBuild(shape, 3, schedule, real=real).for_rendering()
    for schedule, real in itertools.product(SCHEDULES.values(), REALS):
        yield KernelBuild(DEFAULT_SHAPE, 3, schedule, real=real).for_rendering()
    for shape, normalisation in KERNELS:
        yield KernelBuild(shape, 3, cpu, normalisation).for_rendering()
    for i, skew_map in enumerate(SKEW_MAPS):
        yield KernelBuild("skew-normal", i % 4, cpu, skew_map=skew_map)


@pytest.fixture(scope="module")
def compiler(devices: list[Device]) -> Device:
    """Return one device: PoCL if it is present, because its front end is the fastest."""
    if not devices:
        pytest.skip("no OpenCL device")
    return min(devices, key=lambda device: device.info.platform != "Portable Computing Language")


def build_all(device: Device, kernels: KernelBuild) -> None:
    if kernels.real == "double" and not device.has_fp64:
        return
    kernels.projection_program(device)
    kernels.pixel_program(device)
    loss_program(device, kernels)
    exposure_program(device, kernels)
    optim_program(device, kernels)
    lazy_program(device, kernels)


def test_every_kernel_builds_without_warnings(compiler: Device) -> None:
    """Every kernel builds without warnings, and every file in cl/ is part of a program."""
    for kernels in some_builds():
        build_all(compiler, kernels)
    KernelBuild(DEFAULT_SHAPE, 3, SCHEDULES["cpu16"]).count_program(compiler)
    roofline_program(compiler, CHAINS[0])
    build(compiler, ("measure/smoke.cl",))
    sort_program(compiler, 64)
    for name in ("cpu16", "gpu32"):
        kernels = KernelBuild(DEFAULT_SHAPE, 3, SCHEDULES[name])
        group_binning_program(compiler, kernels, 64)
        kernels.binning_program(compiler, CHUNK_FILES, ORDER_DEFINES)
    columns_program(compiler, kernels)
    depth_program(compiler, kernels)
    dropout_program(compiler)
    there = {
        f"{folder.name}/{file.name}"
        for folder in files("clsplat_cl").iterdir()
        if folder.is_dir()
        for file in folder.iterdir()
    }
    # Shapes that a test has registered lie in other folders, with absolute paths.
    used = {name for names, *_ in compiler.programs for name in names if not Path(name).is_absolute()}
    assert used == {name for name in there if name.endswith((".cl", ".clh"))}


def test_builds_share_the_programs_that_they_do_not_change(compiler: Device) -> None:
    """Training and rendering share the projection, all SH degrees the pixels. Other options change both programs."""
    training = KernelBuild("gaussian", 3, SCHEDULES["cpu16"])
    flat, drawn = KernelBuild("gaussian", 0, SCHEDULES["cpu16"]), training.for_rendering()
    assert training.projection_program(compiler) is drawn.projection_program(compiler)
    assert training.pixel_program(compiler) is not drawn.pixel_program(compiler)
    assert training.pixel_program(compiler) is flat.pixel_program(compiler)
    assert training.projection_program(compiler) is not flat.projection_program(compiler)
    for option in ({"antialiased": True}, {"alpha_min": 0.0}, {"normalisation": "pdf"}):
        other = replace(training, **option)
        assert training.projection_program(compiler) is not other.projection_program(compiler), option
        assert training.pixel_program(compiler) is not other.pixel_program(compiler), option
    wide = replace(training, schedule=SCHEDULES["gpu256"])
    assert training.pixel_program(compiler) is not wide.pixel_program(compiler)


@pytest.mark.slow
def test_every_kernel_builds_on_every_device(device: Device) -> None:
    for kernels in all_builds():
        build_all(device, kernels)


@pytest.mark.parametrize("group", [64, 128])
def test_sort_and_binning_build(device: Device, group: int) -> None:
    sort_program(device, group)
    for name in ("cpu16", "gpu32"):
        kernels = KernelBuild(DEFAULT_SHAPE, 3, SCHEDULES[name])
        group_binning_program(device, kernels, group)
        kernels.binning_program(device, CHUNK_FILES, ORDER_DEFINES)
