"""The first view of a client, and the cameras of the scene."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..cameras.camera import Camera
from ..cameras.cameras_json import NamedCamera
from ..files.file_names import printable
from ..splats.fields import Array

Vector = NDArray[np.float64]

_FOV = math.radians(60.0)
UP = np.array([0.0, -1.0, 0.0])  # the y axis of a 3DGS world points down, as that of a camera
_AWAY = np.array([0.0, -0.7, -2.4])  # camera position in radii of the model
_FRUSTUM = 0.06  # size of a drawn camera as a share of the spread of all cameras


@dataclass(frozen=True)
class InitialView:
    """The view with which a client begins.

    Attributes
    ----------
    position, look_at, up : in the world of the splats. fov : vertical field of view [radians].
    """

    position: Vector
    look_at: Vector
    up: Vector
    fov: float


@dataclass(frozen=True)
class SceneCameras:
    """Cameras of a scene in file order.

    Attributes
    ----------
    train, test : training and test cameras; () if they are unknown.
    """

    train: tuple[NamedCamera, ...] = ()
    test: tuple[NamedCamera, ...] = ()

    @property
    def by_label(self) -> dict[str, Camera]:
        """All cameras by unique labels, training cameras first."""
        return {
            f"{kind} {number}: {printable(item.name)}": item.camera
            for kind, items in (("train", self.train), ("test", self.test))
            for number, item in enumerate(items)
        }

    @property
    def size(self) -> float:
        """Size of a drawn camera [world units], small compared with the distances between cameras."""
        places = np.array([item.camera.position for item in (*self.train, *self.test)])
        spread = float(np.median(np.linalg.norm(places - np.median(places, axis=0), axis=1))) if len(places) else 0.0
        return _FRUSTUM * (spread or 1.0)


def initial_view(means: Array, cameras: Sequence[Camera]) -> InitialView:
    """Return the view of the first camera, upright on average; without cameras a view of nearly all splats.

    Parameters
    ----------
    means : (N, 3) centres of the splats, or the points of the scene.
    """
    if cameras:
        first = cameras[0]
        mean = -np.mean([camera.rotation[1] for camera in cameras], axis=0)
        length = float(np.linalg.norm(mean))
        up = mean / length if length > 1e-3 else -first.rotation[1]
        return InitialView(
            first.position, first.position + _distance(means, first) * first.rotation[2], up, vertical_fov(first)
        )
    middle, radius = np.zeros(3), 1.0
    if len(means):
        wide = means.astype(np.float64)  # sums and squares of float32 may overflow
        middle = np.median(wide, axis=0)
        radius = float(np.quantile(np.linalg.norm(wide - middle, axis=1), 0.9)) or 1.0
    return InitialView(middle + _AWAY * radius, middle, UP, _FOV)


def vertical_fov(camera: Camera, aspect: float | None = None) -> float:
    """Return the vertical field of view [radians] to show a whole image in a window of `aspect` (width / height)."""
    tall, wide = 0.5 * camera.height / camera.fy, 0.5 * camera.width / camera.fx
    return 2.0 * math.atan(tall if aspect is None else max(tall, wide / aspect))


def _distance(means: Array, camera: Camera) -> float:
    """Return the median depth of the points in view; 1 if there are none."""
    x, y, z = (means.astype(np.float64).reshape(-1, 3) @ camera.rotation.T + camera.translation).T
    wide, tall = 0.5 * camera.width / camera.fx, 0.5 * camera.height / camera.fy
    inside = (z > 1e-3) & (np.abs(x) < wide * z) & (np.abs(y) < tall * z)
    return float(np.median(z[inside])) if inside.any() else 1.0
