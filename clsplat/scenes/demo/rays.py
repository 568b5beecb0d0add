"""What the made-up worlds share: rays and where they end, noise, colours, the sky and the sun.

World axes x and y are level, and z points up. Colours are display values 0..1, and means are taken of these values, as
in splat blending. Rays are float32 arrays of shape (R, 3); directions have length 1.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

Rays = NDArray[np.float32]
Values = NDArray[np.float32]

FAR = np.float32(np.inf)
NEAR = 1e-3  # smallest distance of a hit, so that a ray from a surface does not hit that surface
SUN = np.array([0.45, -0.35, 0.82]) / np.linalg.norm([0.45, -0.35, 0.82])
AMBIENT, DIFFUSE = 0.62, 0.42  # light from the sky and from the sun; the sum is slightly above 1 in full sun


@dataclass(frozen=True)
class Hits:
    """The points where rays hit surfaces.

    Parameters
    ----------
    distance : (R,) distance along the ray.
    surface : (R,) index of the surface; which one it is depends on the world.
    position : (R, 3) position in the world.
    normal : (R, 3) normal of the surface on the side of the ray.
    color : (R, 3) display colour 0..1 with lighting.
    """

    distance: Values
    surface: NDArray[np.int8]
    position: Rays
    normal: Rays
    color: Rays


class RayWorld(Protocol):
    """A world for photos."""

    def cast(self, origin: Rays, direction: Rays) -> Hits:
        """Return the first hit of each ray, with its colour."""

    def nearest(self, origin: Rays, direction: Rays) -> Values:
        """Return the distance to the first hit of each ray, (R,)."""


@dataclass(frozen=True)
class Noise:
    """Periodic noise. lattice : (64, 64) values 0..1."""

    lattice: Values

    @classmethod
    def drawn(cls, rng: np.random.Generator) -> Noise:
        """Return noise of random values."""
        return cls(rng.random((64, 64), dtype=np.float32))

    def smooth(self, u: Values, v: Values) -> Values:
        """Return value noise 0..1: the lattice, interpolated with smoothstep weights."""
        iu, iv = np.floor(u).astype(int), np.floor(v).astype(int)
        a, b = u - iu, v - iv
        a, b = a * a * (3 - 2 * a), b * b * (3 - 2 * b)
        at = [[self.lattice[(iu + i) % 64, (iv + j) % 64] for j in (0, 1)] for i in (0, 1)]
        return (1 - a) * ((1 - b) * at[0][0] + b * at[0][1]) + a * ((1 - b) * at[1][0] + b * at[1][1])


def sky(unit: Rays) -> Rays:
    """Return the colours of the sky with hills at the horizon. unit : (R, 3) directions from the middle."""
    paint = mix((0.93, 0.90, 0.84), (0.35, 0.56, 0.86), np.clip(1.6 * unit[:, 2], 0, 1) ** 0.7)
    around = np.arctan2(unit[:, 1], unit[:, 0])
    hill = 0.05 + 0.04 * np.sin(3 * around + 1) + 0.025 * np.sin(7 * around)
    far = unit[:, 2] < hill
    paint[far] = mix((0.30, 0.40, 0.33), (0.55, 0.62, 0.55), (unit[far, 2] / 0.115))
    return paint


def daylight(normal: Rays, in_sun: NDArray[np.bool_]) -> Values:
    """Return the light of the sky and the sun on surfaces, (R,). in_sun : where no surface is before the sun."""
    slant = np.maximum(normal @ SUN.astype(np.float32), 0.0) * in_sun
    above = 0.8 + 0.2 * normal[:, 2]
    return AMBIENT * above + DIFFUSE * slant


def nonzero(value: Values) -> Values:
    """Return the values with a small number in the place of 0, so that division works."""
    return np.where(np.abs(value) < 1e-9, np.float32(1e-9), value)


def wave(value: Values) -> Values:
    """Return the signed distance to the nearest whole number."""
    return value - np.rint(value)


def mix(low: tuple[float, ...], high: tuple[float, ...], weight: Values) -> Rays:
    """Return colours between two colours, (R, 3). weight : (R,) of the second one, clipped to 0..1."""
    w = np.clip(weight, 0, 1)[:, None].astype(np.float32)
    return (1 - w) * rgb(*low) + w * rgb(*high)


def rgb(*color: float) -> Values:
    """Return a colour as an array."""
    return np.array(color, np.float32)


def dot(a: Rays, b: Rays) -> Values:
    """Return row-wise dot products. NumPy's sum over a short last axis is slow, so this uses einsum."""
    return np.einsum("ij,ij->i", a, b)


def constant(like: Rays, value: tuple[float, ...] | NDArray[np.float64]) -> Rays:
    """Return one vector for each row of `like`."""
    return np.broadcast_to(np.asarray(value, np.float32), like.shape)


def ball(origin: Rays, direction: Rays, centre: NDArray[np.float64], radius: float, inside: bool) -> Values:
    """Return the distance to a sphere, hit from inside or from outside."""
    to = origin - centre.astype(np.float32)
    b = dot(to, direction)
    root = b * b - dot(to, to) + radius * radius
    distance = -b + (1 if inside else -1) * np.sqrt(np.maximum(root, 0))
    return np.where((root > 0) & (distance > NEAR), distance, FAR)
