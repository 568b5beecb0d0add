"""Materials, meshes and tubes of the scenes of blender_scenes.py, made of Blender's primitives."""

from __future__ import annotations

from typing import Any

import bpy


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
