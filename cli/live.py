"""`clsplat train --view`: the page that shows a run while it trains."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING

import click

from .view import require_viser

if TYPE_CHECKING:
    from clsplat.scenes.scene import Scene
    from clsplat.training.config import TrainConfig
    from clsplat.training.log import Progress
    from clsplat.training.trainer import Visit


class LiveView:
    """A server for those who look at one run; use as a context manager.

    Raises
    ------
    InputError : viser is not installed. OutputError : the address cannot be listened at.
    """

    def __init__(
        self, scene: Scene, config: TrainConfig, model_path: Path, host: str, port: int, quiet: bool = False
    ) -> None:
        require_viser()
        from clsplat.cameras.cameras_json import NamedCamera
        from clsplat.viewer.server import Server
        from clsplat.viewer.start import Known, start_of
        from clsplat.viewer.training import TrainingView

        known = Known(
            tuple(NamedCamera(view.name, view.camera) for view in scene.train),
            tuple(NamedCamera(view.name, view.camera) for view in scene.test),
        )
        cameras = [item.camera for item in (*known.train, *known.test)]
        self._training = TrainingView(config)
        self.visit: Visit = self._training.visit
        self._server = Server(
            self._training.viewer,
            start_of(scene.points.xyz, cameras),
            known,
            host=host,
            port=port,
            title=f"clsplat: {model_path.resolve().name}",
        )
        self._server.add_training(self._training.toggle)
        self.url = self._server.url
        if not quiet:
            click.echo(f"training can be watched at {self.url}", err=True)

    def __enter__(self) -> LiveView:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._server.say("the run has ended: clsplat view shows its model")
        self._training.viewer.close()
        self._server.close()

    def told(self, display: Callable[[Progress], None]) -> Callable[[Progress], None]:
        """A `progress` that also tells the page."""
        from clsplat.viewer.training import run_line

        def progress(news: Progress) -> None:
            display(news)
            self._server.tell_training(run_line(news))

        return progress
