"""Everything that decides a training run, apart from the scene. JSON in and out."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from types import NoneType, UnionType
from typing import Any, get_args, get_origin, get_type_hints

from ..errors import InputError
from ..files.json_file import describe, to_real
from ..splats.color import BLACK, Color
from ..splats.fields import MAX_SH_DEGREE
from ..splats.shapes import DEFAULT_SHAPE, check_normalisation, shape_named
from .optim.skew_map import check_map, map_named

STRATEGIES = ("mcmc", "adc")
OPTIMIZERS = ("fused", "numpy")
POSITION_OPTIMIZERS = ("adam", "sghmc", "sghmc-sss")
ALTERNATIONS = ("off", "cyclic")
RELOCATIONS = ("length", "length-squared", "opacity-only")
# Options that change nothing in the result: runs that differ in these alone are the same run.
FREE_OPTIONS = ("device", "save_iterations", "test_iterations", "checkpoint_interval")
# What an option is where it is not given: what was best with that strategy on validation views (benchmarks/SYSTEMS.md).
BY_STRATEGY: dict[str, dict[str, float]] = {
    "mcmc": {
        "opacity_reg": 0.001,
        "scale_reg": 0.001,
        "noise_lr": 5e5,
        "densify_until": 0.8,
        "init_opacity": 0.5,
        "init_scale": 0.5,
    },
    "adc": {
        "opacity_reg": 0.0,
        "scale_reg": 0.0,
        "noise_lr": 0.0,
        "densify_until": 0.5,
        "init_opacity": 0.2,
        "init_scale": 0.7,
    },
}
REMOVED_OPTIONS = {"sampling": "opacity"}  # options of earlier versions, with the one value that files may still hold
PUBLISHED_ITERATIONS = 30_000  # that 3DGS's rates are meant for


@dataclass(frozen=True)
class TrainConfig:
    """Training options; the names are the command line's. Constants are 3DGS's and 3DGS-MCMC's unless said.

    Those of BY_STRATEGY that are not given (None) become their strategy's own.

    Parameters
    ----------
    shape : the splat kernel.
    normalisation : of skewed kernels: what `opacity` means.
    antialiased : let opacities fall as the low-pass widens small splats (Mip-Splatting's filter on the screen): a model
        then looks alike in images of other sizes than those it was trained on.
    skew_map : from the trainable skew to the kernel's; "auto": cube-root for the centred form, polar for the direct.
    iterations : optimizer steps, one image each.
    cap_max : hard limit on splats.
    strategy : "mcmc" (relocate dead splats, grow to the cap, noise on positions) or "adc" (3DGS: clone, split,
        prune, opacity reset).
    relocation : what a relocated splat's copies change: "length" (opacity and scale, such that what they absorb along
        a line stays), "length-squared" (SSS as released: the square of that factor), "opacity-only".
    relocation_limit : most splats relocated per action, as a fraction of all (SSS: 0.05); 1: no limit.
    init : "sfm", "random" or a .ply path.
    random_points : points at random beside the scene's, as a fraction of the cap; not given: 0.1 where the scene has
        fewer than that, else none.
    sh_degree : highest degree of spherical harmonics, 0 to 3.
    sh_interval : iterations from one SH degree to the next; 0: a tenth of the run, at most 1000.
    lambda_dssim : weight of 1 - SSIM against L1.
    background : behind the splats, R, G, B in 0..1.
    random_background : train over another colour in each iteration; photos with transparency are laid over it too.
    exposure : find an affine map of the colours of each training photo (exposure compensation); the mean of all stays
        the identity.
    exposure_rate : part of the way to the best one that a photo's exposure goes whenever it is trained on.
    exposure_pull : how much the best one is drawn to the identity: as much as if that fraction of the photo's pixels
        had colours of mean square 1 and no other exposure.
    seed : of everything random; the same seed gives the same bits on one device.
    coarse_to_fine : train on images at 1/4, then 1/2, then full size.
    position_lr_init : Adam's rate of positions at the start, times the scene extent.
    position_lr_final : the same at the end; log-linear between.
    opacity_lr : Adam's rate of opacity logits.
    scaling_lr : Adam's rate of log scales.
    rotation_lr : Adam's rate of quaternions.
    feature_lr : Adam's rate of colour; bands above the constant learn 20 times slower.
    skew_lr : Adam's rate of the trainable skew; not given: the shape's own (2.5e-3 centred, 1.25e-2 direct).
    opacity_reg : weight of the mean opacity in the loss; not given: 0.001 with "mcmc", 0 with "adc".
    scale_reg : weight of the mean scale in the loss; not given: likewise.
    bisect_reg : weight of the mean squared difference of a splat's two opacities in the loss (3DSGS).
    normal_lr : Adam's rate of the plane's normal (half-gaussian).
    beta_lr : Adam's rate of log beta (generalised-exponential).
    nu_lr : Adam's rate of log nu (student-t).
    noise_lr : size of the position noise, times the positions' rate; not given: 5e5 with "mcmc", 0 with "adc".
    position_optimizer : "adam", "sghmc" (friction and noise in scene units, always stable) or "sghmc-sss" (as SSS
        writes it).
    sghmc_friction : SSS's C, after the burn-in.
    sghmc_burn_in : fraction of the run before momentum sets in.
    sghmc_burn_in_friction : SSS's C during the burn-in; there it only sets the noise.
    alternation : "off", or "cyclic": after a joint warm-up, cycles that train first everything but the skew, then
        the skew alone (SNS).
    alternation_warmup : fraction of the run before the first cycle.
    alternation_cycle : iterations of a cycle.
    alternation_split : fraction of a cycle given to everything but the skew.
    init_opacity : of splats made from points; not given: 0.5 with "mcmc", 0.2 with "adc".
    init_scale : of splats made from points, in units of the distance to their three neighbours; not given: 0.5 with
        "mcmc", 0.7 with "adc".
    densify_from : when the strategy begins, as a fraction of the run.
    densify_until : when it ends, as a fraction of the run; not given: 0.8 with "mcmc", 0.5 with "adc".
    densify_interval : iterations between its actions.
    growth : least growth of the splat count per action; more where the cap is far (see trainer.growth_factor).
    grad_threshold : "adc" clones or splits splats whose mean gradient of the screen position is above it (3DGS).
    depth_threshold : the same for the gradient along the viewing ray times the scene extent (3DSGS); 0: not looked at.
    opacity_reset : "adc" resets opacities that often per run (3DGS: 10), but not within 1000 iterations; 0: never.
    dense_size : "adc" splits splats larger than this fraction of the scene extent and clones others.
    checkpoint_interval : iterations between checkpoints; 0: only at the end.
    save_iterations : when to write a PLY, beside the end.
    test_iterations : when to measure the test views; for the log only.
    visible_adam : step only splats that the image saw, and their neighbours in memory; the others later, at once. With
        regularisers, noise or SGHMC the geometry is stepped as ever.
    optimizer : "fused" (on the device) or "numpy" (the reference).
    device : as `--device`.
    """

    shape: str = DEFAULT_SHAPE
    normalisation: str = "peak"
    antialiased: bool = False
    skew_map: str = "auto"
    iterations: int = 7000
    cap_max: int = 100_000
    strategy: str = "adc"
    relocation: str = "length"
    relocation_limit: float = 1.0
    init: str = "sfm"
    random_points: float | None = None
    sh_degree: int = 3
    sh_interval: int = 0
    lambda_dssim: float = 0.2
    background: Color = BLACK
    random_background: bool = False
    exposure: bool = False
    exposure_rate: float = 0.2
    exposure_pull: float = 1e-2
    seed: int = 0
    coarse_to_fine: bool = True
    position_lr_init: float = 1.6e-4
    position_lr_final: float = 1.6e-6
    opacity_lr: float = 0.05
    scaling_lr: float = 5e-3
    rotation_lr: float = 1e-3
    feature_lr: float = 2.5e-3
    skew_lr: float | None = None
    opacity_reg: float = None  # type: ignore[assignment]  # see BY_STRATEGY: never None after __post_init__
    scale_reg: float = None  # type: ignore[assignment]
    bisect_reg: float = 0.0
    normal_lr: float = 3e-3
    beta_lr: float = 1e-3
    nu_lr: float = 1e-2
    noise_lr: float = None  # type: ignore[assignment]
    position_optimizer: str = "adam"
    sghmc_friction: float = 120.0
    sghmc_burn_in: float = 7 / 30
    sghmc_burn_in_friction: float = 5e5
    alternation: str = "off"
    alternation_warmup: float = 0.1
    alternation_cycle: int = 100
    alternation_split: float = 0.5
    init_opacity: float = None  # type: ignore[assignment]
    init_scale: float = None  # type: ignore[assignment]
    densify_from: float = 0.05
    densify_until: float = None  # type: ignore[assignment]
    densify_interval: int = 100
    growth: float = 1.05
    grad_threshold: float = 2e-4
    depth_threshold: float = 0.0
    opacity_reset: int = 0
    dense_size: float = 0.01
    checkpoint_interval: int = 1000
    save_iterations: tuple[int, ...] = ()
    test_iterations: tuple[int, ...] = ()
    visible_adam: bool = False
    optimizer: str = "fused"
    device: str | None = None

    def __post_init__(self) -> None:
        shape_named(self.shape)
        check_normalisation(self.normalisation)
        check_map(self.skew_map, shape_named(self.shape).skew_form)
        _one_of("strategy", self.strategy, STRATEGIES)
        for name, value in BY_STRATEGY[self.strategy].items():
            if getattr(self, name) is None:
                object.__setattr__(self, name, value)
        _one_of("optimizer", self.optimizer, OPTIMIZERS)
        _one_of("relocation", self.relocation, RELOCATIONS)
        _one_of("position_optimizer", self.position_optimizer, POSITION_OPTIMIZERS)
        _one_of("alternation", self.alternation, ALTERNATIONS)
        for name in ("iterations", "cap_max", "densify_interval", "alternation_cycle"):
            _at_least(name, getattr(self, name), 1)
        for name in (
            "seed",
            "sh_interval",
            "checkpoint_interval",
            "position_lr_init",
            "position_lr_final",
            "opacity_lr",
            "scaling_lr",
            "rotation_lr",
            "feature_lr",
            "opacity_reg",
            "scale_reg",
            "bisect_reg",
            "exposure_pull",
            "normal_lr",
            "beta_lr",
            "nu_lr",
            "noise_lr",
            "sghmc_friction",
            "sghmc_burn_in_friction",
            "grad_threshold",
            "depth_threshold",
            "opacity_reset",
            "dense_size",
        ):
            _at_least(name, getattr(self, name), 0)
        if self.skew_lr is not None:
            _at_least("skew_lr", self.skew_lr, 0)
        if self.random_points is not None and not 0 <= self.random_points <= 1:
            raise InputError(f"random_points {self.random_points}: must be 0 to 1, a fraction of cap_max")
        if not 0 <= self.sh_degree <= MAX_SH_DEGREE:
            raise InputError(f"sh_degree {self.sh_degree}: must be 0 to {MAX_SH_DEGREE}")
        for name in (
            "lambda_dssim",
            "relocation_limit",
            "exposure_rate",
            "sghmc_burn_in",
            "alternation_warmup",
            "alternation_split",
        ):
            if not 0 <= getattr(self, name) <= 1:
                raise InputError(f"{name} {getattr(self, name)}: must be 0 to 1")
        if self.position_lr_init <= 0 or self.position_lr_final <= 0:
            raise InputError("position_lr_init and position_lr_final must be above 0")
        if self.seed >= 2**64:
            raise InputError(f"seed {self.seed}: must be below 2^64")
        if not 0 < self.init_opacity < 1 or not self.init_scale > 0:
            raise InputError("init_opacity must lie between 0 and 1, init_scale above 0")
        if len(self.background) != 3 or not all(0 <= c <= 1 for c in self.background):
            raise InputError(f"background {self.background}: expected R,G,B, each 0 to 1")

    def rate_factor(self, field: str) -> float:
        """How much larger a field's rate is in a short run: (30 000 / iterations)^p, at least 1.

        3DGS's rates belong to 30 000 iterations. p is 3/4 for positions, 1/2 for rotation and the shape's own, 1/4 for
        scale, 0 otherwise; measured on validation views at 1500 iterations (ARCHITECTURE.md, "Training").
        """
        power = {"mean": 0.75, "quat": 0.5, "skew": 0.5, "normal": 0.5, "beta": 0.5, "nu": 0.5, "log_scale": 0.25}.get(
            field, 0.0
        )
        return float(max(1.0, PUBLISHED_ITERATIONS / self.iterations) ** power)

    @property
    def map(self) -> str:
        """The skew map in use, "auto" resolved; "" for shapes without a skew."""
        return map_named(self.skew_map, shape_named(self.shape).skew_form)

    @classmethod
    def option_types(cls) -> dict[str, Any]:
        """The type of each option's values; X of those that are X or not given."""
        hints = get_type_hints(cls)
        optional = {
            key: [part for part in get_args(hint) if part is not NoneType]
            for key, hint in hints.items()
            if isinstance(hint, UnionType)
        }
        return hints | {key: parts[0] for key, parts in optional.items()}

    def to_json(self) -> dict[str, Any]:
        """Plain values for json.dump."""
        return dataclasses.asdict(self)

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> TrainConfig:
        """The config that `to_json` gave; InputError on an unknown key, or a value that is of no such kind."""
        if not isinstance(values, dict):
            raise InputError(f"config: is {describe(values)}; expected an object of options")
        values = {key: value for key, value in values.items() if (key, value) not in REMOVED_OPTIONS.items()}
        known, hints = {field.name: field for field in dataclasses.fields(cls)}, get_type_hints(cls)
        unknown = sorted(set(values) - set(known))
        if unknown:
            raise InputError(f"config: unknown option {unknown[0]!r}")
        given: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in values.items()}
        for key, value in given.items():
            if not (_is_a(value, hints[key]) or (value is None and known[key].default is None)):
                raise InputError(f"config: {key} is {describe(values[key])}; expected {_expected(hints[key])}")
        return cls(**given)


def _is_a(value: Any, hint: Any) -> bool:
    """Whether a value from JSON is of an option's type."""
    if isinstance(hint, UnionType):
        return any(_is_a(value, part) for part in get_args(hint))
    if get_origin(hint) is tuple:
        parts = get_args(hint)
        same_length = parts[1:] == (...,) or (isinstance(value, tuple) and len(value) == len(parts))
        return isinstance(value, tuple) and same_length and all(_is_a(part, parts[0]) for part in value)
    if hint is float:
        real = to_real(value)
        return real is not None and math.isfinite(real)
    return isinstance(value, hint) and (hint is bool or not isinstance(value, bool))


def _expected(hint: Any) -> str:
    names = {bool: "true or false", int: "a whole number", float: "a finite number", str: "a text"}
    return names.get(hint, "a list of numbers" if get_origin(hint) is tuple else "another kind of value, or null")


def _one_of(name: str, value: str, allowed: tuple[str, ...]) -> None:
    if value not in allowed:
        raise InputError(f"{name} {value!r}: choose one of {', '.join(allowed)}")


def _at_least(name: str, value: float, least: float) -> None:
    if not value >= least:
        raise InputError(f"{name} {value}: must be at least {least}")
