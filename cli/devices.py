"""`clsplat devices`: the OpenCL devices of this machine, whether they work, and how to fix those that do not."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING

import click

from clsplat.errors import DeviceError

from .command import DocumentedCommand

if TYPE_CHECKING:
    from clsplat.device.device import DeviceInfo


@click.command(
    cls=DocumentedCommand,
    examples=(
        ("clsplat devices", "Which devices are there, and does each compute right?"),
        (
            "clsplat train SCENE -m MODEL --device cpu",
            "Use the processor, even beside a GPU. All commands that compute have this option.",
        ),
    ),
    see_also=("bench",),
    environment=(
        ("PYOPENCL_CTX", "The default device, as pyopencl names it: 0:1, or part of a platform's name."),
        ("CLSPLAT_SCHEDULE", "A schedule to use instead of the fastest one, such as cpu8 or scalar."),
        ("XDG_CACHE_HOME", "Folder for the caches of kernels and schedules.  [default: ~/.cache]"),
    ),
)
@click.pass_context
def devices(ctx: click.Context) -> None:
    """List the OpenCL devices, test each on a small scene, and suggest fixes for known faults.

    The self-test compares an image, its gradients, the loss and steps of the optimizer with known numbers. The first
    call also finds the fastest schedule of each device, which takes some seconds.

    The default device of the other commands is marked. --device takes an index such as 0:1, "cpu", "gpu", or a part
    of a platform's or device's name. The exit code is 1 if no device works.
    """
    from clsplat.device.device import NO_PLATFORM, list_devices, open_device

    infos, default = [], None
    try:
        infos = list_devices()
        if infos:
            default = open_device().info.index
        else:
            click.echo(f"error: {NO_PLATFORM}", err=True)
    except DeviceError as error:
        click.echo(f"error: {error}", err=True)
    working = 0
    for info in infos:
        mark = "  (default)" if info.index == default else ""
        click.echo(f"{info.index}  {info.name}{mark}")
        rows = {
            "platform": f"{info.platform}, {info.platform_version}",
            "driver": f"{info.driver} ({info.version})",
            "type": f"{info.type}, {info.compute_units} compute units",
            "memory": f"{_mb(info.global_mem_bytes)}, {_mb(info.max_alloc_bytes)} in one buffer, "
            f"{info.local_mem_bytes >> 10} KB local",
            "precision": "float32 and float64" if info.has_fp64 else "float32",
        }
        try:
            rows |= _try(info)
            working += 1
        except DeviceError as error:
            rows["FAILED"] = str(error)
        for name, text in rows.items():
            click.echo(f"     {name:<11}{text}")
    for hint in hints({info.platform for info in infos}, any(info.type == "GPU" for info in infos)):
        click.echo(f"hint: {hint}", err=True)
    if not working:
        ctx.exit(1)


def hints(platforms: set[str], has_gpu: bool, root: Path = Path("/")) -> list[str]:
    """Return fixes for GPUs of this machine that OpenCL does not list (Linux).

    Parameters
    ----------
    platforms : names of the OpenCL platforms.
    has_gpu : whether any of their devices is a GPU.
    root : folder that contains `dev`.
    """
    if any("NVIDIA" in name for name in platforms):
        return []
    if (root / "dev/nvidia0").exists():
        return [
            "an NVIDIA GPU is here, but its OpenCL is not registered: install the driver's OpenCL library "
            "and write its name, libnvidia-opencl.so.1, into /etc/OpenCL/vendors/nvidia.icd "
            "(in a container also set NVIDIA_DRIVER_CAPABILITIES=compute,utility)"
        ]
    nodes = sorted((root / "dev/dri").glob("renderD*"))
    if has_gpu or not nodes:
        return []
    if not any(os.access(node, os.R_OK | os.W_OK) for node in nodes):
        return [f"a GPU is here, but this user may not use {nodes[0]}: add the user to the group `render`"]
    return [
        "a GPU is here, but no OpenCL driver for it: install intel-opencl-icd (Intel) or ROCm's OpenCL runtime (AMD)"
    ]


def _try(info: DeviceInfo) -> dict[str, str]:
    """Return the schedule and the results of the tests; DeviceError if the device does not work or computes wrong."""
    from clsplat.device.device import open_device
    from clsplat.device.program import smoke_test
    from clsplat.device.schedule import SCHEDULES
    from clsplat.rendering.self_test import check_rendering
    from clsplat.rendering.tuning import schedule_for
    from clsplat.training.config import TrainConfig
    from clsplat.training.loss_check import check_loss
    from clsplat.training.programs import kernel_build
    from clsplat.training.step_check import check_step

    device = open_device(info.index)
    build_ms, run_ms = smoke_test(device)
    schedule = schedule_for(device)
    check_rendering(device, schedule)
    config = TrainConfig()
    kernels = kernel_build(config, schedule)
    check_loss(device, kernels, config.loss.lambda_dssim, config.loss.smooth_l1)
    check_step(device, kernels, config.sghmc.position_optimizer)
    name = next((name for name, known in SCHEDULES.items() if known == schedule), "set by hand")
    return {
        "schedule": f"{name} ({schedule})",
        "smoke test": f"ok (built in {build_ms:.0f} ms, ran in {run_ms:.3f} ms)",
        "self-test": "image, gradients, loss and steps are right",
    }


def _mb(nbytes: int) -> str:
    return f"{nbytes >> 20} MB"
