"""The flag `--path` and the flags that change the path."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any, TypeVar

import click

from clsplat.cameras.make_path import AROUND, BETWEEN, FRAMES, PathRequest

from .options import PATH

F = TypeVar("F", bound=Callable[..., Any])


class Size(click.ParamType):  # type: ignore[type-arg]
    """WIDTHxHEIGHT in pixels."""

    name = "WxH"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        if isinstance(value, tuple):
            return value
        match = re.fullmatch(r"\s*([1-9]\d{0,4})\s*[xX×]\s*([1-9]\d{0,4})\s*", value)
        if match is None:
            self.fail(f"{value!r} is not a size: give WIDTHxHEIGHT in pixels, such as 1280x720", param, ctx)
        return int(match[1]), int(match[2])


class Range(click.ParamType):  # type: ignore[type-arg]
    """NEAR,FAR in world units."""

    name = "NEAR,FAR"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[float, float]:
        if isinstance(value, tuple):
            return value
        try:
            near, far = (float(part) for part in value.split(","))
        except ValueError:
            near = far = 0.0
        if not 0.0 < near < far < float("inf"):
            self.fail(f"{value!r} is not a range: give NEAR,FAR with 0 < NEAR < FAR, such as 0.5,20", param, ctx)
        return near, far


def path_options(function: F) -> F:
    """Add `--path` and the flags that change the path; `path_request` reads them."""
    for option in reversed(
        (
            click.option(
                "--path",
                metavar="|".join((*AROUND, BETWEEN, "FILE")),
                help="Render a camera path: around the scene, between cameras, or from a file (nerfstudio's "
                "camera_path.json, or a cameras.json).",
            ),
            click.option(
                "--keys",
                metavar="NAME,NAME,...",
                help="Cameras to interpolate between, in this order.  [default: all, by name]",
            ),
            click.option("--closed", is_flag=True, help="Interpolate back to the first camera."),
            click.option(
                "--frames",
                type=click.IntRange(min=1),
                metavar="N",
                help=f"Number of images on the path.  [default: {FRAMES}, or the number in the file]",
            ),
            click.option(
                "--seconds",
                type=click.FloatRange(min=0, min_open=True),
                metavar="S",
                help="Duration of the path, instead of --frames.",
            ),
            click.option(
                "--fps",
                type=click.FloatRange(min=0, min_open=True, max=1000),
                metavar="N",
                help="Frames per second.  [default: 30, or the number in the file]",
            ),
            click.option("--size", type=Size(), help="Size of the images [px]; the vertical field of view is kept."),
            click.option("--save-path", type=PATH, metavar="FILE", help="Also write the path as camera_path.json."),
        )
    ):
        function = option(function)
    return function


def path_request(values: dict[str, Any]) -> PathRequest | None:
    """Remove the flags of `path_options`, except `save_path`, from `values` and return the path that they request.

    Raises
    ------
    click.UsageError : two flags exclude each other.
    """
    path, size, fps = values.pop("path"), values.pop("size"), values["fps"]
    keys, closed, frames, seconds = (values.pop(name) for name in ("keys", "closed", "frames", "seconds"))
    if path is None:
        if keys or closed or frames or seconds or values["save_path"]:
            raise click.UsageError("--keys, --closed, --frames, --seconds and --save-path belong to --path")
        return None
    if frames is not None and seconds is not None:
        raise click.UsageError("give --frames or --seconds, not both")
    if path != BETWEEN and (keys is not None or closed):
        raise click.UsageError(f"--keys and --closed belong to --path {BETWEEN}")
    names = None if keys is None else tuple(part.strip() for part in keys.split(","))
    return PathRequest(path, names, closed, frames, seconds, fps, size)
