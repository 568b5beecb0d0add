"""Rounds of pruning: the least important splats are removed, and the others are trained on to replace them.

A round removes a quarter of the splats and trains the others for a tenth of the run. The model stays as good as before
for several rounds, and is then better than a run with that number of splats.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
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
FINAL_RATE = 0.3  # factor on the rates of the last part, which removes no splat
_WARM = 10.0  # first rate of positions over the last: removed splats leave gaps, which positions must close


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

    The training run of the model is not known. Rates are those at the end of a run with clsplat's defaults that is ten
    times as long as a round.

    Parameters
    ----------
    floor : lowest allowed PSNR [dB]. iterations : length of a round.
    """
    config = TrainConfig(
        shape=splats.shape,
        normalisation=splats.normalisation,
        antialiased=splats.antialiased,
        near_plane=splats.near_plane,
        iterations=10 * iterations,
        background=validation.background,
        strategy=Adc.strategy,  # rounds add no splats, and adc has no penalties
    )
    config = decide(scene, config).config
    good = splats
    while len(splats) > 1:
        fewer = without_quarter(splats, scene.train, validation.renderer, validation.background)
        splats = fine_tune(scene, fewer, config, iterations, device, progress)
        if validation.psnr(splats) < floor:
            break
        good = splats
    return good


def fine_tune(
    scene: Scene,
    splats: Splats,
    config: TrainConfig,
    iterations: int,
    device: Device,
    progress: Callable[[Progress], None] | None = None,
    rate: float = 1.0,
) -> Splats:
    """Train `splats` on, at the rates at the end of `config`'s run; their number does not change.

    Parameters
    ----------
    scene : its training views are used. config : options of the run that made the splats.
    iterations : 0 returns the splats unchanged. rate : factor on all rates but that of the positions.
    """
    if not iterations:
        return splats
    with tempfile.TemporaryDirectory() as folder:
        start = Path(folder) / "start.ply"
        splats.save(start)
        trainer = Trainer(
            scene,
            fine_tuning(config, splats, iterations, start, rate),
            device=device,
            progress=without_messages(progress),
        )
    return trainer.run().splats


def without_messages(progress: Callable[[Progress], None] | None) -> Callable[[Progress], None] | None:
    """Return a callback that gets reports of iterations only, without the messages of the partial runs."""
    if progress is None:
        return None

    def iterations_only(report: Progress) -> None:
        if not report.message:
            progress(report)

    return iterations_only


def fine_tuning(config: TrainConfig, splats: Splats, iterations: int, start: Path, rate: float = 1.0) -> TrainConfig:
    """Return options that train the splats in the file `start`: full images, all bands, no strategy, no noise."""
    short = config.replace(iterations=iterations)
    # Rates of short runs are larger: the short run gets options that lead to the rates of the long one.
    rates = {
        rate_option(field): rate * run_rate(config, field) / short.rate_factor(field.name)
        for field in splats.schema
        if field.name != "mean" and hasattr(config.optim, rate_option(field))
    }
    rates["feature_rest_lr"] = rate * run_rest_rate(config) / short.length_factor(SH_REST_POWER)
    last = config.optim.position_lr_final * config.rate_factor("mean") / short.rate_factor("mean")
    return short.replace(
        shape=splats.shape,
        normalisation=splats.normalisation,
        antialiased=splats.antialiased,
        near_plane=splats.near_plane,
        sh_degree=splats.sh_degree,
        cap_max=len(splats),
        init=str(start),
        coarse_to_fine=False,
        sh_interval=1,
        strategy="adc",
        densify_until=0.0,
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
