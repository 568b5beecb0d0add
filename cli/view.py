"""`clsplat view`: walk through a model in the browser."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from clsplat.cameras.cameras_json import named_cameras
from clsplat.errors import ClsplatError, InputError
from clsplat.splats.color import Color
from clsplat.training.folder import ModelFolder

from .models import LoadedModel, both_forms, load_model, one_model, recorded_cameras, scene_of
from .options import (
    PATH,
    background_of,
    background_options,
    device_option,
    iteration_option,
    quiet_option,
    scene_options,
)

if TYPE_CHECKING:
    from clsplat.viewer.server import Server
    from clsplat.viewer.source import ModelSource, Watch
    from clsplat.viewer.start import Known

F = TypeVar("F", bound=Callable[..., Any])

POLL = 1.0  # seconds between looks at the file


def server_options(function: F) -> F:
    """`--port` and `--host` of a viewer."""
    function = click.option(
        "--host",
        default="127.0.0.1",
        show_default=True,
        help="Address of the viewer; at 0.0.0.0 all who reach this machine may look.",
    )(function)
    return click.option(
        "--port",
        type=click.IntRange(0, 65535),
        default=8080,
        show_default=True,
        help="Port of the viewer; 0: any free one.",
    )(function)


def require_viser() -> None:
    """Say what to install where the viewer's library is missing."""
    try:
        import viser  # noqa: F401
    except ImportError:
        raise InputError("the viewer needs viser: pip install clsplat[view]") from None


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
    help="Folder where recorded camera paths may be saved. Without it they can be downloaded.",
)
@background_options
@iteration_option
@device_option
@quiet_option
def view(
    model: Path | None,
    model_path: Path | None,
    source_path: Path | None,
    images: str | None,
    resolution: int | None,
    port: int,
    host: str,
    folder: Path | None,
    background: Color | None,
    white_background: bool,
    iteration: int | None,
    device: str | None,
    quiet: bool,
) -> None:
    """Walk through MODEL_OR_PLY in the browser: a model's folder, or any splat PLY.

    Ctrl-C ends it. From another machine: ssh -L 8080:localhost:8080 HOST, then open http://localhost:8080 here. A file
    that changes is read again.
    """
    given = one_model(model, model_path)
    colour = background_of(background, white_background)
    require_viser()
    loaded = load_model(given, iteration)
    known = known_cameras(loaded, source_path, images, resolution)
    viewing = Viewing(
        loaded, iteration, known, loaded.background if colour is None else colour, host, port, folder, device
    )
    if not quiet:
        click.echo(f"{given}: {len(loaded.splats)} splats at {viewing.server.url} (Ctrl-C ends)")
    try:
        viewing.run()
    except KeyboardInterrupt:
        pass
    finally:
        viewing.close()


def known_cameras(model: LoadedModel, source_path: Path | None, images: str | None, resolution: int | None) -> Known:
    """Cameras of the scene given, else those in the model's folder; none are known of a PLY alone."""
    from clsplat.viewer.start import Known

    if source_path is not None or images is not None or resolution is not None:
        scene = scene_of(model, source_path, images, resolution)
        cameras, held_out = named_cameras(scene.names, scene.cameras), scene.test_names
    else:
        cameras, held_out = recorded_cameras(model), model.test_names or frozenset()
    test = both_forms(held_out)
    return Known(
        tuple(item for item in cameras if item.name not in test), tuple(item for item in cameras if item.name in test)
    )


class Viewing:
    """A model, those who look at it, and the file behind it."""

    def __init__(
        self,
        model: LoadedModel,
        iteration: int | None,
        known: Known,
        background: Color,
        host: str,
        port: int,
        folder: Path | None,
        device: str | None,
    ) -> None:
        import numpy as np

        from clsplat.cameras.camera import Camera
        from clsplat.viewer.server import Server
        from clsplat.viewer.settings import Settings
        from clsplat.viewer.source import ModelSource, Watch
        from clsplat.viewer.start import start_of
        from clsplat.viewer.viewer import Viewer

        cameras = [item.camera for item in (*known.train, *known.test)]
        self.source: ModelSource = ModelSource(model.splats, device)
        self.watch: Watch = Watch(_finder(model.path, iteration))
        settings = Settings(background=background)
        self.viewer = Viewer(self.source, settings)
        # Kernels are built before anybody waits for them, and a device's errors are said here.
        self.source.picture(Camera(64, 48, 50.0, 50.0, 32.0, 24.0, np.eye(4)), settings)
        self.server: Server = Server(
            self.viewer,
            start_of(model.splats.mean, cameras),
            known,
            host=host,
            port=port,
            title=f"clsplat: {model.path.resolve().name}",
            reload=self.reload,
            folder=folder,
        )
        self._worker = threading.Thread(target=self.viewer.run, daemon=True)
        self._lock = threading.Lock()

    def run(self) -> None:
        """Make pictures and look after the file, until interrupted."""
        self._worker.start()
        while True:
            time.sleep(POLL)
            self.poll()

    def poll(self) -> None:
        """Show the file's new model, or say why not; the old one stays then."""
        try:
            with self._lock:
                splats = self.watch.poll()
        except ClsplatError as error:
            self.server.say(f"{_short(error)}; the model of before is shown")
            return
        if splats is not None:
            self.source.show(splats)
            self.server.model_changed()

    def reload(self) -> str:
        """Read the file at once; what came of it."""
        try:
            with self._lock:
                splats = self.watch.reload()
        except ClsplatError as error:
            return f"{_short(error)}; the model of before is shown"
        self.source.show(splats)
        self.server.model_changed()
        return f"{self.watch.path.name}: read again, {len(splats)} splats"

    def close(self) -> None:
        """Hang up and let the device go."""
        self.viewer.close()
        self.server.close()
        if self._worker.is_alive():
            self._worker.join(5.0)


def _finder(path: Path, iteration: int | None) -> Callable[[], Path]:
    """Which file shows the model, asked again and again: a run may write a later iteration."""
    return (lambda: ModelFolder(path).latest_ply(iteration)[0]) if path.is_dir() else (lambda: path)


def _short(error: ClsplatError) -> str:
    return str(error).rstrip(".")
