"""`clsplat view`: walk through a model in the browser."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

import click

from clsplat.files.stop_signals import exit_code
from clsplat.splats.color import Color

from .command import DocumentedCommand
from .models import one_model, scene_choice
from .options import (
    PATH,
    background_of,
    background_options,
    detail_option,
    device_option,
    iteration_option,
    quiet_option,
    scene_options,
)

CTRL_C = 130  # exit code after Ctrl-C

F = TypeVar("F", bound=Callable[..., Any])


class Address(click.ParamType):  # type: ignore[type-arg]
    """The name or the number of a network interface."""

    name = "ADDRESS"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> str:
        if not re.fullmatch(r"[\w.:%-]{1,255}", value, re.ASCII):
            self.fail(f"{value!r} is not an address: give for example 127.0.0.1, 0.0.0.0 or localhost", param, ctx)
        return str(value)


def server_options(function: F) -> F:
    """Add `--port`, `--host`, `--allow-host` and `--token` of a viewer."""
    for option in (
        click.option("--token", is_flag=True, help="Ask for the token of the printed address also on this machine."),
        click.option(
            "--allow-host",
            "names",
            multiple=True,
            metavar="NAME",
            help="Host name of a proxy under which browsers reach the viewer. Repeat it for more names.",
        ),
        click.option(
            "--host",
            type=Address(),
            metavar="ADDRESS",
            default="127.0.0.1",
            show_default=True,
            help="Address of the viewer. With 0.0.0.0, other machines can open it by the printed address.",
        ),
        click.option(
            "--port",
            type=click.IntRange(0, 65535),
            default=8080,
            show_default=True,
            metavar="N",
            help="Port of the viewer. 0: any free port.",
        ),
    ):
        function = option(function)
    return function


def addresses(urls: Sequence[str]) -> str:
    """Return the addresses of a viewer as a part of a line."""
    return f"{urls[0]}, from other machines at {urls[1]}" if len(urls) > 1 else urls[0]


@click.command(
    cls=DocumentedCommand,
    examples=(
        ("clsplat view MODEL", "Then open the printed address in a browser."),
        ("clsplat view FILE.ply --port 0", "Any splat file, at any free port."),
        ("clsplat view MODEL --against OTHER", "Two models in one picture, with a divider."),
    ),
    see_also=("render", "convert"),
)
@click.argument("model", required=False, type=PATH, metavar="MODEL_OR_PLY")
@click.option("-m", "--model-path", type=PATH, help="The same as MODEL_OR_PLY.")
@click.option(
    "--against",
    type=PATH,
    metavar="MODEL",
    help="Another model of the same scene, to the right of a divider that the panel moves.",
)
@scene_options
@server_options
@click.option(
    "--paths",
    "folder",
    type=PATH,
    metavar="DIR",
    help="Folder for recorded camera paths and cropped models. Without it they can only be downloaded.",
)
@background_options
@detail_option(0.0)
@iteration_option
@device_option
@quiet_option
def view(
    model: Path | None,
    model_path: Path | None,
    against: Path | None,
    port: int,
    host: str,
    names: tuple[str, ...],
    token: bool,
    folder: Path | None,
    background: Color | None,
    white_background: bool,
    detail: float,
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
    from clsplat.viewer.options import ServerOptions
    from clsplat.viewer.session import ViewingSession, known_cameras, require_viser

    source, scene = one_model(model, model_path), scene_choice(values)
    colour = background_of(background, white_background)
    require_viser()
    loaded = load_model(source, iteration)
    options = ServerOptions(host, port, names, token, folder)
    other = None if against is None else load_model(against)
    session = ViewingSession(loaded, known_cameras(loaded, scene), colour, options, iteration, device, other, detail)
    if not quiet:
        click.echo(f"{source}: {len(loaded.splats)} splats at {addresses(session.server.urls)} (Ctrl-C ends)")
    try:
        session.run()
    except KeyboardInterrupt:
        if exit_code() != CTRL_C:  # Ctrl-C is the usual end
            raise
    finally:
        session.close()
