"""Options that several commands share, and the flags of the training options."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import MISSING
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from clsplat.scenes.options import ALPHA_USES, VIEW_SETS
from clsplat.splats.color import WHITE, Color
from clsplat.training.config import OPTIONS, SECTIONS, TrainConfig
from clsplat.training.no_effect import no_effect
from clsplat.training.options.density import STRATEGIES
from clsplat.training.options.option import Option, option_table

from .command import SectionedCommand, SectionOption

if TYPE_CHECKING:
    from clsplat.scenes.scene import Scene

F = TypeVar("F", bound=Callable[..., Any])


class AnyPath(click.Path):
    """A path. An empty one, such as that of an unset variable of the shell, would mean the working directory."""

    def __init__(self) -> None:
        super().__init__(path_type=Path)

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Any:
        if isinstance(value, str) and (not value or "\0" in value):
            self.fail(f"{value!r} is not a path: name a file or a folder", param, ctx)
        return super().convert(value, param, ctx)


PATH = AnyPath()


_DIGITS = 18  # most digits of a whole number in a list
_MOST_DECIBELS = 1000.0


class ColorType(click.ParamType):  # type: ignore[type-arg]  # not generic before click 8.2
    """A colour as R,G,B, each part 0 to 1."""

    name = "R,G,B"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Color:
        if isinstance(value, tuple):
            return value
        try:
            rgb = tuple(float(part) for part in value.split(","))
        except ValueError:
            rgb = ()
        if len(rgb) != 3 or not all(0 <= part <= 1 for part in rgb):
            self.fail(f"{value!r} is not a colour: give R,G,B, each 0 to 1, such as 1,1,1", param, ctx)
        return rgb


class Numbers(click.ParamType):  # type: ignore[type-arg]
    """A list of whole numbers, separated by commas or spaces.

    Parameters
    ----------
    plural : what the numbers are, for messages.
    smallest : smallest allowed number.
    """

    name = "N,N,..."

    def __init__(self, plural: str = "iterations", smallest: int = 1) -> None:
        self.plural, self.smallest = plural, smallest

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, ...]:
        if isinstance(value, tuple):
            return value
        parts = [part for part in re.split(r"[,\s]+", value) if part]
        # A number of thousands of digits is an error of Python's int.
        if not parts or not all(
            part.isdecimal() and len(part) <= _DIGITS and int(part) >= self.smallest for part in parts
        ):
            self.fail(f"{value!r} is not a list of {self.plural}: give for example 1000,2000", param, ctx)
        return tuple(int(part) for part in parts)


class Decibels(click.ParamType):  # type: ignore[type-arg]
    """A number of decibels, such as 0.1 or 0.1dB."""

    name = "dB"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        if isinstance(value, (int, float)):
            return float(value)
        match = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*(dB)?\s*", value, re.I)
        if match is None or float(match[1]) > _MOST_DECIBELS:
            self.fail(f"{value!r} is not a number of decibels: give for example 0.1 or 0.1dB", param, ctx)
        return float(match[1])


class TrainingCommand(SectionedCommand):
    """A command with training options, whose lists may have 3DGS's form: `--save_iterations 1000 2000`."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        lists = {name for param in self.params if isinstance(param.type, Numbers) for name in param.opts}
        joined: list[str] = []
        in_list = False  # whether the previous argument belongs to a list that may continue
        for arg in args:
            if in_list and arg.isdecimal() and joined[-1].isdecimal():
                joined += [next(opt for opt in reversed(joined) if opt.startswith("--")), arg]
                continue
            in_list = arg.replace("_", "-") in lists or (in_list and arg.isdecimal())
            joined.append(arg)
        return super().parse_args(ctx, joined)


device_option = click.option(
    "--device", metavar="SPEC", help='OpenCL device: "cpu", "gpu", an index such as 0:1, or part of a name.'
)


def detail_option(default: float) -> Callable[[F], F]:
    """Add `--detail`, with 0 for the model itself."""
    return click.option(
        "--detail",
        type=click.FloatRange(0, 100),
        default=default,
        show_default=True,
        metavar="PIXELS",
        help="Draw parts that are far away as fewer and larger splats, whose merged centres are at most this far apart "
        "in the image. 0.25 is hardly visible. 0: all splats.",
    )


quiet_option = click.option("-q", "--quiet", is_flag=True, help="Print warnings and errors only.")
iteration_option = click.option(
    "--iteration",
    type=click.IntRange(min=0),
    metavar="N",
    help="Point cloud to use, by iteration.  [default: the last]",
)
set_option = click.option(
    "--set", "--views", "view_set", type=click.Choice(VIEW_SETS), help="Views of the scene to use.  [default: test]"
)


def overwrite_option(existing: str = "the file that is there") -> Callable[[F], F]:
    """Add `--overwrite`. `existing`: what it replaces, for its help."""
    return click.option("--overwrite", is_flag=True, help=f"Replace {existing}.")


def background_options(function: F, help_text: str = "Colour behind the splats, each part 0 to 1.", **extra: Any) -> F:
    """Add `--background R,G,B` and `-w`; read them with `background_of`. `extra`: more arguments of `click.option`."""
    white = click.option(
        "-w", "--white-background", is_flag=True, help="White behind the splats: --background 1,1,1.", **extra
    )
    return click.option("--background", type=ColorType(), metavar="R,G,B", help=help_text, **extra)(white(function))


def background_of(background: Color | None, white: bool) -> Color | None:
    """Return the background on the command line, or None."""
    if background is not None and white:
        raise click.UsageError("give --background or --white-background, not both")
    return WHITE if white else background


def photo_options(function: F) -> F:
    """Add `-i` and `-r`: the folder and the size of the photos."""
    function = click.option(
        "-r",
        "--resolution",
        type=int,
        metavar="N",
        help="Size of the photos. 1, 2, 4 or 8 divide it; a number from 24 on is the width in pixels; -1 keeps it up "
        "to a width of 1600 pixels.",
    )(function)
    return click.option("-i", "--images", metavar="NAME", help="Folder of photos inside the scene, such as images_4.")(
        function
    )


def scene_options(function: F) -> F:
    """Add `-s`, `-i` and `-r`: the scene, and the folder and the size of its photos."""
    return click.option(
        "-s",
        "--source-path",
        type=PATH,
        help="Folder of the scene, with photos and their cameras, or the file of its cameras.",
    )(photo_options(function))


changed_photos_option = click.option(
    "--allow-changed-photos", is_flag=True, help="Use photos that have changed since the model was trained."
)


def hiding_options(function: F) -> F:
    """Add `--masks` and `--alpha`: which pixels of the photos are used."""
    function = click.option(
        "--alpha",
        type=click.Choice(ALPHA_USES),
        help="Transparent photos: composite them over the background, ignore the transparent pixels, or ignore alpha.  "
        "[default: background; mask, if the same pixels are transparent in all photos and points lie there]",
    )(function)
    return click.option(
        "--masks",
        metavar="NAME",
        help='Folder of masks inside the scene; black pixels are ignored. "none": no masks.  [default: masks, if it '
        "exists]",
    )(function)


def split_options(implied: str = "") -> Callable[[F], F]:
    """Add `--test-every` and `--test-list`: which views are held out. implied : what else they do, for their help."""

    def decorate(function: F) -> F:
        function = click.option(
            "--test-list",
            type=PATH,
            metavar="FILE",
            help=f"Names of the test views, one per line{implied}.",
        )(function)
        return click.option(
            "--test-every",
            type=int,
            metavar="N",
            help=f"Every Nth of the sorted views is a test view{implied}. No effect if the scene's files name test "
            "views.  [default: 8]",
        )(function)

    return decorate


def config_options(*without: str) -> Callable[[F], F]:
    """Add a flag for each training option except those in `without`; `config_values` reads them."""

    def decorate(function: F) -> F:
        for section, definitions in reversed(SECTIONS.items()):
            for definition in reversed(definitions):
                if definition.name == "background":
                    function = background_options(function, definition.help, cls=SectionOption, section=section)
                elif definition.name not in without:
                    function = _flag_of(definition, section)(function)
        return function

    return decorate


def warn_without_effect(configs: Sequence[TrainConfig], names: Iterable[str], scene: Scene | None = None) -> None:
    """Warn about flags that have no effect in any of the runs. scene : that of all runs, if it is one."""
    for name in names:
        reasons = [no_effect(config, name, scene) for config in configs]
        if all(reasons):
            why = " or ".join(dict.fromkeys(filter(None, reasons)))
            warnings.warn(f"--{name.replace('_', '-')} has no effect {why}", stacklevel=2)


def config_values(ctx: click.Context, values: dict[str, Any]) -> dict[str, Any]:
    """Remove the training options from `values` and return by name those that are on the command line."""
    background = background_of(values.pop("background"), values.pop("white_background"))
    chosen = {name: values.pop(name) for name in OPTIONS if name in values and is_given(ctx, name)}
    for name in OPTIONS:
        values.pop(name, None)
    for name in ("save_iterations", "test_iterations"):
        if name in chosen:
            chosen[name] = tuple(sorted({number for group in chosen[name] for number in group}))
    return chosen if background is None else chosen | {"background": background}


def is_given(ctx: click.Context, name: str) -> bool:
    """Return whether the option is on the command line."""
    return ctx.get_parameter_source(name) is click.core.ParameterSource.COMMANDLINE


def _flag_of(definition: Option, section: str) -> Callable[[F], F]:
    """Return the decorator that adds the flag of a training option."""
    flag = "--" + definition.name.replace("_", "-")
    extra: dict[str, Any] = {"cls": SectionOption, "section": section, "help": definition.help}
    if definition.by_scene and definition.default is not MISSING:
        extra["help"] += "  [default: by the scene]"
    if definition.value_type is bool and definition.by_scene:
        return click.option(f"{flag}/--no-{flag[2:]}", definition.name, default=None, **extra)
    if definition.value_type is bool:
        return click.option(
            f"{flag}/--no-{flag[2:]}", definition.name, default=definition.default, show_default=True, **extra
        )
    if definition.value_type == tuple[int, ...]:
        return click.option(flag, definition.name, type=Numbers(), multiple=True, **extra)
    if definition.default is MISSING:
        by_scene = ", or by the scene" if definition.by_scene else ""
        extra["help"] += f"  [default: {_strategy_defaults(definition.name)}{by_scene}]"
    elif definition.default is not None and not definition.by_scene:
        # Click's own text would have all digits of a fraction.
        shown = f"{definition.default:g}" if definition.value_type is float else definition.default
        extra |= {"default": definition.default, "help": f"{extra['help']}  [default: {shown}]"}
    value_type: Any = click.Choice(tuple(definition.choices)) if definition.choices else definition.value_type
    metavar = definition.metavar or {int: "N", float: "NUMBER"}.get(definition.value_type)
    return click.option(flag, *definition.aliases, definition.name, type=value_type, metavar=metavar, **extra)


def _strategy_defaults(name: str) -> str:
    """Return the defaults of an option that differ between the strategies, as text."""
    return ", ".join(f"{option_table(group)[name].default:g} with {strategy}" for strategy, group in STRATEGIES.items())
