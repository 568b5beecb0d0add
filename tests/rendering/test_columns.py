"""Groups of work-items with one lane: pixels of a work-item in one column, and the GPU's own exp, 2^x and 1/x."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from conftest import MakeRenderer
from device_schedules import as_kind
from kernel_checks import Case
from reference.scenes import random_camera, random_splats
from reference.tolerances import GRADIENT_FLOAT32, IMAGE_FLOAT32, SAME_FLOAT32
from scipy.special import ndtr

from clsplat.device.device import Device
from clsplat.device.memory import to_device, to_host
from clsplat.device.program import build_text, source
from clsplat.device.schedule import SCHEDULES
from clsplat.rendering.build import KernelBuild
from clsplat.splats.shapes import SHAPES

INTEL_CPU = "Intel(R) OpenCL"  # its native functions have eleven right bits
GROUPS = [name for name, schedule in SCHEDULES.items() if schedule.group > 1]
PHI = """
kernel void phi(global const float *restrict z, global float *restrict cdf, global float *restrict density, int n) {
    const int i = get_global_id(0);
    float d;
    if (i >= n) return;
    cdf[i] = native_phi(z[i], &d);
    density[i] = d;
}
"""


def as_gpu(device: Device) -> Device:
    """Return another object for this device, which says that it is a GPU."""
    if device.info.platform == INTEL_CPU:
        pytest.skip("native functions of this runtime have eleven right bits")
    gpu = as_kind(device, "GPU")
    assert gpu.info.has_exact_native
    return gpu


def test_native_functions_are_for_drivers_that_are_known(device: Device) -> None:
    for platform, kind, native in (
        ("NVIDIA CUDA", "GPU", True),
        ("AMD Accelerated Parallel Processing", "GPU", True),
        ("Intel(R) OpenCL Graphics", "GPU", True),
        (INTEL_CPU, "CPU", False),
        ("Portable Computing Language", "CPU", False),
        ("A driver of tomorrow", "GPU", False),
    ):
        assert replace(device.info, platform=platform, type=kind).has_exact_native is native, platform


def test_phi_by_its_odds(device: Device) -> None:
    """The distribution to float32's rounding for all z, and its density with a relative error."""
    gpu = as_gpu(device)
    tails = [-np.inf, -3e38, -1e10, -100, 100, 1e10, 3e38, np.inf]
    z = np.concatenate([np.linspace(-12, 12, 20_001), tails]).astype(np.float32)
    buffers = [gpu.alloc(z.nbytes) for _ in range(3)]
    to_device(gpu, buffers[0], z)
    program = build_text(gpu, source("math/lanes.clh", "math/approx.clh") + PHI, {"LANES": 1})
    program.phi.over(len(z), z=buffers[0], cdf=buffers[1], density=buffers[2], n=len(z))
    cdf, density = (to_host(gpu, buffer, np.empty_like(z)) for buffer in buffers[1:])
    exact = z.astype(np.float64)
    assert np.abs(cdf - ndtr(exact)).max() < 4e-7
    middle = np.abs(exact) < 6
    expected = np.exp(-0.5 * exact[middle] ** 2) / np.sqrt(2 * np.pi)
    assert np.abs(density[middle] / expected - 1).max() < 3e-6
    assert (density[~np.isfinite(exact)] == 0).all()


def is_fast(name: str, shape: str) -> bool:
    """Whether a combination is in the default suite. Each one takes the compilation of a program."""
    return (name, shape) == ("gpu32", "skew-normal")


@pytest.mark.parametrize(
    ("name", "shape"),
    [
        pytest.param(name, shape, marks=[] if is_fast(name, shape) else pytest.mark.slow)
        for name in GROUPS
        for shape in SHAPES
    ],
)
def test_native_pixels_agree_with_the_reference(
    make_renderer: MakeRenderer, device: Device, name: str, shape: str
) -> None:
    """The image's edge cuts tiles, so that rows of a column and columns of a group are outside of it."""
    gpu, schedule = as_gpu(device), SCHEDULES[name]
    if schedule.group > gpu.info.max_group:
        pytest.skip(f"no groups of {schedule.group}")
    case = Case(random_splats(11, 24, 3), random_camera(1, 41, 27), shape)
    case.check(make_renderer(gpu, schedule=schedule), IMAGE_FLOAT32, GRADIENT_FLOAT32)


def test_native_pixels_are_other_ones(make_renderer: MakeRenderer, device: Device) -> None:
    """The test above would pass without native functions: here they change the last bits."""
    if device.info.type == "GPU":
        pytest.skip("both would have native functions")
    case = Case(random_splats(11, 24, 3), random_camera(1, 41, 27), "skew-normal")
    native, exact = (
        case.render(make_renderer(one, schedule=SCHEDULES["gpu32"])).color for one in (as_gpu(device), device)
    )
    assert 0 < np.abs(native - exact)[case.decided].max() < SAME_FLOAT32


def test_each_group_has_columns() -> None:
    for name, schedule in SCHEDULES.items():
        defines = KernelBuild("gaussian", 0, schedule).defines()
        assert defines["COLUMNS"] == (schedule.group > 1), name
