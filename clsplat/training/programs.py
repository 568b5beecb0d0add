"""OpenCL programs of training: loss, exposure and optimizer. Each depends on a part of the renderer's build."""

from __future__ import annotations

import numpy as np

from ..device.device import Device
from ..device.program import Define, Program, build
from ..rendering.build import MARGIN_X, MARGIN_Y, KernelBuild
from .optim import adam
from .optim.skew_map import SKEW_MAPS

EXPOSURE_VECS = 8  # vectors of a work-item of cl/train/exposure.cl
EXPOSURE_GROUP = 64


def loss_strip(kernels: KernelBuild) -> int:
    """Vectors of a row that one work-item of the loss blurs.

    Narrow strips of wide images touch a new page of memory in each row. So strips are as wide as the second cache of a
    CPU allows: it holds 22 rows of four maps, 225 kB.
    """
    return 1 if kernels.lanes == 1 else 2560 // (kernels.lanes * kernels.dtype.itemsize)


def loss_program(device: Device, kernels: KernelBuild) -> Program:
    """L1, SSIM and their gradients. The program depends on lanes and precision only."""
    window = np.exp(-0.5 * (np.arange(-5, 6) / 1.5) ** 2)
    window /= window.sum()
    defines: dict[str, Define] = {f"WINDOW_{i}": float(window[i]) for i in range(6)}
    defines |= {"LANES": kernels.lanes, "STRIP": loss_strip(kernels), "MARGIN_X": MARGIN_X, "MARGIN_Y": MARGIN_Y}
    return build(device, ("math/lanes.clh", "train/loss.cl"), defines, kernels.real)


def exposure_program(device: Device, kernels: KernelBuild) -> Program:
    """Exposure, masks and transparency. The program depends on lanes and precision only."""
    defines: dict[str, Define] = {
        "LANES": kernels.lanes,
        "MARGIN_X": MARGIN_X,
        "MARGIN_Y": MARGIN_Y,
        "PHOTO_VECS": EXPOSURE_VECS,
        "EXPOSURE_GROUP": EXPOSURE_GROUP,
    }
    return build(device, ("math/lanes.clh", "train/exposure.cl"), defines, kernels.real)


def optim_program(device: Device, kernels: KernelBuild) -> Program:
    """The optimizer's step with its skew map and regularisers, noise and gathers."""
    wanted = ("ROW_", "LANES", "SKEW_", "SLANT_", "OPACITY_", "SH_", "GEOM_")
    defines = {k: v for k, v in kernels.defines().items() if k.startswith(wanted)}
    # 1 - beta is a constant of its own: as a difference of float32 it is off by 1e-5.
    defines |= {
        "ADAM_BETA1": adam.BETA1,
        "ADAM_BETA2": adam.BETA2,
        "ADAM_EPS": adam.EPS,
        "ADAM_REST1": 1.0 - adam.BETA1,
        "ADAM_REST2": 1.0 - adam.BETA2,
        "SKEW_MAP": SKEW_MAPS.index(kernels.skew_map),
        "ADAM_WAITS": adam.WAITS,
    }
    files = (
        "math/lanes.clh",
        "math/algebra.clh",
        "math/opacity.clh",
        "math/harmonics.clh",
        "train/skew_map.clh",
        "math/noise.clh",
        "train/adam.clh",
        "train/optim.cl",
        "train/lazy.cl",
    )
    return build(device, files, defines, kernels.real)
