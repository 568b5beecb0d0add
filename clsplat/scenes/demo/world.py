"""The small world of the demo scene: analytic surfaces, ray-cast with NumPy. rays.py has axes and units."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from .rays import FAR, NEAR, SUN, Hits, Noise, Rays, Values, ball, constant, daylight, dot, mix, nonzero, rgb, sky, wave

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
class World:
    """The small world; `seed` moves the poles and changes the ground's noise."""

    seed: int = 0
    poles: Values = field(init=False)  # (5, 2) positions on the ground
    noise: Noise = field(init=False)

    def __post_init__(self) -> None:
        rng = np.random.default_rng(self.seed)
        angles = 2 * np.pi * (np.arange(5) + rng.uniform(0.2, 0.8, 5)) / 5
        feet = rng.uniform(1.35, 1.7, 5)[:, None] * np.stack([np.cos(angles), np.sin(angles)], axis=1)
        object.__setattr__(self, "poles", feet.astype(np.float32))
        object.__setattr__(self, "noise", Noise.drawn(rng))

    def distances(self, origin: Rays, direction: Rays) -> Values:
        """Return the distance to each surface along each ray, (len(SURFACES), R); inf if the ray misses it."""
        ground = (0.0 - origin[:, 2]) / nonzero(direction[:, 2])
        at = origin[:, :2] + ground[:, None] * direction[:, :2]
        ground = np.where((ground > NEAR) & (dot(at, at) < GROUND_RADIUS**2), ground, FAR)
        poles = np.min([_pole(origin, direction, foot) for foot in self.poles], axis=0)
        return np.stack(
            [
                ground,
                ball(origin, direction, np.zeros(3), DOME_RADIUS, inside=True),
                _box(origin, direction),
                ball(origin, direction, _BALL_CENTRE, _BALL_RADIUS, inside=False),
                _panel(origin, direction),
                poles,
            ]
        ).astype(np.float32)

    def nearest(self, origin: Rays, direction: Rays) -> Values:
        """Return the distance to the first hit of each ray, (R,)."""
        return self.distances(origin, direction).min(axis=0)

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
        sun = constant(position, SUN)
        blocked = np.delete(self.distances(position + 2e-3 * normal, sun), SURFACES.index("dome"), axis=0)
        in_sun: NDArray[np.bool_] = np.isinf(blocked.min(axis=0))
        lit = paint * daylight(normal, in_sun)[:, None]
        if glossy:  # the Blinn-Phong highlight is the only colour that depends on the view
            half = sun - direction
            shine = np.maximum(dot(normal, half) / np.sqrt(dot(half, half)), 0.0) ** 40
            lit += (0.5 * (in_sun & (normal @ sun[0] > 0)) * shine).astype(np.float32)[:, None]
        return lit

    def _ground_paint(self, position: Rays, direction: Rays) -> tuple[Rays, Rays]:
        x, y = position[:, 0], position[:, 1]
        grain = 0.6 * self.noise.smooth(2.2 * x + 7, 2.2 * y) + 0.4 * self.noise.smooth(7.0 * x, 7.0 * y + 3)
        tile = (np.floor(x / 0.8) + np.floor(y / 0.8)) % 2
        paint = mix((0.42, 0.50, 0.34), (0.86, 0.80, 0.66), 0.55 * tile + 0.45 * grain)
        gap = np.minimum(np.abs(wave(x / 0.8)), np.abs(wave(y / 0.8))) < 0.02
        paint[gap] *= 0.6
        return paint, constant(paint, (0.0, 0.0, 1.0))

    def _dome_paint(self, position: Rays, direction: Rays) -> tuple[Rays, Rays]:
        unit = position / np.float32(DOME_RADIUS)
        return sky(unit), -unit

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
        spots = self.noise.smooth(4 * normal[:, 0] + 9, 4 * normal[:, 2] + 4 * normal[:, 1])
        paint = np.where(band[:, None], rgb(0.85, 0.55, 0.15), rgb(0.20, 0.55, 0.60))
        return (paint * (0.7 + 0.4 * spots[:, None])).astype(np.float32), normal

    def _panel_paint(self, position: Rays, direction: Rays) -> tuple[Rays, Rays]:
        local = (position - _PANEL_CENTRE) @ _turned(_PANEL_ANGLE)
        x, z = local[:, 0] / _PANEL_HALF[0], local[:, 2] / _PANEL_HALF[1]
        front = direction @ _turned(_PANEL_ANGLE)[:, 1].astype(np.float32) > 0  # the front faces along -y
        mural = mix((0.95, 0.75, 0.20), (0.70, 0.15, 0.45), (z + 1) / 2)
        mural[np.abs(wave(3 * x + z)) < 0.2] = (0.10, 0.18, 0.40)
        mural[(x - 0.25) ** 2 * 2 + (z - 0.2) ** 2 < 0.16] = (0.97, 0.96, 0.92)
        back = mix((0.30, 0.31, 0.33), (0.38, 0.38, 0.39), self.noise.smooth(6 * x, 6 * z))
        paint = np.where(front[:, None], mural, back)
        frame = (np.abs(x) > 0.94) | (np.abs(z) > 0.92)
        paint[frame] = (0.25, 0.17, 0.10)
        facing = constant(paint, _turned(_PANEL_ANGLE)[:, 1])
        return paint, np.where(front[:, None], -facing, facing)

    def _poles_paint(self, position: Rays, direction: Rays) -> tuple[Rays, Rays]:
        offset = position[:, None, :2] - self.poles
        which = (offset[:, :, 0] ** 2 + offset[:, :, 1] ** 2).argmin(axis=1)
        stripe = np.floor(position[:, 2] / 0.15 + which).astype(int) % 2 == 0
        colors = np.stack(
            [
                rgb(0.85, 0.15, 0.12),
                rgb(0.10, 0.35, 0.75),
                rgb(0.10, 0.50, 0.25),
                rgb(0.55, 0.20, 0.55),
                rgb(0.15, 0.15, 0.18),
            ]
        )
        paint = np.where(stripe[:, None], colors[which], rgb(0.96, 0.95, 0.92))
        normal = np.zeros_like(position)
        normal[:, :2] = offset[np.arange(len(which)), which] / _POLE_RADIUS
        normal[position[:, 2] > _POLE_HEIGHT - 1e-4] = (0.0, 0.0, 1.0)
        return paint, normal


def _box(origin: Rays, direction: Rays) -> Values:
    """Return the distance to the box by the slab method (Kay & Kajiya 1986)."""
    turn = _turned(_BOX_ANGLE).astype(np.float32)
    start = (origin - _BOX_CENTRE.astype(np.float32)) @ turn
    step = nonzero(direction @ turn)
    half = _BOX_HALF.astype(np.float32)
    first, second = (-half - start) / step, (half - start) / step
    low, high = np.minimum(first, second), np.maximum(first, second)
    enter = np.maximum(np.maximum(low[:, 0], low[:, 1]), low[:, 2])
    leave = np.minimum(np.minimum(high[:, 0], high[:, 1]), high[:, 2])
    return np.where((enter < leave) & (enter > NEAR), enter, FAR)


def _panel(origin: Rays, direction: Rays) -> Values:
    """Return the distance to the panel, an upright rectangle without thickness."""
    turn = _turned(_PANEL_ANGLE).astype(np.float32)
    start, step = (origin - _PANEL_CENTRE.astype(np.float32)) @ turn, direction @ turn
    distance = -start[:, 1] / nonzero(step[:, 1])
    x, z = start[:, 0] + distance * step[:, 0], start[:, 2] + distance * step[:, 2]
    inside = (np.abs(x) < _PANEL_HALF[0]) & (np.abs(z) < _PANEL_HALF[1])
    return np.where(inside & (distance > NEAR), distance, FAR)


def _pole(origin: Rays, direction: Rays, foot: Values) -> Values:
    """Return the distance to a pole, an upright cylinder on the ground with a flat top."""
    nearest = np.full(len(origin), FAR)
    to, step = origin[:, :2] - foot, direction[:, :2]
    across = to[:, 0] * step[:, 1] - to[:, 1] * step[:, 0]
    near = np.flatnonzero(across * across < _POLE_RADIUS**2 * dot(step, step))  # only few rays pass this near
    to, step, start, climb = to[near], step[near], origin[near, 2], direction[near, 2]
    a, b = np.maximum(dot(step, step), 1e-12), dot(to, step)
    side = (-b - np.sqrt(np.maximum(_POLE_RADIUS**2 * a - across[near] ** 2, 0))) / a
    height = start + side * climb
    side = np.where((side > NEAR) & (height > 0) & (height < _POLE_HEIGHT), side, FAR)
    top = (_POLE_HEIGHT - start) / nonzero(climb)
    at = to + top[:, None] * step
    top = np.where((top > NEAR) & (dot(at, at) < _POLE_RADIUS**2), top, FAR)
    nearest[near] = np.minimum(side, top)
    return nearest
