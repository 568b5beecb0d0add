"""Limits of learning rates: high rates are refused, and defaults and presets are always accepted."""

from __future__ import annotations

import pytest

from clsplat.errors import InputError
from clsplat.training.config import TrainConfig
from clsplat.training.decisions import FEWEST_ITERATIONS, RANDOM_START_RATES
from clsplat.training.presets import PRESETS, preset
from clsplat.training.rate_limits import LIMITS, check_rates


@pytest.mark.parametrize("iterations", [1, 10, 200, 30_000])
def test_defaults_and_presets_pass(iterations: int) -> None:
    check_rates(TrainConfig(iterations=iterations))
    for name in PRESETS:
        check_rates(TrainConfig(**(preset(name) | {"iterations": iterations})))


@pytest.mark.parametrize("name", LIMITS)
def test_a_hundred_times_the_rate_is_refused_and_a_usable_one_named(name: str) -> None:
    rate = 100 * (getattr(TrainConfig().optim, name) or 2.5e-3)
    if name == "position_lr_final":  # its limit is 100 times as high: the rate at the start
        rate *= 100
    with pytest.raises(InputError, match=rf"^{name} .* of 200 iterations .*: use at most [\d.e-]+$") as caught:
        check_rates(TrainConfig(iterations=200, **{name: rate}))
    usable = float(str(caught.value).rsplit(" ", 1)[1])
    check_rates(TrainConfig(iterations=200, **{name: usable}))


@pytest.mark.parametrize("iterations", [100, 1000, 7000])
def test_the_rate_of_the_bands_is_checked_as_the_run_has_it(iterations: int) -> None:
    highest = 0.08 / max(1.0, 30_000 / iterations) ** 0.25
    check_rates(TrainConfig(iterations=iterations, feature_rest_lr=0.99 * highest))
    with pytest.raises(InputError, match="feature_rest_lr"):
        check_rates(TrainConfig(iterations=iterations, feature_rest_lr=1.01 * highest))


@pytest.mark.parametrize("iterations", [FEWEST_ITERATIONS, 200, 1000, 30_000])
def test_the_factor_of_a_random_start_passes(iterations: int) -> None:
    check_rates(TrainConfig(iterations=iterations, lr_factor=RANDOM_START_RATES))


def test_a_high_factor_is_refused_and_a_usable_one_named() -> None:
    with pytest.raises(InputError, match=r"^lr_factor 40: each of 200 iterations .*: use at most [\d.]+$") as caught:
        check_rates(TrainConfig(iterations=200, lr_factor=40.0))
    usable = float(str(caught.value).rsplit(" ", 1)[1])
    assert usable > 1
    check_rates(TrainConfig(iterations=200, lr_factor=usable))
    check_rates(TrainConfig(iterations=200, lr_factor=1e-3))
