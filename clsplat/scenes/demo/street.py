"""A street of houses with gardens, trees, lamps and parked cars, for trials of large scenes.

The street runs along x. Units are metres. Each lot of the street has a house on both sides.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from .paints import FRONT, PAINTS, PAVEMENT, ROAD, STOREY, paint_ground
from .rays import FAR, NEAR, SUN, Hits, Noise, Rays, Values, ball, constant, daylight, nonzero, sky
from .solids import Point, Solid, SolidGroup, box, gable_roof, post, round_solid

LOT = 14.0  # length of a lot along the street [m]
DOME_RADIUS = 400.0  # of the sky [m]
GROUND, DOME = 0, 1  # numbers of these surfaces; solids follow
_SOLIDS = 2

_WALLS = ((0.86, 0.80, 0.68), (0.74, 0.42, 0.32), (0.88, 0.86, 0.82), (0.62, 0.66, 0.70), (0.84, 0.70, 0.46))
_ROOFS = ((0.62, 0.27, 0.20), (0.36, 0.34, 0.36), (0.52, 0.34, 0.24))
_CARS = ((0.75, 0.12, 0.10), (0.12, 0.25, 0.55), (0.85, 0.86, 0.88), (0.18, 0.19, 0.20), (0.30, 0.45, 0.30))


@dataclass(frozen=True)
class Street:
    """The street; `seed` changes houses, trees and cars. lots : houses on each side."""

    lots: int = 14
    seed: int = 0
    noise: Noise = field(init=False)
    houses: SolidGroup = field(init=False)
    drives: Values = field(init=False)  # places of the paths to the doors along x

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.seed)
        object.__setattr__(self, "noise", Noise.drawn(rng))
        lots = [(index, side) for index in range(self.lots) for side in (-1.0, 1.0)]
        built = [_lot(LOT * index - 0.5 * self.length, side, rng) for index, side in lots]
        object.__setattr__(self, "houses", SolidGroup([SolidGroup(solids) for solids, _ in built]))
        object.__setattr__(self, "drives", np.array([drive for _, drive in built], np.float32))

    @property
    def length(self) -> float:
        """Length of the street [m]."""
        return LOT * self.lots

    def nearest(self, origin: Rays, direction: Rays) -> Values:
        """Return the distance to the first hit of each ray, (R,)."""
        return self._first(origin, direction)[0]

    def cast(self, origin: Rays, direction: Rays) -> Hits:
        """Return the first hit of each ray, with its colour in sunlight or shadow."""
        distance, number = self._first(origin, direction)
        position = origin + distance[:, None] * direction
        color, normal = np.empty_like(position), np.empty_like(position)
        for surface in np.unique(number):
            rows = np.flatnonzero(number == surface)
            at, along = position[rows], direction[rows]
            if surface == DOME:
                unit = (at / DOME_RADIUS).astype(np.float32)
                color[rows], normal[rows] = sky(unit), -unit
            elif surface == GROUND:
                color[rows], normal[rows] = paint_ground(self.noise, at, self.drives), constant(at, (0.0, 0.0, 1.0))
            else:
                solid = self.houses.solids[surface - _SOLIDS]
                normal[rows] = outward = solid.normal(at)
                color[rows] = PAINTS[solid.kind](solid, self.noise, at, outward, along)
        lit = np.flatnonzero(number != DOME)
        color[lit] *= daylight(normal[lit], self._in_sun(position[lit], normal[lit]))[:, None]
        return Hits(distance, np.minimum(number, _SOLIDS).astype(np.int8), position, normal, np.clip(color, 0.0, 1.0))

    def _first(self, origin: Rays, direction: Rays) -> tuple[Values, NDArray[np.int16]]:
        """Return distance and number of the surface that each ray hits first."""
        distance = ball(origin, direction, np.zeros(3), DOME_RADIUS, inside=True).astype(np.float32)
        number = np.full(len(origin), DOME, np.int16)
        ground = -origin[:, 2] / nonzero(direction[:, 2])
        below = (ground > NEAR) & (ground < distance)
        distance[below], number[below] = ground[below], GROUND
        distance, solid = self.houses.hits(origin, direction, distance)
        return distance, np.where(solid < 0, number, solid + _SOLIDS).astype(np.int16)

    def _in_sun(self, position: Rays, normal: Rays) -> NDArray[np.bool_]:
        start, far = position + np.float32(5e-3) * normal, np.full(len(position), FAR, np.float32)
        return self.houses.hits(start, constant(position, SUN), far)[1] < 0


def _lot(start: float, side: float, rng: np.random.Generator) -> tuple[list[Solid], float]:
    """Return what stands on a lot from x = `start` on, at y < 0 or y > 0, and the place of its path along x."""
    width, depth = rng.uniform(9.0, 11.0), rng.uniform(7.0, 9.0)
    storeys, setback = int(rng.integers(2, 4)), FRONT + rng.uniform(0.0, 1.5)
    left = start + 0.5 * (LOT - width) + rng.uniform(-0.8, 0.8)
    height, rise = STOREY * storeys, rng.uniform(2.5, 3.6)
    wall = _WALLS[rng.integers(len(_WALLS))]
    near, far = sorted((side * setback, side * (setback + depth)))
    eaves = 0.45
    solids = [
        box("wall", (left, near, 0.0), (left + width, far, height), wall),
        gable_roof(
            "roof",
            (left - eaves, near - eaves, height - 0.15),
            (left + width + eaves, far + eaves, height + rise),
            _ROOFS[rng.integers(len(_ROOFS))],
        ),
        _chimney(left + rng.uniform(1.5, width - 2.0), 0.5 * (near + far) + side, height + rise),
    ]
    drive = left + 3.75  # the middle of the door (paints.py)
    hedge = side * (PAVEMENT + 0.5)
    for low, high in ((start + 0.3, drive - 1.0), (drive + 1.0, start + LOT - 0.3)):
        low_y, high_y = sorted((hedge, hedge + side * 0.7))
        solids.append(box("leaves", (low, low_y, 0.0), (high, high_y, rng.uniform(0.7, 1.1)), (0.30, 0.46, 0.20)))
    solids += _tree(start + rng.uniform(10.0, 12.5), side * (PAVEMENT + rng.uniform(1.8, 2.8)), rng)
    lamp = (start + 0.6, side * (ROAD + 0.5), 0.0)
    solids += [
        post("plain", lamp, 0.08, 4.6, (0.30, 0.33, 0.34)),
        round_solid("plain", (lamp[0], lamp[1], 4.75), 0.24, (1.05, 1.02, 0.92)),
    ]
    if rng.random() < 0.6:
        solids += _car(start + rng.uniform(1.5, LOT - 6.0), side * (ROAD - 1.1), _CARS[rng.integers(len(_CARS))])
    return solids, drive


def _chimney(x: float, y: float, top: float) -> Solid:
    return box("plain", (x, y - 0.35, top - 2.0), (x + 0.7, y + 0.35, top + 0.6), (0.56, 0.32, 0.26))


def _tree(x: float, y: float, rng: np.random.Generator) -> list[Solid]:
    stem, crown = rng.uniform(1.6, 2.4), rng.uniform(1.2, 1.9)
    green = (rng.uniform(0.25, 0.55), rng.uniform(0.50, 0.68), rng.uniform(0.16, 0.26))
    balls = [round_solid("leaves", (x, y, stem + crown), crown, green)]
    for _ in range(3):
        dx, dy, dz = rng.uniform(-0.6, 0.6, 3) * crown
        balls.append(round_solid("leaves", (x + dx, y + dy, stem + crown + dz), 0.7 * crown, green))
    return [post("plain", (x, y, 0.0), 0.16, stem + 0.6, (0.36, 0.26, 0.18)), *balls]


def _car(x: float, y: float, tint: Point) -> list[Solid]:
    return [
        box("car", (x, y - 0.85, 0.22), (x + 4.1, y + 0.85, 0.9), tint),
        box("plain", (x + 1.0, y - 0.75, 0.9), (x + 3.2, y + 0.75, 1.42), (0.16, 0.19, 0.22)),
    ]
