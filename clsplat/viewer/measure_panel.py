"""The part of the panel that measures the distance of two points of the model."""

from __future__ import annotations

import math
import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import viser

from ..splats.fields import DoubleArray
from .settings import Settings
from .source import Source

_COLOUR = (90, 220, 120)
_DOT = 0.006  # radius of a point, as a share of its distance to the camera
_DIGITS = 6  # decimals of a real length
_IDLE = "Measure a distance"
_STARTED = "click the first of two points"


class MeasurePanel:
    """A button, after which two clicks choose points, and fields for the distance.

    Parameters
    ----------
    source : returns what is shown. settings : returns how it is shown. say : shows a text.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        source: Callable[[], Source],
        settings: Callable[[], Settings],
        say: Callable[[str], None],
    ) -> None:
        self._client, self._source, self._settings, self._say = client, source, settings, say
        self._lock = threading.Lock()  # messages of a browser come in several threads
        self._points: list[DoubleArray] = []
        self._drawn: list[Any] = []
        self._distance, self._unit = 0.0, 1.0
        gui = client.gui
        self._group = gui.add_folder("Measure", expand_by_default=False, visible=source().splats is not None)
        with self._group:
            self._button = gui.add_button(_IDLE, icon=viser.Icon.RULER_MEASURE, hint="Click two points of the model")
            self._button.on_click(lambda _: self._begin())
            self._text = gui.add_markdown("")
            self._real: Any = gui.add_number(
                "Real length", 0.0, min=0.0, step=0.001, hint="Of this distance. It sets the scale of all others"
            )
            self._real.precision = _DIGITS
            self._real.on_update(lambda _: self._calibrate())

    def model_changed(self) -> None:
        """Show this part of the panel once there is a model."""
        self._group.visible = self._source().splats is not None

    def _begin(self) -> None:
        with self._lock:
            self._points.clear()
            for item in self._drawn:
                item.remove()
            self._drawn.clear()
        self._client.scene.remove_click_callback()  # of a button that was pressed twice
        self._client.scene.on_click()(self._clicked)
        self._say(_STARTED)

    def _clicked(self, event: viser.SceneClickEvent) -> None:
        eye = np.asarray(event.ray_origin, np.float64)
        ahead = np.asarray(event.ray_direction, np.float64)
        point = self._source().surface(eye, ahead, self._settings(), event.screen_pos[0])
        if point is None:
            self._say("there is nothing to measure: click a point of the model")
            return
        with self._lock:
            if len(self._points) >= 2 or any((point == other).all() for other in self._points):
                return
            self._points.append(point)
            ended = len(self._points) == 2
            self._draw(float(np.linalg.norm(point - eye)))
        if ended:
            self._client.scene.remove_click_callback()
            self._distance = float(np.linalg.norm(self._points[1] - self._points[0]))
            self._show()
        else:
            self._say("click the second point")

    def _draw(self, far: float) -> None:
        """Draw the latest point, and the line between both."""
        scene, points = self._client.scene, self._points
        self._drawn.append(
            scene.add_icosphere(
                f"/measure/{len(points)}", radius=_DOT * far, color=_COLOUR, position=tuple(points[-1].tolist())
            )
        )
        if len(points) == 2:
            line = np.array([points], np.float32)
            self._drawn.append(
                scene.add_line_segments("/measure/line", line, _COLOUR, thickness=2.0, thickness_units="screen")
            )

    def _calibrate(self) -> None:
        """Take the real length of the distance as the scale."""
        length = self._real.value
        if self._distance > 0.0 and isinstance(length, (int, float)) and math.isfinite(length) and length > 0.0:
            self._unit = length / self._distance
            self._show()

    def _show(self) -> None:
        text = f"{self._distance:.4g} units of the model"
        if self._unit != 1.0:
            text += f", {self._unit * self._distance:.4g} in real"
        self._text.content = text
        self._say(f"distance: {text}")
