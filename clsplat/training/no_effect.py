"""Options that a run ignores, because another option or the shape of its splats does not use them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..splats.shapes import shape_named
from .config import TrainConfig

if TYPE_CHECKING:
    from ..scenes.scene import Scene

# Options by the field of the splats that they are about.
_BY_FIELD = {
    "skew": ("skew_lr", "skew_map", "alternation"),
    "beta": ("beta_lr",),
    "nu": ("nu_lr",),
    "normal": ("normal_lr",),
    "opacity_minus_logit": ("bisect_reg",),
}
_FIELD_OF = {name: field for field, names in _BY_FIELD.items() for name in names}
# Options by the switch that they need.
_NEEDS = {
    "exposure_rate": "exposure",
    "exposure_pull": "exposure",
    "random_background_until": "random_background",
}


def no_effect(config: TrainConfig, name: str) -> str | None:
    """Return why a named option has no effect in a run, such as "with shape gaussian"; None if it has one.

    config : complete options of the run (`decide`).
    """
    shape, values = shape_named(config.shape), config.to_json()
    if config.without_effect([name]):
        return f"with strategy {config.strategy}"
    field = _FIELD_OF.get(name)
    if field is not None and field not in {one.name for one in shape.fields}:
        return f"with shape {config.shape}"
    if name == "normalisation" and not shape.normalised:
        return f"with shape {config.shape}"
    if name.startswith("sghmc_") and values["position_optimizer"] == "adam":
        return "with position optimizer adam"
    if name.startswith("alternation_") and values["alternation"] == "off":
        return "with alternation off"
    if name == "dense_size" and values["split"] != "published":
        return f"with split {values['split']}"
    switch = _NEEDS.get(name)
    if switch is not None and not values[switch]:
        return f"without --{switch.replace('_', '-')}"
    if name in ("save_iterations", "test_iterations"):
        beyond = [number for number in values[name] if number > config.iterations]
        if beyond and len(beyond) == len(values[name]):
            return f"beyond the run's {config.iterations} iterations"
    return None


def no_effect_in(scene: Scene, name: str) -> str | None:
    """Return why a named option has no effect with this scene; None if it has one."""
    return "without test views" if name == "test_iterations" and not scene.test else None
