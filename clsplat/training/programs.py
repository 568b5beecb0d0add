"""OpenCL programs of training: loss, exposure and optimizer. Each depends on a part of the renderer's build."""

from __future__ import annotations

import numpy as np

from ..device.device import Device
from ..device.program import Define, Program, build
from ..device.schedule import Schedule
from ..evaluation.metrics import SSIM_C1, SSIM_C2, SSIM_RADIUS, SSIM_SIGMA
from ..rendering.build import CULLED_KEY, MARGIN_X, MARGIN_Y, KernelBuild, layout_defines
from ..rendering.splat_buffers import COMPACT_ROWS
from ..splats.fields import Group, sh_coefficients
from ..splats.harmonics import SH_C0
from ..splats.low_pass import LOW_PASS
from ..splats.near_plane import NEAR_PLANE
from ..splats.optical_depth import MAX_COORDINATE
from ..splats.shapes import shape_named
from .config import TrainConfig
from .optim import adam, noise
from .optim.skew_map import R_CEILING, R_FLOOR, SKEW_MAPS

EXPOSURE_VECS = 8  # vectors of a work-item of cl/train/exposure.cl
EXPOSURE_GROUP = 64
EXPOSURE_SUMS = 22  # sums of each work-item of cl/train/exposure.cl


def kernel_build(config: TrainConfig, schedule: Schedule) -> KernelBuild:
    """Return the build of the renderer's kernels for a run."""
    return KernelBuild(
        config.shape,
        config.sh_degree,
        schedule,
        config.normalisation,
        skew_map=config.skew_map or SKEW_MAPS[0],
        antialiased=bool(config.antialiased),
        near_plane=config.near_plane or NEAR_PLANE,
        low_pass=config.low_pass or LOW_PASS,
    )


def loss_strip(kernels: KernelBuild) -> int:
    """Return the number of vectors of a row that one work-item of the loss blurs.

    Narrow strips of wide images touch a new page of memory in each row. So strips are as wide as the second-level cache
    of a CPU allows. It must hold 22 rows of four maps, which are 225 kB.
    """
    return 1 if kernels.lanes == 1 else 2560 // (kernels.lanes * kernels.dtype.itemsize)


def loss_program(device: Device, kernels: KernelBuild) -> Program:
    """Return the program of L1, SSIM and their gradients. It depends on lanes and precision only."""
    window = np.exp(-0.5 * (np.arange(-SSIM_RADIUS, SSIM_RADIUS + 1) / SSIM_SIGMA) ** 2)
    window /= window.sum()
    defines: dict[str, Define] = {f"WINDOW_{i}": float(window[i]) for i in range(SSIM_RADIUS + 1)}
    defines |= {"SSIM_C1": SSIM_C1, "SSIM_C2": SSIM_C2}
    defines |= {"LANES": kernels.lanes, "STRIP": loss_strip(kernels), "MARGIN_X": MARGIN_X, "MARGIN_Y": MARGIN_Y}
    return build(device, ("math/lanes.clh", "train/loss.cl"), defines, kernels.real)


def exposure_program(device: Device, kernels: KernelBuild, group: int = EXPOSURE_GROUP) -> Program:
    """Return the program of exposure, masks and transparency. It depends on lanes and precision only.

    Parameters
    ----------
    group : work-items of the kernel step_exposure. With another number it sums in another order.
    """
    defines: dict[str, Define] = {
        "LANES": kernels.lanes,
        "MARGIN_X": MARGIN_X,
        "MARGIN_Y": MARGIN_Y,
        "PHOTO_VECS": EXPOSURE_VECS,
        "EXPOSURE_GROUP": group,
        "SUMS": EXPOSURE_SUMS,
    }
    return build(device, ("math/lanes.clh", "train/exposure.cl"), defines, kernels.real)


def coefficients_of_item(kernels: KernelBuild) -> int:
    """Return the number of coefficients of the colour that one work-item steps (cl/train/optim.cl)."""
    return sh_coefficients(kernels.sh_degree) if kernels.lanes == 1 else 1


# Parts of a geometry step (cl/train/optim.cl): a work-item steps the rows of one part.
PARTS = ("mean", "quat", "scale", "own")

_BELOW_STEPS = (
    "math/lanes.clh",
    "math/algebra.clh",
    "math/opacity.clh",
    "math/harmonics.clh",
    "train/skew_map.clh",
    "math/philox.clh",
    "math/noise.clh",
    "train/adam.clh",
    "train/steps.clh",
)
_STEPS = ("train/optim.cl", "train/positions.cl")


def optim_program(device: Device, kernels: KernelBuild, half_moments: bool = False, photos: int = 1) -> Program:
    """Return the program of the optimizer: steps of colour, geometry and skew, SGHMC and noise.

    half_moments : whether the moments of colours have 16 bits. photos : those of an iteration.
    """
    defines = _optim_defines(kernels, half_moments) | {"LAZY": 0, "PHOTOS": photos}
    return build(device, (*_BELOW_STEPS, *_STEPS), defines, kernels.real)


def lazy_program(device: Device, kernels: KernelBuild, half_moments: bool = False) -> Program:
    """Return the program of the optimizer with the kernels for visible splats (optim/lazy.py)."""
    defines = _optim_defines(kernels, half_moments) | {
        "LAZY": 1,
        "PHOTOS": 1,
        "ADAM_WAITS": adam.WAITS,
        "CULLED_KEY": f"{CULLED_KEY:#x}u",
        "DRIFT": adam.DECAY_ROWS + adam.DRIFT,
        "DRIFT_MEAN": adam.DECAY_ROWS + adam.DRIFT_MEAN,
        "DRIFT_SKEW": adam.DECAY_ROWS + adam.DRIFT_SKEW,
    }
    return build(device, (*_BELOW_STEPS, "train/lazy.clh", *_STEPS, "train/lazy.cl"), defines, kernels.real)


def columns_program(device: Device, kernels: KernelBuild) -> Program:
    """Return the program of densification: a summary of every splat, and moves of splats between columns."""
    schema = kernels.schema
    defines = layout_defines(shape_named(kernels.shape), schema)
    defines |= {"LANES": 1, "SH_ROWS": schema.rows(Group.SH), "MAX_COORDINATE": MAX_COORDINATE}
    return build(device, ("math/lanes.clh", "train/columns.cl", "train/density.cl"), defines, kernels.real)


def dropout_program(device: Device) -> Program:
    """Return the program that hides splats for one iteration."""
    defines: dict[str, Define] = {
        "LANES": 1,
        "CULLED_KEY": f"{CULLED_KEY:#x}u",
        "DROPOUT_STREAM": f"{noise.DROPOUT_STREAM}u",
    }
    return build(device, ("math/lanes.clh", "math/philox.clh", "train/dropout.cl"), defines)


def depth_program(device: Device, kernels: KernelBuild) -> Program:
    """Return the program of smooth depths. It depends on the fields and the precision only."""
    defines = layout_defines(shape_named(kernels.shape), kernels.schema)
    defines |= {"LANES": 1, "MARGIN_X": MARGIN_X, "MARGIN_Y": MARGIN_Y, "SH_C0": SH_C0}
    return build(device, ("math/lanes.clh", "train/depth.cl"), defines, kernels.real)


def _optim_defines(kernels: KernelBuild, half_moments: bool) -> dict[str, Define]:
    geometry = kernels.schema.group(Group.GEOM)
    widths = {field.name: field.width for field in geometry if field.name not in ("mean", "quat", "log_scale", "skew")}
    defines: dict[str, Define] = {f"PART_{name.upper()}": number for number, name in enumerate(PARTS)}
    defines |= layout_defines(shape_named(kernels.shape), kernels.schema)
    # 1 - beta is a constant, because the difference of float32 numbers has a relative error of 1e-5.
    return defines | {
        "PART_ROWS": max(4, sum(widths.values())),
        "LANES": kernels.lanes,
        "COEFFICIENTS": coefficients_of_item(kernels),
        "HALF_MOMENTS": int(half_moments),
        "FULL_MOMENTS": int(not half_moments),
        "COMPACT_ROWS": COMPACT_ROWS,
        "SKEW_MAP": SKEW_MAPS.index(kernels.skew_map),
        "SKEW_FLOOR": R_FLOOR,
        "SKEW_CEILING": R_CEILING,
        "GATE_SHARPNESS": noise.GATE_SHARPNESS,
        "GATE_OFFSET": noise.GATE_OFFSET,
        "ADAM_BETA1": adam.BETA1,
        "ADAM_BETA2": adam.BETA2,
        "ADAM_EPS": adam.EPS,
        "ADAM_REST1": 1.0 - adam.BETA1,
        "ADAM_REST2": 1.0 - adam.BETA2,
    }
