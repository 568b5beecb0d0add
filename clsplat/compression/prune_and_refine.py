"""Fewer splats, round by round: the least needed go, and the others are trained on to take over.

A quarter of the splats goes in a round. Trained on for a tenth of the run, the rest is as good as before for several
rounds: of fox's 32 000 splats (1000 iterations, 31.16 dB on validation views) 18 000 had 31.33 dB after two rounds and
10 125 had 31.11 dB after four; a run at 16 000 has 30.43 dB.
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
from ..training.log import Progress
from ..training.optim.rules import field_rate, rate_option
from ..training.trainer import Trainer
from .importance import measure_importance
from .prune import Validation, splat_scores, strongest

KEPT = 0.75  # of the splats, by a round
SETTLING = 0.3  # rate of a last part without removal: 0.2 dB better than at full rate (fox, 13 500 and 5700 splats)
_WARM = 10.0  # positions' first rate over their last: removing splats leaves gaps to be closed


def without_quarter(
    splats: Splats,
    views: Sequence[View],
    renderer: Renderer,
    background: Color = BLACK,
    seed: int = 0,
    count: int | None = None,
) -> Splats:
    """The splats whose removal would change the views most: KEPT of them, or `count` where that is more."""
    importance = measure_importance(renderer, splats, views, background, seed, parts=False)
    keep = max(int(KEPT * len(splats)), count or 1)
    return strongest(splats, splat_scores(splats, importance), min(keep, len(splats)))


def trained_rounds(
    scene: Scene,
    splats: Splats,
    validation: Validation,
    floor: float,
    iterations: int,
    device: Device,
    progress: Callable[[Progress], None] | None = None,
) -> Splats:
    """Rounds for a model whose run is not known, until the validation PSNR falls below the floor; the last good one.

    Rates are those that a run of clsplat's defaults, ten times as long as a round, ends with.

    Parameters
    ----------
    iterations : of a round.
    """
    config = TrainConfig(
        shape=splats.shape,
        normalisation=splats.normalisation,
        antialiased=splats.antialiased,
        iterations=10 * iterations,
        background=validation.background,
    )
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
    """`splats` after some more iterations, at the rates that `config`'s run ends with; their number stays.

    Parameters
    ----------
    scene : its training views are used. config : of the run that made the splats.
    iterations : 0 gives the splats back. rate : times all rates but the positions'.
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
    """The same, told of iterations only: where parts of a run start from is no news."""
    if progress is None:
        return None

    def told(report: Progress) -> None:
        if not report.message:
            progress(report)

    return told


def fine_tuning(config: TrainConfig, splats: Splats, iterations: int, start: Path, rate: float = 1.0) -> TrainConfig:
    """Options that train `splats`, saved in `start`, on: full images, all bands, no strategy, no noise."""
    short = config.replace(iterations=iterations)
    # Rates of short runs are larger: the short run gets options that lead to the rates of the long one.
    rates = {
        rate_option(field): rate
        * field_rate(config, field)
        * config.rate_factor(field.name)
        / short.rate_factor(field.name)
        for field in splats.schema
        if field.name != "mean"
    }
    last = config.optim.position_lr_final * config.rate_factor("mean") / short.rate_factor("mean")
    return short.replace(
        shape=splats.shape,
        normalisation=splats.normalisation,
        antialiased=splats.antialiased,
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
        **rates,
    )
