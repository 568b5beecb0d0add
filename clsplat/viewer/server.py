"""The viewer's server: a page for each browser. Only this module and `viewer_page` know viser."""

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
from .page import Page, plain
from .start import Known, Start, Vector
from .viewer import Viewer

DEFAULT_HOST, DEFAULT_PORT = "127.0.0.1", 8080
_BRAND = (17, 137, 151)
NOTHING = Known()
_LAST_WORDS = 0.1  # seconds


class Server:
    """Pages for browsers at an address; open as soon as it is made.

    Parameters
    ----------
    host, port : where it listens; port 0 is any free one.
    title : of the panel.
    start : where browsers begin.
    reload : reads the model again and says what came of it; None: there is no file.
    folder : where paths may be saved; None: nowhere, they can only be downloaded.

    Raises
    ------
    OutputError : the address cannot be listened at.
    """

    def __init__(
        self,
        viewer: Viewer,
        start: Start,
        known: Known = NOTHING,
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
        """Where to look."""
        host = "localhost" if self.host in ("0.0.0.0", "::", "") else self.host
        return f"http://[{host}]:{self.port}" if ":" in host else f"http://{host}:{self.port}"

    def add_training(self, toggle: Callable[[], bool]) -> None:
        """A line about a run and a button that pauses it, for all browsers; `toggle` says whether the run now waits."""
        with self.server.gui.add_folder("Training", order=-1.0):
            label = self.server.gui.add_markdown("")
            button = self.server.gui.add_button("Pause", icon=viser.Icon.PLAYER_PAUSE)
        self._panel = label, button

        @button.on_click
        def _(_: object) -> None:
            paused = toggle()
            button.label = "Resume" if paused else "Pause"
            button.icon = viser.Icon.PLAYER_PLAY if paused else viser.Icon.PLAYER_PAUSE

    def tell_training(self, text: str) -> None:
        """The line about the run."""
        if self._panel is not None:
            self._panel[0].content = plain(text)

    def say(self, text: str) -> None:
        """The line on top of every page."""
        for page in self._all():
            page.say(text)

    def model_changed(self) -> None:
        """There are other splats: new pictures for all."""
        for page in self._all():
            page.model_changed()
        self.viewer.refresh()

    def close(self) -> None:
        """Hang up, once what was said last has gone out."""
        for page in self._all():
            page.close()
            page.client.flush()
        time.sleep(_LAST_WORDS if self._pages else 0.0)
        with contextlib.redirect_stdout(io.StringIO()):  # viser says that it has stopped
            self.server.stop()

    def _all(self) -> list[Page]:
        with self._lock:
            return list(self._pages.values())

    def _connect(self, client: viser.ClientHandle) -> None:
        page = Page(client, self.viewer, self._known, self._reload, self._folder)
        with self._lock:
            self._pages[client.client_id] = page
        if client.client_id not in self.server.get_clients():  # gone while its page was made
            self._disconnect(client)

    def _disconnect(self, client: viser.ClientHandle) -> None:
        with self._lock:
            page = self._pages.pop(client.client_id, None)
        if page is not None:
            page.close()


class _Private(viser.ViserServer):
    """A browser may ask viser to make the page public through a relay; this server does not."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        return None


def _opened(host: str, port: int) -> viser.ViserServer:
    """A server at exactly this address: viser alone would take the next free port."""
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    try:
        with socket.socket(family) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
    except (OSError, OverflowError) as error:
        raise _refusal(host, port, getattr(error, "strerror", None) or str(error)) from None
    # Noise of connections that end badly; what matters is said in the page.
    for name in ("websockets", "websockets.server"):
        logging.getLogger(name).setLevel(logging.CRITICAL)
    for message in ("Queued a .* on a closed connection", r"\[viser\]"):
        warnings.filterwarnings("ignore", message=message)
    with contextlib.redirect_stdout(io.StringIO()):  # viser's own greeting
        server = _Private(host, port, verbose=False)
    if port and server.get_port() != port:  # taken in between
        server.stop()
        raise _refusal(host, port, "taken by another program")
    # A browser's message that makes no sense ends with itself, without a traceback.
    loop = server.get_event_loop()
    loop.call_soon_threadsafe(loop.set_exception_handler, lambda *_: None)
    return server


def _refusal(host: str, port: int, reason: str) -> OutputError:
    return OutputError(f"{host}:{port}: cannot be listened at ({reason}); choose another --port or --host")


def _triple(values: Vector) -> tuple[float, float, float]:
    x, y, z = values.tolist()
    return x, y, z
