"""A place of blender_scenes.py that is seen from one side: a plant before a shelf and a window, trees behind it."""

from __future__ import annotations

import math
from collections.abc import Iterator

import bpy
import numpy as np
from blender_flat import Triple, box, wood
from blender_places import ground, house, leaves, tree
from blender_shapes import add, add_wire, material, textured

SIDES = (0.9, 0.6)  # of the window in which cameras stand [m]
TABLE = 0.825  # height of its top [m]


def front(rng: np.random.Generator) -> None:
    """One end of a room: a table with a plant, a shelf of books, and a large window to a garden with houses."""
    garden(rng)
    walls()
    shelf(rng)
    on_table(rng)
    bpy.ops.object.light_add(type="AREA", location=(-0.5, 1.0, 2.5))
    bpy.context.object.data.energy, bpy.context.object.data.size = 70, 1.2


def stand(rng: np.random.Generator, n: int) -> Iterator[tuple[Triple, Triple]]:
    """Yield places and targets of n photos by hand, row by row there and back, from 1.6 m before the plant."""
    columns = math.ceil(math.sqrt(n * SIDES[0] / SIDES[1]))
    rows = math.ceil(n / columns)
    for i in range(n):
        row, column = divmod(i, columns)
        column = columns - 1 - column if row % 2 else column
        x = SIDES[0] * (column / (columns - 1) - 0.5) + rng.normal(0, 0.025)
        z = 1.35 + SIDES[1] * (row / max(rows - 1, 1) - 0.5) + rng.normal(0, 0.025)
        target = (0.35 * x + 0.05 + rng.normal(0, 0.06), 3.0, 1.3 + 0.3 * (z - 1.35) + rng.normal(0, 0.05))
        yield (x, rng.normal(0, 0.05), z), target


def garden(rng: np.random.Generator) -> None:
    """Add what is outside."""
    ground(rng, 0.1)
    bark = textured("bark", "Noise", 12.0, (0.06, 0.04, 0.02), (0.25, 0.18, 0.12))
    greens = [material(f"green{i}", (0.05 + 0.05 * i, 0.16 + 0.06 * i, 0.03), 0.5) for i in range(3)]
    for i, (x, y) in enumerate(((2.0, 8.5), (5.5, 13.0), (3.5, 17.0), (9.0, 22.0), (0.0, 20.0), (14.0, 30.0))):
        tree(rng, x, y, rng.uniform(3, 6), bark, greens[i % 3])
    house(rng, 7, 28, 0.2, (5, 4, 4))
    house(rng, 22, 45, -0.3, (5, 4, 6))
    house(rng, -4, 40, 0.1, (5, 4, 5))


def walls() -> None:
    """Add floor, ceiling, and walls with a window."""
    floor = textured("floor", "Wave", 1.2, (0.25, 0.13, 0.06), (0.45, 0.28, 0.15))
    floor.node_tree.nodes["Principled BSDF"].inputs["Roughness"].default_value = 0.25
    brick = textured("wall", "Voronoi", 14.0, (0.3, 0.16, 0.12), (0.65, 0.58, 0.5))
    white, frame = material("white", (0.8, 0.8, 0.8)), material("frame", (0.9, 0.9, 0.9), 0.3)
    box(floor, (0, 1.5, 0.0), (4, 2.5, 0.03))
    box(material("ceiling", (0.9, 0.9, 0.9)), (0, 1.5, 2.65), (4, 2.5, 0.05))
    box(material("plain", (0.55, 0.62, 0.6)), (-4.0, 1.5, 1.3), (0.05, 2.5, 1.3))
    box(brick, (-2.2, 4.05, 1.3), (1.8, 0.05, 1.3))
    for place, half in (((1.5, 0.35), (1.9, 0.35)), ((1.5, 2.5), (1.9, 0.15)), ((3.6, 1.3), (0.3, 1.3))):
        box(white, (place[0], 4.05, place[1]), (half[0], 0.05, half[1]))
    for x in (-0.35, 1.5, 3.3):
        box(frame, (x, 4.02, 1.5), (0.03, 0.04, 0.85))


def shelf(rng: np.random.Generator) -> None:
    """Add four boards with books."""
    books = [textured(f"book{i}", "Noise", 6.0, *map(tuple, rng.uniform(0.05, 0.8, (2, 3)))) for i in range(12)]
    for z in (0.7, 1.15, 1.6, 2.05):
        box(wood(), (-1.6, 3.8, z), (0.9, 0.16, 0.015))
        for x in np.arange(-2.4, -0.75, 0.07):
            half = rng.uniform(0.1, 0.17)
            if rng.uniform() < 0.85:
                book = books[rng.integers(12)]
                box(book, (x, 3.8, z + 0.015 + half), (rng.uniform(0.015, 0.03), 0.12, half))


def on_table(rng: np.random.Generator) -> None:
    """Add the table, and on it a plant with flowers, a mirror ball, a head, a book and a card."""
    box(wood(), (0.0, 1.75, TABLE - 0.025), (1.1, 0.55, 0.025))
    pot = textured("pot", "Voronoi", 30.0, (0.1, 0.15, 0.3), (0.8, 0.78, 0.7))
    add("cone", pot, (0.05, 1.6, 0.96), vertices=64, radius1=0.09, radius2=0.14, depth=0.26)
    leaf = material("leaf", (0.1, 0.3, 0.05), 0.35)
    leaves(rng, 260, (0.05, 1.6, 1.36), np.array([0.26, 0.24, 0.24]), 0.035, leaf)
    for i in range(9):
        angle, out = 2 * math.pi * i / 9, rng.uniform(0.3, 0.5)
        tip = (0.05 + out * math.cos(angle), 1.6 + 0.7 * out * math.sin(angle), 1.25 + rng.uniform(0.1, 0.45))
        add_wire("stem", [(0.05, 1.6, 1.05), (0.05 + 0.4 * (tip[0] - 0.05), 1.6, 1.3), tip], 0.006, leaf)
        add("uv_sphere", material(f"flower{i}", (0.8, 0.1 + 0.07 * i, 0.1 + 0.05 * i), 0.4), tip, (0.04, 0.04, 0.03))
    add("uv_sphere", material("mirror", (0.9, 0.9, 0.9), 0.03, metallic=1.0), (-0.5, 1.5, 0.93), (0.11, 0.11, 0.11))
    add("monkey", material("red", (0.7, 0.05, 0.05), 0.2), (0.55, 1.7, 0.98), (0.16, 0.16, 0.16))
    box(textured("cover", "Checker", 9.0, (0.2, 0.3, 0.5), (0.8, 0.75, 0.6)), (-0.35, 1.9, 0.86), (0.2, 0.14, 0.035))
    box(material("card", (0.85, 0.83, 0.75)), (0.35, 1.4, 0.83), (0.12, 0.16, 0.004))
