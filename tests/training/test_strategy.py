"""Strategy: which edit the options request, and at which iteration."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from model_arrays import Arrays, random_model

from clsplat.splats import shapes
from clsplat.training.config import TrainConfig
from clsplat.training.density import strategy
from clsplat.training.density.edit import DensifyEdit
from clsplat.training.density.relocation import relocation
from clsplat.training.density.strategy import StepInfo
from clsplat.training.density.table import HostSplats

N = 100


def action(
    config: TrainConfig,
    iteration: int = 100,
    seed: int = 0,
    arrays: Arrays | None = None,
    stats: np.ndarray | None = None,
) -> tuple[Arrays, DensifyEdit]:
    shape = shapes.shape_named(config.shape)
    arrays = random_model(shape, N, 1) if arrays is None else arrays
    stats = np.zeros((3, N)) if stats is None else stats
    info = StepInfo(iteration, int(config.density.densify_until * config.iterations), 1.5, 1.0)
    return arrays, strategy.next_edit(config, HostSplats(shape, arrays), stats, np.random.default_rng(seed), info)


def mcmc(**options: Any) -> TrainConfig:
    return TrainConfig(strategy="mcmc", **options)


def test_mcmc_relocates_and_grows_by_the_options() -> None:
    config = mcmc(shape="gaussian", cap_max=130, iterations=3000)
    arrays, edit = action(config)
    assert len(edit.source) == 130
    dead = np.sum(shapes.GAUSSIAN.strength(arrays) <= 0.005)
    assert edit.relocated == dead > 10
    _, few = action(mcmc(shape="gaussian", cap_max=130, relocation_limit=0.05))
    assert few.relocated == 5
    _, flat = action(mcmc(shape="gaussian", cap_max=130, relocation="opacity-only", split="published"))
    assert "log_scale" not in flat.values


def test_mcmc_moves_splats_at_the_cap_to_high_mean_gradients() -> None:
    arrays = random_model(shapes.GAUSSIAN, N, 1, dead=0)
    row = int(shapes.GAUSSIAN.strength(arrays).argmax())
    stats = np.zeros((3, N))
    stats[:, row] = (1.0, 0.0, 4.0)
    _, edit = action(mcmc(shape="gaussian", cap_max=N), arrays=arrays, stats=stats)
    assert edit.relocated == 5  # 7000 iterations
    assert np.flatnonzero(np.bincount(edit.source) == 6).tolist() == [row]
    assert not action(mcmc(shape="gaussian", cap_max=N, turnover=0.0), arrays=arrays, stats=stats)[1].relocated


def test_mcmc_splits_or_piles_by_the_option() -> None:
    for split, apart in (("long-axis", True), ("published", False)):
        _, edit = action(mcmc(shape="gaussian", cap_max=130, split=split))
        assert ("mean" in edit.values) == apart


def test_the_default_turnover_falls_with_the_length_of_the_run() -> None:
    arrays, stats = random_model(shapes.GAUSSIAN, N, 1, dead=0), np.ones((3, N))

    def moved(**options: Any) -> int:
        config = mcmc(shape="gaussian", cap_max=N, **options)
        return action(config, arrays=arrays, stats=stats)[1].relocated

    assert [moved(iterations=n) for n in (100, 2000, 7000, 15_000, 30_000)] == [8, 8, 5, 2, 1]
    assert moved(iterations=30_000, densify_interval=500) == 5
    assert [moved(iterations=30_000, turnover=part) for part in (0.0, 0.2)] == [0, 20]


def test_length_squared_is_twice_the_log_factor() -> None:
    shifts = []
    for rule in ("length", "length-squared"):
        arrays, edit = action(mcmc(shape="gaussian", cap_max=130, relocation=rule, split="published"))
        shifts.append(edit.after("log_scale", arrays["log_scale"]) - arrays["log_scale"][edit.source])
    assert shifts[0].min() < -0.01
    np.testing.assert_allclose(shifts[1], 2 * shifts[0], atol=1e-5)
    size = np.bincount(edit.source, minlength=N)
    row = int(size.argmax())
    _, factor = relocation(shapes.GAUSSIAN, {k: a[row : row + 1] for k, a in arrays.items()}, size[row : row + 1])
    np.testing.assert_allclose(shifts[0][row], np.log(factor[0]), atol=1e-5)


@pytest.mark.parametrize(("normalisation", "scaled"), [("peak", True), ("pdf", False), ("none", False)])
def test_a_kernel_without_peak_one_keeps_its_scale(normalisation: str, scaled: bool) -> None:
    _, edit = action(mcmc(shape="skew-normal", normalisation=normalisation, cap_max=130, split="published"))
    assert ("log_scale" in edit.values) == scaled


def adc(**options: object) -> TrainConfig:
    return TrainConfig(
        **(
            {"shape": "gaussian", "strategy": "adc", "iterations": 30_000, "opacity_reset": 10, "cap_max": 1000}
            | options
        )
    )  # type: ignore[arg-type]


def test_adc_resets_when_3dgs_does() -> None:
    config = adc()
    at = [it for it in range(100, 15_001, 100) if action(config, it)[1].reset_fields]
    assert at == [3000, 6000, 9000, 12_000]
    assert not any(action(adc(opacity_reset=0), it)[1].reset_fields for it in at)
    # If no action occurs at a multiple, the next action resets instead, once.
    odd = adc(iterations=7000, opacity_reset=7, densify_interval=300, densify_until=0.8)
    assert [it for it in range(300, 5601, 300) if action(odd, it)[1].reset_fields] == [1200, 2100, 3000, 4200, 5100]


def test_adc_hands_on_its_options() -> None:
    arrays = random_model(shapes.GAUSSIAN, N, 1, dead=0)
    stats = np.zeros((3, N))
    stats[:3, 5] = (0.1, 1.0, 1.0)
    assert len(action(adc(), arrays=arrays, stats=stats)[1].source) == N + 1
    assert len(action(adc(grad_threshold=0.2), arrays=arrays, stats=stats)[1].source) == N
    deep = adc(grad_threshold=0.2, depth_threshold=0.5)
    assert len(action(deep, arrays=arrays, stats=stats)[1].source) == N + 1
    assert not action(adc(cap_max=N, turnover=0.0), arrays=arrays, stats=stats)[1].added
    assert action(adc(cap_max=N, turnover=0.01), arrays=arrays, stats=stats)[1].added
    size = float(np.exp(arrays["log_scale"][5].max()))
    drawn = action(adc(dense_size=size / 2, split="published"), arrays=arrays, stats=stats)[1]
    assert "log_scale" in drawn.values
    assert "opacity_logit" not in drawn.values
    cloned = action(adc(dense_size=size * 2, split="published"), arrays=arrays, stats=stats)[1]
    assert np.array_equal(cloned.apply(arrays)["log_scale"], arrays["log_scale"][cloned.source])
    assert "opacity_logit" in action(adc(), arrays=arrays, stats=stats)[1].values  # side by side, and fainter


def test_short_runs_leave_opacities_the_time_to_recover() -> None:
    config = adc(iterations=4000, densify_until=0.9)
    assert [it for it in range(100, 3601, 100) if action(config, it)[1].reset_fields] == [1000, 2000, 3000]
