"""`TrainConfig`: equal groups and flat options, defaults of strategies, and checks of ranges and files."""

from __future__ import annotations

import dataclasses
import doctest
import importlib
import json
from typing import Any

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.training.config import FREE_OPTIONS, GROUPS, OPTIONS, TrainConfig
from clsplat.training.options.density import STRATEGIES, Adc, DensityConfig, Mcmc
from clsplat.training.options.groups import OptimConfig
from clsplat.training.options.option import Range, option_table


def test_groups_and_flat_options_make_the_same_config() -> None:
    grouped = TrainConfig(cap_max=7, density=Mcmc(growth=1.1), optim=OptimConfig(opacity_lr=0.1))
    assert grouped == TrainConfig(cap_max=7, strategy="mcmc", growth=1.1, opacity_lr=0.1)
    assert (grouped.strategy, grouped.density.init_opacity) == ("mcmc", Mcmc().init_opacity)
    assert grouped.replace(opacity_lr=0.05) == TrainConfig(cap_max=7, density=Mcmc(growth=1.1))
    assert dataclasses.replace(grouped, density=Adc()) == TrainConfig(cap_max=7, opacity_lr=0.1)
    with pytest.raises(InputError, match="no option 'iteration': did you mean iterations"):
        TrainConfig(iteration=1)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("iterations", 10.5, "iterations is 10.5; expected a whole number"),
        ("iterations", True, "iterations is true; expected a whole number"),
        ("opacity_lr", None, "opacity_lr is null; expected a finite number"),
        ("background", "red", "background is the text 'red'; expected a list of numbers"),
        ("background", 5, "background is 5; expected a list of numbers"),
        ("init", 5, "init is 5; expected a text"),
        ("device", 5, "device is 5; expected a text, or null"),
        ("test_iterations", 5, "test_iterations is 5; expected a list of numbers"),
        ("shape", [], r"shape \[\]: choose one of gaussian"),
    ],
)
def test_a_value_of_another_type_is_refused(name: str, value: object, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        TrainConfig(**{name: value})
    assert "\n" not in str(caught.value)


def test_numbers_and_lists_of_numpy_are_values() -> None:
    config = TrainConfig(iterations=np.int64(10), opacity_lr=np.float32(0.5), background=[0.0, 0.5, 1])
    assert (config.iterations, config.optim.opacity_lr, config.background[1]) == (10, 0.5, 0.5)
    assert len(TrainConfig(background=np.zeros(3)).background) == 3


def test_every_option_is_in_one_group_and_has_help() -> None:
    groups = [DensityConfig, *GROUPS.values()]
    names = [name for group in groups for name in option_table(group)]
    assert len(names) == len(set(names))
    assert not set(names) & {field.name for field in dataclasses.fields(TrainConfig)}
    assert TrainConfig().to_json().keys() == OPTIONS.keys()
    for definition in OPTIONS.values():
        assert definition.help.endswith("."), definition.name


@pytest.mark.parametrize("strategy", STRATEGIES)
def test_a_strategy_has_defaults_of_its_own(strategy: str) -> None:
    config = TrainConfig(strategy=strategy, noise_lr=7.0)
    assert config.density == STRATEGIES[strategy](noise_lr=7.0)
    assert config == TrainConfig.from_json(config.to_json())
    assert config == TrainConfig.from_json({"strategy": strategy, "noise_lr": 7.0, "opacity_reg": None})
    with pytest.raises(InputError, match="opacity_reg -1: must be at least 0"):
        TrainConfig(strategy=strategy, opacity_reg=-1)


# Defaults with an effect on the model. Those of 3DGS and 3DGS-MCMC are published; benchmarks/SYSTEMS.md measures the
# others. A change of any of them changes what a command without options trains.
DEFAULTS = {
    "shape": "skew-normal",
    "iterations": 7000,
    "cap_max": 100_000,
    "sh_degree": 3,
    "normalisation": "peak",
    "antialiased": None,
    "low_pass": None,
    "near_plane": None,
    "background": (0.0, 0.0, 0.0),
    "cut_background": False,
    "random_background": False,
    "random_background_until": 0.8,
    "seed": 0,
    "strategy": "adc",
    "init": "sfm",
    "random_points": None,
    "sh_interval": 0,
    "coarse_to_fine": True,
    "batch": 1,
    "lambda_dssim": 0.2,
    "smooth_l1": 0.05,
    "bisect_reg": 0.0,
    "dropout": 0.0,
    "depth_smoothness": 0.0,
    "occluder_check": False,
    "outlier_check": True,
    "position_lr_init": 1.6e-4,
    "position_lr_final": 1.6e-6,
    "opacity_lr": 0.05,
    "scaling_lr": 5e-3,
    "rotation_lr": 1e-3,
    "feature_lr": 2.5e-3,
    "feature_rest_lr": None,
    "lr_factor": 1.0,
    "skew_lr": None,
    "normal_lr": 3e-3,
    "beta_lr": 1e-3,
    "nu_lr": 1e-2,
    "skew_map": "auto",
    "average_last": 0.05,
    "visible_adam": False,
    "half_moments": False,
    "optimizer": "fused",
    "position_optimizer": "adam",
    "sghmc_friction": 120.0,
    "sghmc_burn_in": 7 / 30,
    "sghmc_burn_in_friction": 5e5,
    "alternation": "off",
    "alternation_warmup": 0.1,
    "alternation_cycle": 100,
    "alternation_split": 0.5,
    "exposure": False,
    "exposure_rate": 0.2,
    "exposure_pull": 1e-2,
    "validate": False,
}
DEFAULTS_OF_STRATEGY = {
    Adc: {
        "densify_from": 0.05,
        "densify_until": 0.5,
        "densify_interval": 100,
        "init_opacity": 0.2,
        "init_scale": 0.7,
        "opacity_reg": 0.0,
        "scale_reg": 0.0,
        "noise_lr": 0.0,
        "grad_threshold": 2e-4,
        "depth_threshold": 0.0,
        "dense_size": 0.01,
        "turnover": None,
        "split": "long-axis",
        "opacity_reset": 0,
    },
    Mcmc: {
        "densify_from": 0.05,
        "densify_until": 0.8,
        "densify_interval": 100,
        "init_opacity": 0.2,
        "init_scale": 0.5,
        "opacity_reg": 0.001,
        "scale_reg": 0.001,
        "noise_lr": 5e5,
        "growth": 1.05,
        "relocation": "length",
        "relocation_limit": 1.0,
        "turnover": None,
        "split": "long-axis",
    },
}


def test_defaults_with_an_effect_on_the_model() -> None:
    of_strategies = {name for cls in DEFAULTS_OF_STRATEGY for name in option_table(cls)}
    values = TrainConfig().to_json()
    assert {name: values[name] for name in OPTIONS.keys() - of_strategies - set(FREE_OPTIONS)} == DEFAULTS
    for cls, defaults in DEFAULTS_OF_STRATEGY.items():
        assert dataclasses.asdict(cls()) == defaults


def test_the_strategies_differ_in_defaults_of_shared_options() -> None:
    for name, definition in option_table(DensityConfig).items():
        differ = getattr(Adc(), name) != getattr(Mcmc(), name)
        assert differ == (definition.default is dataclasses.MISSING), name


def test_another_strategy_keeps_the_options_that_both_have() -> None:
    config = TrainConfig(strategy="mcmc", growth=1.2, opacity_reg=0.02)
    changed = config.replace(strategy="adc", densify_until=0.0)
    shared = {name: getattr(config.density, name) for name in option_table(DensityConfig)}
    assert changed.density == Adc(**shared | {"densify_until": 0.0})
    assert changed.density.opacity_reg == 0.02


def test_options_of_the_other_strategy_have_no_effect() -> None:
    config = TrainConfig(strategy="adc", growth=1.2)
    assert config == TrainConfig(strategy="adc")
    assert config.to_json()["growth"] == Mcmc().growth
    assert config.without_effect(["growth", "grad_threshold", "opacity_reg", "iterations"]) == ["growth"]
    assert TrainConfig(strategy="mcmc").without_effect(["growth", "grad_threshold"]) == ["grad_threshold"]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"strategy": "hope"}, "strategy 'hope': choose one of mcmc, adc"),
        ({"optimizer": "lucky"}, "optimizer 'lucky': choose one of fused, numpy"),
        ({"iterations": 0}, "iterations 0: must be at least 1"),
        ({"sh_degree": 4}, "sh_degree 4: must be 0 to 3"),
        ({"densify_from": -0.1}, "densify_from -0.1: must be 0 to 1"),
        ({"densify_until": 1.5}, "densify_until 1.5: must be 0 to 1"),
        ({"strategy": "mcmc", "growth": 0.9}, "growth 0.9: must be 1 to 100"),
        ({"strategy": "mcmc", "growth": 1e308}, "must be 1 to 100"),
        ({"lambda_dssim": 1.5}, "lambda_dssim 1.5: must be 0 to 1"),
        ({"position_lr_final": 0}, "position_lr_final 0: must be above 0"),
        ({"init_opacity": 1.0}, "init_opacity 1.0: must be above 0 and below 1"),
        ({"init_scale": float("nan")}, "init_scale nan: must be finite and above 0"),
        ({"skew_lr": -1.0}, "skew_lr -1.0: must be at least 0"),
        ({"seed": 2**64}, f"seed {2**64}: must be at least 0 and below {2**64}"),
        ({"background": (0, 0, 2)}, r"background \(0, 0, 2\): expected R,G,B, each 0 to 1"),
        ({"shape": "gaussian", "skew_map": "oblique"}, "skew_map 'oblique': choose one of auto, "),
        ({"shape": "skew-normal", "skew_map": "polar"}, "skew_map 'polar' for the centred form"),
    ],
)
def test_a_value_out_of_range_is_named(options: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        TrainConfig(**options)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("background", [(-0.1, 0, 0), (0, 0, 1.1), (0, 0), (float("nan"), 0, 0)])
def test_a_background_is_a_colour(background: tuple[float, ...]) -> None:
    with pytest.raises(InputError, match="expected R,G,B, each 0 to 1"):
        TrainConfig(background=background)  # type: ignore[arg-type]


def test_rates_of_short_runs_are_raised() -> None:
    """The published rates are for 30 000 iterations: max(1, 30 000 / iterations)^p, p = 3/4 for positions."""
    assert TrainConfig(iterations=30_000).rate_factor("mean") == 1
    assert TrainConfig(iterations=60_000).rate_factor("mean") == 1
    assert TrainConfig(iterations=7500).rate_factor("mean") == pytest.approx(4**0.75)
    assert TrainConfig(iterations=7500).rate_factor("quat") == pytest.approx(2)


def test_ranges() -> None:
    assert [Range(above=0, below=1).allows(x) for x in (0, 0.5, 1, float("nan"))] == [False, True, False, False]
    assert [Range(at_least=0, at_most=1).allows(x) for x in (-1, 0, 1, 2)] == [False, True, True, False]


def test_a_file_of_another_order_of_keys_is_the_same_config() -> None:
    config = TrainConfig(strategy="mcmc", growth=1.3, save_iterations=(3, 4))
    stored = json.loads(json.dumps(config.to_json(), sort_keys=True))
    assert TrainConfig.from_json(stored) == config


def test_a_file_of_an_earlier_version_loads() -> None:
    """An old file has options of both strategies, null for defaults, and options that were removed since."""
    file = {"strategy": "adc", "growth": 1.2, "relocation": "length", "sampling": "opacity", "init_scale": None}
    assert TrainConfig.from_json(file) == TrainConfig(strategy="adc")
    with pytest.raises(InputError, match="config: unknown option 'sampling'"):
        TrainConfig.from_json({"sampling": "pull"})


def test_the_example_in_the_documentation() -> None:
    module = importlib.import_module("clsplat.training.config")
    assert doctest.testmod(module).failed == 0
    assert doctest.testmod(module).attempted > 0


@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
@pytest.mark.parametrize("name", ["growth", "densify_from", "sghmc_friction", "relocation_limit"])
def test_numbers_that_are_not_finite_are_refused(name: str, value: float) -> None:
    """Also for an option without a range, and for one that only the other strategy has."""
    with pytest.raises(InputError, match=rf"{name} {value}: must be finite"):
        TrainConfig(**{name: value})


def test_options_of_the_other_strategy_are_checked() -> None:
    with pytest.raises(InputError, match="relocation_limit 5"):
        TrainConfig(strategy="adc", relocation_limit=5.0)


@pytest.mark.parametrize(("name", "value"), [("iterations", "200"), ("opacity_lr", [0.1]), ("cap_max", {})])
def test_values_of_another_type_are_named(name: str, value: object) -> None:
    with pytest.raises(InputError, match=f"{name} is .*; expected"):
        TrainConfig(**{name: value})
