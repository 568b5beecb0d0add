"""Lists of systems: their syntax, the resulting configs, and refused entries."""

from __future__ import annotations

import pytest

from clsplat.comparison.methods import parse_methods
from clsplat.errors import InputError
from clsplat.training.config import TrainConfig
from clsplat.training.presets import preset


def test_presets_shapes_and_the_default() -> None:
    gaussian, mcmc, default = parse_methods("gaussian, 3DGS_mcmc ,default".lower())
    assert gaussian.config(5, 1) == TrainConfig(shape="gaussian", cap_max=5, seed=1)
    assert default.config(5, 1) == TrainConfig(cap_max=5, seed=1)
    assert mcmc.label == "3dgs-mcmc"
    assert mcmc.config(5, 1) == TrainConfig(**preset("3dgs-mcmc"), cap_max=5, seed=1)


def test_changes_follow_a_colon_and_go_on_after_commas() -> None:
    text = "3dgs:strategy=mcmc,opacity-lr=1e-3,coarse_to_fine=off,gaussian,default:dense_size=2"
    first, second, third = parse_methods(text)
    assert first.label == "3dgs:strategy=mcmc,opacity_lr=1e-3,coarse_to_fine=off"
    config = first.config(9, 0)
    assert (config.strategy, config.optim.opacity_lr, config.schedule.coarse_to_fine) == ("mcmc", 1e-3, False)
    assert config.density.init_opacity == preset("3dgs")["init_opacity"]
    assert (second.label, dict(second.changes)) == ("gaussian", {})
    assert third.config(9, 0).density.dense_size == 2.0


def test_common_options_hold_for_all_but_changes_win() -> None:
    common = {"iterations": 11, "opacity_lr": 0.5, "strategy": "adc"}
    plain, changed = parse_methods("3dgs,3dgs:opacity_lr=0.25")
    assert plain.config(1, 0, common).optim.opacity_lr == 0.5
    assert changed.config(1, 0, common).optim.opacity_lr == 0.25
    assert changed.config(1, 0, common).iterations == 11
    # The name of a system contains changes of its preset, but no common options.
    (other,) = parse_methods("3dgs:strategy=mcmc")
    assert other.config(1, 0, common).strategy == "mcmc"
    with pytest.raises(InputError, match="preset 3dgs has strategy adc, which contradicts strategy mcmc"):
        plain.config(1, 0, {"strategy": "mcmc"})


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("cube", "unknown system 'cube': choose one of default, 3dgs"),
        (" , ", "name at least one"),
        ("gaussian,gaussian", "system gaussian: is named twice"),
        ("opacity_lr=1", "unknown system 'opacity_lr=1'"),
        ("3dgs:", "'' is not a key=value"),
        ("3dgs:strategy", "'strategy' is not a key=value"),
        ("3dgs:colour=red", "system 3dgs: unknown option 'colour'"),
        ("gaussian:strategy=mcmc,strategy=adc", "system gaussian: strategy is named twice: name it once"),
        ("gaussian:opacity-lr=1,init_scale=2,opacity_lr=1", "opacity_lr is named twice"),
        ("3dgs:seed=1", "seed is the same for all systems"),
        ("3dgs:cap-max=1", "cap_max is the same for all"),
        ("3dgs:sh_degree=two", "sh_degree=two: expected a whole number"),
        ("3dgs:opacity_lr=fast", "opacity_lr=fast: expected a number"),
        ("3dgs:coarse_to_fine=maybe", "coarse_to_fine=maybe: expected on or off"),
    ],
)
def test_faulty_lists_are_named(text: str, said: str) -> None:
    with pytest.raises(InputError, match=said) as caught:
        parse_methods(text)
    assert "\n" not in str(caught.value)


def test_options_that_do_not_fit_name_the_system() -> None:
    (system,) = parse_methods("gaussian:strategy=hope")
    with pytest.raises(InputError, match="system gaussian:strategy=hope: strategy 'hope': choose one of"):
        system.config(1, 0)
    for key in ("shape", "cap_max", "seed"):
        with pytest.raises(InputError, match=f"{key} is set for each run"):
            parse_methods("default")[0].config(1, 0, {key: 1})


def test_an_option_of_the_other_strategy_is_refused() -> None:
    (method,) = parse_methods("gaussian:strategy=adc,growth=2")
    with pytest.raises(InputError, match="growth has no effect with strategy adc"):
        method.config(5, 1)
