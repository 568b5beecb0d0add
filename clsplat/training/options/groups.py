"""Groups of training options: start, schedule, loss, optimizer, appearance and output."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from ...errors import InputError
from ..optim.skew_map import SKEW_MAPS
from .option import OptionGroup, option

OPTIMIZERS = ("fused", "numpy")
POSITION_OPTIMIZERS = ("adam", "sghmc", "sghmc-sss")
ALTERNATIONS = ("off", "cyclic")


@dataclass(frozen=True, kw_only=True)
class StartConfig(OptionGroup):
    """The splats at the start of a run."""

    title: ClassVar[str] = "Start"

    init: str = option(
        "sfm",
        help="Start of training: the scene's points, random points, or a file of splats.",
        metavar="sfm|random|FILE",
    )
    random_points: float | None = option(
        None,
        help="Number of random points that are added to the scene's points, as a fraction of the cap. With init "
        "random, 0 stands for the whole cap, but at most 100 000 points.",
        at_least=0,
        at_most=1,
        by_scene=True,
    )


@dataclass(frozen=True, kw_only=True)
class ScheduleConfig(OptionGroup):
    """Stages that make the first iterations cheaper."""

    title: ClassVar[str] = "Schedule"

    sh_interval: int = option(
        0,
        help="Iterations from one degree of spherical harmonics to the next. 0: a tenth of the run, at most 1000.",
        at_least=0,
    )
    coarse_to_fine: bool = option(True, help="Train on images at 1/4 size, then 1/2, then full size.")
    batch: int = option(
        1,
        help="Photos in one iteration. Its step has the mean of their gradients, and rates times the root of their "
        "number. By default the number of devices.",
        at_least=1,
        by_scene=True,
    )


@dataclass(frozen=True, kw_only=True)
class ValidationConfig(OptionGroup):
    """Views that are neither trained nor tested."""

    title: ClassVar[str] = "Validation"

    validate: bool = option(
        False,
        help="Hold out every 7th training photo, measure these photos along the run, and keep the model that was best "
        "on them besides the last one. It is never chosen on test photos.",
    )


@dataclass(frozen=True, kw_only=True)
class LossConfig(OptionGroup):
    """The loss, except for regularisers whose defaults depend on the strategy (`DensityConfig`)."""

    title: ClassVar[str] = "Loss"

    lambda_dssim: float = option(0.2, help="Weight of 1 - SSIM in the loss; L1 has the rest.", at_least=0, at_most=1)
    smooth_l1: float = option(
        0.05, help="Error of a colour, 0 to 1, below which L1 is quadratic. 0: nowhere (3DGS).", at_least=0, at_most=1
    )
    bisect_reg: float = option(
        0.0, help="Weight of the mean squared difference between the two opacities of a splat (3DSGS).", at_least=0
    )


@dataclass(frozen=True, kw_only=True)
class ViewsConfig(OptionGroup):
    """What keeps a run from fitting each of a few photos by splats of its own."""

    title: ClassVar[str] = "Few photos"

    dropout: float = option(
        0.0,
        help="Part of the splats, chosen at random, that an iteration does not draw, until 0.9 of the run. Then splats "
        "that fit one photo alone are worth less.",
        at_least=0,
        below=1,
        by_scene=True,
    )
    depth_smoothness: float = option(
        0.0,
        help="Weight of a penalty on steps of the depth between neighbouring pixels, in the photos and between them, "
        "until 0.9 of the run.",
        at_least=0,
        by_scene=True,
    )
    occluder_check: bool = option(
        False,
        help="Remove splats that cameras between the photos show much larger than any photo does, after each tenth of "
        "the run.",
        by_scene=True,
    )
    outlier_check: bool = option(
        True,
        help="Leave out photos whose renders do not resemble them at all, as with wrong poses, after 0.1, 0.2 and "
        "0.3 of the run.",
    )


@dataclass(frozen=True, kw_only=True)
class OptimConfig(OptionGroup):
    """Adam's learning rates, with the values of 3DGS, and how the optimizer runs."""

    title: ClassVar[str] = "Learning rates and optimizer"

    position_lr_init: float = option(
        1.6e-4, help="Learning rate of positions at the start, times the scene extent.", above=0
    )
    position_lr_final: float = option(
        1.6e-6, help="Learning rate of positions at the end, times the scene extent; log-linear between.", above=0
    )
    opacity_lr: float = option(0.05, help="Learning rate of opacities, as logits.", at_least=0)
    scaling_lr: float = option(5e-3, help="Learning rate of scales, as logarithms.", at_least=0)
    rotation_lr: float = option(1e-3, help="Learning rate of rotations, as quaternions.", at_least=0)
    feature_lr: float = option(
        2.5e-3, help="Learning rate of colours, for the part that is the same in all directions.", at_least=0
    )
    feature_rest_lr: float | None = option(
        None,
        help="Learning rate of the part of colours that depends on the direction. By default a twentieth of the other "
        "part's.",
        at_least=0,
    )
    lr_factor: float = option(
        1.0,
        help="Factor on all learning rates except those of positions at the end of the run and of the part of colours "
        "that is the same in all directions.",
        above=0,
        by_scene=True,
    )
    skew_lr: float | None = option(
        None,
        help="Learning rate of the skew. By default that of the shape: 2.5e-3 (centred) or 1.25e-2 (direct form).",
        at_least=0,
    )
    normal_lr: float = option(3e-3, help="Learning rate of the plane's normal (half-gaussian).", at_least=0)
    beta_lr: float = option(1e-3, help="Learning rate of beta, as a logarithm (generalised-exponential).", at_least=0)
    nu_lr: float = option(1e-2, help="Learning rate of nu, as a logarithm (student-t).", at_least=0)
    skew_map: str = option(
        "auto",
        help="Map from the trained skew to the kernel's skew. auto: cube-root in the centred form, polar in the direct "
        "form.",
        choices=("auto", *SKEW_MAPS),
    )
    average_last: float = option(
        0.05,
        help="Part of the run, at its end, whose parameters are averaged for the model: 0.05 is the last twentieth. "
        "0: the parameters of the last iteration.",
        at_least=0,
        at_most=1,
    )
    visible_adam: bool = option(
        False,
        help="Update only splats that the image shows; the others catch up later. Regularisers, noise and SGHMC "
        "still update the geometry of all splats.",
        by_scene=True,
    )
    half_moments: bool = option(
        False, help="Keep Adam's moments of colours in 16 bits: a sixth less device memory of a splat."
    )
    optimizer: str = option(
        "fused", help="Implementation of the optimizer: fused (on the device) or numpy (reference).", choices=OPTIMIZERS
    )

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.half_moments and self.optimizer != "fused":
            raise InputError(f"half_moments needs optimizer fused, not {self.optimizer}")


@dataclass(frozen=True, kw_only=True)
class SghmcConfig(OptionGroup):
    """The optimizer of positions: Adam, or the stochastic-gradient Hamiltonian Monte Carlo (SGHMC) of SSS."""

    title: ClassVar[str] = "Optimizer of positions (SSS)"

    position_optimizer: str = option(
        "adam",
        help="Optimizer of positions: adam, sghmc (friction and noise in scene units, always stable) or sghmc-sss "
        "(as published by SSS).",
        choices=POSITION_OPTIMIZERS,
    )
    sghmc_friction: float = option(120.0, help="Friction of SGHMC after the burn-in (C of SSS).", at_least=0)
    sghmc_burn_in: float = option(
        7 / 30, help="Burn-in of SGHMC, without momentum, as a fraction of the run.", at_least=0, at_most=1
    )
    sghmc_burn_in_friction: float = option(
        5e5, help="Friction of SGHMC during the burn-in; it sets only the noise.", at_least=0
    )


@dataclass(frozen=True, kw_only=True)
class AlternationConfig(OptionGroup):
    """Alternating training of SNS: the skew and all other parameters take turns."""

    title: ClassVar[str] = "Alternating training (SNS)"

    alternation: str = option(
        "off",
        help="cyclic: after a warm-up, train all parameters but the skew, then only the skew, and so on (SNS).",
        choices=ALTERNATIONS,
    )
    alternation_warmup: float = option(
        0.1, help="Warm-up of the alternation, as a fraction of the run.", at_least=0, at_most=1
    )
    alternation_cycle: int = option(100, help="Iterations of one cycle of the alternation.", at_least=1)
    alternation_split: float = option(
        0.5, help="Fraction of a cycle that trains all parameters but the skew.", at_least=0, at_most=1
    )


@dataclass(frozen=True, kw_only=True)
class AppearanceConfig(OptionGroup):
    """Exposure compensation: one affine map of the colours for each training photo."""

    title: ClassVar[str] = "Exposure compensation"

    exposure: bool = option(
        False, help="Fit an affine map of the colours to each training photo. The mean map stays the identity."
    )
    exposure_rate: float = option(
        0.2,
        help="Fraction of the way to the best fit that a photo's map moves each time the photo is trained. 0: the maps "
        "are those of the model that the run begins with.",
        at_least=0,
        at_most=1,
    )
    exposure_pull: float = option(
        1e-2, help="Strength of the prior towards no correction, as a fraction of the photo's pixels.", at_least=0
    )


@dataclass(frozen=True, kw_only=True)
class OutputConfig(OptionGroup):
    """Files and log entries during a run. These options do not change the model."""

    title: ClassVar[str] = "Checkpoints and files"

    checkpoint_interval: int = option(
        1000, help="Iterations between two checkpoints. 0: none by iterations.", at_least=0
    )
    checkpoint_minutes: float = option(
        5.0,
        help="Minutes after which a checkpoint is saved, if none was saved for the iterations. 0: none by time.",
        at_least=0,
    )
    save_iterations: tuple[int, ...] = option(
        (), help="Iterations after which a PLY file is saved, besides the last one.", metavar="N,N,..."
    )
    test_iterations: tuple[int, ...] = option(
        (), help="Iterations after which the test views are measured, for the log only.", metavar="N,N,..."
    )
