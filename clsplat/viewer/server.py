"""The web server of the viewer: a panel for each browser. Only this module and `page` import viser."""

from __future__ import annotations

import contextlib
import io
import logging
import socket
import threading
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import viser

from ..errors import OutputError
from .initial_view import InitialView, SceneCameras, Vector
from .page import Page, plain
from .viewer import Viewer

DEFAULT_HOST, DEFAULT_PORT = "127.0.0.1", 8080
_BRAND = (17, 137, 151)
NO_CAMERAS = SceneCameras()
_FLUSH_TIME = 0.1  # seconds for the last messages before the server stops


class Server:
    """A running web server.

    Parameters
    ----------
    host, port : address of the server; port 0 chooses a free one.
    title : title of the panel.
    start : the first view of a browser.
    reload : reads the model file again and returns a status text, or None if there is no file.
    folder : folder for saved paths, or None if paths can only be downloaded.

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
        title: str = "clsplat",
        reload: Callable[[], str] | None = None,
        folder: Path | None = None,
    ) -> None:
        self.viewer, self._known, self._reload, self._folder = viewer, known, reload, folder
        self._pages: dict[int, Page] = {}
        self._lock = threading.Lock()
        self.server = _opened(host, port)
        self.host, self.port = host, self.server.get_port()
        self.server.gui.set_panel_label(title)
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
        """Address for a browser."""
        host = "localhost" if self.host in ("0.0.0.0", "::", "") else self.host
        return f"http://[{host}]:{self.port}" if ":" in host else f"http://{host}:{self.port}"

    def add_training(self, toggle: Callable[[], bool]) -> None:
        """Add the status line of a run and a pause button for all browsers.

        `toggle` pauses or resumes the run and returns whether it is paused now.
        """
        with self.server.gui.add_folder("Training", order=-1.0):
            label = self.server.gui.add_markdown("")
            button = self.server.gui.add_button("Pause", icon=viser.Icon.PLAYER_PAUSE)
        self._panel = label, button

        @button.on_click
        def _(_: object) -> None:
            paused = toggle()
            button.label = "Resume" if paused else "Pause"
            button.icon = viser.Icon.PLAYER_PLAY if paused else viser.Icon.PLAYER_PAUSE

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
        page = Page(client, self.viewer, self._known, self._reload, self._folder)
        with self._lock:
            self._pages[client.client_id] = page
        if client.client_id not in self.server.get_clients():  # the browser left before its panel was complete
            self._disconnect(client)

    def _disconnect(self, client: viser.ClientHandle) -> None:
        with self._lock:
            page = self._pages.pop(client.client_id, None)
        if page is not None:
            page.close()


class _Private(viser.ViserServer):
    """A viser server without the relay that would make the page public at the request of a browser."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        return None


def _opened(host: str, port: int) -> viser.ViserServer:
    """Open a server at exactly this address; viser alone would take the next free port."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        with socket.socket(family) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
    except (OSError, OverflowError) as error:
        raise _refusal(host, port, getattr(error, "strerror", None) or str(error)) from None
    # Broken connections log noise; the panel shows what matters.
    for name in ("websockets", "websockets.server"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    for message in ("Queued a .* on a closed connection", r"\[viser\]"):
        warnings.filterwarnings("ignore", message=message)
    with contextlib.redirect_stdout(io.StringIO()):  # viser prints a greeting
        server = _Private(host, port, verbose=False)
    if port and server.get_port() != port:  # another program took the port in between
        server.stop()
        raise _refusal(host, port, "taken by another program")
    # A malformed message of a browser is dropped without a traceback.
    loop = server.get_event_loop()
    loop.call_soon_threadsafe(loop.set_exception_handler, lambda *_: None)
    return server


def _refusal(host: str, port: int, reason: str) -> OutputError:
    return OutputError(f"{host}:{port}: cannot listen on this address ({reason}); choose another --port or --host")


def _triple(values: Vector) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z
