"""Viewing of a training run while it goes on."""

from __future__ import annotations

import threading
from collections.abc import Callable
from types import TracebackType
from typing import TYPE_CHECKING

from ..cameras.cameras_json import NamedCamera
from ..device.specs import first_device
from ..scenes.scene import Scene
from ..training.config import TrainConfig
from ..training.log import Progress
from ..training.run import Model
from ..training.trainer import Visit
from .initial_view import SceneCameras, initial_view
from .options import ServerOptions
from .session import POLL, require_viser
from .source import ModelSource
from .training import TrainingView, run_line

if TYPE_CHECKING:
    from .server import Server


class TrainingSession:
    """A server that shows one run; a context manager.

    Pass `visit` and `progress(display)` to `train`.

    Attributes
    ----------
    urls : addresses of the page, as `Server.urls`. visit : renders between iterations.

    Raises
    ------
    InputError : viser is not installed.
    OutputError : the server cannot listen at the address.
    """

    def __init__(self, scene: Scene, config: TrainConfig, name: str, options: ServerOptions | None = None) -> None:
        require_viser()
        from .server import Server

        options = options or ServerOptions()
        known = SceneCameras(
            tuple(NamedCamera(view.name, view.camera) for view in scene.train),
            tuple(NamedCamera(view.name, view.camera) for view in scene.test),
        )
        cameras = [item.camera for item in (*known.train, *known.test)]
        self._config = config
        self._display: Callable[[Progress], None] = lambda progress: None
        self._training = TrainingView(config, on_pause=self._say_pause)
        self.visit: Visit = self._training.visit
        self._server: Server = Server(
            self._training.viewer,
            initial_view(scene.points.xyz, cameras),
            known,
            host=options.host,
            port=options.port,
            names=options.names,
            token=options.token,
            name=name,
        )
        self._server.add_training(self._training.toggle)
        self.urls = self._server.urls

    def __enter__(self) -> TrainingSession:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._server.set_status("the run has ended: clsplat view shows its model")
        self._training.viewer.close()
        self._server.close()

    def progress(self, display: Callable[[Progress], None]) -> Callable[[Progress], None]:
        """A `progress` callback that passes its argument to `display` and to the page."""
        self._display = display
        return self._report

    def stay(self, model: Model) -> None:
        """Show a finished model, until interrupted or until `stop`."""
        self._training.finish(ModelSource(model.splats, first_device(self._config.device)))
        self._server.end_training()
        self._server.set_training_status(f"iteration {model.iteration}: the run has finished")
        self._server.model_changed()
        worker = threading.Thread(target=self._training.viewer.run, daemon=True)
        worker.start()
        try:
            while worker.is_alive():
                worker.join(POLL)
        finally:
            self._training.viewer.close()
            worker.join(5.0)

    def stop(self) -> None:
        """End `stay`."""
        self._training.viewer.close()

    def _report(self, progress: Progress) -> None:
        self._display(progress)
        self._server.set_training_status(run_line(progress))

    def _say_pause(self, paused: bool, message: str) -> None:
        iterations = self._config.iterations
        self._report(Progress.note(message, iterations))
        self._server.show_paused(paused)
