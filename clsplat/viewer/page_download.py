"""The button of the panel that sends the model as a web page, which draws it without this viewer."""

from __future__ import annotations

import threading
from collections.abc import Callable

import viser

from ..errors import ClsplatError
from ..splats.approximate import nearest_gaussians
from ..splats.color import Color
from ..splats.splats import Splats
from ..webpage.page import PageContent, as_drawn, page_text
from .initial_view import SceneCameras


class PageDownload:
    """The button.

    Parameters
    ----------
    model : returns the splats, or None during a run. name : of the model, for the file and the heading.
    background : returns the colour behind the splats. say : shows a text.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        model: Callable[[], Splats | None],
        cameras: SceneCameras,
        name: str,
        background: Callable[[], Color],
        say: Callable[[str], None],
    ) -> None:
        self._client, self._model, self._cameras, self._name = client, model, cameras, name
        self._background, self._say = background, say
        button = client.gui.add_button(
            "Download web page", icon=viser.Icon.WORLD_DOWNLOAD, hint="A file that shows the model in any browser"
        )
        # Packing a large model takes seconds.
        button.on_click(lambda _: threading.Thread(target=self._send, daemon=True).start())

    def _send(self) -> None:
        splats = self._model()
        if splats is None:
            self._say("a run goes on: download the page when it has ended")
            return
        file = f"{self._name}.html"
        self._say(f"{file}: is being made")
        try:
            text, kind = self._text(splats)
        except ClsplatError as error:
            self._say(str(error))
            return
        self._client.send_file_download(file, text.encode(), save_immediately=True)
        self._say(f"{file}: {len(splats)} {kind}, {len(text) / 1e6:.1f} MB")

    def _text(self, splats: Splats) -> tuple[str, str]:
        """Return the page, and a word for the splats that it draws."""
        kind = "splats"
        try:
            drawn = as_drawn(splats)
        except ClsplatError:
            drawn, kind = nearest_gaussians(splats), "Gaussians, which are near the splats but not equal to them"
        cameras = (*self._cameras.train, *self._cameras.test)
        return page_text(drawn, PageContent(self._name, cameras, background=self._background())), kind
