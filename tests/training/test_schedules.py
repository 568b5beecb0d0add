"""Schedules: end points, monotonic change, and short runs."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from clsplat.errors import InputError
from clsplat.training.config import TrainConfig
from clsplat.training.density.control import DensityControl
from clsplat.training.schedules import (
    RunSchedule,
    downscale_at,
    downscale_for,
    exponential_decay,
    growth_factor,
    resolution_schedule,
    sh_degree_at,
)


def test_decay_is_log_linear_and_constant_beyond() -> None:
    rate = exponential_decay(1.6e-4, 1.6e-6, 30_000)
    assert rate(0) == pytest.approx(1.6e-4)
    assert rate(15_000) == pytest.approx(1.6e-5)
    assert rate(30_000) == pytest.approx(1.6e-6)
    assert rate(99_999) == pytest.approx(1.6e-6)
    assert rate(-1) == pytest.approx(1.6e-4)


@pytest.mark.parametrize(
    "arguments", [(0.0, 1.0, 5), (1.0, -1.0, 5), (1.0, float("nan"), 5), (float("inf"), 1.0, 5), (1.0, 1.0, 0)]
)
def test_decay_rejects(arguments: tuple[float, float, int]) -> None:
    with pytest.raises(InputError):
        exponential_decay(*arguments)


def test_sh_degree_rises_every_interval() -> None:
    assert [sh_degree_at(i, 1000, 3) for i in (0, 999, 1000, 2999, 3000, 30_000)] == [0, 0, 1, 2, 3, 3]
    assert sh_degree_at(1, 0, 2) == 2
    assert sh_degree_at(5000, 1000, 0) == 0


@pytest.mark.parametrize(("n_first", "cap"), [(100, 50_000), (1000, 3000), (2000, 2000)])
def test_growth_reaches_the_cap_after_half_of_the_window(n_first: int, cap: int) -> None:
    """A far cap needs more than the option `growth`. A near one is reached earlier, at that growth."""
    config = TrainConfig(strategy="mcmc", iterations=2000, cap_max=cap, densify_interval=10, growth=1.05)
    schedule = RunSchedule.create(config, n_first)
    assert (schedule.densify_first, schedule.densify_last) == (100, 1600)
    half = (1600 - 100) // 10 // 2
    far = (cap / n_first) ** (1 / half)
    assert schedule.growth == pytest.approx(max(far, 1.05))
    assert n_first * schedule.growth**half >= cap * (1 - 1e-9)
    if far > 1.05:
        assert n_first * schedule.growth ** (half - 1) < cap
    assert growth_factor(TrainConfig(strategy="adc", cap_max=cap), n_first, 1500) == 1.0


def test_a_strategy_acts_at_both_ends_of_its_window() -> None:
    config = TrainConfig(strategy="mcmc", iterations=100, densify_from=0.2, densify_until=0.8, densify_interval=20)
    unused: Any = None
    control = DensityControl(config, unused, RunSchedule.create(config, 1), unused, unused, unused, unused, 1.0, 1)
    assert [iteration for iteration in range(101) if control.is_due(iteration)] == [20, 40, 60, 80]


def test_default_resolution_schedule() -> None:
    schedule = resolution_schedule(1000)
    assert schedule == [(0, 4), (200, 2), (500, 1)]
    assert [downscale_at(schedule, i) for i in (0, 199, 200, 499, 500, 1000)] == [4, 4, 2, 2, 1, 1]


def test_small_images_skip_coarse_stages() -> None:
    assert resolution_schedule(1000, image_side=150) == [(0, 2), (500, 1)]
    assert resolution_schedule(1000, image_side=100) == [(0, 1)]
    assert resolution_schedule(1000, image_side=256) == [(0, 4), (200, 2), (500, 1)]


@given(iterations=st.integers(1, 5000), side=st.integers(1, 2000))
def test_any_run_starts_at_zero_refines_and_ends_at_full_resolution(iterations: int, side: int) -> None:
    schedule = resolution_schedule(iterations, image_side=side)
    firsts = [first for first, _ in schedule]
    downscales = [downscale for _, downscale in schedule]
    assert firsts[0] == 0
    assert firsts == sorted(set(firsts))
    assert downscales == sorted(set(downscales), reverse=True)
    assert downscale_at(schedule, iterations) == 1


@pytest.mark.parametrize(
    "stages", [[], [(0.1, 2), (0.5, 1)], [(0.0, 2)], [(0.0, 1), (0.5, 1)], [(0.0, 4), (0.0, 1)], [(0.0, 4), (1.0, 1)]]
)
def test_resolution_schedule_rejects(stages: list[tuple[float, int]]) -> None:
    with pytest.raises(InputError, match="resolution schedule"):
        resolution_schedule(100, stages)


def test_few_splats_stay_longer_with_small_images() -> None:
    schedule, pixels = resolution_schedule(1000), 160_000
    for many in (20_000, 10**6):  # 8 pixels per splat, or fewer
        assert [downscale_for(schedule, i, many, pixels) for i in (0, 199, 200, 499, 500)] == [4, 4, 2, 2, 1]
    for few in (10_000, 1, 0):  # 16 pixels per splat, or more
        assert [downscale_for(schedule, i, few, pixels) for i in (0, 259, 260, 649, 650)] == [4, 4, 2, 2, 1]
    # 12 pixels per splat, halfway between
    assert [downscale_for(schedule, i, 13_333, pixels) for i in (0, 229, 231, 574, 576)] == [4, 4, 2, 2, 1]
    assert downscale_for([(0, 1)], 0, 10, 1) == 1


@given(iteration=st.integers(0, 1000), splats=st.integers(0, 10**6), pixels=st.integers(1, 10**6))
def test_no_downscale_is_finer_than_the_schedules(iteration: int, splats: int, pixels: int) -> None:
    schedule = resolution_schedule(1000)
    chosen = downscale_for(schedule, iteration, splats, pixels)
    assert chosen >= downscale_at(schedule, iteration)
    assert chosen <= downscale_for(schedule, iteration, max(splats - 1, 0), pixels)
    assert chosen >= downscale_for(schedule, iteration + 1, splats, pixels)
    assert downscale_for(schedule, 1000, splats, pixels) == 1
