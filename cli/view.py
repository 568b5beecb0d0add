"""`clsplat view`: walk through a model in the browser."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import click

from clsplat.splats.color import Color

from .models import one_model, scene_choice
from .options import (
    PATH,
    background_of,
    background_options,
    device_option,
    iteration_option,
    quiet_option,
    scene_options,
)

F = TypeVar("F", bound=Callable[..., Any])


def server_options(function: F) -> F:
    """Add `--port` and `--host` of a viewer."""
    function = click.option(
        "--host",
        default="127.0.0.1",
        show_default=True,
        help="Address of the viewer. With 0.0.0.0, every machine that reaches this one can open it.",
    )(function)
    return click.option(
        "--port",
        type=click.IntRange(0, 65535),
        default=8080,
        show_default=True,
        help="Port of the viewer. 0: any free port.",
    )(function)


@click.command()
@click.argument("model", required=False, type=PATH, metavar="MODEL_OR_PLY")
@click.option("-m", "--model-path", type=PATH, help="The same as MODEL_OR_PLY.")
@scene_options
@server_options
@click.option(
    "--paths",
    "folder",
    type=PATH,
    metavar="DIR",
    help="Folder for recorded camera paths. Without it they can only be downloaded.",
)
@background_options
@iteration_option
@device_option
@quiet_option
def view(
    model: Path | None,
    model_path: Path | None,
    port: int,
    host: str,
    folder: Path | None,
    background: Color | None,
    white_background: bool,
    iteration: int | None,
    device: str | None,
    quiet: bool,
    **values: Any,
) -> None:
    """Walk through MODEL_OR_PLY, a model folder or a file of splats, in the browser.

    Ctrl-C ends it. From another machine: ssh -L 8080:localhost:8080 HOST, then open http://localhost:8080 here. A file
    that changes is read again.
    """
    from clsplat.models.model import load_model
    from clsplat.viewer.session import ServerOptions, ViewingSession, known_cameras, require_viser

    source, scene = one_model(model, model_path), scene_choice(values)
    colour = background_of(background, white_background)
    require_viser()
    loaded = load_model(source, iteration)
    session = ViewingSession(
        loaded, known_cameras(loaded, scene), colour, ServerOptions(host, port, folder), iteration, device
    )
    if not quiet:
        click.echo(f"{source}: {len(loaded.splats)} splats at {session.server.url} (Ctrl-C ends)")
    try:
        session.run()
    except KeyboardInterrupt:
        pass
    finally:
        session.close()
