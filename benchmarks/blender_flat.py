"""A place of blender_scenes.py inside a building: a flat of two furnished rooms, and a walk through it."""

from __future__ import annotations

import math
from typing import Any

import bpy
import numpy as np
from blender_places import house, leaves, tree
from blender_shapes import add, add_wire, material, textured

Triple = tuple[float, float, float]
# Corners of the walk, seen from above [m]: around the first room, through the door, around the second and back.
WAY = (
    *((1.2, 0.9), (3.6, 0.9), (4.2, 1.6), (3.8, 2.8), (2.9, 2.9), (1.0, 2.3), (1.0, 1.2), (3.4, 1.0), (5.0, 1.0)),
    *((5.9, 1.6), (7.3, 1.6), (8.9, 1.3), (7.2, 2.2), (6.6, 3.3), (5.6, 2.6), (5.7, 1.2), (4.4, 1.0)),
)


def flat(rng: np.random.Generator) -> None:
    """Two rooms of 5 x 4 m with plain walls, a shiny floor and windows, through which trees and houses are seen."""
    walls()
    books = living_room(rng)
    pictures(rng)
    bedroom(rng, books)
    for x in (2.5, 7.5):
        bpy.ops.object.light_add(type="AREA", location=(x, 2, 2.55))
        bpy.context.object.data.energy, bpy.context.object.data.size = 45, 0.8
    box(textured("grass", "Noise", 200.0, (0.04, 0.09, 0.02), (0.18, 0.24, 0.06)), (5, 54, -1), (60, 50, 0.02))
    bark = textured("bark", "Noise", 12.0, (0.06, 0.04, 0.02), (0.25, 0.18, 0.12))
    for x, y in ((0, 9), (3, 12), (6, 10), (9, 13), (12, 9)):
        tree(rng, x, y, 5.0, bark, material("green", (0.1, 0.25, 0.04)))
    house(rng, 4, 24, 0.1, (5, 4, 5))
    house(rng, -8, 26, 0, (5, 4, 4))
    house(rng, 16, 25, 0, (5, 4, 6))


def walk(rng: np.random.Generator, n: int) -> list[tuple[Triple, Triple]]:
    """Return places and targets of n photos along the way, at the height of the eyes, that look around."""
    way = np.array(WAY)
    length = np.r_[0, np.cumsum(np.linalg.norm(np.diff(way, axis=0), axis=1))]
    along, window = np.linspace(0, length[-1], n), np.hanning(7)
    window /= window.sum()
    places = (np.interp(along, length, way[:, axis]) for axis in (0, 1))
    xs, ys = (np.convolve(np.pad(each, 3, "edge"), window, "valid") for each in places)
    found = []
    for i, (x, y) in enumerate(zip(xs, ys, strict=True)):
        angle = math.atan2(2 - y, (2.5 if x < 5 else 7.5) - x) + 1.1 * math.sin(2 * math.pi * i / 17)
        eye = (x, y, 1.5 + 0.12 * math.sin(i / 6) + rng.normal(0, 0.02))
        found.append((eye, (x + math.cos(angle), y + math.sin(angle), eye[2] - 0.22 + rng.normal(0, 0.1))))
    return found


def box(made_of: Any, place: Triple, half: Triple) -> None:
    """Add a box by its middle and half of its sides."""
    add("cube", made_of, place, half, smooth=False)


def walls() -> None:
    """Add floor, ceiling, walls with two windows, curtains, and a wall with a door between the rooms."""
    white, plain = material("white", (0.82, 0.81, 0.78)), material("plain", (0.55, 0.62, 0.6))
    floor = textured("floor", "Wave", 1.2, (0.25, 0.13, 0.06), (0.45, 0.28, 0.15))
    floor.node_tree.nodes["Principled BSDF"].inputs["Roughness"].default_value = 0.25
    box(floor, (5, 2, -0.05), (5, 2, 0.05))
    box(material("ceiling", (0.9, 0.9, 0.9)), (5, 2, 2.65), (5, 2, 0.05))
    box(white, (5, -0.05, 1.3), (5, 0.05, 1.3))
    for x0, x1 in ((0, 1.5), (3.5, 6.5), (8.5, 10)):
        box(white, ((x0 + x1) / 2, 4.05, 1.3), ((x1 - x0) / 2, 0.05, 1.3))
    for x0 in (1.5, 6.5):
        box(white, (x0 + 1, 4.05, 0.4), (1, 0.05, 0.4))
        box(white, (x0 + 1, 4.05, 2.4), (1, 0.05, 0.2))
        frame = material("frame", (0.9, 0.9, 0.9), 0.3)
        box(frame, (x0 + 1, 4.05, 1.5), (0.03, 0.03, 0.7))
        box(frame, (x0 + 1, 4.05, 1.5), (1, 0.03, 0.03))
        curtain = textured("curtain", "Wave", 8.0, (0.5, 0.3, 0.25), (0.75, 0.6, 0.5))
        for side in (-0.1, 2.1):
            box(curtain, (x0 + side, 3.9, 1.35), (0.22, 0.04, 1.1))
    for x in (-0.05, 10.05):
        box(plain, (x, 2, 1.3), (0.05, 2, 1.3))
    box(white, (5, 0.25, 1.3), (0.06, 0.25, 1.3))
    box(white, (5, 2.75, 1.3), (0.06, 1.25, 1.3))
    box(white, (5, 1.0, 2.3), (0.06, 0.5, 0.3))


def wood() -> Any:
    """Return the material of the furniture."""
    return textured("wood", "Noise", 8.0, (0.3, 0.15, 0.06), (0.55, 0.35, 0.18))


def table(made_of: Any, place: Triple, half: tuple[float, float], inset: float) -> None:
    """Add a table by the middle of its board, half of its sides, and how far its legs stand inside."""
    x, y, z = place
    box(made_of, place, (*half, 0.02))
    for dx in (inset - half[0], half[0] - inset):
        for dy in (inset - half[1], half[1] - inset):
            box(made_of, (x + dx, y + dy, z / 2), (0.025, 0.025, z / 2))


def living_room(rng: np.random.Generator) -> list[Any]:
    """Add a sofa, a table, plants, a screen and a shelf of books, and return the materials of the books."""
    sofa = textured("sofa", "Noise", 30.0, (0.1, 0.13, 0.2), (0.2, 0.25, 0.35))
    box(sofa, (1.2, 3.2, 0.25), (0.9, 0.4, 0.2))
    box(sofa, (1.2, 3.6, 0.6), (0.9, 0.12, 0.3))
    for x in (0.2, 2.2):
        box(sofa, (x, 3.2, 0.4), (0.12, 0.45, 0.28))
    for i in range(3):
        dark, light = tuple(rng.uniform(0, 0.5, 3)), tuple(rng.uniform(0.4, 1, 3))
        add(
            "uv_sphere",
            textured("cushion", "Checker", 6.0 + i, dark, light),
            (0.7 + 0.5 * i, 3.3, 0.62),
            (0.2, 0.1, 0.2),
        )
    table(wood(), (2.2, 1.8, 0.42), (0.55, 0.35), 0.05)
    add("cylinder", material("vase", (0.1, 0.25, 0.5), 0.1), (2.1, 1.8, 0.57), radius=0.07, depth=0.26)
    small, tall = np.array([0.16, 0.16, 0.16]), np.array([0.35, 0.35, 0.5])
    leaves(rng, 250, (2.1, 1.8, 0.85), small, 0.025, material("leaf", (0.1, 0.3, 0.05), 0.4))
    leaves(rng, 500, (4.5, 3.4, 1.1), tall, 0.05, material("leaf2", (0.07, 0.25, 0.06), 0.4))
    add("cone", material("pot", (0.6, 0.3, 0.2)), (4.5, 3.4, 0.2), radius1=0.15, radius2=0.2, depth=0.4)
    box(textured("rug", "Voronoi", 5.0, (0.4, 0.08, 0.08), (0.75, 0.6, 0.4)), (2.2, 1.8, 0.01), (1.2, 0.9, 0.01))
    box(wood(), (2.2, 0.25, 0.25), (0.8, 0.2, 0.25))
    box(material("tv", (0.01, 0.01, 0.01), 0.05), (2.2, 0.2, 0.95), (0.6, 0.03, 0.36))
    books = [material(f"book{i}", tuple(rng.uniform(0.05, 0.8, 3)), 0.5) for i in range(12)]
    for z in (0.3, 0.7, 1.1, 1.5, 1.9):
        box(wood(), (0.18, 1.2, z), (0.16, 0.7, 0.015))
        for y in np.arange(0.55, 1.85, 0.06):
            half = rng.uniform(0.09, 0.16)
            if rng.uniform() < 0.85:
                book = books[rng.integers(12)]
                box(book, (0.17, y, z + 0.015 + half), (0.12, rng.uniform(0.015, 0.028), half))
    return books


def pictures(rng: np.random.Generator) -> None:
    """Add pictures on the walls. The last number says along which axis they are thin."""
    places = (
        *((3.7, 0.02, 1.5, 1), (0.9, 0.02, 1.6, 1), (5.07, 3.0, 1.5, 0)),
        *((4.93, 2.4, 1.5, 0), (7.0, 0.02, 1.5, 1), (9.98, 2.0, 1.6, 0)),
    )
    for k, (x, y, z, thin) in enumerate(places):
        kind, dark = ("Voronoi", "Noise", "Magic")[k % 3], tuple(rng.uniform(0, 0.4, 3))
        picture = textured(f"pic{k}", kind, 3 + k, dark, tuple(rng.uniform(0.5, 1, 3)))
        box(picture, (x, y, z), (0.015, 0.3, 0.22) if thin == 0 else (0.3, 0.015, 0.22))
        frame = material("fr", (0.05, 0.04, 0.03))
        box(frame, (x, y, z), (0.01, 0.33, 0.25) if thin == 0 else (0.33, 0.01, 0.25))


def bedroom(rng: np.random.Generator, books: list[Any]) -> None:
    """Add a bed, a desk with a screen and books, a chair and a wardrobe."""
    box(wood(), (8.8, 2.9, 0.2), (1.05, 0.85, 0.2))
    box(textured("sheet", "Noise", 4.0, (0.6, 0.6, 0.65), (0.85, 0.85, 0.88)), (8.75, 2.9, 0.48), (1.0, 0.8, 0.1))
    for y in (2.5, 3.3):
        add("uv_sphere", material("pillow", (0.9, 0.88, 0.85)), (9.5, y, 0.65), (0.22, 0.3, 0.1))
    blanket = textured("blanket", "Checker", 9.0, (0.2, 0.3, 0.5), (0.8, 0.75, 0.6))
    box(blanket, (8.2, 2.9, 0.53), (0.45, 0.83, 0.08))
    table(wood(), (6.6, 0.35, 0.74), (0.7, 0.3), 0.05)
    box(material("screen", (0.02, 0.02, 0.03), 0.1), (6.6, 0.2, 1.05), (0.3, 0.015, 0.2))
    for i in range(10):
        book = books[rng.integers(12)]
        box(book, (6.1 + 0.05 * i, 0.2, 0.85), (0.02, 0.08, rng.uniform(0.07, 0.12)))
    chair = textured("chair", "Noise", 10.0, (0.1, 0.1, 0.1), (0.3, 0.28, 0.26))
    box(chair, (6.7, 1.0, 0.45), (0.22, 0.22, 0.03))
    box(chair, (6.7, 1.2, 0.8), (0.22, 0.03, 0.3))
    for dx in (-0.18, 0.18):
        for dy in (-0.18, 0.18):
            add_wire("leg", [(6.7 + dx, 1 + dy, 0), (6.7 + dx, 1 + dy, 0.45)], 0.015, chair)
    box(wood(), (9.6, 0.6, 1.0), (0.3, 0.5, 1.0))
