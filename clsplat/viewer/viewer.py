"""Frames for viewer clients, one at a time, the latest request of each first.

The resolution is low while a camera moves and full when it rests. This module is independent of the web server: a
client is a number and a function that receives frames.
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..errors import ClsplatError
from ..rendering.colormaps import Picture, to_bytes
from .camera import AdaptiveResolution, Pose, camera_of, window_of
from .render_queue import RenderQueue
from .settings import Settings
from .source import Source

REST = 0.15  # seconds without a move after which a camera counts as still
_ROUNDING = 1e-3  # seconds; the frame at rest must not come just before the rest begins
FRAME_TIME = 1.0 / 16.0  # seconds for a frame of a moving camera


@dataclass(frozen=True)
class ViewerImage:
    """A frame for one client.

    Attributes
    ----------
    still : whether the camera rests, so that the frame has full size. seconds : time that the frame took.
    message : the fault if the frame could not be rendered, or "".
    near_far : depths at the two ends of the colours, None if the picture does not show depth.
    """

    picture: Picture
    still: bool
    seconds: float
    message: str = ""
    near_far: tuple[float, float] | None = None


@dataclass
class ViewerClient:
    """State of one client."""

    send: Callable[[ViewerImage], None]
    settings: Settings
    pose: Pose | None = None
    moved: float = -math.inf
    resolution: AdaptiveResolution = field(default_factory=lambda: AdaptiveResolution(FRAME_TIME))
    order: tuple[int, Callable[[ViewerImage], None]] | None = None  # size and receiver of a picture to save


class Viewer:
    """All clients of one source.

    Parameters
    ----------
    settings : settings of new clients. seconds : time allowed for a frame of a moving camera.
    """

    def __init__(
        self,
        source: Source,
        settings: Settings | None = None,
        seconds: float = FRAME_TIME,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.source = source
        self.settings = settings or Settings()
        self.seconds = seconds
        self.queue = RenderQueue(clock)
        self._clock = clock
        self._clients: dict[int, ViewerClient] = {}
        self._lock = threading.Lock()

    def join(self, client_id: int, send: Callable[[ViewerImage], None]) -> None:
        """Add a client. The serving thread calls `send` with each frame."""
        with self._lock:
            self._clients[client_id] = ViewerClient(send, self.settings, resolution=AdaptiveResolution(self.seconds))

    def leave(self, client_id: int) -> None:
        """Remove a client and its request."""
        with self._lock:
            self._clients.pop(client_id, None)
        self.queue.cancel(client_id)

    def move(self, client_id: int, pose: Pose) -> None:
        """Move the camera of a client."""
        self._change(client_id, lambda _: {"pose": pose})

    def choose(self, client_id: int, name: str, value: Any) -> None:
        """Change a setting of a client; unusable values change nothing."""
        self._change(client_id, lambda client: {"settings": client.settings.changed(name, value, self.source.modes)})

    def order_picture(self, client_id: int, size: int, receive: Callable[[ViewerImage], None]) -> None:
        """Render a client's view once with a longest side of `size` px. The serving thread calls `receive` with it."""
        client = self._clients.get(client_id)
        if client is not None:
            client.order = size, receive
            self.queue.request(client_id)

    def set_frame_time(self, seconds: float) -> None:
        """Set the time allowed for a frame of a moving camera."""
        with self._lock:
            self.seconds = seconds
            for client in self._clients.values():
                client.resolution.seconds = seconds

    def refresh(self) -> None:
        """Request a new frame for all clients, because the source has changed."""
        for client_id in list(self._clients):
            self.queue.request(client_id)

    def settings_of(self, client_id: int) -> Settings:
        """Return the settings of a client."""
        client = self._clients.get(client_id)
        return client.settings if client else self.settings

    @property
    def count(self) -> int:
        """Number of clients."""
        return len(self._clients)

    @property
    def moving(self) -> int:
        """Number of clients whose cameras move."""
        now = self._clock()
        return sum(now - client.moved < REST for client in list(self._clients.values()))

    def serve(self, timeout: float = 0.0) -> bool:
        """Render and send one frame; return False if no request came within `timeout` seconds."""
        client_id = self.queue.next_client(timeout)
        client = None if client_id is None else self._clients.get(client_id)
        if client_id is None or client is None or client.pose is None:
            return False
        pose, settings = client.pose, client.settings
        start = self._clock()
        order, client.order = client.order, None
        if order is not None:
            order[1](self._render(pose, settings, order[0], True, start, enlarge=True))
            start = self._clock()
        resting = start - client.moved
        still = resting >= REST
        size = settings.size if still else max(round(client.resolution.scale * max(window_of(pose, settings.size))), 1)
        frame = self._render(pose, settings, size, still, start)
        try:
            client.send(frame)
        except Exception:  # a closed connection may raise anything
            self.leave(client_id)
            return True
        if not still:
            client.resolution.update((self._clock() - start) * max(self.moving, 1))
            self.queue.request(client_id, max(client.moved + REST + _ROUNDING - self._clock(), 0.0))
        return True

    def run(self) -> None:
        """Serve until `close`, in a thread of its own."""
        while not self.queue.closed:
            self.serve(1.0)

    def close(self) -> None:
        """Stop serving."""
        self.queue.close()

    def _change(self, client_id: int, values: Callable[[ViewerClient], dict[str, Any]]) -> None:
        """Change attributes of a client. Two changes that arrive together are both made."""
        with self._lock:
            client = self._clients.get(client_id)
            if client is None:
                return
            for name, value in values(client).items():
                setattr(client, name, value)
            client.moved = self._clock()
        self.queue.request(client_id)

    def _render(
        self, pose: Pose, settings: Settings, size: int, still: bool, start: float, enlarge: bool = False
    ) -> ViewerImage:
        """Render a frame; return a blank one with a message if that fails."""
        message = ""
        try:
            camera = camera_of(pose, size, enlarge)
            if camera is not None:
                view = self.source.view(camera, settings)
                return ViewerImage(view.picture, still, self._clock() - start, near_far=view.near_far)
        except ClsplatError as error:
            message = str(error)
        except Exception as error:  # such as a fault of the driver; the server must go on
            message = f"no picture: {type(error).__name__}: {error}".split("\n")[0]
        return ViewerImage(blank(pose, size, settings), still, self._clock() - start, message)


def blank(pose: Pose, size: int, settings: Settings) -> Picture:
    """Return a picture of the background."""
    width, height = window_of(pose, size)
    return to_bytes(np.broadcast_to(np.asarray(settings.background), (height, width, 3)))
