"""Places of blender_scenes.py that surround the cameras: a room, a garden and a lane."""

from __future__ import annotations

import math
from typing import Any

import bpy
import numpy as np
from blender_shapes import add, add_mesh, add_wire, material, textured
from mathutils import Matrix


def room(rng: np.random.Generator) -> None:
    """A furnished room with plain and patterned walls, two lamps, and shiny things."""
    walls = [
        textured("wall", "Brick", 3.0, (0.35, 0.12, 0.08), (0.6, 0.55, 0.5)),
        material("plain", (0.75, 0.72, 0.65)),
        textured("paper", "Voronoi", 4.0, (0.2, 0.3, 0.5), (0.8, 0.8, 0.7)),
        material("white", (0.85, 0.85, 0.85)),
    ]
    sides = (
        ((0, 3, 1.5), (math.pi / 2, 0, 0)),
        ((3, 0, 1.5), (math.pi / 2, 0, math.pi / 2)),
        ((0, -3, 1.5), (math.pi / 2, 0, 0)),
        ((-3, 0, 1.5), (math.pi / 2, 0, math.pi / 2)),
    )
    for made_of, (place, turn) in zip(walls, sides, strict=True):
        add("plane", made_of, place, (3, 1.5, 1), smooth=False).rotation_euler = turn
    add(
        "plane", textured("floor", "Wave", 1.5, (0.2, 0.1, 0.05), (0.5, 0.32, 0.18)), (0, 0, 0), (3, 3, 1), smooth=False
    )
    add("plane", material("ceiling", (0.9, 0.9, 0.9)), (0, 0, 3), (3, 3, 1), smooth=False)
    wood = textured("wood", "Noise", 8.0, (0.3, 0.15, 0.06), (0.55, 0.35, 0.18))
    add("cube", wood, (0, 0, 0.75), (0.8, 0.5, 0.03), smooth=False)
    for x in (-0.7, 0.7):
        for y in (-0.4, 0.4):
            add("cylinder", wood, (x, y, 0.37), radius=0.04, depth=0.74)
    add("monkey", material("red", (0.7, 0.05, 0.05), 0.2), (0.2, 0.1, 1.0), (0.22, 0.22, 0.22))
    add("uv_sphere", material("mirror", (0.9, 0.9, 0.9), 0.02, metallic=1.0), (-0.4, 0.1, 0.95), (0.17, 0.17, 0.17))
    add(
        "torus",
        textured("ring", "Checker", 12.0, (0.9, 0.6, 0.0), (0.05, 0.05, 0.3)),
        (-0.1, -0.3, 0.84),
        major_radius=0.14,
        minor_radius=0.05,
    )
    shelf = [material(f"book{i}", tuple(rng.uniform(0.05, 0.8, 3)), 0.5) for i in range(12)]
    for z in (0.5, 1.0, 1.5, 2.0):
        add("cube", wood, (-2.8, 0, z), (0.18, 1.2, 0.015), smooth=False)
        for y in np.arange(-1.1, 1.1, 0.09):
            tall = rng.uniform(0.12, 0.2)
            add(
                "cube",
                shelf[rng.integers(12)],
                (-2.8, y, z + 0.015 + tall),
                (0.13, rng.uniform(0.02, 0.04), tall),
                smooth=False,
            )
    for _ in range(14):
        x, y = rng.uniform(-2.5, 2.5, 2)
        if max(abs(x), abs(y)) > 1.6:
            size = rng.uniform(0.1, 0.35)
            kind = textured(
                "box",
                ("Voronoi", "Checker", "Noise")[rng.integers(3)],
                rng.uniform(4, 12),
                tuple(rng.uniform(0, 0.4, 3)),
                tuple(rng.uniform(0.4, 1, 3)),
            )
            add("cube", kind, (x, y, size), (size, size, size), smooth=False).rotation_euler = (0, 0, rng.uniform(0, 3))
    for x, y in ((1.2, 0.5), (-1.0, -1.2)):
        bpy.ops.object.light_add(type="AREA", location=(x, y, 2.9))
        bpy.context.object.data.energy, bpy.context.object.data.size = 60, 1.0


def leaves(rng: np.random.Generator, n: int, center: Any, radius: Any, size: float, made_of: Any) -> None:
    """Add a crown of n leaves, small quads at random in an ellipsoid, as one mesh."""
    within = rng.normal(size=(n, 3))
    within *= rng.uniform(0.55, 1.0, (n, 1)) / np.linalg.norm(within, axis=1, keepdims=True)
    along, across = rng.normal(size=(2, n, 3)) * size
    corners = np.stack([-along, -across, along, across], axis=1) + (within * radius + center)[:, None]
    add_mesh("crown", corners.reshape(-1, 3), np.arange(4 * n).reshape(-1, 4), made_of)


def tree(rng: np.random.Generator, x: float, y: float, height: float, bark: Any, green: Any) -> None:
    """Add a tree: a trunk and a crown."""
    bend = rng.normal(0, 0.05 * height, 2)
    trunk = [(x, y, -0.1), (x + bend[0] / 2, y + bend[1] / 2, 0.3 * height), (x + bend[0], y + bend[1], 0.8 * height)]
    add_wire("trunk", trunk, 0.03 * height, bark)
    crown = (x + bend[0], y + bend[1], 0.7 * height)
    leaves(rng, 900, crown, np.array([0.3, 0.3, 0.35]) * height, 0.03 * height, green)


def house(rng: np.random.Generator, x: float, y: float, turn: float, size: tuple[float, float, float]) -> None:
    """Add a house with a roof, windows and a door. size : half its width and depth, and the height of its walls."""
    wide, deep, high = size
    light = rng.uniform(0.3, 0.75, 3) * (1.0, 0.9, 0.8)
    walls = textured("walls", ("Brick", "Noise")[rng.integers(2)], rng.uniform(4, 9), tuple(0.6 * light), tuple(light))
    roof = textured("roof", "Wave", 3.0, (0.12, 0.04, 0.03), (0.35, 0.13, 0.09))
    pane, frame = material("pane", (0.03, 0.04, 0.06), 0.1), material("frame", (0.8, 0.8, 0.78))
    spin = Matrix.Translation((x, y, 0)) @ Matrix.Rotation(turn, 4, "Z")
    parts = [add("cube", walls, (0, 0, high / 2), (wide, deep, high / 2), smooth=False)]
    for side in (-1, 1):
        for k in range(max(2, int(wide / 1.2))):
            at = (2 * k + 1) / max(2, int(wide / 1.2)) - 1
            for level in np.arange(1.4, high - 0.6, 2.6):
                parts.append(add("cube", frame, (at * wide, side * deep, level), (0.5, 0.06, 0.65), smooth=False))
                parts.append(add("cube", pane, (at * wide, side * deep, level), (0.42, 0.08, 0.57), smooth=False))
    ridge = high + 0.7 * deep
    corners = [(s * 1.08 * wide, t * 1.12 * deep, high) for s in (-1, 1) for t in (-1, 1)]
    corners += [(s * 1.08 * wide, 0, ridge) for s in (-1, 1)]
    parts.append(add_mesh("roof", corners, [(0, 4, 5, 2), (1, 3, 5, 4), (0, 1, 4), (2, 5, 3)], roof))
    for part in parts:
        part.matrix_world = spin @ Matrix.LocRotScale(part.location, None, part.scale)


def ground(rng: np.random.Generator, blades_within: float) -> None:
    """Add a meadow with blades of grass around the origin, and hills at the horizon."""
    grass = textured("grass", "Noise", 1500.0, (0.04, 0.09, 0.02), (0.18, 0.24, 0.06))
    add("plane", grass, (0, 0, 0), (400, 400, 1), smooth=False)
    n = 9000
    foot = np.c_[rng.uniform(-blades_within, blades_within, (n, 2)), np.zeros(n)]
    lean, side = rng.normal((0, 0, 0.09), 0.03, (n, 3)), rng.normal(0, (0.006, 0.006, 0), (n, 3))
    blades = np.stack([foot - side, foot + side, foot + lean], axis=1)
    add_mesh("blades", blades.reshape(-1, 3), np.arange(3 * n).reshape(-1, 3), material("blade", (0.1, 0.25, 0.03)))
    hill = textured("hill", "Noise", 6.0, (0.05, 0.09, 0.05), (0.16, 0.22, 0.12))
    for k in range(9):
        angle = 2 * math.pi * k / 9 + rng.uniform(-0.2, 0.2)
        far = rng.uniform(220, 340)
        scale = rng.uniform(60, 110), rng.uniform(60, 110), rng.uniform(14, 40)
        add("uv_sphere", hill, (far * math.cos(angle), far * math.sin(angle), -2), scale)


def trees_and_houses(rng: np.random.Generator, nearest: float) -> None:
    """Add trees and houses all around, at `nearest` [world units] and beyond."""
    bark = textured("bark", "Noise", 12.0, (0.06, 0.04, 0.02), (0.25, 0.18, 0.12))
    green = [material(f"green{i}", (0.05 + 0.05 * i, 0.16 + 0.06 * i, 0.03), 0.5) for i in range(4)]
    for k in range(22):
        angle, far = 2 * math.pi * k / 22 + rng.uniform(-0.1, 0.1), nearest * rng.uniform(1.0, 4.0)
        tree(rng, far * math.cos(angle), far * math.sin(angle), rng.uniform(3, 8), bark, green[k % 4])
    for k in range(6):
        angle, far = 2 * math.pi * k / 6 + rng.uniform(-0.3, 0.3), nearest * rng.uniform(3.5, 7.0)
        place = far * math.cos(angle), far * math.sin(angle)
        house(rng, *place, angle + math.pi / 2, (rng.uniform(4, 7), rng.uniform(3, 5), rng.uniform(3, 6)))


def garden(rng: np.random.Generator) -> None:
    """A garden table with a pot on grass, trees and houses around it, hills at the horizon, and the sky."""
    ground(rng, 4.0)
    trees_and_houses(rng, 6.0)
    wood = textured("wood", "Wave", 3.0, (0.2, 0.1, 0.05), (0.5, 0.32, 0.18))
    add("cylinder", wood, (0, 0, 0.74), radius=0.75, depth=0.05, vertices=64)
    for k in range(4):
        x, y = 0.5 * math.cos(1.57 * k), 0.5 * math.sin(1.57 * k)
        add_wire("leg", [(x, y, 0.72), (1.2 * x, 1.2 * y, 0)], 0.03, wood)
    pot = textured("pot", "Voronoi", 5.0, (0.1, 0.15, 0.3), (0.8, 0.78, 0.7))
    add("cone", pot, (0, 0, 0.9), vertices=64, radius1=0.11, radius2=0.18, depth=0.28)
    leaves(rng, 500, (0, 0, 1.2), np.array([0.24, 0.24, 0.22]), 0.03, material("herb", (0.15, 0.35, 0.06), 0.3))
    add("uv_sphere", material("ball", (0.9, 0.9, 0.92), 0.05, metallic=1.0), (0.42, 0.2, 0.84), (0.08, 0.08, 0.08))
    for k in range(3):
        angle = 2.1 * k + 0.5
        x, y = 1.25 * math.cos(angle), 1.25 * math.sin(angle)
        add("cube", wood, (x, y, 0.42), (0.2, 0.2, 0.02), smooth=False)
        for dx in (-0.17, 0.17):
            for dy in (-0.17, 0.17):
                back = 0.95 if dx * math.cos(angle) + dy * math.sin(angle) > 0.1 else 0.42
                add_wire("leg", [(x + dx, y + dy, back), (x + dx, y + dy, 0)], 0.02, wood)
    for k in range(24):
        angle = 2 * math.pi * k / 24
        stone = textured("stone", "Noise", 7.0, (0.15, 0.15, 0.14), (0.5, 0.48, 0.45))
        size = rng.uniform(0.1, 0.18)
        add("ico_sphere", stone, (2.4 * math.cos(angle), 2.4 * math.sin(angle), 0.02), (size, size, 0.6 * size))


def lane(rng: np.random.Generator) -> None:
    """A lane between two rows of houses with hedges and cars, which cameras walk along."""
    ground(rng, 6.0)
    paving = textured("paving", "Brick", 24.0, (0.12, 0.12, 0.13), (0.3, 0.29, 0.28))
    add("plane", paving, (0, 0, 0.01), (60, 2.6, 1), smooth=False)
    bark = textured("bark", "Noise", 12.0, (0.06, 0.04, 0.02), (0.25, 0.18, 0.12))
    green = [material(f"green{i}", (0.05 + 0.05 * i, 0.16 + 0.06 * i, 0.03), 0.5) for i in range(3)]
    for side in (-1, 1):
        for k, x in enumerate(np.arange(-55, 60, 11)):
            size = (rng.uniform(3.2, 4.6), rng.uniform(2.5, 3.5), rng.uniform(3.5, 7.0))
            house(rng, x + rng.uniform(-1, 1), side * rng.uniform(8.5, 10), 0, size)
            tree(rng, x + 5.5, side * rng.uniform(4.5, 6.0), rng.uniform(3, 6), bark, green[k % 3])
            hedge = (x + 1.5, side * 3.6, 0.5)
            leaves(rng, 500, hedge, np.array([2.2, 0.35, 0.5]), 0.05, green[(k + 1) % 3])
    for k, x in enumerate((-22.0, -9.0, 4.0, 15.0, 27.0)):
        paint, y = material(f"car{k}", tuple(rng.uniform(0.05, 0.7, 3)), 0.2), (2.0 if k % 2 else -2.0)
        add("cube", paint, (x, y, 0.55), (2.0, 0.8, 0.3), smooth=False)
        add("cube", material("pane", (0.03, 0.04, 0.06), 0.05), (x - 0.2, y, 1.05), (1.0, 0.7, 0.25), smooth=False)
        for dx in (-1.2, 1.2):
            wheel = add("cylinder", material("tyre", (0.02, 0.02, 0.02)), (x + dx, y, 0.32), radius=0.32, depth=1.66)
            wheel.rotation_euler = (math.pi / 2, 0, 0)
