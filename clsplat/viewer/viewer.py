"""Pictures for looker-ons: one at a time, the newest wish of each, small while the camera moves and full when still.

Nothing here knows browsers: who looks on is a number and a function that takes pictures.
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
from .camera import Pace, Pose, camera_of, window_of
from .render_queue import Wishes
from .settings import Settings
from .source import Source

REST = 0.15  # seconds without a move after which a camera is still
_ROUNDING = 1e-3  # seconds, so that a picture that waits for rest finds it
SECONDS = 1.0 / 16.0  # that a picture of a moving camera may take: leaves a margin to 10 a second


@dataclass(frozen=True)
class ViewerImage:
    """A picture made for a looker-on.

    Attributes
    ----------
    still : full size, as nothing moved. seconds : that making it took. message : what went wrong, or "".
    """

    picture: Picture
    still: bool
    seconds: float
    message: str = ""


@dataclass
class Looker:
    """One who looks on."""

    send: Callable[[ViewerImage], None]
    settings: Settings
    pose: Pose | None = None
    moved: float = -math.inf
    pace: Pace = field(default_factory=lambda: Pace(SECONDS))


class Viewer:
    """All who look on at one source.

    Parameters
    ----------
    settings : of those who have chosen nothing yet. seconds : that a picture of a moving camera may take.
    """

    def __init__(
        self,
        source: Source,
        settings: Settings | None = None,
        seconds: float = SECONDS,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.source = source
        self.settings = settings or Settings()
        self.seconds = seconds
        self.wishes = Wishes(clock)
        self._clock = clock
        self._lookers: dict[int, Looker] = {}
        self._lock = threading.Lock()

    def join(self, who: int, send: Callable[[ViewerImage], None]) -> None:
        """Somebody looks on from now; `send` is called by the thread that serves."""
        with self._lock:
            self._lookers[who] = Looker(send, self.settings, pace=Pace(self.seconds))

    def leave(self, who: int) -> None:
        """Somebody has gone; nothing is sent any more."""
        with self._lock:
            self._lookers.pop(who, None)
        self.wishes.drop(who)

    def move(self, who: int, pose: Pose) -> None:
        """A camera is elsewhere."""
        self._change(who, pose=pose)

    def choose(self, who: int, name: str, value: Any) -> None:
        """A setting is wanted otherwise; unusable values change nothing."""
        looker = self._lookers.get(who)
        if looker is not None:
            self._change(who, settings=looker.settings.changed(name, value, self.source.modes))

    def hurry(self, seconds: float) -> None:
        """Pictures of moving cameras may take this long from now on."""
        with self._lock:
            self.seconds = seconds
            for looker in self._lookers.values():
                looker.pace.seconds = seconds

    def refresh(self) -> None:
        """What is looked at has changed: all get a new picture."""
        for who in list(self._lookers):
            self.wishes.ask(who)

    def settings_of(self, who: int) -> Settings:
        """What somebody has chosen."""
        looker = self._lookers.get(who)
        return looker.settings if looker else self.settings

    @property
    def count(self) -> int:
        """How many look on."""
        return len(self._lookers)

    def serve(self, timeout: float = 0.0) -> bool:
        """Make and send one picture; False when none was wanted within `timeout` seconds."""
        who = self.wishes.take(timeout)
        looker = None if who is None else self._lookers.get(who)
        if who is None or looker is None or looker.pose is None:
            return False
        pose, settings = looker.pose, looker.settings
        start = self._clock()
        resting = start - looker.moved
        still = resting >= REST
        size = settings.size if still else max(round(looker.pace.scale * max(window_of(pose, settings.size))), 1)
        shot = self._shot(pose, settings, size, still, start)
        try:
            looker.send(shot)
        except Exception:  # whatever a connection that has gone may raise
            self.leave(who)
            return True
        if not still:
            looker.pace.took((self._clock() - start) * self._moving(start))
            self.wishes.ask(who, max(looker.moved + REST + _ROUNDING - self._clock(), 0.0))
        return True

    def run(self) -> None:
        """Serve until `close`; for a thread of its own."""
        while not self.wishes.closed:
            self.serve(1.0)

    def close(self) -> None:
        """Make no more pictures."""
        self.wishes.close()

    def _change(self, who: int, **values: Any) -> None:
        with self._lock:
            looker = self._lookers.get(who)
            if looker is None:
                return
            for name, value in values.items():
                setattr(looker, name, value)
            looker.moved = self._clock()
        self.wishes.ask(who)

    def _moving(self, now: float) -> int:
        """How many cameras move: they share the time."""
        return max(sum(now - looker.moved < REST for looker in list(self._lookers.values())), 1)

    def _shot(self, pose: Pose, settings: Settings, size: int, still: bool, start: float) -> ViewerImage:
        """A picture, whatever comes; blank where there is nothing to see from the pose."""
        message = ""
        try:
            camera = camera_of(pose, size)
            if camera is not None:
                return ViewerImage(self.source.picture(camera, settings), still, self._clock() - start)
        except ClsplatError as error:
            message = str(error)
        except Exception as error:  # a driver's, for one: the server goes on
            message = f"no picture: {type(error).__name__}: {error}".split("\n")[0]
        return ViewerImage(blank(pose, size, settings), still, self._clock() - start, message)


def blank(pose: Pose, size: int, settings: Settings) -> Picture:
    """A picture of the background alone."""
    width, height = window_of(pose, size)
    return to_bytes(np.broadcast_to(np.asarray(settings.background), (height, width, 3)))
