"""The demo scene: photos, exact poses and a point cloud of a small world, for trials without a data set.

The world (world.py) contains what is difficult for splats: hard edges, thin poles, a panel with two different sides,
cast shadows, and a glossy ball.
"""

from __future__ import annotations

import os
from dataclasses import fields
from pathlib import Path

import numpy as np

from ...cameras.camera import Camera
from ...errors import InputError, OutputError
from ...files.images import write_png
from ..colmap_binary import ModelView, write_binary_model
from .capture import cast, photograph, pixels, project, rays_through, upright_camera, visible
from .rays import Hits
from .world import SURFACES, World

RING_RADIUS = 3.6  # radius of the rings of cameras [world units]
_HEIGHTS = (0.75, 1.9)  # heights of the lower and the upper ring
RING_TARGET = np.array([0.0, 0.0, 0.5])
_FOCAL = 0.9  # focal length over the image width: 58 degrees wide

_N_POINTS = 3000
_MIN_OBSERVATIONS = 3  # smallest number of views that see a point
# Share of the point cloud on each surface; thin and small surfaces get more than their share of the area.
_SHARES = {"ground": 0.36, "dome": 0.16, "box": 0.16, "ball": 0.08, "panel": 0.12, "poles": 0.12}


def write_capture(
    folder: str | os.PathLike[str], width: int = 200, height: int = 150, n_views: int = 40, seed: int = 0
) -> Path:
    """Render the small world from two rings of cameras and write it as a COLMAP scene.

    Parameters
    ----------
    folder : folder for images/*.png and sparse/0/*.bin; created if it does not exist, and empty otherwise.
    width, height : image size [px].
    n_views : number of photos, half of them on the lower ring.
    seed : seed of the world's details and of the choice of points. Equal arguments give equal files.

    Returns
    -------
    The folder, for `load_scene`.

    Raises
    ------
    InputError : images are smaller than 16 px, or there are fewer than 4 views.
    OutputError : the folder is not empty, or cannot be written.
    """
    if width < 16 or height < 16 or n_views < 4:
        raise InputError(f"capture: {width}x{height} px, {n_views} views; needs at least 16x16 px and 4 views")
    root = Path(folder)
    if root.exists() and (not root.is_dir() or any(root.iterdir())):
        raise OutputError(f"{root}: exists and is not an empty folder; name another folder")
    world, cameras = World(seed), ring_cameras(width, height, n_views)
    for index, camera in enumerate(cameras):
        write_png(root / "images" / _name(index), photograph(world, camera))
    points = _surface_points(world, cameras, np.random.default_rng(seed))
    seen = np.stack([visible(world, camera, points.position, points.normal) for camera in cameras])
    kept = seen.sum(axis=0) >= _MIN_OBSERVATIONS
    xyz, seen = points.position[kept].astype(np.float64), seen[:, kept]
    rgb = np.rint(255 * points.color[kept]).astype(np.uint8)
    views = [
        ModelView(
            _name(index),
            (width, height),
            (camera.fx, camera.fy, camera.cx, camera.cy),
            camera.cam_from_world,
            project(camera, xyz[of_view])[0],
            np.flatnonzero(of_view),
        )
        for index, (camera, of_view) in enumerate(zip(cameras, seen, strict=True))
    ]
    write_binary_model(root / "sparse" / "0", views, xyz, rgb)
    return root


def ring_cameras(width: int, height: int, n_views: int) -> list[Camera]:
    """Return cameras that look at the world's middle: a lower ring, then an upper ring between its gaps."""
    low = n_views // 2
    cameras = []
    for index in range(n_views):
        ring, place, count = (0, index, low) if index < low else (1, index - low + 0.5, n_views - low)
        angle = 2 * np.pi * place / count
        position = np.array([RING_RADIUS * np.cos(angle), RING_RADIUS * np.sin(angle), _HEIGHTS[ring]])
        cameras.append(upright_camera(width, height, _FOCAL * width, position, RING_TARGET))
    return cameras


def _name(index: int) -> str:
    return f"view_{index:03d}.png"


def _surface_points(world: World, cameras: list[Camera], rng: np.random.Generator) -> Hits:
    """Return surface points at random pixels of every view, with the share of each surface."""
    chosen: list[Hits] = []
    for camera in cameras:
        places = pixels(camera) + rng.random((camera.width * camera.height, 2))
        surface = world.distances(*rays_through(camera, places)).argmin(axis=0)
        counts = [max(1, round(_N_POINTS * _SHARES[name] / len(cameras))) for name in SURFACES]
        picks = [rng.permutation(np.flatnonzero(surface == index))[:count] for index, count in enumerate(counts)]
        chosen.append(cast(world, camera, places[np.concatenate(picks)]))
    return Hits(*(np.concatenate([getattr(hits, part.name) for hits in chosen]) for part in fields(Hits)))
