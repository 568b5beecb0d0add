"""The OpenCL programs of clsplat as a GPU's compiler reads them."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any, cast
from unittest import mock

import clsplat.device.program
from clsplat.device.device import Device
from clsplat.device.program import GPU_OPTIONS
from clsplat.device.program import OPTIONS as COMMON_OPTIONS
from clsplat.device.schedule import SCHEDULES
from clsplat.rendering.build import KernelBuild
from clsplat.rendering.group_binner import group_binning_program
from clsplat.rendering.radix_sort import sort_program
from clsplat.splats.low_pass import PIXEL
from clsplat.training.programs import (
    EXPOSURE_GROUP,
    columns_program,
    depth_program,
    dropout_program,
    exposure_program,
    lazy_program,
    loss_program,
    optim_program,
)

OPTIONS = (*COMMON_OPTIONS, *GPU_OPTIONS)
SHAPES = ("gaussian", "skew-normal")
GPU_SCHEDULES = tuple(name for name, schedule in SCHEDULES.items() if schedule.group > 1)
SCAN_GROUP, ITEM_GROUP = 128, 64
_SH_DEGREE = 3
_PIXEL_KERNELS = ("rasterize", "rasterize_vjp")
_SCAN_KERNELS = ("radix_histogram", "radix_scan", "radix_scatter", "count_isects", "scan_isects")


def programs() -> dict[str, str]:
    """Return the text of each program of a training step on a GPU, by name."""
    texts: dict[str, str] = {}
    gpu = SCHEDULES[GPU_SCHEDULES[0]]
    with _recorded() as (device, built):
        for shape in SHAPES:
            kernels = KernelBuild(shape, _SH_DEGREE, gpu, antialiased=True, low_pass=PIXEL)  # as training has it
            kernels.projection_program(device)
            texts[f"project {shape}"] = built.pop()
            optim_program(device, kernels)
            texts[f"optimize {shape}"] = built.pop()
            lazy_program(device, kernels)
            texts[f"optimize visible {shape}"] = built.pop()
            columns_program(device, kernels)
            texts[f"densify {shape}"] = built.pop()
            depth_program(device, kernels)
            texts[f"depth {shape}"] = built.pop()
            for name in GPU_SCHEDULES:
                KernelBuild(shape, _SH_DEGREE, SCHEDULES[name]).pixel_program(device)
                texts[f"pixels {shape} {name}"] = built.pop()
            group_binning_program(device, KernelBuild(shape, _SH_DEGREE, SCHEDULES["gpu32"]), SCAN_GROUP)
            texts[f"bin {shape}"] = built.pop()
        loss_program(device, KernelBuild(SHAPES[0], _SH_DEGREE, gpu))
        texts["loss"] = built.pop()
        exposure_program(device, KernelBuild(SHAPES[0], _SH_DEGREE, gpu))
        texts["exposure"] = built.pop()
        dropout_program(device)
        texts["dropout"] = built.pop()
        sort_program(device, SCAN_GROUP)
        texts["sort"] = built.pop()
    return texts


def group_size(program: str, kernel: str) -> int:
    """Return the number of work-items of a kernel's groups."""
    if kernel in _PIXEL_KERNELS:
        return SCHEDULES[program.split()[-1]].group
    if kernel == "step_exposure":
        return EXPOSURE_GROUP
    return SCAN_GROUP if kernel in _SCAN_KERNELS else ITEM_GROUP


@contextmanager
def _recorded() -> Iterator[tuple[Device, list[str]]]:
    """A stand-in for a GPU whose builds are appended to the list as text."""
    texts: list[str] = []

    def keep(_device: Device, text: str, _options: list[str]) -> object:
        texts.append(text)
        return object()

    device: Any = SimpleNamespace(
        info=SimpleNamespace(has_prefetch=False, has_exact_native=True, type="GPU"),
        shared=SimpleNamespace(built={}),
        programs={},
        has_fp64=False,
    )
    with mock.patch.object(clsplat.device.program, "_compiled", keep):
        yield cast(Device, device), texts
