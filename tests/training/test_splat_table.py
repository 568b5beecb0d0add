"""Densification reads the same of splats on the device as of arrays on the host, and makes the same plans."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays as some_arrays
from model_arrays import ALL_SHAPES, Arrays, random_model

from clsplat.device.device import Device
from clsplat.device.schedule import SCHEDULES
from clsplat.rendering.build import KernelBuild
from clsplat.rendering.splat_buffers import SplatBuffers
from clsplat.splats.optical_depth import MAX_COORDINATE
from clsplat.splats.shapes import Shape
from clsplat.training.config import TrainConfig
from clsplat.training.density.edit import DensifyEdit
from clsplat.training.density.on_device import DeviceSplats
from clsplat.training.density.strategy import StepInfo, next_edit
from clsplat.training.density.table import HostSplats, SplatTable, smallest
from clsplat.training.programs import columns_program

N = 700


def broken(arrays: Arrays) -> Arrays:
    """Make one splat unsound in each field, and in each way of the position."""
    for row, name in enumerate(arrays):
        arrays[name].reshape(N, -1)[10 * row, -1] = np.nan if row % 2 else np.inf
    arrays["mean"][300, 0], arrays["mean"][301, 1] = -np.inf, np.nan
    arrays["mean"][302, 2], arrays["mean"][303, 2] = np.float32(MAX_COORDINATE), 2 * np.float32(MAX_COORDINATE)
    return arrays


def on_device(device: Device, shape: Shape, arrays: Arrays) -> DeviceSplats:
    kernels = KernelBuild(shape.name, 1, SCHEDULES["scalar"])
    splats = SplatBuffers(device, shape.schema(1), N + 100, np.dtype(np.float32))
    splats.set(arrays)
    return DeviceSplats(splats, columns_program(device, kernels))


@pytest.mark.parametrize("shape", ALL_SHAPES, ids=lambda shape: shape.name)
def test_the_device_reads_what_the_host_reads(devices: list[Device], shape: Shape) -> None:
    arrays = broken(random_model(shape, N, 3))
    host, table = HostSplats(shape, arrays), on_device(devices[0], shape, arrays)
    expected, found = host.summary(), table.summary()
    np.testing.assert_array_equal(found.log_size, expected.log_size)
    np.testing.assert_array_equal(found.raw_opacity, expected.raw_opacity)
    unsound = np.flatnonzero(~expected.finite)
    assert unsound.tolist() == sorted({*range(0, 10 * len(arrays), 10), 300, 301, 303})
    rows = np.random.default_rng(0).permutation(N)[:90]
    for chosen in (rows, rows[:1], rows[:0]):
        taken = table.take(chosen)
        assert set(taken) == set(arrays) - {"sh"}
        for name, array in host.take(chosen).items():
            np.testing.assert_array_equal(taken[name], array, err_msg=name)
    for name, array in arrays.items():
        np.testing.assert_array_equal(table.field(name), array, err_msg=name)


CONFIGS = {
    "clone and split": {"grad_threshold": 1e-4, "cap_max": 2 * N, "split": "published"},
    "split along the longest axis": {"grad_threshold": 1e-4, "cap_max": 2 * N},
    "turnover": {"grad_threshold": 1e-5, "cap_max": N},
    "3DSGS, with a reset": {
        "depth_threshold": 0.1,
        "opacity_reset": 1,
        "iterations": 1000,
        "cap_max": 2 * N,
        "split": "published",
    },
    "relocation": {"strategy": "mcmc", "cap_max": N + 60},
    "relocation in one place": {"strategy": "mcmc", "cap_max": N + 60, "split": "published"},
    "relocation at the cap": {"strategy": "mcmc", "cap_max": N},
}


@pytest.mark.parametrize("options", CONFIGS.values(), ids=CONFIGS)
@pytest.mark.parametrize("shape", ALL_SHAPES, ids=lambda shape: shape.name)
def test_plans_of_splats_on_the_device_equal_those_of_the_host(
    devices: list[Device], shape: Shape, options: dict[str, float]
) -> None:
    arrays = broken(random_model(shape, N, 5))
    stats = np.random.default_rng(1).exponential((2e-4, 0.1, 1.0), (N, 3)).T.astype(np.float32)
    stats[2] = np.ceil(4 * stats[2])
    config = TrainConfig(shape=shape.name, **options)  # type: ignore[arg-type]

    def plan(splats: SplatTable) -> DensifyEdit:
        info = StepInfo(1000, 2000, 1.05, 2.0)
        return next_edit(config, splats, stats, np.random.default_rng(7), info)

    expected, found = plan(HostSplats(shape, arrays)), plan(on_device(devices[0], shape, arrays))
    assert expected.added + expected.relocated > 20
    assert (found.added, found.removed, found.relocated) == (expected.added, expected.removed, expected.relocated)
    assert found.reset_fields == expected.reset_fields
    np.testing.assert_array_equal(found.source, expected.source)
    np.testing.assert_array_equal(found.fresh, expected.fresh)
    if expected.state_source is not None:
        np.testing.assert_array_equal(found.state_source, expected.state_source)
    assert set(found.values) == set(expected.values)
    for name, new in expected.values.items():
        np.testing.assert_array_equal(found.values[name].rows, new.rows, err_msg=name)
        np.testing.assert_array_equal(found.values[name].values, new.values, err_msg=name)


@given(
    values=some_arrays(np.float32, st.integers(0, 60), elements=st.integers(-3, 3).map(float)),
    count=st.integers(-2, 70),
)
def test_the_smallest_are_those_of_a_stable_sort(values: np.ndarray, count: int) -> None:
    expected = np.sort(np.argsort(values, kind="stable")[: max(count, 0)])
    np.testing.assert_array_equal(smallest(values, count), expected)


@pytest.mark.parametrize("count", [1, 3, 900, 15_000, 29_999, 40_000])
@pytest.mark.parametrize("order", ["random", "rising", "falling", "few values", "sampled ones are small", "... large"])
def test_the_smallest_of_many_values_are_those_of_a_stable_sort(order: str, count: int) -> None:
    values = np.random.default_rng(1).standard_normal(30_000).astype(np.float32)
    if order in ("rising", "falling"):
        values = np.sort(values)[:: 1 if order == "rising" else -1]
    elif order == "few values":
        values = np.round(values)
    elif order != "random":  # every third value is in the sample
        values[::3] += -100.0 if "small" in order else 100.0
    expected = np.sort(np.argsort(values, kind="stable")[:count])
    np.testing.assert_array_equal(smallest(values, count), expected)


def test_a_sample_that_is_too_small_a_bound_leaves_no_value_out() -> None:
    values = np.ones(30_000, np.float32)
    values[::3] = -np.arange(10_000)  # the sample is of these alone
    np.testing.assert_array_equal(smallest(values, 20_000)[:4], [0, 1, 2, 3])
    assert len(smallest(values, 20_000)) == 20_000
