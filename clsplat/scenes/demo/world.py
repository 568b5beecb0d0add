"""The small world of the demo scene: analytic surfaces, ray-cast with NumPy.

World axes x and y are level, and z points up. Colours are display values 0..1, and means are taken of these values, as
in splat blending. Rays are float32 arrays of shape (R, 3); directions have length 1.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

Rays = NDArray[np.float32]

_FAR = np.float32(np.inf)
_NEAR = 1e-3  # smallest distance of a hit, so that a ray from a surface does not hit that surface
_SUN = np.array([0.45, -0.35, 0.82]) / np.linalg.norm([0.45, -0.35, 0.82])
_AMBIENT, _DIFFUSE = 0.62, 0.42  # light from the sky and from the sun; the sum is slightly above 1 in full sun

GROUND_RADIUS = 5.0
DOME_RADIUS = 14.0
_BOX_CENTRE, _BOX_HALF, _BOX_ANGLE = np.array([-0.55, 0.35, 0.45]), np.array([0.5, 0.4, 0.45]), 0.45
_BALL_CENTRE, _BALL_RADIUS = np.array([0.65, 0.6, 0.4]), 0.4
_PANEL_CENTRE, _PANEL_HALF, _PANEL_ANGLE = np.array([0.55, -0.75, 0.55]), np.array([0.65, 0.45]), 0.6
_POLE_RADIUS, _POLE_HEIGHT = 0.028, 1.5

SURFACES = ("ground", "dome", "box", "ball", "panel", "poles")


def _turned(angle: float) -> NDArray[np.float64]:
    """Return the object-to-world rotation about z."""
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


@dataclass(frozen=True)
class Hits:
    """The points where rays hit surfaces.

    Parameters
    ----------
    distance : (R,) distance along the ray.
    surface : (R,) index into SURFACES.
    position : (R, 3) position in the world.
    normal : (R, 3) normal of the surface on the side of the ray.
    color : (R, 3) display colour 0..1 with lighting.
    """

    distance: NDArray[np.float32]
    surface: NDArray[np.int8]
    position: Rays
    normal: Rays
    color: Rays


@dataclass(frozen=True)
class World:
    """The small world; `seed` moves the poles and changes the ground's noise."""

    seed: int = 0
    poles: NDArray[np.float32] = field(init=False)  # (5, 2) positions on the ground
    noise: NDArray[np.float32] = field(init=False)  # (64, 64) periodic lattice of values 0..1

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.seed)
        angles = 2 * np.pi * (np.arange(5) + rng.uniform(0.2, 0.8, 5)) / 5
        feet = rng.uniform(1.35, 1.7, 5)[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        object.__setattr__(self, "poles", feet.astype(np.float32))
        object.__setattr__(self, "noise", rng.random((64, 64), dtype=np.float32))

    def distances(self, origin: Rays, direction: Rays) -> NDArray[np.float32]:
        """Return the distance to each surface along each ray, (len(SURFACES), R); inf if the ray misses it."""
        ground = (0.0 - origin[:, 2]) / _nonzero(direction[:, 2])
        at = origin[:, :2] + ground[:, None] * direction[:, :2]
        ground = np.where((ground > _NEAR) & (_dot(at, at) < GROUND_RADIUS**2), ground, _FAR)
        poles = np.min([_pole(origin, direction, foot) for foot in self.poles], axis=0)
        return np.stack(
            [
                ground,
                _ball(origin, direction, np.zeros(3), DOME_RADIUS, inside=True),
                _box(origin, direction),
                _ball(origin, direction, _BALL_CENTRE, _BALL_RADIUS, inside=False),
                _panel(origin, direction),
                poles,
            ]
        ).astype(np.float32)

    def cast(self, origin: Rays, direction: Rays) -> Hits:
        """Return the first hit of each ray, with its colour in sunlight or shadow."""
        distances = self.distances(origin, direction)
        surface = distances.argmin(axis=0).astype(np.int8)
        distance = distances.min(axis=0)
        position = origin + distance[:, None] * direction
        normal, color = np.empty_like(position), np.empty_like(position)
        for index, name in enumerate(SURFACES):
            rows = np.flatnonzero(surface == index)
            if rows.size == 0:
                continue
            paint, outward = getattr(self, f"_{name}_paint")(position[rows], direction[rows])
            if name != "dome":
                paint = self._lit(position[rows], direction[rows], paint, outward, glossy=name == "ball")
            color[rows], normal[rows] = paint, outward
        return Hits(distance, surface, position, normal, np.clip(color, 0.0, 1.0))

    def _lit(self, position: Rays, direction: Rays, paint: Rays, normal: Rays, glossy: bool) -> Rays:
        sun = _SUN.astype(np.float32)
        toward = np.broadcast_to(sun, position.shape)
        blocked = np.delete(self.distances(position + 2e-3 * normal, toward), SURFACES.index("dome"), axis=0)
        slant = np.maximum(normal @ sun, 0.0) * ~np.isfinite(blocked).any(axis=0)
        sky = 0.8 + 0.2 * normal[:, 2]
        lit = paint * (_AMBIENT * sky + _DIFFUSE * slant)[:, None]
        if glossy:  # the Blinn-Phong highlight is the only colour that depends on the view
            half = sun - direction
            shine = np.maximum(_dot(normal, half) / np.sqrt(_dot(half, half)), 0.0) ** 40
            lit += (0.5 * (slant > 0) * shine).astype(np.float32)[:, None]
        return lit

    def _smooth(self, u: NDArray[np.float32], v: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return value noise 0..1: the lattice, interpolated with smoothstep weights."""
        iu, iv = np.floor(u).astype(int), np.floor(v).astype(int)
        a, b = u - iu, v - iv
        a, b = a * a * (3 - 2 * a), b * b * (3 - 2 * b)
        at = [[self.noise[(iu + i) % 64, (iv + j) % 64] for j in (0, 1)] for i in (0, 1)]
        return (1 - a) * ((1 - b) * at[0][0] + b * at[0][1]) + a * ((1 - b) * at[1][0] + b * at[1][1])

    def _ground_paint(self, position: Rays, direction: Rays) -> tuple[Rays, Rays]:
        x, y = position[:, 0], position[:, 1]
        grain = 0.6 * self._smooth(2.2 * x + 7, 2.2 * y) + 0.4 * self._smooth(7.0 * x, 7.0 * y + 3)
        tile = (np.floor(x / 0.8) + np.floor(y / 0.8)) % 2
        paint = _mix((0.42, 0.50, 0.34), (0.86, 0.80, 0.66), 0.55 * tile + 0.45 * grain)
        gap = np.minimum(np.abs(_wave(x / 0.8)), np.abs(_wave(y / 0.8))) < 0.02
        paint[gap] *= 0.6
        return paint, _constant(paint, (0.0, 0.0, 1.0))

    def _dome_paint(self, position: Rays, direction: Rays) -> tuple[Rays, Rays]:
        unit = position / np.float32(DOME_RADIUS)
        paint = _mix((0.93, 0.90, 0.84), (0.35, 0.56, 0.86), np.clip(1.6 * unit[:, 2], 0, 1) ** 0.7)
        around = np.arctan2(unit[:, 1], unit[:, 0])
        hill = 0.05 + 0.04 * np.sin(3 * around + 1) + 0.025 * np.sin(7 * around)
        far = unit[:, 2] < hill
        paint[far] = _mix((0.30, 0.40, 0.33), (0.55, 0.62, 0.55), (unit[far, 2] / 0.115))
        return paint, -unit

    def _box_paint(self, position: Rays, direction: Rays) -> tuple[Rays, Rays]:
        local = (position - _BOX_CENTRE) @ _turned(_BOX_ANGLE) / _BOX_HALF
        axis = np.abs(local).argmax(axis=1)
        squares = np.floor(2.5 * (local + 1) - 1e-4).astype(int)
        squares[np.arange(len(axis)), axis] = 0
        dark = squares.sum(axis=1) % 2 == 1
        pale = np.array([[0.95, 0.92, 0.85], [0.97, 0.86, 0.45], [0.85, 0.93, 0.97]])[axis]
        deep = np.array([[0.75, 0.16, 0.13], [0.13, 0.30, 0.62], [0.16, 0.45, 0.24]])[axis]
        outward = np.zeros_like(local)
        outward[np.arange(len(axis)), axis] = np.sign(local[np.arange(len(axis)), axis])
        return (
            np.where(dark[:, None], deep, pale).astype(np.float32),
            (outward @ _turned(_BOX_ANGLE).T).astype(np.float32),
        )

    def _ball_paint(self, position: Rays, direction: Rays) -> tuple[Rays, Rays]:
        normal = ((position - _BALL_CENTRE) / _BALL_RADIUS).astype(np.float32)
        around = np.arctan2(normal[:, 1], normal[:, 0])
        band = np.sin(6 * around + 5 * normal[:, 2]) > 0
        spots = self._smooth(4 * normal[:, 0] + 9, 4 * normal[:, 2] + 4 * normal[:, 1])
        paint = np.where(band[:, None], _rgb(0.85, 0.55, 0.15), _rgb(0.20, 0.55, 0.60))
        return (paint * (0.7 + 0.4 * spots[:, None])).astype(np.float32), normal

    def _panel_paint(self, position: Rays, direction: Rays) -> tuple[Rays, Rays]:
        local = (position - _PANEL_CENTRE) @ _turned(_PANEL_ANGLE)
        x, z = local[:, 0] / _PANEL_HALF[0], local[:, 2] / _PANEL_HALF[1]
        front = direction @ _turned(_PANEL_ANGLE)[:, 1].astype(np.float32) > 0  # the front faces along -y
        mural = _mix((0.95, 0.75, 0.20), (0.70, 0.15, 0.45), (z + 1) / 2)
        mural[np.abs(_wave(3 * x + z)) < 0.2] = (0.10, 0.18, 0.40)
        mural[(x - 0.25) ** 2 * 2 + (z - 0.2) ** 2 < 0.16] = (0.97, 0.96, 0.92)
        back = _mix((0.30, 0.31, 0.33), (0.38, 0.38, 0.39), self._smooth(6 * x, 6 * z))
        paint = np.where(front[:, None], mural, back)
        frame = (np.abs(x) > 0.94) | (np.abs(z) > 0.92)
        paint[frame] = (0.25, 0.17, 0.10)
        facing = _constant(paint, _turned(_PANEL_ANGLE)[:, 1])
        return paint, np.where(front[:, None], -facing, facing)

    def _poles_paint(self, position: Rays, direction: Rays) -> tuple[Rays, Rays]:
        offset = position[:, None, :2] - self.poles
        which = (offset[:, :, 0] ** 2 + offset[:, :, 1] ** 2).argmin(axis=1)
        stripe = np.floor(position[:, 2] / 0.15 + which).astype(int) % 2 == 0
        colors = np.stack(
            [
                _rgb(0.85, 0.15, 0.12),
                _rgb(0.10, 0.35, 0.75),
                _rgb(0.10, 0.50, 0.25),
                _rgb(0.55, 0.20, 0.55),
                _rgb(0.15, 0.15, 0.18),
            ]
        )
        paint = np.where(stripe[:, None], colors[which], _rgb(0.96, 0.95, 0.92))
        normal = np.zeros_like(position)
        normal[:, :2] = offset[np.arange(len(which)), which] / _POLE_RADIUS
        normal[position[:, 2] > _POLE_HEIGHT - 1e-4] = (0.0, 0.0, 1.0)
        return paint, normal


def _nonzero(value: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.where(np.abs(value) < 1e-9, np.float32(1e-9), value)


def _wave(value: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the signed distance to the nearest whole number."""
    return value - np.rint(value)


def _mix(low: tuple[float, ...], high: tuple[float, ...], weight: NDArray[np.float32]) -> Rays:
    w = np.clip(weight, 0, 1)[:, None].astype(np.float32)
    return (1 - w) * _rgb(*low) + w * _rgb(*high)


def _rgb(*color: float) -> NDArray[np.float32]:
    return np.array(color, np.float32)


def _dot(a: Rays, b: Rays) -> NDArray[np.float32]:
    """Return row-wise dot products. NumPy's sum over a short last axis is slow, so this uses einsum."""
    return np.einsum("ij,ij->i", a, b)


def _constant(like: Rays, value: tuple[float, ...] | NDArray[np.float64]) -> Rays:
    return np.broadcast_to(np.asarray(value, np.float32), like.shape)


def _ball(
    origin: Rays, direction: Rays, centre: NDArray[np.float64], radius: float, inside: bool
) -> NDArray[np.float32]:
    """Return the distance to a sphere, hit from inside or from outside."""
    to = origin - centre.astype(np.float32)
    b = _dot(to, direction)
    root = b * b - _dot(to, to) + radius * radius
    distance = -b + (1 if inside else -1) * np.sqrt(np.maximum(root, 0))
    return np.where((root > 0) & (distance > _NEAR), distance, _FAR)


def _box(origin: Rays, direction: Rays) -> NDArray[np.float32]:
    """Return the distance to the box by the slab method (Kay & Kajiya 1986)."""
    turn = _turned(_BOX_ANGLE).astype(np.float32)
    start = (origin - _BOX_CENTRE.astype(np.float32)) @ turn
    step = _nonzero(direction @ turn)
    half = _BOX_HALF.astype(np.float32)
    first, second = (-half - start) / step, (half - start) / step
    low, high = np.minimum(first, second), np.maximum(first, second)
    enter = np.maximum(np.maximum(low[:, 0], low[:, 1]), low[:, 2])
    leave = np.minimum(np.minimum(high[:, 0], high[:, 1]), high[:, 2])
    return np.where((enter < leave) & (enter > _NEAR), enter, _FAR)


def _panel(origin: Rays, direction: Rays) -> NDArray[np.float32]:
    """Return the distance to the panel, an upright rectangle without thickness."""
    turn = _turned(_PANEL_ANGLE).astype(np.float32)
    start, step = (origin - _PANEL_CENTRE.astype(np.float32)) @ turn, direction @ turn
    distance = -start[:, 1] / _nonzero(step[:, 1])
    x, z = start[:, 0] + distance * step[:, 0], start[:, 2] + distance * step[:, 2]
    inside = (np.abs(x) < _PANEL_HALF[0]) & (np.abs(z) < _PANEL_HALF[1])
    return np.where(inside & (distance > _NEAR), distance, _FAR)


def _pole(origin: Rays, direction: Rays, foot: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the distance to a pole, an upright cylinder on the ground with a flat top."""
    nearest = np.full(len(origin), _FAR)
    to, step = origin[:, :2] - foot, direction[:, :2]
    across = to[:, 0] * step[:, 1] - to[:, 1] * step[:, 0]
    near = np.flatnonzero(across * across < _POLE_RADIUS**2 * _dot(step, step))  # only few rays pass this near
    to, step, start, climb = to[near], step[near], origin[near, 2], direction[near, 2]
    a, b = np.maximum(_dot(step, step), 1e-12), _dot(to, step)
    side = (-b - np.sqrt(np.maximum(_POLE_RADIUS**2 * a - across[near] ** 2, 0))) / a
    height = start + side * climb
    side = np.where((side > _NEAR) & (height > 0) & (height < _POLE_HEIGHT), side, _FAR)
    top = (_POLE_HEIGHT - start) / _nonzero(climb)
    at = to + top[:, None] * step
    top = np.where((top > _NEAR) & (_dot(at, at) < _POLE_RADIUS**2), top, _FAR)
    nearest[near] = np.minimum(side, top)
    return nearest
