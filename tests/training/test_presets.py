"""Presets: every one is a usable config with the published constants, and flags may not contradict what it is."""

from __future__ import annotations

import pytest

from clsplat.errors import InputError
from clsplat.splats import shapes
from clsplat.splats.shapes import SHAPES, Shape
from clsplat.training.config import OPTIONS, TrainConfig
from clsplat.training.optim.skew_map import map_named
from clsplat.training.presets import IDENTITY, PRESETS, preset, with_preset

SHAPE_OF = {
    "3dgs": "gaussian",
    "ges": "ges-modulation",
    "3d-hgs": "half-gaussian",
    "sss": "student-t",
    "sns": "skew-normal-direct",
    "3dsgs": "bisected-skew",
    "3dgs-mcmc": "gaussian",
}
# The papers' numbers once more, as (key, value).
PUBLISHED = [
    ("3dgs", "densify_until", 0.5),
    ("3dgs", "grad_threshold", 2e-4),
    ("3dgs", "init_opacity", 0.1),
    ("3dgs", "init_scale", 1.0),
    ("3dgs", "opacity_reset", 10),
    ("3dgs", "opacity_lr", 0.05),
    ("3dgs", "noise_lr", 0),
    ("3dgs", "opacity_reg", 0),
    ("ges", "grad_threshold", 3e-4),
    ("ges", "densify_until", 0.375),
    ("3d-hgs", "normal_lr", 3e-3),
    ("3d-hgs", "densify_until", 2 / 3),
    ("3dgs-mcmc", "noise_lr", 5e5),
    ("3dgs-mcmc", "opacity_reg", 0.01),
    ("3dgs-mcmc", "scale_reg", 0.01),
    ("3dgs-mcmc", "init_scale", 0.1),
    ("3dgs-mcmc", "densify_until", 5 / 6),
    ("sss", "sghmc_friction", 120),
    ("sss", "opacity_lr", 5e-3),
    ("sss", "relocation_limit", 0.05),
    ("sss", "relocation", "length-squared"),
    ("sss", "sghmc_burn_in", 7 / 30),
    ("sss", "position_optimizer", "sghmc-sss"),
    ("sns", "normalisation", "none"),
    ("sns", "skew_map", "polar"),
    ("sns", "alternation", "cyclic"),
    ("sns", "opacity_reg", 0),
    ("3dsgs", "strategy", "adc"),
]


def described(name: str) -> Shape:
    """A shape's descriptor, live or not yet."""
    return next(value for value in vars(shapes).values() if isinstance(value, Shape) and value.name == name)


def test_presets_are_the_seven_systems_with_their_kernels() -> None:
    assert {name: preset(name)["shape"] for name in PRESETS} == SHAPE_OF


@pytest.mark.parametrize("name", PRESETS)
def test_every_preset_is_a_config(name: str) -> None:
    values = preset(name)
    assert values.keys() <= OPTIONS.keys()
    shape = described(values["shape"])
    if "skew_map" in values:
        assert map_named(values["skew_map"], shape.skew_form) == values["skew_map"]
    assert ("normalisation" in values) == shape.normalised
    usable = values if shape.name in SHAPES else values | {"shape": "gaussian", "skew_map": "auto"}
    config = TrainConfig(**usable)
    assert TrainConfig.from_json(config.to_json()) == config
    # What belongs to the comparison, or to clsplat alone, is not a preset's.
    assert not values.keys() & {"iterations", "cap_max", "seed", "coarse_to_fine", "sh_degree", "background", "init"}


@pytest.mark.parametrize(("name", "key", "value"), PUBLISHED)
def test_published_constants(name: str, key: str, value: object) -> None:
    assert preset(name)[key] == pytest.approx(value)


@pytest.mark.parametrize("name", PRESETS)
def test_docstrings_name_paper_and_source(name: str) -> None:
    text = PRESETS[name].__doc__ or ""
    assert "et al." in text.splitlines()[0]
    assert ("code" in text.splitlines()[0]) != ("Not published" in text)


def test_the_alternatives_to_adam_have_noise_of_their_own() -> None:
    for name in PRESETS:
        values = preset(name)
        assert values["position_optimizer"] == "adam" or values["noise_lr"] == 0


def test_flags_replace_constants() -> None:
    values = with_preset("3dgs", {"opacity_lr": 0.025, "cap_max": 7})
    assert (values["opacity_lr"], values["cap_max"], values["grad_threshold"]) == (0.025, 7, 2e-4)
    assert preset("3dgs")["opacity_lr"] == 0.05  # a fresh dictionary each time


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
