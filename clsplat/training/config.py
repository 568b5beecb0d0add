"""`TrainConfig`: all options of a training run except the scene, in groups, with a flat form for files and flags."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, dataclass, field
from difflib import get_close_matches
from typing import Any

from ..errors import InputError
from ..files.json_file import describe
from ..splats.color import BLACK, Color
from ..splats.fields import MAX_SH_DEGREE
from ..splats.shapes import DEFAULT_SHAPE, NORMALISATIONS, SHAPES, known_fields, shape_named
from .optim.skew_map import check_map, map_named
from .options.density import DEFAULT_STRATEGY, STRATEGIES, Adc, DensityConfig, Mcmc
from .options.groups import (
    AlternationConfig,
    AppearanceConfig,
    LossConfig,
    OptimConfig,
    OutputConfig,
    ScheduleConfig,
    SghmcConfig,
    StartConfig,
    ValidationConfig,
    ViewsConfig,
)
from .options.option import Option, OptionGroup, check_options, option, option_table

# Options without an effect on the result. Runs that differ only in these are the same run.
FREE_OPTIONS = ("device", "save_iterations", "test_iterations", "checkpoint_interval", "checkpoint_minutes")
REMOVED_OPTIONS = {"sampling": "opacity"}  # options of earlier versions, with the only value that is still accepted
PUBLISHED_ITERATIONS = 30_000  # run length for which 3DGS's learning rates were published


@dataclass(frozen=True, init=False, kw_only=True)
class TrainConfig:
    """Options of a training run. Constants are those of 3DGS and 3DGS-MCMC unless stated otherwise.

    Options that most parts of the program read are attributes; the others are in groups (`training/options/`). The
    constructor takes the attributes, whole groups, and the options of the groups by their names:

    >>> from clsplat.training.options.density import Mcmc
    >>> grouped = TrainConfig(iterations=200, cap_max=3000, density=Mcmc(growth=1.1))
    >>> grouped == TrainConfig(iterations=200, cap_max=3000, strategy="mcmc", growth=1.1)
    True
    >>> grouped.density.growth
    1.1

    `to_json` and `from_json` use one flat dictionary. Its keys are also the flags of the command line. An option that
    only the other strategy has is accepted and has no effect (see `without_effect`).

    `clsplat.train` decides some options by the scene, if the caller did not name them (`training/decisions.py`).

    Attributes
    ----------
    named_options : values of the options that the caller named. It has no part in comparisons and files.

    Raises
    ------
    InputError : an option is unknown, or a value has another type or is out of range.
    """

    shape: str = option(
        DEFAULT_SHAPE,
        help="Kernel of the splats: the form of a single splat. Short runs have gaussian, unless they name an option "
        "of the skew.",
        choices=SHAPES,
        by_scene=True,
    )
    iterations: int = option(
        7000,
        help="Number of training steps. Each one learns from --batch photos, usually one.",
        at_least=1,
        aliases=["--steps"],
    )
    cap_max: int = option(
        100_000,
        help="Largest number of splats. More splats show finer detail, and take more time and memory.",
        at_least=1,
    )
    sh_degree: int = option(
        3,
        help="Degree of the spherical harmonics, 0 to 3: how much a colour may change with the viewing direction.",
        at_least=0,
        at_most=MAX_SH_DEGREE,
    )
    normalisation: str = option(
        "peak",
        help="Meaning of the opacity of a skewed kernel. peak: its maximum is 1. pdf: its integral is the Gaussian's. "
        "none: half of pdf.",
        choices=NORMALISATIONS,
    )
    antialiased: bool | None = option(
        None,
        help="Lower the opacity of small splats by the factor by which the screen filter enlarges them "
        "(Mip-Splatting). The model then looks similar at other image sizes. On, unless the run starts from a model "
        "without it.",
        by_scene=True,
    )
    low_pass: float | None = option(
        None,
        help="Variance by which the screen filter widens each splat [px^2]: 0.1, about that of a pixel, with "
        "--antialiased, else 0.3 as in 3DGS.",
        above=0,
        metavar="VARIANCE",
        by_scene=True,
    )
    near_plane: float | None = option(
        None,
        help="Depth below which a splat is not drawn, by its centre [world units]: 0.2 as in 3DGS, or less in scenes "
        "that are small or near to their cameras.",
        above=0,
        metavar="DEPTH",
        by_scene=True,
    )
    background: Color = option(  # noqa: RUF009
        BLACK,
        help="Colour behind the splats, each part 0 to 1: black, or the colour in which all photos end.",
        metavar="R,G,B",
        by_scene=True,
    )
    cut_background: bool = option(
        False,
        help="Count the background of photos as transparent: pixels of the colour --background that are connected to a "
        "side of the photo, and those in holes. On if all photos show an object before one colour.",
        by_scene=True,
    )
    random_background: bool = option(
        False,
        help="Train with a random background colour in each iteration, also behind transparent photos, until "
        "--random-background-until.",
        by_scene=True,
    )
    random_background_until: float = option(
        0.8,
        help="End of the random backgrounds, as a fraction of the run. The rest of the run has --background. 1: the "
        "model fits any background better, and this one less.",
        at_least=0,
        at_most=1,
    )
    seed: int = option(
        0,
        help="Seed of all random numbers. The same seed gives the same bits on one device.",
        at_least=0,
        below=2**64,
    )
    device: str | None = option(
        None,
        help='OpenCL device: "cpu", "gpu", an index such as 0:1, or part of a name. For train also several '
        "with commas between, as 0:0,0:1, or the equal parts of one, as cpu/2.",
        metavar="SPEC",
    )
    density: Adc | Mcmc
    start: StartConfig
    schedule: ScheduleConfig
    loss: LossConfig
    views: ViewsConfig
    optim: OptimConfig
    sghmc: SghmcConfig
    phases: AlternationConfig
    appearance: AppearanceConfig
    validation: ValidationConfig
    output: OutputConfig
    named_options: Mapping[str, Any] = field(init=False, repr=False, compare=False)

    def __init__(self, **options: Any) -> None:
        unknown = [name for name in options if name not in OPTIONS and name not in ("density", *GROUPS)]
        if unknown:
            near = get_close_matches(unknown[0], [*OPTIONS, "density", *GROUPS], n=2)
            remedy = f"did you mean {' or '.join(near)}?" if near else "see the help of clsplat.TrainConfig"
            raise InputError(f"TrainConfig has no option {unknown[0]!r}: {remedy}")
        for name in options.keys() & OPTIONS.keys():  # also those that only the other strategy has
            OPTIONS[name].check(options[name])
        values = {name: options.get(name, definition.default) for name, definition in option_table(TrainConfig).items()}
        values["density"] = _density_of(options)
        for name, group in GROUPS.items():
            changes = {key: options[key] for key in option_table(group) if key in options}
            values[name] = options.get(name) or group()
            if changes:
                values[name] = dataclasses.replace(values[name], **changes)
        for name, value in values.items():
            object.__setattr__(self, name, value)
        object.__setattr__(self, "named_options", _named_options(options))
        check_options(self)
        check_map(self.optim.skew_map, shape_named(self.shape).skew_form)
        if len(self.background) != 3 or not all(0 <= part <= 1 for part in self.background):
            raise InputError(f"background {self.background}: expected R,G,B, each 0 to 1")

    @property
    def strategy(self) -> str:
        """Name of the densification strategy, "adc" or "mcmc"."""
        return self.density.strategy

    @property
    def densify_every(self) -> int:
        """Iterations from one densification to the next: those that have `densify_interval` photos, rounded down."""
        return max(self.density.densify_interval // self.schedule.batch, 1)

    @property
    def skew_map(self) -> str:
        """Name of the skew map in use: never "auto", and "" for shapes without a skew."""
        return map_named(self.optim.skew_map, shape_named(self.shape).skew_form)

    def rate_factor(self, field: str) -> float:
        """Return the factor on a field's learning rate for the length of the run: max(1, 30 000 / photos)^p √batch.

        3DGS's rates were published for 30 000 iterations of one photo; shorter runs need larger steps. p is the field's
        `lr_power`: 3/4 for positions, 1/2 for rotation and the parameters of shapes, 1/4 for scale, 0 for the others.
        View-dependent colours have 1/4 (`optim.rules.SH_REST_POWER`).
        """
        return self.length_factor(next((known.lr_power for known in known_fields() if known.name == field), 0.0))

    def length_factor(self, power: float) -> float:
        """Return max(1, 30 000 / photos)^power √batch, with the photos of all iterations of the run."""
        batch = self.schedule.batch
        return float(max(1.0, PUBLISHED_ITERATIONS / (self.iterations * batch)) ** power * math.sqrt(batch))

    def replace(self, **options: Any) -> TrainConfig:
        """Return a copy with other values of some options. The names are those of the constructor."""
        changed = dataclasses.replace(self, **options)
        object.__setattr__(changed, "named_options", {**self.named_options, **_named_options(options)})
        return changed

    def without_effect(self, names: Iterable[str]) -> list[str]:
        """Return the options of `names` that have no effect, because only the other strategy has them."""
        return [name for name in names if name in STRATEGY_OPTIONS and name not in option_table(type(self.density))]

    def to_json(self) -> dict[str, Any]:
        """Return all options in one flat dictionary of plain values.

        Options of the other strategy have their default values, so that all runs have the same keys.
        """
        values = {name: definition.default for name, definition in OPTIONS.items()}
        values |= {name: getattr(self, name) for name in RUN_OPTIONS}
        for name in ("density", *GROUPS):
            values |= dataclasses.asdict(getattr(self, name))
        return values

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> TrainConfig:
        """Return the config of a flat dictionary in the form of `to_json`. Missing options have their defaults.

        Raises
        ------
        InputError : an unknown option, a value of another type, or a value out of range.
        """
        return cls(**read_options(values))


def read_options(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of a JSON object as arguments of `TrainConfig`, with checked types and lists as tuples.

    Raises
    ------
    InputError : not an object, an unknown option, or a value of another type.
    """
    if not isinstance(values, dict):
        raise InputError(f"config: is {describe(values)}; expected an object of options")
    values = {name: value for name, value in values.items() if (name, value) not in REMOVED_OPTIONS.items()}
    unknown = sorted(set(values) - set(OPTIONS))
    if unknown:
        raise InputError(f"config: unknown option {unknown[0]!r}")
    # Old files have null for an option whose default depends on the strategy.
    return {
        name: OPTIONS[name].from_json(value)
        for name, value in values.items()
        if not (value is None and OPTIONS[name].default is MISSING)
    }


def _named_options(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return by name the options that arguments of `TrainConfig` set. A group sets all of its options."""
    values: dict[str, Any] = {}
    for name in ("density", *GROUPS):
        if options.get(name):
            values |= dataclasses.asdict(options[name])
    if options.get("density"):
        values["strategy"] = options["density"].strategy
    return values | {name: value for name, value in options.items() if name in OPTIONS}


def _density_of(options: Mapping[str, Any]) -> Adc | Mcmc:
    """Return the group `density` that the arguments of `TrainConfig` describe.

    It is the group in `options`, or the default one, changed by the single options. If `strategy` names another
    strategy than that of the group, the new group keeps the values of the shared options.
    """
    group: Adc | Mcmc | None = options.get("density")
    name = options.get("strategy", DEFAULT_STRATEGY if group is None else group.strategy)
    OPTIONS["strategy"].check(name)
    cls = STRATEGIES[name]
    shared = {} if group is None else {key: getattr(group, key) for key in option_table(DensityConfig)}
    changes = {key: options[key] for key in option_table(cls) if key in options}
    if isinstance(group, cls):
        return dataclasses.replace(group, **changes)
    return cls(**(shared | changes))


def _run_options() -> dict[str, Option]:
    """Return the options that are attributes of `TrainConfig`, and the option `strategy`.

    The strategy is not an attribute of its own: the class of the group `density` defines it.
    """
    strategy = Option(
        "strategy",
        str,
        DEFAULT_STRATEGY,
        "Densification strategy. adc: clone, split and prune splats, as in 3DGS. mcmc: relocate dead splats, grow to "
        "the cap, and add noise to positions, as in 3DGS-MCMC.",
        choices=tuple(STRATEGIES),
        by_scene=True,
    )
    return option_table(TrainConfig) | {"strategy": strategy}


# All groups except `density`, by the name of their attribute.
GROUPS: dict[str, type[OptionGroup]] = {
    "start": StartConfig,
    "schedule": ScheduleConfig,
    "loss": LossConfig,
    "views": ViewsConfig,
    "optim": OptimConfig,
    "sghmc": SghmcConfig,
    "phases": AlternationConfig,
    "appearance": AppearanceConfig,
    "validation": ValidationConfig,
    "output": OutputConfig,
}
RUN_OPTIONS = _run_options()
STRATEGY_OPTIONS = option_table(DensityConfig) | option_table(Adc) | option_table(Mcmc)


def _sections() -> dict[str, tuple[Option, ...]]:
    """Return all options by section of `--help`, the most common ones first."""
    shared = option_table(DensityConfig)
    sections = {"Training": tuple(RUN_OPTIONS.values()), DensityConfig.title: tuple(shared.values())}
    for strategy in (Adc, Mcmc):
        specific = (definition for name, definition in option_table(strategy).items() if name not in shared)
        sections[strategy.title] = tuple(specific)
    return sections | {group.title: tuple(option_table(group).values()) for group in GROUPS.values()}


SECTIONS = _sections()
# All options by name.
OPTIONS = {definition.name: definition for section in SECTIONS.values() for definition in section}
