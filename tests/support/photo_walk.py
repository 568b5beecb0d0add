"""Photos of a textured corner with known poses. They are so small that structure from motion takes seconds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

WIDTH, HEIGHT, FOCAL = 240, 180, 230.0
FISHEYE_FOCAL = 170.0
N_PHOTOS = 8


def names(count: int = N_PHOTOS) -> list[str]:
    return [f"walk_{index:02}.png" for index in range(count)]


def cam_from_world(index: int, count: int = N_PHOTOS) -> NDArray[np.float64]:
    """Return the (4, 4) pose of a photo on an arc around the corner, at varying heights."""
    angle = np.radians(-24 + 48 * index / (count - 1))
    centre = np.array([3.2 * np.sin(angle), 0.25 * np.sin(2.1 * index), -3.2 * np.cos(angle)])
    forward = np.array([0.0, 0.0, 0.3]) - centre
    forward /= np.linalg.norm(forward)
    right = np.cross([0.0, 1.0, 0.0], forward)
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = rotation, -rotation @ centre
    return pose


def picture(index: int, count: int = N_PHOTOS, fisheye: bool = False) -> NDArray[np.uint8]:
    """Return a photo, (H, W, 3), of two walls that meet at right angles behind the origin.

    fisheye : whether the lens is an equidistant fisheye.
    """
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    focal = FISHEYE_FOCAL if fisheye else FOCAL
    across, down = (x - WIDTH / 2) / focal, (y - HEIGHT / 2) / focal
    if fisheye:
        angle = np.hypot(across, down)
        across, down = across * np.tan(angle) / angle, down * np.tan(angle) / angle
    rays = np.stack([across, down, np.ones_like(x)], axis=2)
    pose = cam_from_world(index, count)
    centre, directions = -pose[:3, :3].T @ pose[:3, 3], rays @ pose[:3, :3]
    image, nearest = np.zeros(x.shape), np.full(x.shape, np.inf)
    for side in (-1.0, 1.0):
        normal = np.array([side, 0.0, -1.0]) / np.sqrt(2)  # the wall that contains (0, 0, 1)
        with np.errstate(divide="ignore"):
            depth = (normal @ (np.array([0.0, 0.0, 1.0]) - centre)) / (directions @ normal)
        hit = (depth > 0) & (depth < nearest)
        at = centre + depth[..., None] * directions
        along = side * (at[..., 0] * np.sqrt(2))
        hit &= along > 0
        image = np.where(hit, _texture(along + (17.0 if side > 0 else 0.0), at[..., 1]), image)
        nearest = np.where(hit, depth, nearest)
    return np.repeat(np.rint(255 * image).astype(np.uint8)[:, :, None], 3, axis=2)


def write_walk(folder: Path, count: int = N_PHOTOS, fisheye: bool = False) -> Path:
    """Write all photos as PNG files and return their folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for index, name in enumerate(names(count)):
        Image.fromarray(picture(index, count, fisheye)).save(folder / name)
    return folder


def _texture(u: NDArray[np.float64], v: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return smooth noise in 0..1, at three scales."""
    rng = np.random.default_rng(3)
    total = np.zeros(u.shape)
    for cells, weight in ((2.5, 0.3), (6.0, 0.4), (13.0, 0.3)):
        table = rng.uniform(size=(256, 256))
        x, y = np.nan_to_num(u) * cells, np.nan_to_num(v) * cells
        column, row = np.floor(x).astype(int), np.floor(y).astype(int)
        s, t = x - column, y - row
        corner = [[table[(row + j) % 256, (column + i) % 256] for i in (0, 1)] for j in (0, 1)]
        total += weight * (
            (corner[0][0] * (1 - s) + corner[0][1] * s) * (1 - t) + (corner[1][0] * (1 - s) + corner[1][1] * s) * t
        )
    return total
