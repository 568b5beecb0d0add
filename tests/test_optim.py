"""Optimizers: the fused kernels against NumPy step for step, plans, bounded fields, frozen blocks, state."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from clsplat.buffers import ParameterBuffers, SplatBuffers
from clsplat.config import TrainConfig
from clsplat.device import Device, default_schedule
from clsplat.kernels import KernelBuild
from clsplat.optim import Optimizer, make_optimizer
from clsplat.plan import Plan
from clsplat.schema import Group
from clsplat.shapes import shape_named
from clsplat.skew_map import MAPS, SKEW_MAPS
from clsplat.splats import Splats

CAPACITY = 400
EXTENT = 3.0
ITERATIONS = 30_000  # at which rates have no factor
MEAN_LR = 1e-3
TOLERANCE = 3e-6  # ten float32 steps: some ulp of the value or vector, and of ten steps of at most the rate

SGHMC = {"position_optimizer": "sghmc", "sghmc_burn_in": 4.5 / ITERATIONS}
CASES = [
    {"shape": "gaussian"},
    *({"shape": "skew-normal", "skew_map": name} for name in MAPS["centred"]),
    *({"shape": "skew-normal-direct", "skew_map": name} for name in MAPS["direct"]),
    {"shape": "half-gaussian", **SGHMC},
    {"shape": "generalised-exponential"},
    {"shape": "student-t", **SGHMC, "position_optimizer": "sghmc-sss"},
    {"shape": "bisected-skew", "skew_map": "coupled", **SGHMC, "alternation": "cyclic",
     "alternation_warmup": 2.5 / ITERATIONS, "alternation_cycle": 3},
]  # fmt: skip


def some_splats(shape: str, n: int = 300, sh_degree: int = 2) -> Splats:
    """Random splats, some nearly transparent; bounded fields all over their range."""
    rng = np.random.default_rng(5)
    arrays: dict[str, np.ndarray] = {"sh": 0.5 * rng.standard_normal((n, (sh_degree + 1) ** 2, 3))}
    for field in shape_named(shape).schema(sh_degree).group(Group.GEOM):
        size = (n,) if field.width == 1 else (n, field.width)
        values = rng.standard_normal(size)
        if field.bounds is not None:
            values = np.exp(rng.uniform(*np.log(field.bounds), size))
        elif field.limit is not None:
            # Ten steps do not reach 0 from here, where the cube-root map is steep and rounding is no measure.
            length = field.limit * rng.uniform(0.45, 0.95, (n, 1))
            values *= length / np.linalg.norm(values, axis=1, keepdims=True)
        elif field.name == "log_scale":
            values = rng.uniform(-3.5, -1.5, size)
        elif "opacity" in field.name:
            values = rng.uniform(-7, 3, size)
            values[: n // 4] = 1e-2 * rng.standard_normal(n // 4)  # of a signed shape these are transparent
        arrays[field.name] = values
    return Splats(shape, {name: array.astype(np.float32) for name, array in arrays.items()})


def words(options: dict[str, object]) -> str:
    return "-".join(value for value in options.values() if isinstance(value, str))


def config_of(**options: object) -> TrainConfig:
    return TrainConfig(**({"iterations": ITERATIONS, "seed": (7 << 32) + 3} | options))  # type: ignore[arg-type]


def kernels_of(device: Device, config: TrainConfig, sh_degree: int = 2) -> KernelBuild:
    return KernelBuild(config.shape, sh_degree, default_schedule(device.cl_device),
                       skew_map=config.map or SKEW_MAPS[0])


def started(device: Device, config: TrainConfig, splats: Splats) -> tuple[SplatBuffers, Optimizer]:
    kernels = kernels_of(device, config, splats.schema.sh_degree)
    buffers = SplatBuffers.of(device, splats, kernels.dtype, CAPACITY)
    return buffers, make_optimizer(device, kernels, buffers, config, EXTENT)


def gradients(buffers: SplatBuffers, rng: np.random.Generator) -> dict[str, np.ndarray]:
    return {name: rng.standard_normal(array.shape).astype(np.float32)
            for name, array in buffers.download(buffers.n).items()}  # fmt: skip


def step(buffers: SplatBuffers, optimizer: Optimizer, grads: dict[str, np.ndarray], iteration: int,
         sh_degree: int = 2) -> None:
    on_device = ParameterBuffers(buffers.device, buffers.schema, CAPACITY, buffers.dtype)
    on_device.upload(grads)
    optimizer.step(on_device, MEAN_LR, sh_degree, iteration)


def growing(arrays: dict[str, np.ndarray], rng: np.random.Generator) -> Plan:
    """As a relocation: some rows become copies, 40 are added, states stay where they are."""
    n = len(arrays["mean"])
    source = np.concatenate([np.arange(n), rng.integers(0, n, 40)])
    source[: n // 5] = rng.integers(n // 2, n, n // 5)
    fresh = np.zeros(n + 40, bool)
    fresh[rng.integers(0, n, 30)] = True
    fresh[n : n + 20] = True  # the other new rows have no state either
    values = {"opacity_logit": arrays["opacity_logit"][source] - 1, "log_scale": arrays["log_scale"][source] - 0.1}
    return Plan(source, values, fresh)


def shrinking(arrays: dict[str, np.ndarray], rng: np.random.Generator) -> Plan:
    """As pruning with a reset: 100 rows go, states move along, some rows are turned or given another skew."""
    n = len(arrays["mean"])
    source = rng.permutation(n)[: n - 100]
    fresh = np.zeros(n - 100, bool)
    fresh[::7] = True
    moved = {name: array[source].copy() for name, array in arrays.items()}
    moved["quat"][3] = [0.5, 0.1, -0.2, 0.7]
    values = {"mean": moved["mean"] + 0.1, "quat": moved["quat"]}
    if "skew" in moved:
        moved["skew"][5:9] *= -0.5
        values["skew"] = moved["skew"]
    resets = ("opacity_logit", "mean", "sh", *(("skew",) if "skew" in moved else ()))
    return Plan(source, values, fresh, state_source=source, reset_fields=resets)


@pytest.mark.parametrize("options", CASES, ids=words)
def test_fused_steps_equal_numpy(device: Device, options: dict[str, object]) -> None:
    """The same gradients into both; growth, shrinking and growth again between the steps."""
    config = config_of(**options)
    splats = some_splats(config.shape)
    both = {name: started(device, replace(config, optimizer=name), splats) for name in ("fused", "numpy")}
    buffers = both["numpy"][0]
    rng = np.random.default_rng(8)
    plans = {3: growing, 5: shrinking, 8: growing}
    for iteration, degree in enumerate([0] * 3 + [1] * 3 + [2] * 4, start=1):
        start = buffers.download(buffers.n)
        grads = gradients(buffers, rng)
        for target, optimizer in both.values():
            step(target, optimizer, grads, iteration, degree)
        if iteration in plans:
            for target, optimizer in both.values():  # each from its own values: copies must be equal to the bit
                optimizer.apply(plans[iteration](target.download(target.n), np.random.default_rng(iteration)))
        else:
            moved = buffers.download(buffers.n)
            blocks = {True: "skew" in moved, False: True}
            if config.alternation == "cyclic" and iteration > 2:
                skew_turn = (iteration - 3) % 3 >= 2
                blocks = {True: skew_turn, False: not skew_turn}
            for name in moved:
                turns = name == "skew" and config.map == "coupled"  # moves with the rotation, too
                assert np.any(moved[name] != start[name]) == (blocks[name == "skew"] or turns), name
    fused, numpy = (target.download(target.n) for target, _ in both.values())
    for name, expected in numpy.items():
        length = splats.schema[name].limit or 1.0
        np.testing.assert_allclose(fused[name], expected, TOLERANCE, TOLERANCE * length, err_msg=name)
    states = [optimizer.state() for _, optimizer in both.values()]
    assert set(states[0]) == set(states[1])
    for name, expected in states[1].items():
        np.testing.assert_allclose(states[0][name], expected, 1e-6, 1e-6 * np.abs(expected).max(), err_msg=name)
