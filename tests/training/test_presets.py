"""Presets: each is a valid config of one strategy, has its own constants, and refuses flags that contradict it."""

from __future__ import annotations

import json

import pytest

from clsplat.errors import InputError
from clsplat.splats.shapes import SHAPES
from clsplat.training.config import OPTIONS, TrainConfig
from clsplat.training.optim.skew_map import map_named
from clsplat.training.presets import IDENTITY, PRESETS, preset, with_preset

# Options in which a system differs from the system it is based on, as its paper describes it.
DIFFERENCES = {
    ("3dgs", "ges"): {"shape", "beta_lr", "grad_threshold", "densify_from", "densify_until", "opacity_reset"},
    ("3dgs", "3d-hgs"): {"shape", "densify_until"},
    ("3dgs", "3dsgs"): {"shape", "skew_lr", "depth_threshold", "bisect_reg"},
    ("3dgs-mcmc", "sss"): {
        "shape",
        "position_optimizer",
        "noise_lr",
        "opacity_lr",
        "nu_lr",
        "relocation",
        "relocation_limit",
    },
}


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_is_a_config_that_comes_back_from_a_file(name: str) -> None:
    values = preset(name)
    config = TrainConfig(**values)
    stored = json.loads(json.dumps(config.to_json()))
    assert {key: stored[key] for key in values} == values
    assert TrainConfig.from_json(stored) == config
    assert config != TrainConfig()


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_has_only_options_with_an_effect(name: str) -> None:
    values = preset(name)
    config, shape = TrainConfig(**values), SHAPES[values["shape"]]
    assert values.keys() <= OPTIONS.keys()
    assert config.without_effect(values) == []
    assert ("normalisation" in values) == shape.normalised
    if "skew_map" in values:
        assert map_named(values["skew_map"], shape.skew_form) == values["skew_map"]
    # A preset does not set options of the comparison, or options that only clsplat has.
    assert not values.keys() & {"iterations", "cap_max", "seed", "coarse_to_fine", "sh_degree", "background", "init"}


def test_each_preset_is_another_system() -> None:
    configs = [TrainConfig(**preset(name)) for name in PRESETS]
    assert len(set(configs)) == len(PRESETS)


@pytest.mark.parametrize(("base", "name"), DIFFERENCES)
def test_a_system_differs_from_its_base_in_what_it_publishes(base: str, name: str) -> None:
    first, second = (TrainConfig(**preset(which)).to_json() for which in (base, name))
    assert {key for key in first if first[key] != second[key]} == DIFFERENCES[base, name]


@pytest.mark.parametrize("name", PRESETS)
def test_the_strategy_decides_about_noise_and_resets(name: str) -> None:
    """Noise replaces gradients for exploration (3DGS-MCMC), unless SGHMC has its own noise. Only ADC has resets."""
    config = TrainConfig(**preset(name))
    adam = config.sghmc.position_optimizer == "adam"
    assert (config.density.noise_lr > 0) == (config.strategy == "mcmc" and adam)
    if config.strategy == "adc":
        assert config.density.opacity_reset > 0


def test_densification_ends_before_the_run_does() -> None:
    for name in PRESETS:
        density = TrainConfig(**preset(name)).density
        assert 0 < density.densify_from < density.densify_until < 1


def test_resets_are_as_far_apart_as_published() -> None:
    """A reset occurs every 3000 iterations: of 30 000 in 3DGS, and of 40 000 in GES."""
    for name, iterations in (("3dgs", 30_000), ("ges", 40_000)):
        assert iterations // preset(name)["opacity_reset"] == pytest.approx(3000, rel=0.03)


@pytest.mark.parametrize("name", PRESETS)
def test_docstrings_name_paper_and_source(name: str) -> None:
    text = PRESETS[name].__doc__ or ""
    assert "et al." in text.splitlines()[0]
    assert ("code" in text.splitlines()[0]) != ("Not published" in text)


def test_splats_of_mcmc_start_small_and_half_opaque() -> None:
    """3DGS-MCMC starts with a tenth of the distance to the neighbours and opacity 0.5; 3DGS with all of it and 0.1."""
    found = {
        name: (config.density.init_scale, config.density.init_opacity)
        for name in ("3dgs", "3dgs-mcmc")
        for config in [TrainConfig(**with_preset(name, {}))]
    }
    assert found == {"3dgs": (1.0, 0.1), "3dgs-mcmc": (0.1, 0.5)}


def test_flags_replace_constants() -> None:
    values = with_preset("3dgs", {"opacity_lr": 0.025, "cap_max": 7})
    assert (values["opacity_lr"], values["cap_max"], values["grad_threshold"]) == (0.025, 7, 2e-4)
    assert preset("3dgs")["opacity_lr"] == 0.05  # each call returns a new dictionary


@pytest.mark.parametrize("name", PRESETS)
@pytest.mark.parametrize("key", IDENTITY)
def test_flags_may_repeat_but_not_contradict(name: str, key: str) -> None:
    values = preset(name)
    if key not in values:
        assert with_preset(name, {key: "anything"})[key] == "anything"
        return
    assert with_preset(name, {key: values[key]}) == values
    with pytest.raises(InputError, match=f"preset {name} has {key} {values[key]}, .*{key} something") as caught:
        with_preset(name, {key: "something"})
    assert "\n" not in str(caught.value)


def test_unknown_preset() -> None:
    with pytest.raises(InputError, match="unknown preset 'vanilla': choose one of 3dgs, ges"):
        preset("vanilla")
