"""What a run decides by itself: options that the caller did not name, from what the scene shows.

- Transparent photos are trained over random backgrounds. Over one colour, a splat of that colour costs nothing wherever
  it is, and other views see it before the object.
- A run that starts at random places, or at few points of the scene, relocates splats (`mcmc`): splats where no photo
  needs them fade and move. A run that starts at good points clones and splits them by gradient (`adc`).

docs/decisions.md has the measurements.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from .config import OPTIONS, TrainConfig
from .log import Progress
from .options.density import Adc, Mcmc

if TYPE_CHECKING:
    from ..scenes.scene import Scene, View

DECIDED = tuple(name for name, definition in OPTIONS.items() if definition.by_scene)
FEW_POINTS = 0.05  # fewer points than this share of the cap are few
TRANSPARENT_SHARE = 0.01  # smallest share of transparent pixels of photos that are trained over random backgrounds
_STEP = 8  # pixels between two that are looked at
_OPAQUE = 250  # smallest alpha of a pixel that counts as opaque: photos are resampled and rounded


@dataclass(frozen=True)
class Decision:
    """The options of a run, and why it has them.

    Attributes
    ----------
    config : complete options; deciding again changes nothing.
    reasons : a phrase for each decision, such as "random backgrounds, because the photos are transparent".
    """

    config: TrainConfig
    reasons: tuple[str, ...]

    def __str__(self) -> str:
        return f"decided: {'; '.join(self.reasons)}"

    def tell(self, progress: Callable[[Progress], None] | None) -> TrainConfig:
        """Send the reasons as one message, and return the options."""
        if progress is not None and self.reasons:
            progress(Progress(0, self.config.iterations, math.nan, math.nan, 0, 0.0, 0.0, str(self)))
        return self.config


def decide(scene: Scene, config: TrainConfig) -> Decision:
    """Return the options of a run on a scene. Options that the caller named (`TrainConfig.given`) stay as they are.

    Parameters
    ----------
    scene : its training views and points are looked at, never its test views.
    config : options of the run. All options of a preset or of a stored run count as named.
    """
    chosen: dict[str, Any] = {}
    reasons = []
    if "strategy" not in config.given:
        chosen["strategy"], reason = _strategy(scene, config)
        reasons.append(reason)
    if "random_background" not in config.given:
        share = transparent_share(scene.train)
        chosen["random_background"] = share >= TRANSPARENT_SHARE
        if chosen["random_background"]:
            reasons.append(f"random backgrounds, because {share:.0%} of the photos' pixels are transparent")
    return Decision(_with(config, chosen), tuple(reasons))


def as_decided(config: TrainConfig, stored: Mapping[str, Any]) -> TrainConfig:
    """Return the options with the decisions of a stored run. stored : options of the run in the form of `to_json`."""
    return _with(config, {name: stored[name] for name in DECIDED if name not in config.given})


def _with(config: TrainConfig, chosen: Mapping[str, Any]) -> TrainConfig:
    """Return the complete options. Those that the caller named replace the defaults of the chosen strategy."""
    decided = TrainConfig(**({**config.given, **chosen})) if "strategy" in chosen else config.replace(**chosen)
    return TrainConfig.from_json(decided.to_json())


def _strategy(scene: Scene, config: TrainConfig) -> tuple[str, str]:
    """Return the strategy and the reason."""
    n_points, init = len(scene.points.xyz), config.start.init
    if init == "random":
        return Mcmc.strategy, f"strategy {Mcmc.strategy}, because the start is random"
    if init != "sfm":
        return Adc.strategy, f"strategy {Adc.strategy}, because the start is a model"
    if n_points < FEW_POINTS * config.cap_max:
        why = "the scene has no points" if not n_points else f"the scene has only {n_points} points"
        return Mcmc.strategy, f"strategy {Mcmc.strategy}, because {why}"
    return Adc.strategy, f"strategy {Adc.strategy}, because the scene has {n_points} points"


def transparent_share(views: list[View]) -> float:
    """Return the share of transparent pixels in photos, 0 to 1, from every 8th row and column."""
    samples = [view.alpha[::_STEP, ::_STEP] for view in views if view.alpha is not None]
    total = sum(-(-view.camera.width // _STEP) * -(-view.camera.height // _STEP) for view in views)
    return float(sum((sample < _OPAQUE).sum() for sample in samples)) / total if total else 0.0
