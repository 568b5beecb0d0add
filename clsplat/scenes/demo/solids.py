"""Solids of the street: convex bodies with flat faces, and balls. Rays test only solids whose sphere they pass."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .rays import FAR, NEAR, Rays, Values, ball, dot, nonzero

Point = tuple[float, float, float]

_CHUNK = 4096  # rays that are tested at once, so that all fits into the processor's cache
_SLACK, _ROUNDING = 1.02, 0.1  # spheres are this much larger, as float32 has errors of 0.05 m² in this world


@dataclass(frozen=True, eq=False)
class Solid:
    """A convex body: the intersection of half-spaces, or a ball without any.

    Parameters
    ----------
    kind : name of its paint (paints.py).
    centre, radius : a sphere around it, or the ball itself.
    planes : (F, 4) outward unit normal n and distance d of each face: n . p <= d inside.
    tint : its colour. base : a corner or the middle of its foot, from which paint is measured.
    """

    kind: str
    centre: NDArray[np.float64]
    radius: float
    planes: NDArray[np.float64]
    tint: Point
    base: Point

    def distance(self, origin: Rays, direction: Rays) -> Values:
        """Return the distance along each ray, (R,); inf if the ray misses the solid."""
        if not len(self.planes):
            return ball(origin, direction, self.centre, self.radius, inside=False)
        enter, leave = np.full(len(origin), -FAR), np.full(len(origin), FAR)
        for x, y, z, d in self.planes.astype(np.float32):
            slant = nonzero(direction[:, 0] * x + direction[:, 1] * y + direction[:, 2] * z)
            at = (d - (origin[:, 0] * x + origin[:, 1] * y + origin[:, 2] * z)) / slant
            enter = np.where(slant < 0, np.maximum(enter, at), enter)
            leave = np.where(slant > 0, np.minimum(leave, at), leave)
        return np.where((enter < leave) & (enter > NEAR), enter, FAR)

    def normal(self, position: Rays) -> Rays:
        """Return the outward normal at points of the surface, (R, 3)."""
        if not len(self.planes):
            return ((position - self.centre) / self.radius).astype(np.float32)
        outside = position @ self.planes[:, :3].T - self.planes[:, 3]
        return self.planes[outside.argmax(axis=1), :3].astype(np.float32)


class SolidGroup:
    """Solids or groups, and a sphere around all of them; rays that miss it are not tested against each."""

    def __init__(self, parts: Sequence[Solid | SolidGroup]) -> None:
        self.parts = parts
        self._centres = np.array([part.centre for part in parts])
        self._radii = np.array([part.radius for part in parts])
        self.centre: NDArray[np.float64] = 0.5 * (self._centres.min(axis=0) + self._centres.max(axis=0))
        self.radius: float = float((np.linalg.norm(self._centres - self.centre, axis=1) + self._radii).max())
        self.solids: list[Solid] = [
            solid for part in parts for solid in (part.solids if isinstance(part, SolidGroup) else [part])
        ]

    def hits(self, origin: Rays, direction: Rays, farthest: Values) -> tuple[Values, NDArray[np.int16]]:
        """Return for each ray the distance to the nearest solid and its number, (R,).

        A ray that hits none before `farthest` (R,) has this distance and the number -1.
        """
        distance, number = farthest.copy(), np.full(len(farthest), -1, np.int16)
        passed, first = passes(origin, direction, self._centres, self._radii), 0
        for column, part in enumerate(self.parts):
            rows = np.flatnonzero(passed[column])
            inner: NDArray[np.int16] | int
            if isinstance(part, SolidGroup):
                found, inner = part.hits(origin[rows], direction[rows], distance[rows])
            else:
                found, inner = part.distance(origin[rows], direction[rows]), 0
            closer = found < distance[rows]
            distance[rows[closer]] = found[closer]
            number[rows[closer]] = first + (inner if isinstance(inner, int) else inner[closer])
            first += len(part.solids) if isinstance(part, SolidGroup) else 1
        return distance, number


def passes(
    origin: Rays, direction: Rays, centres: NDArray[np.float64], radii: NDArray[np.float64]
) -> NDArray[np.bool_]:
    """Return whether each ray passes each sphere or starts in it, (C, R). Near misses may count as well."""
    centre, reach = centres.astype(np.float32), (_SLACK * radii**2 + _ROUNDING).astype(np.float32)[:, None]
    squares = (centre * centre).sum(axis=1)[:, None]
    result = np.empty((len(centre), len(origin)), np.bool_)
    for first in range(0, len(origin), _CHUNK):
        rays = slice(first, first + _CHUNK)
        start, step = origin[rays], direction[rays]
        along = centre @ step.T - dot(start, step)
        away = squares - 2 * (centre @ start.T) + dot(start, start)
        result[:, rays] = (away - along * along < reach) & ((along > 0) | (away < reach))
    return result


def box(kind: str, low: Point, high: Point, tint: Point) -> Solid:
    """Return a box with level and upright faces."""
    planes = np.concatenate([np.eye(3), -np.eye(3)]), np.concatenate([high, -np.array(low)])
    return _solid(kind, np.column_stack(planes), low, high, tint)


def gable_roof(kind: str, low: Point, high: Point, tint: Point) -> Solid:
    """Return a roof with its ridge along x: the box from `low` to `high` without what is above its two slopes."""
    half, rise = 0.5 * (high[1] - low[1]), high[2] - low[2]
    length = np.hypot(half, rise)
    slopes = np.array([[0.0, rise, half], [0.0, -rise, half]]) / length
    middle = 0.5 * (low[1] + high[1])
    tops = [slope @ (0.0, middle, high[2]) for slope in slopes]
    planes = [
        *((*slope, top) for slope, top in zip(slopes, tops, strict=True)),
        (0, 0, -1, -low[2]),
        (1, 0, 0, high[0]),
        (-1, 0, 0, -low[0]),
    ]
    return _solid(kind, np.array(planes, np.float64), low, high, tint)


def post(kind: str, foot: Point, radius: float, height: float, tint: Point) -> Solid:
    """Return an upright post with eight sides."""
    angles = 2 * np.pi * np.arange(8) / 8
    sides = np.column_stack([np.cos(angles), np.sin(angles), np.zeros(8)])
    planes = np.column_stack([sides, sides @ foot + radius])
    ends = [(0, 0, 1, foot[2] + height), (0, 0, -1, -foot[2])]
    wide = 1.1 * radius
    low, high = (foot[0] - wide, foot[1] - wide, foot[2]), (foot[0] + wide, foot[1] + wide, foot[2] + height)
    return _solid(kind, np.concatenate([planes, ends]), low, high, tint)


def round_solid(kind: str, centre: Point, radius: float, tint: Point) -> Solid:
    """Return a ball."""
    return Solid(kind, np.array(centre, np.float64), radius, np.empty((0, 4)), tint, centre)


def _solid(kind: str, planes: NDArray[np.float64], low: Point, high: Point, tint: Point) -> Solid:
    middle = 0.5 * (np.array(low) + np.array(high))
    return Solid(kind, middle, float(np.linalg.norm(np.array(high) - middle)) + 1e-3, planes, tint, low)
