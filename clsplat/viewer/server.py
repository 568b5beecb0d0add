"""The web server of the viewer: a panel for each browser. `listen` opens it."""

from __future__ import annotations

import contextlib
import io
import socket
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import viser

from .access import access_for
from .initial_view import InitialView, SceneCameras, Vector
from .listen import open_server
from .page import Page
from .status_line import plain
from .viewer import Viewer

DEFAULT_HOST, DEFAULT_PORT = "127.0.0.1", 8080
ANY_HOST = ("0.0.0.0", "::", "")  # every address of the machine
_BRAND = (17, 137, 151)
NO_CAMERAS = SceneCameras()
_FLUSH_TIME = 0.1  # seconds for the last messages before the server stops


class Server:
    """A running web server.

    Parameters
    ----------
    host, port : address of the server; port 0 chooses a free one.
    names : more host names under which browsers reach it, for a proxy.
    token : require the token of `url` even if only this machine reaches the server. Otherwise it is always required.
    name : of the model, for the title of the panel and for files.
    start : the first view of a browser.
    reload : reads the model file again and returns a status text, or None if there is no file.
    folder : folder for saved paths and models, or None if they can only be downloaded.

    Raises
    ------
    OutputError : the server cannot listen on the address.
    """

    def __init__(
        self,
        viewer: Viewer,
        start: InitialView,
        known: SceneCameras = NO_CAMERAS,
        *,
        host: str = DEFAULT_HOST,
        port: int = DEFAULT_PORT,
        names: Sequence[str] = (),
        token: bool = False,
        name: str = "view",
        reload: Callable[[], str] | None = None,
        folder: Path | None = None,
    ) -> None:
        self.viewer, self._known, self._reload, self._folder = viewer, known, reload, folder
        self._name, self._up = name, start.up
        self._pages: dict[int, Page] = {}
        self._lock = threading.Lock()
        self.access = access_for(host, names, token)
        self.server = open_server(host, port, self.access)
        self.host, self.port = host, self.server.get_port()
        self.server.gui.set_panel_label(f"clsplat: {name}")
        self.server.gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False, brand_color=_BRAND)
        self.server.scene.set_up_direction(_triple(start.up))
        first = self.server.initial_camera
        first.position, first.look_at = _triple(start.position), _triple(start.look_at)
        first.up, first.fov = _triple(start.up), start.fov
        self._panel: tuple[viser.GuiMarkdownHandle, viser.GuiButtonHandle] | None = None
        self.server.on_client_connect(self._connect)
        self.server.on_client_disconnect(self._disconnect)

    @property
    def url(self) -> str:
        """Address for a browser on this machine, with the token if one is needed."""
        return self._url("localhost" if self.host in ANY_HOST else self.host)

    @property
    def urls(self) -> tuple[str, ...]:
        """Addresses for browsers: on this machine, and on others if they reach the server under another name."""
        return (self.url, self._url(socket.gethostname())) if self.host in ANY_HOST else (self.url,)

    def _url(self, host: str) -> str:
        name = f"[{host}]" if ":" in host else host
        return f"http://{name}:{self.port}{self.access.query}"

    def add_training(self, toggle: Callable[[], None]) -> None:
        """Add the status line of a run and a button for all browsers, which calls `toggle` to pause or resume it."""
        with self.server.gui.add_folder("Training", order=-1.0):
            label = self.server.gui.add_markdown("")
            button = self.server.gui.add_button("Pause", icon=viser.Icon.PLAYER_PAUSE)
        self._panel = label, button
        button.on_click(lambda _: toggle())

    def show_paused(self, paused: bool) -> None:
        """Label the button of a run."""
        if self._panel is not None:
            button = self._panel[1]
            button.label = "Resume" if paused else "Pause"
            button.icon = viser.Icon.PLAYER_PLAY if paused else viser.Icon.PLAYER_PAUSE

    def end_training(self) -> None:
        """Remove the button of a run that has ended."""
        if self._panel is not None:
            self._panel[1].visible = False

    def set_training_status(self, text: str) -> None:
        """Set the status line of the run."""
        if self._panel is not None:
            self._panel[0].content = plain(text)

    def set_status(self, text: str) -> None:
        """Set the status line of every browser."""
        for page in self._all():
            page.set_status(text)

    def model_changed(self) -> None:
        """Adapt all browsers to a new model and request new frames."""
        for page in self._all():
            page.model_changed()
        self.viewer.refresh()

    def close(self) -> None:
        """Stop the server after the last messages are sent."""
        for page in self._all():
            page.close()
            page.client.flush()
        time.sleep(_FLUSH_TIME if self._pages else 0.0)
        with contextlib.redirect_stdout(io.StringIO()):  # viser prints that it has stopped
            self.server.stop()

    def _all(self) -> list[Page]:
        with self._lock:
            return list(self._pages.values())

    def _connect(self, client: viser.ClientHandle) -> None:
        page = Page(client, self.viewer, self._known, self._reload, self._folder, self._name, self._up)
        with self._lock:
            self._pages[client.client_id] = page
        if client.client_id not in self.server.get_clients():  # the browser left before its panel was complete
            self._disconnect(client)

    def _disconnect(self, client: viser.ClientHandle) -> None:
        with self._lock:
            page = self._pages.pop(client.client_id, None)
        if page is not None:
            page.close()


def _triple(values: Vector) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z
