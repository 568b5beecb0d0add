"""Where a looker-on begins, and the cameras there are to jump to."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..cameras.cameras_json import NamedCamera
from ..splats.fields import Array

Vector = NDArray[np.float64]

_FOV = math.radians(60.0)
_UP = np.array([0.0, -1.0, 0.0])  # 3DGS worlds come from cameras, whose y axis points down
_AWAY = np.array([0.0, -0.7, -2.4])  # radii of the splats
_FRUSTUM = 0.06  # of the cameras' spread


@dataclass(frozen=True)
class Start:
    """A first view.

    Attributes
    ----------
    position, look_at, up : in the world of the splats. fov : vertical [radians].
    """

    position: Vector
    look_at: Vector
    up: Vector
    fov: float


@dataclass(frozen=True)
class Known:
    """Cameras of a scene, by name, in file order.

    Attributes
    ----------
    train, test : the cameras; () where none are known.
    """

    train: tuple[NamedCamera, ...] = ()
    test: tuple[NamedCamera, ...] = ()

    @property
    def by_label(self) -> dict[str, Camera]:
        """All of them under labels that differ, training cameras first."""
        return {
            f"{kind} {number}: {item.name}": item.camera
            for kind, items in (("train", self.train), ("test", self.test))
            for number, item in enumerate(items)
        }

    @property
    def size(self) -> float:
        """Of a frustum [world units]: small against the space between the cameras."""
        places = np.array([item.camera.position for item in (*self.train, *self.test)])
        spread = float(np.median(np.linalg.norm(places - np.median(places, axis=0), axis=1))) if len(places) else 0.0
        return _FRUSTUM * (spread or 1.0)


def start_of(means: Array, cameras: Sequence[Camera]) -> Start:
    """The first camera's view, with the up that all agree on; without cameras from where nearly all splats are seen.

    Parameters
    ----------
    means : (N, 3) centres of the splats, or the points that they will start from.
    """
    if cameras:
        first = cameras[0]
        mean = -np.mean([camera.rotation[1] for camera in cameras], axis=0)
        length = float(np.linalg.norm(mean))
        up = mean / length if length > 1e-3 else -first.rotation[1]
        return Start(first.position, first.position + _distance(means, first) * first.rotation[2], up, fov_of(first))
    middle, radius = np.zeros(3), 1.0
    if len(means):
        middle = np.median(means, axis=0).astype(np.float64)
        radius = float(np.quantile(np.linalg.norm(means - middle, axis=1), 0.9)) or 1.0
    return Start(middle + _AWAY * radius, middle, _UP, _FOV)


def fov_of(camera: Camera, aspect: float | None = None) -> float:
    """Vertical field of view [radians] that shows the camera's whole image in a window of `aspect` (width / height)."""
    tall, wide = 0.5 * camera.height / camera.fy, 0.5 * camera.width / camera.fx
    return 2.0 * math.atan(tall if aspect is None else max(tall, wide / aspect))


def _distance(means: Array, camera: Camera) -> float:
    """Median depth of what the camera sees; 1 where it sees nothing."""
    x, y, z = (means.astype(np.float64).reshape(-1, 3) @ camera.rotation.T + camera.translation).T
    wide, tall = 0.5 * camera.width / camera.fx, 0.5 * camera.height / camera.fy
    inside = (z > 1e-3) & (np.abs(x) < wide * z) & (np.abs(y) < tall * z)
    return float(np.median(z[inside])) if inside.any() else 1.0
