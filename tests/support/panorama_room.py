"""Panoramas in a box with textured walls, computed ray by ray."""

from __future__ import annotations

import numpy as np
from PIL import Image
from scipy.ndimage import map_coordinates
from scipy.spatial.transform import Rotation

HALF = np.array([3.0, 1.5, 2.5])  # half of the room's sizes
_TEXELS = 512


def rays(height: int) -> np.ndarray:
    """Directions (H, 2 H, 3) of the pixels of a panorama: x right, y down, z in the middle."""
    v, u = np.mgrid[:height, : 2 * height]
    longitude = ((u + 0.5) / (2 * height) - 0.5) * 2 * np.pi
    latitude = (0.5 - (v + 0.5) / height) * np.pi
    return np.stack(
        [np.cos(latitude) * np.sin(longitude), -np.sin(latitude), np.cos(latitude) * np.cos(longitude)], axis=2
    )


def walls(seed: int = 3) -> np.ndarray:
    """Textures (6, T, T, 3) with details of all sizes, 0..1."""
    rng = np.random.default_rng(seed)
    found = np.zeros((6, _TEXELS, _TEXELS, 3))
    for wall in found:
        for cells in (8, 32, 128, 512):
            noise = (255 * rng.random((cells, cells, 3))).astype(np.uint8)
            wall += np.asarray(Image.fromarray(noise).resize((_TEXELS, _TEXELS), Image.Resampling.BICUBIC)) / 255
    return (found - found.min()) / np.ptp(found)


def room(place: np.ndarray, turn: np.ndarray, height: int, textures: np.ndarray) -> np.ndarray:
    """The panorama (H, 2 H, 3), uint8, of a camera. turn : the rotation from the camera to the room."""
    directions = rays(2 * height) @ turn.T  # two by two rays a pixel
    nearest = np.full(directions.shape[:2], np.inf)
    colours = np.zeros(directions.shape)
    for axis in range(3):
        u, v = (other for other in range(3) if other != axis)
        for sign in (1, -1):
            with np.errstate(divide="ignore", invalid="ignore"):
                far = (sign * HALF[axis] - place[axis]) / directions[..., axis]
            hit = (far > 1e-6) & (far < nearest)
            nearest[hit] = far[hit]
            points = place + far[hit][:, None] * directions[hit]
            where = [((points[:, i] / HALF[i] + 1) / 2 * (_TEXELS - 1)).clip(0, _TEXELS - 1) for i in (u, v)]
            texture = textures[2 * axis + (sign < 0)]
            colours[hit] = np.stack([map_coordinates(texture[..., c], where, order=1) for c in range(3)], axis=1)
    small = colours.reshape(height, 2, 2 * height, 2, 3).mean(axis=(1, 3))
    return np.rint(255 * small).astype(np.uint8)


def walk(n: int, seed: int = 1) -> list[tuple[np.ndarray, np.ndarray]]:
    """Places and turns of a camera that walks a loop in the room."""
    rng = np.random.default_rng(seed)
    found = []
    for index in range(n):
        angle = 2 * np.pi * index / n
        place = np.array([1.2 * np.cos(angle), 0.3 * np.sin(2 * angle), np.sin(angle)])
        degrees = [25 * index + 10 * rng.random(), 4 * rng.standard_normal()]
        found.append((place, Rotation.from_euler("yx", degrees, degrees=True).as_matrix()))
    return found
