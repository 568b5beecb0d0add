"""Objects of blender_scenes.py that stand alone, before nothing."""

from __future__ import annotations

import math

import numpy as np
from blender_shapes import add, add_mesh, add_wire, material, textured
from mathutils import Matrix


def plant(rng: np.random.Generator) -> None:
    """A small tree in a pot: thin stems and a few hundred leaves, like ficus."""
    pot = textured("pot", "Noise", 9.0, (0.25, 0.07, 0.03), (0.55, 0.22, 0.1))
    add("cone", pot, (0, 0, -0.85), vertices=64, radius1=0.32, radius2=0.45, depth=0.6)
    add(
        "cylinder",
        textured("soil", "Noise", 60.0, (0.02, 0.01, 0.005), (0.2, 0.12, 0.06)),
        (0, 0, -0.54),
        radius=0.42,
        depth=0.03,
    )
    bark = textured("bark", "Noise", 40.0, (0.1, 0.05, 0.02), (0.35, 0.22, 0.12))
    green = [material(f"leaf{i}", (0.05 + 0.04 * i, 0.22 + 0.06 * i, 0.04), 0.25) for i in range(4)]
    leaf = np.array(
        [
            [0, 0, 0],
            [0.35, 0.16, 0.05],
            [0.35, -0.16, 0.05],
            [0.75, 0.12, 0.0],
            [0.75, -0.12, 0.0],
            [1.1, 0, -0.12],
            [0.4, 0, -0.02],
            [0.75, 0, -0.06],
        ]
    )
    faces = [(0, 6, 1), (0, 2, 6), (1, 6, 7, 3), (6, 2, 4, 7), (3, 7, 5), (7, 4, 5)]
    for k in range(16):
        angle, height, reach = rng.uniform(0, 2 * math.pi), rng.uniform(0.1, 1.1), rng.uniform(0.5, 1.0)
        t = np.linspace(0, 1, 24)[:, None]
        top = np.array([math.cos(angle) * reach, math.sin(angle) * reach, height])
        base = np.array([0.03 * math.cos(angle), 0.03 * math.sin(angle), -0.5])
        bend = np.array([0.0, 0.0, 0.5]) * np.sin(math.pi * t) + 0.04 * np.sin(9 * t + rng.uniform(0, 6, 3))
        stem = base + (top - base) * t**1.3 + bend * t
        add_wire(f"stem{k}", stem, 0.012, bark)
        for place in stem[6:]:
            for _ in range(2):
                turn = Matrix.Rotation(rng.uniform(0, 2 * math.pi), 3, "Z") @ Matrix.Rotation(
                    rng.uniform(-0.6, 0.9), 3, "Y"
                )
                vertices = place + rng.uniform(0.14, 0.24) * leaf @ np.array(turn).T
                add_mesh("leaf", np.clip(vertices, -1.28, 1.28), faces, green[rng.integers(4)])


def metals(rng: np.random.Generator) -> None:
    """Nine balls and heads on a plate, from mirror to chalk, like materials."""
    add(
        "cylinder",
        textured("plate", "Checker", 6.0, (0.03, 0.03, 0.04), (0.7, 0.7, 0.68)),
        (0, 0, -0.6),
        radius=1.28,
        depth=0.08,
        vertices=96,
    )
    for i in range(9):
        x, y = 0.75 * (i % 3 - 1), 0.75 * (i // 3 - 1)
        color = tuple(rng.uniform(0.1, 0.9, 3))
        made_of = material(f"m{i}", color, (0.02, 0.15, 0.4)[i % 3], metallic=(1.0, 0.0, 1.0)[i // 3])
        if i % 2:
            head = add("monkey", made_of, (x, y, -0.27), (0.3, 0.3, 0.3))
            head.rotation_euler = (0, 0, rng.uniform(0, 2 * math.pi))
            head.modifiers.new("smooth", "SUBSURF").render_levels = 2
        else:
            add("uv_sphere", made_of, (x, y, -0.27), (0.29, 0.29, 0.29), segments=64, ring_count=32)


def wires(rng: np.random.Generator) -> None:
    """A microphone: a cage of thin wires over a dark core, a cable on the ground, like mic."""
    steel, dark = (
        material("steel", (0.55, 0.55, 0.58), 0.2, metallic=1.0),
        textured("foam", "Noise", 80.0, (0.01, 0.01, 0.01), (0.12, 0.12, 0.13)),
    )
    add("uv_sphere", dark, (0, 0, 0.7), (0.3, 0.3, 0.36))
    cage = add("ico_sphere", steel, (0, 0, 0.7), (0.4, 0.4, 0.48), smooth=False, subdivisions=5)
    cage.modifiers.new("w", "WIREFRAME").thickness = 0.012
    add("torus", steel, (0, 0, 0.7), major_radius=0.41, minor_radius=0.025)
    add(
        "cone",
        textured("grip", "Brick", 30.0, (0.03, 0.03, 0.035), (0.2, 0.2, 0.22)),
        (0, 0, -0.1),
        vertices=64,
        radius1=0.12,
        radius2=0.24,
        depth=1.0,
    )
    t = np.linspace(0, 1, 400)[:, None]
    coil = np.concatenate(
        [(0.3 + 0.85 * t) * np.cos(22 * t + 1), (0.3 + 0.85 * t) * np.sin(22 * t + 1), -0.9 + 0.06 * np.sin(40 * t)],
        axis=1,
    )
    add_wire("cable", coil, 0.022, material("rubber", (0.02, 0.02, 0.02), 0.4))
    for _ in range(40):
        a = rng.uniform(0, 2 * math.pi)
        add_wire(
            "hair",
            [
                (0.2 * math.cos(a), 0.2 * math.sin(a), -0.6),
                (1.1 * math.cos(a + 0.4), 1.1 * math.sin(a + 0.4), rng.uniform(-0.95, -0.5)),
            ],
            0.006,
            steel,
        )


def dishes(rng: np.random.Generator) -> None:
    """A laid table: smooth plates, fruit, forks, and glasses of water that show what stands behind them."""
    cloth = textured("cloth", "Checker", 9.0, (0.55, 0.08, 0.07), (0.8, 0.78, 0.74))
    add("cylinder", cloth, (0, 0, -0.55), radius=1.25, depth=0.06, vertices=96)
    china = material("china", (0.85, 0.84, 0.8), 0.08)
    steel = material("steel", (0.6, 0.6, 0.62), 0.15, metallic=1.0)
    glass = material("glass", (1.0, 1.0, 1.0), 0.0)
    glass.node_tree.nodes["Principled BSDF"].inputs["Transmission Weight"].default_value = 1.0
    for k in range(4):
        angle = math.pi / 2 * k + 0.3
        x, y = 0.8 * math.cos(angle), 0.8 * math.sin(angle)
        add("cone", china, (x, y, -0.48), vertices=64, radius1=0.2, radius2=0.33, depth=0.07)
        add("torus", china, (x, y, -0.45), major_radius=0.33, minor_radius=0.015)
        turned = angle + 0.55
        fx, fy = 0.85 * math.cos(turned), 0.85 * math.sin(turned)
        handle = [(0.6 * fx, 0.6 * fy, -0.5), (0.9 * fx, 0.9 * fy, -0.48), (1.15 * fx, 1.15 * fy, -0.5)]
        add_wire("handle", handle, 0.018, steel)
        for side in (-0.04, 0.0, 0.04):
            tine = [(0.6 * fx, 0.6 * fy, -0.5), (0.42 * fx - side * fy, 0.42 * fy + side * fx, -0.5)]
            add_wire("tine", tine, 0.009, steel)
        gx, gy = 0.5 * math.cos(angle - 0.5), 0.5 * math.sin(angle - 0.5)
        add("cylinder", glass, (gx, gy, -0.3), radius=0.1, depth=0.44, vertices=64)
    add("uv_sphere", china, (0, 0, -0.42), (0.36, 0.36, 0.14), segments=64, ring_count=32)
    for k in range(14):
        color = np.array([(0.7, 0.1, 0.05), (0.75, 0.5, 0.05), (0.25, 0.5, 0.08)][k % 3]) * rng.uniform(0.7, 1.1)
        skin = textured(f"skin{k}", "Noise", rng.uniform(10, 30), tuple(0.5 * color), tuple(color))
        ring, angle = (0.0, 0.0) if k == 0 else ((0.24, 2 * math.pi * k / 9) if k < 10 else (0.13, 1.57 * k))
        place = ring * math.cos(angle), ring * math.sin(angle), -0.2 + (0.16 if ring < 0.2 else 0.0)
        size = rng.uniform(0.1, 0.13)
        add("uv_sphere", skin, place, (size, size, size * rng.uniform(0.85, 1.1)))
