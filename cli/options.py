"""Options that several commands share, and those made from TrainConfig's fields."""

from __future__ import annotations

import dataclasses
import inspect
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

from clsplat.scenes.options import ALPHA_USES
from clsplat.splats.color import Color
from clsplat.splats.shapes import NORMALISATIONS, SHAPES
from clsplat.training.config import (
    ALTERNATIONS,
    OPTIMIZERS,
    POSITION_OPTIMIZERS,
    RELOCATIONS,
    STRATEGIES,
    TrainConfig,
)
from clsplat.training.optim.skew_map import SKEW_MAPS

F = TypeVar("F", bound=Callable[..., Any])

PATH = click.Path(path_type=Path)
SETS = ("test", "train", "all")

_CHOICES = {
    "shape": tuple(SHAPES),
    "normalisation": NORMALISATIONS,
    "skew_map": ("auto", *SKEW_MAPS),
    "strategy": STRATEGIES,
    "optimizer": OPTIMIZERS,
    "relocation": RELOCATIONS,
    "position_optimizer": POSITION_OPTIMIZERS,
    "alternation": ALTERNATIONS,
}
_ALIASES = {"iterations": ("--steps",)}
_METAVARS = {"init": "sfm|random|FILE.ply"}
# Shared with other commands, or with a form of their own.
_OWN = ("background", "device", "save_iterations", "test_iterations")


class ColorType(click.ParamType):  # type: ignore[type-arg]  # not generic before click 8.2
    """R,G,B, each 0 to 1."""

    name = "R,G,B"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> Color:
        if isinstance(value, tuple):
            return value
        try:
            rgb = tuple(float(part) for part in value.split(","))
        except ValueError:
            rgb = ()
        if len(rgb) != 3 or not all(0 <= part <= 1 for part in rgb):
            self.fail(f"{value!r} is no colour: give R,G,B, each 0 to 1, such as 1,1,1", param, ctx)
        return rgb


class Numbers(click.ParamType):  # type: ignore[type-arg]
    """Whole numbers with commas or spaces between them.

    Parameters
    ----------
    what : they are, for messages. least : smallest allowed.
    """

    name = "N,N,..."

    def __init__(self, what: str = "iterations", least: int = 1) -> None:
        self.what, self.least = what, least

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, ...]:
        if isinstance(value, tuple):
            return value
        parts = [part for part in re.split(r"[,\s]+", value) if part]
        if not parts or not all(part.isdecimal() and int(part) >= self.least for part in parts):
            self.fail(f"{value!r} is no list of {self.what}: give for example 1000,2000", param, ctx)
        return tuple(int(part) for part in parts)


class Decibels(click.ParamType):  # type: ignore[type-arg]
    """A number of decibels: 0.1, 0.1dB."""

    name = "dB"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> float:
        if isinstance(value, (int, float)):
            return float(value)
        match = re.fullmatch(r"\s*(\d+(?:\.\d*)?|\.\d+)\s*(dB)?\s*", value, re.I)
        if match is None:
            self.fail(f"{value!r} is no number of decibels: give for example 0.1 or 0.1dB", param, ctx)
        return float(match[1])


class SpacedLists(click.Command):
    """A command that also takes 3DGS's form of a list, `--save_iterations 1000 2000`."""

    def parse_args(self, ctx: click.Context, args: list[str]) -> list[str]:
        lists = {name for param in self.params if isinstance(param.type, Numbers) for name in param.opts}
        joined: list[str] = []
        in_list = False  # whether the last argument belongs to a list that may go on
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
quiet_option = click.option("-q", "--quiet", is_flag=True, help="Print warnings and errors only.")
overwrite_option = click.option("--overwrite", is_flag=True, help="Replace the model that is there.")
iteration_option = click.option(
    "--iteration", type=click.IntRange(min=0), metavar="N", help="Point cloud of this iteration.  [default: the last]"
)
set_option = click.option(
    "--set", "--views", "view_set", type=click.Choice(SETS), help="Which of the scene's views.  [default: test]"
)


def background_options(function: F) -> F:
    """`--background R,G,B` and `-w`; read them with `background_of`."""
    function = click.option(
        "--background", type=ColorType(), metavar="R,G,B", help="Colour behind the splats, each 0 to 1."
    )(function)
    return click.option("-w", "--white-background", is_flag=True, help="The same as --background 1,1,1.")(function)


def background_of(background: Color | None, white: bool) -> Color | None:
    """The background asked for, if any."""
    if background is not None and white:
        raise click.UsageError("give --background or --white-background, not both")
    return (1.0, 1.0, 1.0) if white else background


def photo_options(function: F) -> F:
    """`-i` and `-r`: which photos of the scene, and how large."""
    function = click.option(
        "-r",
        "--resolution",
        type=int,
        metavar="N",
        help="1, 2, 4, 8: divide the size of the photos; another number: their width in pixels; "
        "-1: as they are, but at most 1600 wide.",
    )(function)
    return click.option("-i", "--images", metavar="NAME", help="Folder of photos inside the scene, such as images_4.")(
        function
    )


def scene_options(function: F) -> F:
    """`-s`, `-i` and `-r`: where the photos are, and how large."""
    return click.option(
        "-s", "--source-path", type=PATH, help="Scene: a folder with photos and a COLMAP model or transforms.json."
    )(photo_options(function))


def hiding_options(function: F) -> F:
    """`--masks` and `--alpha`: which pixels of the photos count."""
    function = click.option(
        "--alpha",
        type=click.Choice(ALPHA_USES),
        help="Transparent photos: lay them over the background, or hide the transparent pixels.  [default: background]",
    )(function)
    return click.option(
        "--masks",
        metavar="NAME",
        help='Folder of masks inside the scene, black where a pixel is not to count; "none" for no '
        "masks.  [default: masks, where it is there]",
    )(function)


def split_options(function: F) -> F:
    """`--test-every` and `--test-list`: which views are held out."""
    function = click.option(
        "--test-list", type=PATH, metavar="FILE", help="Names of the test views, one a line; implies --eval."
    )(function)
    return click.option(
        "--test-every",
        type=int,
        metavar="N",
        help="Of the sorted views, every Nth is a test view; implies --eval.  [default: 8]",
    )(function)


def config_options(*without: str) -> Callable[[F], F]:
    """One option for each field of TrainConfig but those in `without`; `config_values` reads them."""
    help_of, types = _field_help(), TrainConfig.option_types()

    def decorate(function: F) -> F:
        for name in ("test_iterations", "save_iterations"):
            if name not in without:
                function = click.option(_flag(name), name, type=Numbers(), multiple=True, help=help_of.get(name))(
                    function
                )
        function = background_options(device_option(function))
        for field in reversed(dataclasses.fields(TrainConfig)):
            if field.name not in (*_OWN, *without):
                function = _field_option(field, types[field.name], help_of.get(field.name))(function)
        return function

    return decorate


def config_values(ctx: click.Context, values: dict[str, Any]) -> dict[str, Any]:
    """TrainConfig's arguments that the user gave on the command line; takes them out of `values`."""
    background = background_of(values.pop("background"), values.pop("white_background"))
    device = values.pop("device")
    lists = {
        name: sorted({n for group in values.pop(name, ()) for n in group})
        for name in ("save_iterations", "test_iterations")
    }
    given = {
        field.name: values.pop(field.name)
        for field in dataclasses.fields(TrainConfig)
        if field.name in values and is_given(ctx, field.name)
    }
    given |= {name: tuple(numbers) for name, numbers in lists.items() if numbers}
    own = {"background": background, "device": device}
    return given | {name: value for name, value in own.items() if value is not None}


def is_given(ctx: click.Context, name: str) -> bool:
    """Whether the option stands on the command line."""
    return ctx.get_parameter_source(name) is click.core.ParameterSource.COMMANDLINE


def _field_option(field: dataclasses.Field[Any], kind: Any, text: str | None) -> Callable[[F], F]:
    flag, default = _flag(field.name), field.default
    if kind is bool:
        return click.option(f"{flag}/--no-{flag[2:]}", field.name, default=default, show_default=True, help=text)
    type_: Any = click.Choice(_CHOICES[field.name]) if field.name in _CHOICES else kind
    return click.option(
        flag,
        *_ALIASES.get(field.name, ()),
        field.name,
        type=type_,
        default=default,
        show_default=default is not None,
        metavar=_METAVARS.get(field.name),
        help=text,
    )


def _flag(name: str) -> str:
    return "--" + name.replace("_", "-")


def _field_help() -> dict[str, str]:
    """Field to its text in TrainConfig's docstring, entries of the form "name, name : text"."""
    texts: dict[str, str] = {}
    entry = r"^(\w[\w, ]*) : (.*(?:\n[ ]+.*)*)"
    for match in re.finditer(entry, inspect.cleandoc(TrainConfig.__doc__ or ""), re.M):
        text = " ".join(match[2].replace("`", "").split())
        texts |= {name.strip(): text[:1].upper() + text[1:] for name in match[1].split(",")}
    return texts
