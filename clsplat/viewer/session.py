"""Viewing of a model: its server, its renderer, and a watch over its file."""

from __future__ import annotations

import importlib
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..cameras.camera import Camera
from ..cameras.cameras_json import named_cameras
from ..errors import ClsplatError, InputError
from ..files.file_names import printable
from ..files.real_path import real_path
from ..models.model import LoadedModel, SceneChoice, in_both_forms
from ..splats.color import Color
from ..training.folder import ModelFolder
from .compared import ComparedSource
from .initial_view import SceneCameras, initial_view
from .options import ServerOptions
from .settings import Settings
from .source import ModelSource, ModelWatcher
from .viewer import Viewer

if TYPE_CHECKING:
    from .server import Server

POLL = 1.0  # seconds between checks of the file


class ViewingSession:
    """A model in the browser, read again when its file changes.

    The server listens as soon as the session is made; `run` renders for it.

    Parameters
    ----------
    model : what to show.
    known : cameras to jump to; by default those of the model folder.
    background : colour 0..1; None takes the model's.
    iteration : of a model folder, the point cloud to watch; None watches for the last.
    device : OpenCL device, as for `Renderer`.
    against : another model, which is shown to the right of a divider.
    detail : levels of detail, as `pixels` of `DetailLevels.choose`; 0 draws all splats.

    Raises
    ------
    InputError : viser is not installed.
    OutputError : the server cannot listen at the address.
    """

    def __init__(
        self,
        model: LoadedModel,
        known: SceneCameras | None = None,
        background: Color | None = None,
        options: ServerOptions | None = None,
        iteration: int | None = None,
        device: str | None = None,
        against: LoadedModel | None = None,
        detail: float = 0.0,
    ) -> None:
        require_viser()
        from .server import Server

        known, options = known or known_cameras(model), options or ServerOptions()
        cameras = [item.camera for item in (*known.train, *known.test)]
        source = ModelSource(model.splats, device, detail=detail)
        self.source: ModelSource | ComparedSource = source
        self.watched = [(ModelWatcher(_finder(model.path, iteration)), source)]
        if against is not None:
            other = ModelSource(against.splats, device, detail=detail)
            self.watched.append((ModelWatcher(_finder(against.path, None)), other))
            self.source = ComparedSource(source, other, (_name(model), _name(against)))
        settings = Settings(background=model.background if background is None else background)
        self.viewer = Viewer(self.source, settings)
        # This picture builds the kernels before a client waits for them, and raises the device's errors here.
        self.source.view(Camera(64, 48, 50.0, 50.0, 32.0, 24.0, np.eye(4)), settings)
        self.server: Server = Server(
            self.viewer,
            initial_view(model.splats.mean, cameras),
            known,
            host=options.host,
            port=options.port,
            names=options.names,
            token=options.token,
            name=_name(model),
            reload=self.reload,
            folder=options.paths,
        )
        self._worker = threading.Thread(target=self.viewer.run, daemon=True)
        self._lock = threading.Lock()

    def run(self) -> None:
        """Render frames and watch the file, until interrupted."""
        self._worker.start()
        while True:
            time.sleep(POLL)
            self.poll()

    def poll(self) -> None:
        """Show new models of the files. If one cannot be read, report why and keep the old model."""
        for watch, source in self.watched:
            try:
                with self._lock:
                    splats = watch.poll()
            except ClsplatError as error:
                self.server.set_status(_kept(error))
                continue
            if splats is not None:
                source.show(splats)
                self.server.model_changed()

    def reload(self) -> str:
        """Read the files at once, and return a message about the result."""
        messages = []
        for watch, source in self.watched:
            try:
                with self._lock:
                    splats = watch.reload()
            except ClsplatError as error:
                messages.append(_kept(error))
                continue
            source.show(splats)
            messages.append(f"{watch.path.name}: read again, {len(splats)} splats")
        self.server.model_changed()
        return "; ".join(messages)

    def close(self) -> None:
        """Close the connections and release the device."""
        self.viewer.close()
        self.server.close()
        if self._worker.is_alive():
            self._worker.join(5.0)


def known_cameras(model: LoadedModel, scene: SceneChoice | None = None) -> SceneCameras:
    """Cameras of the scene that is chosen, else those in the model folder. A file alone does not have cameras."""
    if scene:
        loaded = model.load_scene(scene, check=False)
        cameras, test_names = named_cameras(loaded.names, loaded.cameras), loaded.test_names
    else:
        cameras, test_names = model.read_cameras(), model.test_names or frozenset()
    test = in_both_forms(test_names)
    return SceneCameras(
        tuple(item for item in cameras if item.name not in test), tuple(item for item in cameras if item.name in test)
    )


def require_viser() -> None:
    """Raise InputError, which names the package to install, if viser is missing."""
    try:
        importlib.import_module("viser")
    except ImportError:
        raise InputError("the viewer needs viser: pip install clsplat[view]") from None


def _name(model: LoadedModel) -> str:
    """Return the name of a model for the browser."""
    return printable(real_path(model.path).stem)


def _finder(path: Path, iteration: int | None) -> Callable[[], Path]:
    """A function that returns the model's file now: a run may write a later iteration."""
    return (lambda: ModelFolder(path).latest_ply(iteration)[0]) if path.is_dir() else (lambda: path)


def _kept(error: ClsplatError) -> str:
    return f"{str(error).rstrip('.')}; the previous model stays"
