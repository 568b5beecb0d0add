"""A check of the optimizer's steps before a run: the kernels against the optimizer in NumPy, on a few splats."""

from __future__ import annotations

import numpy as np

from ..device.device import Device
from ..device.program import wrong_numbers
from ..rendering.build import KernelBuild
from ..rendering.splat_buffers import CompactGradients, SplatBuffers
from ..splats.fields import LOG_SCALE, Array, Field, public_shape
from .config import TrainConfig
from .optim.fused import FusedOptimizer
from .optim.reference import ReferenceOptimizer
from .optim.rules import Rules

_N, _STEPS = 20, 2
_DIRECTION = (0.779, 0.548, 0.304)  # a unit vector where every basis function is large
_TOLERANCE = 1e-2  # relative to the largest change of a field; float32 errors are 200 times smaller


def check_step(device: Device, kernels: KernelBuild, position_optimizer: str) -> None:
    """Compare the changes that a few steps make with those of the optimizer in NumPy.

    Rates are the default ones: large rates of a run would enlarge the rounding.

    Parameters
    ----------
    kernels : build of the run. Its program of the optimizer is checked as it is without half moments, steps of visible
        splats only, and batches.
    position_optimizer : as in the options of the run.

    Raises
    ------
    DeviceError : the device computes wrong numbers; the message names the field.
    """
    config = TrainConfig(
        shape=kernels.shape,
        sh_degree=kernels.sh_degree,
        skew_map=kernels.skew_map if "skew" in kernels.schema else "auto",
        position_optimizer=position_optimizer,
        opacity_reg=0.01,
        scale_reg=0.01,
    )
    rules, rng = Rules(config, extent=1.0), np.random.default_rng(0)
    before = {field.name: _values(field, rng) for field in kernels.schema}
    after = []
    for fused in (True, False):
        splats = SplatBuffers(device, kernels.schema, _N, kernels.dtype)
        splats.set(before)
        optimizer = FusedOptimizer(device, kernels, splats, rules) if fused else ReferenceOptimizer(splats, rules)
        steps = np.random.default_rng(1)
        for iteration in range(1, _STEPS + 1):
            grads = CompactGradients(device, kernels.schema, splats.capacity, kernels.dtype)
            grads.upload({field.name: _slopes(field, steps) for field in grads.schema})
            optimizer.step(grads, 0.01, kernels.sh_degree, iteration)
        after.append(dict(optimizer.read()))
    got, want = after
    for name, values in want.items():
        change = float(np.abs(values - before[name]).max())
        error = float(np.abs(got[name] - values).max())
        if change and not error <= _TOLERANCE * change:  # NaN is wrong, too
            raise wrong_numbers(device, f"step of {name} off by {error / change:.1e} of the step")


def _values(field: Field, rng: np.random.Generator) -> Array:
    """Return values of a field, away from its bounds and from 0, where maps are steep."""
    shape = public_shape(field, _N)
    values = _away_from_zero(shape, rng)
    if field.bounds is not None:
        low, high = np.log(field.bounds)
        return np.exp(rng.uniform(float(low), float(high), shape))
    if field.limit is not None:
        return 0.7 * field.limit * values / np.sqrt((values * values).sum(-1, keepdims=True))
    return values - 3 if field.name == LOG_SCALE.name else values


def _slopes(field: Field, rng: np.random.Generator) -> Array:
    """Return gradients of a field; of `sh` those of the colour, and directions with no basis function near 0."""
    slopes = _away_from_zero(public_shape(field, _N), rng)
    if field.name == "sh":
        slopes[:, 1] = np.array(_DIRECTION) * np.sign(slopes[:, 1])
    return slopes


def _away_from_zero(shape: tuple[int, ...], rng: np.random.Generator) -> Array:
    """Return numbers of both signs; Adam divides by the size of a gradient, and so do rotations."""
    return rng.uniform(0.2, 1.0, shape) * rng.choice([-1, 1], shape)
