"""Learning rates of a run: the options times the factors of its length and of `lr_factor`."""

from __future__ import annotations

import numpy as np
import pytest

from clsplat.training.config import TrainConfig
from clsplat.training.optim.rules import Rules
from clsplat.training.schedules import RunSchedule


def rates(**options: float) -> dict[str, float]:
    """Return the rate of each field. "constant" and "rest" are those of the colour."""
    rules = Rules(TrainConfig(**options), 1.0)
    colour = rules.sh_rates(48, np.dtype(np.float64))
    assert len(set(colour[:3])) == len(set(colour[3:])) == 1
    return {name: rate for name, rate in rules.rates.items() if name != "sh"} | {
        "constant": colour[0],
        "rest": colour[3],
    }


def test_published_rates_at_the_published_length() -> None:
    expected = {
        "quat": 1e-3,
        "log_scale": 5e-3,
        "opacity_logit": 0.05,
        "skew": 2.5e-3,
        "constant": 2.5e-3,
        "rest": 2.5e-3 / 20,
    }
    assert rates(iterations=30_000) == pytest.approx(expected)
    assert rates(iterations=90_000) == pytest.approx(expected)


def test_short_runs_have_higher_rates() -> None:
    long, short = rates(iterations=30_000), rates(iterations=30_000 // 16)
    factors = {name: short[name] / long[name] for name in long}
    assert factors == pytest.approx(
        {"quat": 4, "log_scale": 2, "opacity_logit": 1, "skew": 4, "constant": 1, "rest": 2}, rel=1e-3
    )


def test_the_factor_applies_to_all_rates_but_the_constant_colour() -> None:
    plain, raised = rates(iterations=2000), rates(iterations=2000, lr_factor=3.0)
    factors = {name: raised[name] / plain[name] for name in plain}
    assert factors == pytest.approx({name: 1.0 if name == "constant" else 3.0 for name in plain})


def test_the_factor_applies_to_positions_at_the_start_only() -> None:
    plain, raised = (
        RunSchedule.create(TrainConfig(iterations=1000, lr_factor=factor), 10).mean_rate for factor in (1.0, 3.0)
    )
    assert raised(0) == pytest.approx(3 * plain(0))
    assert raised(1000) == pytest.approx(plain(1000))
    assert raised(500) == pytest.approx(3**0.5 * plain(500))


def test_view_dependent_colours_follow_the_constant_ones_unless_they_have_a_rate() -> None:
    assert rates(iterations=30_000, feature_lr=0.01)["rest"] == pytest.approx(0.01 / 20)
    assert rates(iterations=30_000, feature_lr=0.01, feature_rest_lr=1e-3)["rest"] == pytest.approx(1e-3)
    assert rates(iterations=30_000, feature_rest_lr=0.0)["rest"] == 0
