"""The large demo scene: photos of the street with their poses, and points on everything that they show.

A walk along the street stops at equal distances. At each stop there are photos of both sides, and of both sides ahead
and behind. Every other stop is above the heads of people. Points come from random pixels of all photos.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np

from ... import activity
from ...cameras.camera import Camera
from ...errors import InputError, OutputError
from ...files.images import write_png
from ..colmap import Points
from ..export import write_transforms
from ..undistort import RegisteredImage, make_lens
from .capture import cast, photograph, pixels, upright_camera
from .rays import Hits
from .street import Street

POINTS_OF_VIEW = 2_000_000 / 600  # points that each photo of the large demo gives
_FOCAL = 0.6  # focal length over the image width: 80 degrees wide
_TURNS = (90.0, -90.0, 40.0, -40.0, 140.0, -140.0)  # directions of a stop's photos from the street's [degrees]
_HEIGHTS, _TILTS = (1.8, 7.0), (6.0, -12.0)  # of low and high stops [m], [degrees]
_BESIDE = 1.6  # distance of the walk from the middle of the street, left and right in turn [m]
_MARGIN = 8.0  # distance of the first and last stop from the street's ends [m]


def write_street(
    folder: str | os.PathLike[str],
    width: int = 320,
    height: int = 240,
    n_views: int = 60,
    n_points: int = 20_000,
    lots: int = 14,
    seed: int = 0,
) -> Path:
    """Render a street of houses and write it as a scene: photos, transforms.json and a PLY file of points.

    Parameters
    ----------
    folder : folder for images/*.png, transforms.json and the points; created if it does not exist, and empty otherwise.
    width, height : image size [px].
    n_views, n_points : number of photos and points. lots : houses on each side of the street.
    seed : seed of the street and of the choice of points. Equal arguments give equal files.

    Returns
    -------
    The folder, for `load_scene`.

    Raises
    ------
    InputError : images are smaller than 16 px, or there are fewer than 12 views, or no points.
    OutputError : the folder is not empty, or cannot be written.
    """
    if width < 16 or height < 16 or n_views < 2 * len(_TURNS) or n_points < 1:
        raise InputError(
            f"street: {width}x{height} px, {n_views} views, {n_points} points; needs at least 16x16 px, "
            f"{2 * len(_TURNS)} views and a point"
        )
    root = Path(folder)
    if root.exists() and (not root.is_dir() or any(root.iterdir())):
        raise OutputError(f"{root}: exists and is not an empty folder; name another folder")
    world = Street(lots, seed)
    cameras = street_cameras(world, width, height, n_views)
    ends = np.linspace(0, n_points, n_views + 1).round().astype(int)

    def shoot(index: int) -> Hits:
        write_png(root / "images" / _name(index), photograph(world, cameras[index]))
        return _seen_points(world, cameras[index], int(np.diff(ends)[index]), np.random.default_rng([seed, index]))

    seen = []
    with ThreadPoolExecutor(os.cpu_count()) as pool:  # NumPy computes outside of Python's lock
        for index, hits in enumerate(pool.map(shoot, range(n_views)), 1):
            activity.report(f"photo {index} of {n_views}")
            seen.append(hits)
    order = np.random.default_rng(seed).permutation(n_points)
    xyz = np.concatenate([hits.position for hits in seen]).astype(np.float64)[order]
    rgb = np.concatenate([np.rint(255 * hits.color).astype(np.uint8) for hits in seen])[order]
    lens = make_lens("PINHOLE", width, height, [_FOCAL * width, _FOCAL * width, width / 2, height / 2])
    photos = [RegisteredImage(_name(index), camera.cam_from_world, lens) for index, camera in enumerate(cameras)]
    points = Points(xyz, rgb, np.ones(n_points, np.int64))
    write_transforms(root / "transforms.json", photos, [f"images/{photo.name}" for photo in photos], points)
    return root


def street_cameras(street: Street, width: int, height: int, n_views: int) -> list[Camera]:
    """Return the cameras of a walk along a street, in the order of the walk."""
    stops = -(-n_views // len(_TURNS))
    places = np.linspace(_MARGIN - 0.5 * street.length, 0.5 * street.length - _MARGIN, stops)
    cameras = []
    for index in range(n_views):
        stop, high = index // len(_TURNS), index // len(_TURNS) % 2
        turn, tilt = np.radians(_TURNS[index % len(_TURNS)]), np.radians(_TILTS[high])
        forward = np.array([np.cos(turn) * np.cos(tilt), np.sin(turn) * np.cos(tilt), np.sin(tilt)])
        position = np.array([places[stop], _BESIDE * (1 if stop // 2 % 2 else -1), _HEIGHTS[high]])
        cameras.append(upright_camera(width, height, _FOCAL * width, position, position + forward))
    return cameras


def _seen_points(world: Street, camera: Camera, count: int, rng: np.random.Generator) -> Hits:
    """Return what the camera sees at random places of its image."""
    corners = pixels(camera)
    return cast(world, camera, corners[rng.integers(len(corners), size=count)] + rng.random((count, 2)))


def _name(index: int) -> str:
    return f"view_{index:04d}.png"
