"""`--path` and what belongs to it: cameras along a path, from the command line's words."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from clsplat.cameras.cameras_json import NamedCamera
from clsplat.cameras.interpolate import interpolate, resized_by_height
from clsplat.cameras.path import DEFAULT_FPS, CameraPath, read_path
from clsplat.errors import InputError
from clsplat.files.image_names import bare_name

from .models import LoadedModel
from .options import PATH

if TYPE_CHECKING:
    from clsplat.cameras.camera import Camera

F = TypeVar("F", bound=Callable[..., Any])

AROUND = ("orbit", "ellipse", "spiral")
BETWEEN = "interpolate"
FRAMES = 60
_SHOWN = 8  # names in a message


class Size(click.ParamType):  # type: ignore[type-arg]
    """WIDTHxHEIGHT in pixels."""

    name = "WxH"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> tuple[int, int]:
        if isinstance(value, tuple):
            return value
        match = re.fullmatch(r"\s*([1-9]\d{0,4})\s*[xX×]\s*([1-9]\d{0,4})\s*", value)
        if match is None:
            self.fail(f"{value!r} is no size: give WIDTHxHEIGHT in pixels, such as 1280x720", param, ctx)
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
            self.fail(f"{value!r} is no range: give NEAR,FAR with 0 < NEAR < FAR, such as 0.5,20", param, ctx)
        return near, far


def path_options(function: F) -> F:
    """`--path` and the flags that shape it; `path_of` reads them."""
    for option in reversed(
        (
            click.option(
                "--path",
                metavar="|".join((*AROUND, BETWEEN, "FILE")),
                help="Render a path: around the scene, between cameras, or of a file (nerfstudio's "
                "camera_path.json, or a cameras.json).",
            ),
            click.option(
                "--keys",
                metavar="NAME,NAME,...",
                help="The cameras to interpolate between, in this order.  [default: all, by name]",
            ),
            click.option("--closed", is_flag=True, help="Interpolate back to the first camera."),
            click.option(
                "--frames",
                type=click.IntRange(min=1),
                metavar="N",
                help=f"Images of the path.  [default: {FRAMES}; a file's own]",
            ),
            click.option(
                "--seconds",
                type=click.FloatRange(min=0, min_open=True),
                metavar="S",
                help="The path's time, instead of --frames.",
            ),
            click.option(
                "--fps",
                type=click.FloatRange(min=0, min_open=True, max=1000),
                metavar="N",
                help="Frames a second.  [default: 30; a file's own]",
            ),
            click.option("--size", type=Size(), help="Of the images in pixels; the vertical field of view is kept."),
            click.option("--save-path", type=PATH, metavar="FILE", help="Also write the path as camera_path.json."),
        )
    ):
        function = option(function)
    return function


def path_of(
    model: LoadedModel,
    views: Sequence[NamedCamera],
    source: Path,
    path: str,
    keys: str | None,
    closed: bool,
    frames: int | None,
    seconds: float | None,
    fps: float | None,
) -> CameraPath:
    """The path that the flags ask for; `views` of `source` are the cameras it goes around or between.

    Raises
    ------
    InputError : no such file, a damaged one, no such camera, or none to interpolate between.
    click.UsageError : flags that exclude each other.
    """
    if frames is not None and seconds is not None:
        raise click.UsageError("give --frames or --seconds, not both")
    if path != BETWEEN and (keys is not None or closed):
        raise click.UsageError(f"--keys and --closed belong to --path {BETWEEN}")
    rate = fps or DEFAULT_FPS
    count = max(1, round(seconds * rate)) if seconds is not None else frames or FRAMES
    if path in AROUND:
        from clsplat.cameras import orbits as paths_around  # lazy: reads no splats where a file has the path

        cameras = getattr(paths_around, path)(model.splats, [view.camera for view in views], count)
        return CameraPath(tuple(cameras), rate, closed=True)
    if path == BETWEEN:
        chosen = _keys(views, source, keys)
        return CameraPath(tuple(interpolate(chosen, count, closed)), rate, tuple(chosen), closed)
    if not Path(path).is_file():
        raise InputError(f"--path {path}: no such file; give one, or {', '.join(AROUND)} or {BETWEEN}")
    read = read_path(path)
    rate = fps or read.fps
    if seconds is not None:
        count = max(1, round(seconds * rate))
    if (seconds is None and frames is None) or count == len(read.cameras):
        return CameraPath(read.cameras, rate, read.keys, read.closed)
    return CameraPath(tuple(interpolate(read.cameras, count, read.closed, even=True)), rate, read.keys, read.closed)


def resized(path: CameraPath, size: tuple[int, int] | None) -> CameraPath:
    """The path at another image size."""
    if size is None:
        return path
    frames, keys = (tuple(resized_by_height(camera, *size) for camera in part) for part in (path.cameras, path.keys))
    return CameraPath(frames, path.fps, keys, path.closed)


def named(path: CameraPath, name: str) -> list[NamedCamera]:
    """The path's frames by the names of their images."""
    stem = name if name in AROUND else "frame"
    digits = max(3, len(str(len(path.cameras) - 1)))
    return [NamedCamera(f"{stem}_{index:0{digits}}", camera) for index, camera in enumerate(path.cameras)]


def _keys(views: Sequence[NamedCamera], source: Path, keys: str | None) -> list[Camera]:
    """The cameras of those names."""
    if not views:
        raise InputError(
            f"{source}: no cameras to interpolate between: give --cameras cameras.json, or a scene with -s"
        )
    if keys is None:
        return [view.camera for view in sorted(views, key=lambda view: view.name)]
    known = {bare_name(view.name): view.camera for view in views} | {view.name: view.camera for view in views}
    chosen = []
    for name in (part.strip() for part in keys.split(",")):
        camera = known.get(name) or known.get(bare_name(name))
        if camera is None:
            names = sorted(view.name for view in views)
            more = f", ... ({len(names)} in all)" if len(names) > _SHOWN else ""
            raise InputError(f"{source}: has no camera {name!r}: choose --keys from {', '.join(names[:_SHOWN])}{more}")
        chosen.append(camera)
    return chosen
