"""Rounds of pruning: the least important splats are removed, and the others are trained on to replace them.

A round removes a quarter of the splats. It trains the others for a tenth of the run at its last rates, then for another
tenth at lower ones. The model stays as good as before for some rounds, and is better than a run with that number of
splats.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from ..device.device import Device
from ..rendering.renderer import Renderer
from ..scenes.scene import Scene, View
from ..splats.color import BLACK, Color
from ..splats.splats import Splats
from ..training.config import TrainConfig
from ..training.decisions import decide
from ..training.log import Progress
from ..training.optim.rules import SH_REST_POWER, rate_option, run_rate, run_rest_rate
from ..training.options.density import Adc
from ..training.trainer import Trainer
from .importance import measure_importance
from .prune import Validation, splat_scores, strongest

KEPT = 0.75  # share of the splats that a round keeps
_WARM = 10.0  # first rate of positions over the last: removed splats leave gaps, which positions must close


@dataclass(frozen=True)
class Part:
    """A part of fine-tuning.

    Parameters
    ----------
    share : its iterations over those of the run. rate : factor on the run's last rates but that of the positions.
    """

    share: float
    rate: float

    def iterations(self, config: TrainConfig) -> int:
        """Return the iterations of the part after a run with these options."""
        return max(round(self.share * config.iterations), 1)


# The parts of a round. Lower rates at its end make its model comparable with that of a whole run.
ROUND = (Part(0.1, 1.0), Part(0.1, 0.3))
_RUN = 5  # iterations of a run over those of a round


def without_quarter(
    splats: Splats,
    views: Sequence[View],
    renderer: Renderer,
    background: Color = BLACK,
    seed: int = 0,
    count: int | None = None,
) -> Splats:
    """Return the most important splats: the share KEPT of them, or `count` if that is more."""
    importance = measure_importance(renderer, splats, views, background, seed, parts=False)
    keep = max(int(KEPT * len(splats)), count or 1)
    return strongest(splats, splat_scores(splats, importance), min(keep, len(splats)))


def prune_in_rounds(
    scene: Scene,
    splats: Splats,
    validation: Validation,
    floor: float,
    iterations: int,
    device: Device,
    progress: Callable[[Progress], None] | None = None,
) -> Splats:
    """Run rounds on a model until the validation PSNR falls below the floor, and return the last good model.

    The training run of the model is not known. Rates are those at the end of a run with clsplat's defaults that is
    _RUN times as long as a round.

    Parameters
    ----------
    floor : lowest allowed PSNR [dB]. iterations : length of a round.
    """
    config = TrainConfig(
        shape=splats.shape,
        normalisation=splats.normalisation,
        antialiased=splats.antialiased,
        near_plane=splats.near_plane,
        low_pass=splats.low_pass,
        iterations=_RUN * iterations,
        background=validation.background,
        strategy=Adc.strategy,  # rounds add no splats, and adc has no penalties
    )
    config, good = decide(scene, config).config, splats
    while len(splats) > 1:
        splats = without_quarter(splats, scene.train, validation.renderer, validation.background)
        for part in ROUND:
            splats = fine_tune(scene, splats, config, part, device, progress)
        if validation.psnr(splats) < floor:
            break
        good = splats
    return good


def fine_tune(
    scene: Scene,
    splats: Splats,
    config: TrainConfig,
    part: Part,
    device: Device,
    progress: Callable[[Progress], None] | None = None,
) -> Splats:
    """Train `splats` on with a scene's training views; their number does not change. config : see `fine_tuning`."""
    with tempfile.TemporaryDirectory() as folder:
        start = Path(folder) / "start.ply"
        splats.save(start)
        options = fine_tuning(config, splats, part, start)
        trainer = Trainer(scene, options, device=device, progress=without_messages(progress))
    return trainer.run().splats


def without_messages(progress: Callable[[Progress], None] | None) -> Callable[[Progress], None] | None:
    """Return a callback that gets reports of iterations only, without the messages of the partial runs."""
    if progress is None:
        return None

    def iterations_only(report: Progress) -> None:
        if not report.message:
            progress(report)

    return iterations_only


def fine_tuning(config: TrainConfig, splats: Splats, part: Part, start: Path) -> TrainConfig:
    """Return options that train the splats in the file `start`: full images, all bands, no strategy, no noise.

    Parameters
    ----------
    config : options of the run that made the splats.
    """
    short = config.replace(iterations=part.iterations(config))
    # Rates of short runs are larger: the short run gets options that lead to the rates of the long one.
    rates = {
        rate_option(field): part.rate * run_rate(config, field) / short.rate_factor(field.name)
        for field in splats.schema
        if field.name != "mean" and hasattr(config.optim, rate_option(field))
    }
    rates["feature_rest_lr"] = part.rate * run_rest_rate(config) / short.length_factor(SH_REST_POWER)
    last = config.optim.position_lr_final * config.rate_factor("mean") / short.rate_factor("mean")
    return short.replace(
        shape=splats.shape,
        normalisation=splats.normalisation,
        antialiased=splats.antialiased,
        near_plane=splats.near_plane,
        low_pass=splats.low_pass,
        sh_degree=splats.sh_degree,
        cap_max=len(splats),
        init=str(start),
        coarse_to_fine=False,
        sh_interval=1,
        strategy="adc",
        densify_until=0.0,
        depth_smoothness=0.0,
        occluder_check=False,
        noise_lr=0.0,
        position_optimizer="adam",
        alternation="off",
        save_iterations=(),
        test_iterations=(),
        position_lr_init=min(_WARM * last, config.optim.position_lr_init),
        position_lr_final=last,
        lr_factor=1.0,
        **rates,
    )
