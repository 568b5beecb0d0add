"""What stands in the scenes of blender_scenes.py: objects and a room, made of Blender's primitives."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import bpy
import numpy as np
from mathutils import Matrix


def material(name: str, color: tuple[float, float, float], roughness: float = 0.6, metallic: float = 0.0) -> Any:
    """Return a principled material."""
    made = bpy.data.materials.new(name)
    made.use_nodes = True
    principled = made.node_tree.nodes["Principled BSDF"]
    principled.inputs["Base Color"].default_value = (*color, 1.0)
    principled.inputs["Roughness"].default_value = roughness
    principled.inputs["Metallic"].default_value = metallic
    return made


def textured(name: str, kind: str, scale: float, dark: tuple[float, ...], light: tuple[float, ...]) -> Any:
    """Return a material with a procedural texture, from `dark` to `light`, in coordinates of the object."""
    made = material(name, (0.5, 0.5, 0.5))
    nodes, links = made.node_tree.nodes, made.node_tree.links
    place, texture, ramp = (nodes.new(t) for t in ("ShaderNodeTexCoord", f"ShaderNodeTex{kind}", "ShaderNodeValToRGB"))
    texture.inputs["Scale"].default_value = scale
    links.new(place.outputs["Object"], texture.inputs["Vector"])
    value = "Fac" if "Fac" in texture.outputs else 0 if "Distance" not in texture.outputs else "Distance"
    links.new(texture.outputs[value], ramp.inputs["Fac"])
    ramp.color_ramp.elements[0].color, ramp.color_ramp.elements[1].color = (*dark, 1.0), (*light, 1.0)
    ramp.color_ramp.elements[0].position, ramp.color_ramp.elements[1].position = 0.35, 0.65
    links.new(ramp.outputs["Color"], nodes["Principled BSDF"].inputs["Base Color"])
    return made


def add(
    primitive: str, made_of: Any, location: Any = (0, 0, 0), scale: Any = (1, 1, 1), smooth: bool = True, **k: Any
) -> Any:
    """Add a primitive mesh and return its object."""
    getattr(bpy.ops.mesh, f"primitive_{primitive}_add")(location=location, **k)
    result = bpy.context.object
    result.scale = scale
    result.data.materials.append(made_of)
    if smooth:
        bpy.ops.object.shade_smooth()
    return result


def add_mesh(name: str, vertices: Any, faces: Any, made_of: Any) -> Any:
    """Add a mesh of vertices [n, 3] and faces, and return its object."""
    mesh = bpy.data.meshes.new(name)
    mesh.from_pydata([tuple(map(float, v)) for v in vertices], [], [tuple(map(int, f)) for f in faces])
    result = bpy.data.objects.new(name, mesh)
    mesh.materials.append(made_of)
    bpy.context.collection.objects.link(result)
    return result


def add_wire(name: str, path: Any, radius: float, made_of: Any) -> Any:
    """Add a tube around a path [n, 3], and return its object."""
    curve = bpy.data.curves.new(name, "CURVE")
    curve.dimensions, curve.bevel_depth = "3D", radius
    line = curve.splines.new("POLY")
    line.points.add(len(path) - 1)
    for point, place in zip(line.points, path, strict=True):
        point.co = (*map(float, place), 1.0)
    result = bpy.data.objects.new(name, curve)
    curve.materials.append(made_of)
    bpy.context.collection.objects.link(result)
    return result


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


SCENES: dict[str, Callable[[np.random.Generator], None]] = {
    "plant": plant,
    "metals": metals,
    "wires": wires,
    "room": room,
}
