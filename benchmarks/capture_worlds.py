"""Made-up captures of captures.py: cameras in the worlds of `clsplat demo`, and what they see."""

from __future__ import annotations

import numpy as np
from common import ROOT

from clsplat.cameras.camera import Camera
from clsplat.scenes.colmap import Points
from clsplat.scenes.demo.capture import cast, photograph, pixels, upright_camera, visible
from clsplat.scenes.demo.rays import RayWorld
from clsplat.scenes.demo.solids import SolidGroup, box
from clsplat.scenes.demo.street import DOME, Street
from clsplat.scenes.demo.world import World
from clsplat.scenes.scene import Scene, View

WIDTH, HEIGHT = 240, 180
MIDDLE = np.array([0.0, 0.0, 0.5])
N_POINTS = 4000
BLOCK, LANE = 10.0, 7.0  # half the side of a block of houses, and the width of the lane around it [m]
EYES = 1.8  # height of a camera in a hand [m]


def around(far: float = 1.0, n: int = 40) -> list[Camera]:
    """Return cameras on a ring that look at the middle. far : factor of their distance and of their focal length."""
    angles = 2 * np.pi * np.arange(n) / n
    places = MIDDLE + far * np.stack([3.6 * np.cos(angles), 3.6 * np.sin(angles), 0.7 + 0.25 * np.sin(3 * angles)], 1)
    return [upright_camera(WIDTH, HEIGHT, 0.9 * far * WIDTH, place, MIDDLE) for place in places]


def ahead(columns: int, rows: int, step: float) -> list[Camera]:
    """Return a grid of cameras that look ahead from nearly one place."""
    grid = [(i - (columns - 1) / 2, j - (rows - 1) / 2) for j in range(rows) for i in range(columns)]
    return [
        upright_camera(
            WIDTH, HEIGHT, 0.9 * WIDTH, np.array([-3.5, step * x, 1 + step * y]), np.array([6, step * x / 2, 0.6])
        )
        for x, y in grid
    ]


def tripod(n: int = 48) -> list[Camera]:
    """Return cameras within two centimetres that look everywhere."""
    angles = 2 * np.pi * np.arange(n) / n
    places = np.stack([0.01 * np.cos(7 * angles) + 2.2, 0.01 * np.sin(5 * angles), np.full(n, 1.2)], axis=1)
    ways = np.stack([np.cos(angles), np.sin(angles), 0.1 * np.sin(5 * angles) - 0.1], axis=1)
    return [
        upright_camera(WIDTH, HEIGHT, 0.7 * WIDTH, place, place + way) for place, way in zip(places, ways, strict=True)
    ]


def street_ahead(n: int = 45) -> list[Camera]:
    """Return cameras along a street that look ahead."""
    return [
        upright_camera(
            WIDTH,
            HEIGHT,
            0.7 * WIDTH,
            np.array([x, 0.8 * np.sin(x / 5), EYES]),
            np.array([x + 10, 0.8 * np.sin(x / 5) + np.sin(x), EYES]),
        )
        for x in np.linspace(-38, 20, n)
    ]


def from_above(columns: int = 22, rows: int = 5) -> list[Camera]:
    """Return a grid of cameras 22 m above a street that look down."""
    return [
        upright_camera(WIDTH, HEIGHT, WIDTH, np.array([x, y, 22.0]), np.array([x + 0.01, y, 0.0]))
        for y in np.linspace(-20, 20, rows)
        for x in np.linspace(-60, 60, columns)
    ]


def around_a_block(turn: float, n: int = 72) -> list[Camera]:
    """Return cameras on the lane around a block that look along it. turn : part of the way around, 0 to 1."""
    cameras = []
    for index in range(round(turn * n)):
        here, there = (_on_lane(4 * index / n + ahead) for ahead in (0.0, 0.5))
        aside = np.array([np.sin(3 * index), np.cos(2 * index), 0.0])
        cameras.append(upright_camera(WIDTH, HEIGHT, 0.7 * WIDTH, here, there + aside))
    return cameras


def _on_lane(way: float) -> np.ndarray:
    """Return a place on the lane, (3,). way : sides of the square that are behind, from 0 on."""
    far = BLOCK + LANE / 2
    side, along = int(way) % 4, (2 * (way - int(way)) - 1) * far
    x, y = [(-far, along), (along, far), (far, -along), (-along, -far)][side]
    return np.array([x, y, EYES + 0.1 * np.sin(9 * way)])


def _block() -> SolidGroup:
    """Return a block of houses with walls around its lane."""
    inner, outer, thick, height = BLOCK, BLOCK + LANE, 1.0, 7.0
    far = outer + thick
    walls = [
        ((-inner, -inner), (inner, inner), (0.86, 0.80, 0.68)),
        ((-far, outer), (far, far), (0.74, 0.42, 0.32)),
        ((-far, -far), (far, -outer), (0.62, 0.66, 0.70)),
        ((outer, -outer), (far, outer), (0.84, 0.70, 0.46)),
        ((-far, -outer), (-outer, outer), (0.88, 0.86, 0.82)),
    ]
    return SolidGroup([box("wall", (*low, 0.0), (*high, height), tint) for low, high, tint in walls])


def in_world(cameras: list[Camera]) -> Scene:
    """Return photos of the demo's world with points that at least three of them show."""
    return _capture(World(0), cameras, N_POINTS)


def in_street(cameras: list[Camera], lots: int = 6, block: bool = False) -> Scene:
    """Return photos of a street, or of a block of houses in its place. No points are in the sky."""
    world = Street(lots)
    if block:
        object.__setattr__(world, "houses", _block())
    return _capture(world, cameras, 2 * N_POINTS, sky=DOME)


def _capture(world: RayWorld, cameras: list[Camera], count: int, sky: int | None = None) -> Scene:
    """Return photos, and those of `count` random points that at least three photos show.

    sky : number of the surface on which no points are.
    """
    rng = np.random.default_rng(0)
    hits = []
    for camera in cameras:
        grid = pixels(camera)
        hits.append(cast(world, camera, grid[rng.integers(len(grid), size=count // len(cameras) + 1)] + 0.5))
    xyz, normal, color, surface = (
        np.concatenate([getattr(hit, name) for hit in hits]) for name in ("position", "normal", "color", "surface")
    )
    tracks = np.sum([visible(world, camera, xyz, normal) for camera in cameras], axis=0)
    kept = (tracks >= 3) & (surface != (-1 if sky is None else sky))
    points = Points(
        xyz[kept].astype(np.float64), np.rint(255 * color[kept]).astype(np.uint8), tracks[kept].astype(np.int64)
    )
    views = [
        View(f"{index:03}.png", camera, np.rint(255 * np.clip(photograph(world, camera), 0, 1)).astype(np.uint8))
        for index, camera in enumerate(cameras)
    ]
    return Scene("world", ROOT, views, points)
