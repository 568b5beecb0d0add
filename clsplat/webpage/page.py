"""The web page of a model: one HTML file with everything in it, for browsers with WebGL 2, without a server."""

from __future__ import annotations

import base64
import json
import math
import os
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..cameras.camera import Camera
from ..cameras.cameras_json import NamedCamera
from ..cameras.orbits import ellipse
from ..cameras.path import CameraPath
from ..errors import InputError, named_place
from ..files.atomic import atomic_writer
from ..files.file_names import printable
from ..files.html_page import escape, package_text
from ..splats.color import BLACK, Color
from ..splats.convert import as_one_of
from ..splats.formats.page_payload import HUGE, PAGE_SHAPES, PRECISIONS, clipped_sizes, pack
from ..splats.splats import Splats

_TOUR, _TOUR_FPS = 24, 0.8  # keys of the tour around the scene, and how many of them pass in a second
_DRAWN = f"{', '.join(PAGE_SHAPES[:-1])} and {PAGE_SHAPES[-1]}"
# In this order: later files use the earlier ones.
_SCRIPTS = ("payload.js", "sort.js", "cameras.js", "renderer.js", "controls.js", "main.js")
_SHADERS = {
    "project.vert": ("phi.glsl", "project.vert"),
    "splat.vert": ("splat.vert",),
    "splat.frag": ("phi.glsl", "splat.frag"),
    "screen.vert": ("screen.vert",),
    "screen.frag": ("screen.frag",),
}


@dataclass(frozen=True)
class PageContent:
    """What a page shows besides the splats.

    Parameters
    ----------
    title : name of the scene.
    cameras : cameras to jump to, such as those of the photos.
    path : the camera path that the page can play; None: an ellipse through the cameras.
    background : colour behind the splats, 0..1.
    """

    title: str
    cameras: Sequence[NamedCamera] = ()
    path: CameraPath | None = None
    background: Color = BLACK


def as_drawn(splats: Splats) -> Splats:
    """Return splats that show the same image and have a kernel that a page draws (PAGE_SHAPES).

    Raises
    ------
    InputError : a splat has no equal of these kernels.
    """
    return as_one_of(splats, PAGE_SHAPES, "a page draws")


def write_web_page(
    path: str | os.PathLike[str], splats: Splats, content: PageContent, precision: str = PRECISIONS[0]
) -> None:
    """Write a page that draws splats of PAGE_SHAPES (`as_drawn`), atomically.

    precision : "compact" or "full" (page_payload.py).

    Warns
    -----
    UserWarning : "compact" draws enormous splats smaller than they are.

    Raises
    ------
    InputError : there is no splat, or the precision is unknown. OutputError : the file cannot be written.
    """
    with named_place(str(path)):
        text = page_text(splats, content, precision)
    with atomic_writer(Path(path)) as stream:
        stream.write(text.encode())


def page_text(splats: Splats, content: PageContent, precision: str = PRECISIONS[0]) -> str:
    """Return the HTML text of a page. Parameters and InputError are those of `write_web_page`."""
    if precision not in PRECISIONS:
        raise InputError(f"unknown precision {precision!r}: choose {' or '.join(PRECISIONS)}")
    if not len(splats):
        raise InputError("the model has no splats to show; train it first")
    if splats.shape not in PAGE_SHAPES:
        raise InputError(f"a page draws {_DRAWN} splats, not {splats.shape}; see `as_drawn`")
    if precision != "full" and (clipped := clipped_sizes(splats.stored())):
        warnings.warn(
            f"{clipped} splat{'s are' if clipped > 1 else ' is'} more than {math.exp(HUGE):.0f} times as large as the "
            f"median, and the page draws {'them' if clipped > 1 else 'it'} smaller: "
            'remove such splats, or choose the precision "full"',
            stacklevel=2,
        )
    payload = pack(splats.stored(), precision)
    cameras = [entry.camera for entry in content.cameras]
    tour = content.path or CameraPath(tuple(ellipse(splats, cameras, _TOUR)), _TOUR_FPS, closed=True)
    settings = {
        "title": content.title,
        "background": content.background,
        "cameras": [{"name": entry.name, **_camera(entry.camera)} for entry in content.cameras],
        "tour": {"cameras": [_camera(camera) for camera in tour.cameras], "fps": tour.fps, "closed": tour.closed},
        "shaders": {name: "".join(map(_text, ("head.glsl", *parts))) for name, parts in _SHADERS.items()},
    }
    # "<" could end the script element.
    settings_text = json.dumps(settings).replace("<", "\\u003c")
    script = "\n".join(_text(name) for name in _SCRIPTS)
    words = {
        "TITLE": escape(printable(content.title)),
        "STYLE": _text("web.css"),
        "SETTINGS": settings_text,
        "PAYLOAD": base64.b64encode(payload).decode(),
        "SCRIPT": f'"use strict";\n{script}',
    }
    template, text = _text("web.html"), ""
    for part in template.split("@"):  # at odd places: the name of a part
        text += words.get(part, part)
    return text


def _text(name: str) -> str:
    return package_text(__package__, name)


def _camera(camera: Camera) -> dict[str, Any]:
    """Return a camera as the page reads it: the pose as a matrix of 4x4, row by row."""
    return {
        "width": camera.width,
        "height": camera.height,
        "fx": camera.fx,
        "fy": camera.fy,
        "cx": camera.cx,
        "cy": camera.cy,
        "pose": camera.cam_from_world.ravel().tolist(),
    }
