"""What the surfaces of the street look like: walls with windows, roofs, leaves, cars, the ground."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from .rays import Noise, Rays, Values, constant, mix, rgb, sky, wave
from .solids import Solid

ROAD, PAVEMENT, FRONT = 3.5, 5.7, 9.0  # distances from the middle of the street: ends of road, pavement, gardens
STOREY = 2.9  # height of a storey
_BAY = 2.5  # distance between windows

Paint = Callable[[Solid, Noise, Rays, Rays, Rays], Rays]


def paint_wall(solid: Solid, noise: Noise, position: Rays, normal: Rays, direction: Rays) -> Rays:
    """Return the colours of a wall with windows, and a door towards the street."""
    across = np.abs(normal[:, 0]) > 0.5  # a side wall
    u: Values = np.where(across, position[:, 1] - solid.base[1], position[:, 0] - solid.base[0])
    z = position[:, 2]
    rows = np.floor(z / 0.22)
    seam = (np.abs(wave(z / 0.22)) < 0.09) | (np.abs(wave(u / 0.5 + 0.5 * (rows % 2))) < 0.04)
    grain = noise.smooth(1.7 * u + 3 * solid.base[0], 1.7 * z) + 0.5 * noise.smooth(9.0 * u, 9.0 * z)
    paint = rgb(*solid.tint) * (0.85 + 0.16 * grain - 0.14 * seam)[:, None]
    paint[z < 0.5] *= 0.72  # the foot of the house
    bay, level = wave(u / _BAY - 0.5) * _BAY, z - np.floor(z / STOREY) * STOREY
    inner, outer = (np.abs(bay) < 0.5), (np.abs(bay) < 0.6)
    window = inner & (level > 0.95) & (level < 2.15)
    frame = outer & (level > 0.85) & (level < 2.25) & ~window
    paint[frame] = (0.93, 0.92, 0.88)
    paint[window] = _glass(position, normal, direction, bay, level)[window]
    door = ~across & (np.abs(u - 0.5 * _BAY - _BAY) < 0.55) & (z < 2.2)
    paint[door] = np.roll(rgb(*solid.tint), 1) * 0.55
    paint[door & (np.abs(u - 1.5 * _BAY) > 0.47)] = (0.93, 0.92, 0.88)
    return paint.astype(np.float32)


def _glass(position: Rays, normal: Rays, direction: Rays, bay: Values, level: Values) -> Rays:
    """Return a dark room behind the glass, and the sky that the glass reflects more at grazing angles."""
    facing = -np.einsum("ij,ij->i", normal, direction)
    mirrored = direction + 2 * facing[:, None] * normal
    share = (0.12 + 0.5 * (1 - np.clip(facing, 0, 1)) ** 3)[:, None]
    room = mix((0.10, 0.12, 0.15), (0.30, 0.27, 0.22), 0.5 + 0.5 * np.sin(1.3 * np.round(position[:, 0])))
    paint = (1 - share) * room + share * sky(mirrored)
    paint[(np.abs(bay) < 0.035) | (np.abs(level - 1.55) < 0.03)] = (0.9, 0.89, 0.85)
    return paint.astype(np.float32)


def paint_roof(solid: Solid, noise: Noise, position: Rays, normal: Rays, direction: Rays) -> Rays:
    """Return the colours of rows of tiles."""
    rise = position[:, 2] / 0.17
    column = position[:, 0] / 0.3 + 0.5 * (np.floor(rise) % 2)
    shade = 0.78 + 0.18 * (rise - np.floor(rise)) + 0.25 * (noise.lattice[_cell(rise), _cell(column)] - 0.5)
    shade -= 0.2 * (np.abs(wave(column)) < 0.06)
    gable = np.abs(normal[:, 0]) > 0.5
    paint = rgb(*solid.tint) * shade[:, None]
    paint[gable] = rgb(0.80, 0.76, 0.68) * (0.9 + 0.1 * shade[gable, None])
    return paint.astype(np.float32)


def _cell(value: Values) -> Values:
    return np.floor(value).astype(int) % 64


def paint_leaves(solid: Solid, noise: Noise, position: Rays, normal: Rays, direction: Rays) -> Rays:
    """Return the colours of leaves in light and shade."""
    x, y, z = position.T
    coarse = noise.smooth(1.9 * x + 1.1 * z + solid.base[0], 1.9 * y - 0.9 * z)
    fine = noise.smooth(7.3 * x - 5.1 * z, 7.3 * y + 5.7 * z)
    paint = rgb(*solid.tint) * (0.35 + 0.55 * coarse + 0.6 * fine)[:, None]
    return paint.astype(np.float32)


def paint_plain(solid: Solid, noise: Noise, position: Rays, normal: Rays, direction: Rays) -> Rays:
    """Return one colour with little grain."""
    grain = noise.smooth(6 * (position[:, 0] + position[:, 1]), 6 * position[:, 2])
    return (rgb(*solid.tint) * (0.92 + 0.12 * grain)[:, None]).astype(np.float32)


def paint_car(solid: Solid, noise: Noise, position: Rays, normal: Rays, direction: Rays) -> Rays:
    """Return lacquer, with dark wheels at the sides and lamps at both ends."""
    u, z = position[:, 0] - solid.base[0], position[:, 2]
    paint = constant(position, solid.tint).copy()
    side = np.abs(normal[:, 1]) > 0.5
    for axle in (0.85, 3.25):
        wheel = (u - axle) ** 2 + (z - 0.35) ** 2
        paint[side & (wheel < 0.34**2)] = (0.09, 0.09, 0.10)
        paint[side & (wheel < 0.18**2)] = (0.72, 0.73, 0.75)
    paint[side & (np.abs(z - 0.62) < 0.03)] *= 0.6
    end = (np.abs(normal[:, 0]) > 0.5) & (np.abs(z - 0.7) < 0.1)
    lamp = end & (np.abs(np.abs(position[:, 1] - solid.centre[1]) - 0.65) < 0.16)
    paint[lamp & (normal[:, 0] > 0)] = (0.97, 0.95, 0.85)
    paint[lamp & (normal[:, 0] < 0)] = (0.75, 0.08, 0.08)
    return paint


def paint_ground(noise: Noise, position: Rays, drives: Values) -> Rays:
    """Return the colours of road, pavements, gardens and fields. drives : (D,) places of the paths to the doors."""
    x, y = position[:, 0], position[:, 1]
    off = np.abs(y)
    coarse, fine = noise.smooth(0.7 * x, 0.7 * y + 5), noise.smooth(8.0 * x, 8.0 * y)
    paint = mix((0.24, 0.42, 0.16), (0.52, 0.62, 0.28), 0.55 * coarse + 0.45 * fine)
    field = off > FRONT + 14
    paint[field] *= (0.8 + 0.4 * noise.smooth(0.07 * x[field] + 9, 0.11 * y[field]))[:, None]
    path = (off < FRONT) & (np.abs(x[:, None] - drives).min(axis=1) < 0.6)
    paint[path] = (0.66, 0.58, 0.50) * (0.85 + 0.25 * fine[path, None])
    slabs = off < PAVEMENT
    seam = (np.abs(wave(x / 0.6)) < 0.03) | (np.abs(wave(y / 0.6)) < 0.03)
    paint[slabs] = (rgb(0.66, 0.65, 0.62) * (0.88 + 0.2 * fine - 0.25 * seam)[:, None])[slabs]
    paint[slabs & (off < ROAD + 0.25)] = (0.78, 0.77, 0.74)
    road = off < ROAD
    paint[road] = (rgb(0.30, 0.30, 0.32) * (0.8 + 0.25 * coarse + 0.25 * fine)[:, None])[road]
    marks = road & (((off < 0.08) & ((x / 6 - np.floor(x / 6)) < 0.5)) | (np.abs(off - ROAD + 0.25) < 0.06))
    paint[marks] = (0.92, 0.91, 0.88)
    return paint.astype(np.float32)


PAINTS: dict[str, Paint] = {
    "wall": paint_wall,
    "roof": paint_roof,
    "leaves": paint_leaves,
    "plain": paint_plain,
    "car": paint_car,
}
