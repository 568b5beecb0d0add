"""Options that a run ignores, because another option or the shape of its splats does not use them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from ..splats.shapes import shape_named
from .config import TrainConfig
from .density.strategy import relocation_rule
from .initialise import names_model

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
# Options of splats that are made of points.
_OF_POINTS = ("init_scale", "init_opacity", "random_points")
# Options by the switch that they need.
_NEEDS = {
    "exposure_rate": "exposure",
    "exposure_pull": "exposure",
    "random_background_until": "random_background",
}


def no_effect(config: TrainConfig, name: str, scene: Scene | None = None) -> str | None:
    """Return why a named option has no effect in a run, such as "with shape gaussian"; None if it has one.

    config : complete options of the run (`decide`). scene : that of the run, if it is known.
    """
    shape, values = shape_named(config.shape), config.to_json()
    if config.without_effect([name]):
        return f"with strategy {config.strategy}"
    field = _FIELD_OF.get(name)
    if field is not None and field not in {one.name for one in shape.fields}:
        return f"with shape {config.shape}"
    if name == "normalisation" and not shape.normalised:
        return f"with shape {config.shape}"
    if name == "relocation" and (rule := relocation_rule(config)) != values[name]:
        return f"with normalisation {config.normalisation}, which needs {rule}"
    if name in ("feature_rest_lr", "sh_interval") and config.sh_degree == 0:
        return "with sh degree 0"
    if name in _OF_POINTS and names_model(config.start.init):
        return f"with splats of a file ({config.start.init})"
    if name.startswith("sghmc_") and values["position_optimizer"] == "adam":
        return "with position optimizer adam"
    if name.startswith("alternation_") and values["alternation"] == "off":
        return "with alternation off"
    if name == "dense_size" and values["split"] != "published":
        return f"with split {values['split']}"
    if name == "average_last" and values[name] > 0 and values["densify_until"] == 1:
        return "with densification until the end"
    if name == "densify_from" and values[name] >= values["densify_until"]:
        return f"with densification until {values['densify_until']:g} of the run"
    switch = _NEEDS.get(name)
    if switch is not None and not values[switch]:
        return f"without --{switch.replace('_', '-')}"
    if name == "test_iterations" and scene is not None and not scene.test:
        return "without test views"
    if name in ("save_iterations", "test_iterations"):
        return _beyond(values[name], config.iterations)
    return None


def _beyond(numbers: Sequence[int], last: int) -> str | None:
    """Return why some of the numbers of iterations have no effect; None if all are within the run."""
    late = [number for number in numbers if number > last]
    if not late:
        return None
    which = "" if len(late) == len(numbers) else f"for {', '.join(map(str, late))}, "
    return f"{which}beyond the run's {last} iterations"
