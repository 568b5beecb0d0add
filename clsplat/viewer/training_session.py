"""Viewing of a training run while it goes on."""

from __future__ import annotations

from collections.abc import Callable
from types import TracebackType
from typing import TYPE_CHECKING

from ..cameras.cameras_json import NamedCamera
from ..scenes.scene import Scene
from ..training.config import TrainConfig
from ..training.log import Progress
from ..training.trainer import Visit
from .initial_view import SceneCameras, initial_view
from .session import ServerOptions, require_viser
from .training import TrainingView, run_line

if TYPE_CHECKING:
    from .server import Server


class TrainingSession:
    """A server that shows one run; a context manager.

    Pass `visit` and `progress(display)` to `train`.

    Attributes
    ----------
    url : the page's address. visit : renders between iterations.

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
        self._training = TrainingView(config)
        self.visit: Visit = self._training.visit
        self._server: Server = Server(
            self._training.viewer,
            initial_view(scene.points.xyz, cameras),
            known,
            host=options.host,
            port=options.port,
            title=f"clsplat: {name}",
        )
        self._server.add_training(self._training.toggle)
        self.url = self._server.url

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

        def report(progress: Progress) -> None:
            display(progress)
            self._server.set_training_status(run_line(progress))

        return report
