"""Two models in one picture: the first to the left of a divider, the second to the right of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import TypeVar

import numpy as np

from ..cameras.camera import Camera
from ..rendering.colormaps import MODES, Picture
from ..rendering.renderer import Rendered
from ..splats.fields import DoubleArray
from ..splats.splats import Splats
from .settings import Settings
from .source import ModelSource, ViewPicture, depth_view

T = TypeVar("T")

_LINE = (255, 255, 255)  # colour of the divider


class ComparedSource:
    """Two models on the device. What a client does with the model, such as a download, is done with the first.

    Parameters
    ----------
    sides : names of the two models.
    """

    modes = MODES
    partial = True

    def __init__(self, first: ModelSource, second: ModelSource, sides: tuple[str, str]) -> None:
        self._both, self.sides = (first, second), sides

    @property
    def splats(self) -> Splats:
        return self._both[0].splats

    @property
    def n_splats(self) -> int:
        return max(source.n_splats for source in self._both)

    @property
    def sh_degree(self) -> int:
        return max(source.sh_degree for source in self._both)

    def view(self, camera: Camera, settings: Settings) -> ViewPicture:
        """Return the view of a camera with the divider at the share `settings.divider` of its width."""
        if settings.mode == "depth":  # one range of depths for both
            images = self._parts(camera, settings, lambda source, part: source.rendered(part, settings))
            joined = Rendered(
                *(
                    np.concatenate([getattr(image, name) for image in images], axis=1)
                    for name in ("color", "alpha", "depth")
                )
            )
            view = depth_view(joined, settings)
            return ViewPicture(self._divided(view.picture, camera, settings), view.near_far)
        pictures = self._parts(camera, settings, lambda source, part: source.picture(part, settings))
        return ViewPicture(self._divided(np.concatenate(pictures, axis=1), camera, settings))

    def surface(
        self, origin: DoubleArray, direction: DoubleArray, settings: Settings, across: float = 0.0
    ) -> DoubleArray | None:
        """Return where a ray meets the model on its side of the divider, as `ModelSource.surface`."""
        return self._both[across >= settings.divider].surface(origin, direction, settings)

    def _parts(self, camera: Camera, settings: Settings, render: Callable[[ModelSource, Camera], T]) -> list[T]:
        """Return what both models show on their sides; a side without pixels is left out."""
        at = _column(camera, settings)
        pieces = ((self._both[0], 0, at), (self._both[1], at, camera.width))
        return [render(source, _piece(camera, start, end)) for source, start, end in pieces if end > start]

    def _divided(self, picture: Picture, camera: Camera, settings: Settings) -> Picture:
        at = _column(camera, settings)
        if 0 < at < camera.width:
            picture = picture.copy()
            picture[:, at] = _LINE
        return picture


def _column(camera: Camera, settings: Settings) -> int:
    return round(settings.divider * camera.width)


def _piece(camera: Camera, start: int, end: int) -> Camera:
    """Return the camera of the columns from `start` to `end` of an image."""
    return Camera(end - start, camera.height, camera.fx, camera.fy, camera.cx - start, camera.cy, camera.cam_from_world)
