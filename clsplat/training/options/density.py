"""Options of the two densification strategies. Each strategy is a class with its defaults.

Defaults that differ from those of the papers were the best ones on validation views (benchmarks/SYSTEMS.md).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from .option import OptionGroup, option

SPLITS = ("long-axis", "published")
RELOCATIONS = ("length", "length-squared", "opacity-only")


@dataclass(frozen=True, kw_only=True)
class DensityConfig(OptionGroup):
    """Options that both strategies have. Some defaults differ between the strategies: see `Adc` and `Mcmc`."""

    title: ClassVar[str] = "Densification"
    strategy: ClassVar[str]

    densify_from: float = option(0.05, help="Start of densification, as a fraction of the run.", at_least=0, at_most=1)
    densify_until: float = option(help="End of densification, as a fraction of the run.", at_least=0, at_most=1)
    densify_interval: int = option(
        100, help="Iterations between two densification steps; of a larger batch, photos.", at_least=1
    )
    init_opacity: float = option(0.2, help="Opacity of splats that are created from points.", above=0, below=1)
    init_scale: float = option(
        help="Scale of splats that are created from points, as a factor of the distance to three neighbours (root mean "
        "square).",
        above=0,
    )
    opacity_reg: float = option(help="Weight of the mean opacity in the loss.", at_least=0, by_scene=True)
    scale_reg: float = option(help="Weight of the mean scale in the loss.", at_least=0)
    noise_lr: float = option(
        help="Strength of the random motion of positions, as a factor of their learning rate.", at_least=0
    )
    turnover: float | None = option(
        None,
        help="Part of the cap that a densification step may replace once the cap is reached: the faintest splats make "
        "room for new ones where the gradient is high. 0: none. Default: 0.05 in runs of 7000 iterations, less in "
        "longer ones, and at most 0.08.",
        at_least=0,
        at_most=0.5,
        metavar="PART",
    )
    split: str = option(
        "long-axis",
        help="How one splat becomes two. long-axis: two halves side by side along its longest axis. published: as in "
        "3DGS (copies of small splats, halves at random places in large ones) and 3DGS-MCMC (copies in one place).",
        choices=SPLITS,
    )


@dataclass(frozen=True, kw_only=True)
class Adc(DensityConfig):
    """Adaptive density control of 3DGS: split, clone and prune splats, and reset opacities."""

    title: ClassVar[str] = "Densification with strategy adc"
    strategy: ClassVar[str] = "adc"

    densify_until: float = 0.5
    init_scale: float = 0.7
    opacity_reg: float = 0.0
    scale_reg: float = 0.0
    noise_lr: float = 0.0
    grad_threshold: float = option(
        2e-4,
        help="Threshold of the mean gradient of the screen position. Splats above it are split or cloned.",
        at_least=0,
    )
    depth_threshold: float = option(
        0.0,
        help="Threshold of the mean gradient along the viewing ray, times the scene extent (3DSGS). 0: not used.",
        at_least=0,
    )
    dense_size: float = option(
        0.01,
        help="With --split published, splats larger than this fraction of the scene extent are split, others are "
        "cloned.",
        at_least=0,
    )
    opacity_reset: int = option(
        0,
        help="Number of opacity resets in a run of full length (3DGS: 10), at least 1000 iterations apart. 0: none.",
        at_least=0,
    )


@dataclass(frozen=True, kw_only=True)
class Mcmc(DensityConfig):
    """Strategy of 3DGS-MCMC: relocate dead splats, grow to the cap, and add noise to positions."""

    title: ClassVar[str] = "Densification with strategy mcmc"
    strategy: ClassVar[str] = "mcmc"

    densify_until: float = 0.8
    init_scale: float = 0.5
    opacity_reg: float = 0.001
    scale_reg: float = 0.001
    noise_lr: float = 5e5
    growth: float = option(
        1.05,
        help="Growth factor of the number of splats per densification step; larger if the cap is far away.",
        at_least=1,
        at_most=100,
    )
    relocation: str = option(
        "length",
        help="Rule for the copies of a relocated splat. length: change opacity and scale so that the absorption along "
        "a line stays equal. length-squared: use the square of that scale factor (SSS). opacity-only: keep the scale.",
        choices=RELOCATIONS,
    )
    relocation_limit: float = option(
        1.0,
        help="Largest fraction of the splats that is relocated in one step (SSS: 0.05). 1: no limit.",
        at_least=0,
        at_most=1,
    )


STRATEGIES: dict[str, type[Adc] | type[Mcmc]] = {"mcmc": Mcmc, "adc": Adc}
DEFAULT_STRATEGY = Adc.strategy
