"""Test scenes for the add-on, rendered one after the other by a Python with bpy.

    python blender_child.py FOLDER [viewport]

FOLDER contains model.ply, other.ply, cameras.json, camera_path.json and addon.zip. The script writes its results to
out.json, or to viewport.json for the viewport, which needs OpenGL.
"""

from __future__ import annotations

import itertools
import json
import os
import sys
import time
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

FOLDER = Path(sys.argv[1])
os.environ["BLENDER_USER_RESOURCES"] = str(FOLDER / "user")  # before bpy loads: it changes no user file

import bpy  # noqa: E402, I001  # first: it brings the others
import addon_utils  # noqa: E402
import numpy as np  # noqa: E402
from mathutils import Matrix, Vector  # noqa: E402

ADDON = "bl_ext.user_default.clsplat"
Facts = dict[str, Any]


def scene() -> Any:
    """Start an empty file with the chosen engine."""
    bpy.ops.wm.read_homefile(use_empty=True, use_factory_startup=False)
    made = bpy.context.scene
    made.render.engine = "CLSPLAT"
    made.view_settings.view_transform = "Standard"
    made.render.image_settings.file_format = "PNG"
    made.render.film_transparent = False
    made.render.dither_intensity = 0.0  # dithering noise of one step, which Blender adds by default
    return made


def rendered(name: str, **extra: Any) -> str:
    """Return the file of a frame, or the message in Blender's report area."""
    file = FOLDER / f"{name}.png"
    bpy.context.scene.render.filepath = str(file)
    try:
        bpy.ops.render.render(write_still=True, **extra)
    except RuntimeError as error:
        return str(error)
    return str(file)


def reported(operator: Callable[..., Any], **values: Any) -> str:
    """Return the message or the result of an operator."""
    try:
        return str(operator(**values))
    except RuntimeError as error:
        return str(error)


def splats(name: str = "model.ply", **values: Any) -> Any:
    bpy.ops.clsplat.import_splats(filepath=str(FOLDER / name), **values)
    return bpy.context.view_layer.objects.active


def cameras() -> Any:
    bpy.ops.clsplat.import_cameras(filepath=str(FOLDER / "cameras.json"))
    return bpy.context.scene.camera


# ---- the scenes ------------------------------------------------------------------------------


def install() -> Facts:
    start = time.perf_counter()
    bpy.ops.extensions.package_install_files(
        filepath=str(FOLDER / "addon.zip"), repo="user_default", enable_on_install=True
    )
    return {"enabled": ADDON in bpy.context.preferences.addons, "seconds": time.perf_counter() - start}


def imported() -> Facts:
    scene()
    item = splats()
    mesh = item.data
    colours = np.empty(4 * len(mesh.vertices), np.float32)
    mesh.attributes["color"].data.foreach_get("color", colours)
    thinned = splats(points=10)
    return {
        "points": len(mesh.vertices),
        "attributes": sorted(mesh.attributes.keys()),
        "ply": item.clsplat_ply,
        "rotation": list(item.rotation_euler),
        "first": list(mesh.vertices[0].co),
        "colour": colours[:4].tolist(),
        "thinned": len(thinned.data.vertices),
    }


def frames() -> Facts:
    """Render each camera of cameras.json, without and with a transform of the common parent."""
    made = scene()
    item = splats()
    cameras()
    found = {}
    for camera in [each for each in made.objects if each.type == "CAMERA"]:
        made.camera = camera
        found[camera.name] = rendered(f"plain_{camera.name}")
    item.matrix_world = Matrix.Translation((3, -2, 1)) @ Matrix.Rotation(0.7, 4, (1, 2, 3)) @ Matrix.Scale(2.5, 4)
    found["moved"] = rendered("moved")
    item.matrix_world = Matrix.Identity(4)
    made.clsplat_background = (0.2, 0.5, 1.0)
    found["background"] = rendered("background")
    made.render.film_transparent = True
    found["transparent"] = rendered("transparent")
    made.view_settings.view_transform = "Raw"
    found["raw"] = rendered("raw")
    made.view_settings.view_transform, made.render.film_transparent = "Standard", False
    made.clsplat_background = (0.0, 0.0, 0.0)
    made.render.use_border, made.render.border_min_x, made.render.border_max_x = True, 0.25, 0.75
    made.render.border_min_y, made.render.border_max_y, made.render.use_crop_to_border = 0.5, 1.0, True
    found["border"] = rendered("border")
    made.render.use_crop_to_border = False
    found["border_whole"] = rendered("border_whole")
    return {"files": found}


def together() -> Facts:
    """Render two objects. One of them is rotated, scaled and moved."""
    scene()
    splats(upright=False)
    other = splats("other.ply", upright=False)
    other.matrix_world = Matrix.Translation((0.3, 0.2, 0)) @ Matrix.Rotation(0.7, 4, (1, 2, 3)) @ Matrix.Scale(0.5, 4)
    bpy.context.view_layer.update()
    bpy.context.view_layer.objects.active = bpy.data.objects["model"]
    cameras()
    return {"file": rendered("together"), "matrix": [list(row) for row in other.matrix_world]}


def animation() -> Facts:
    made = scene()
    splats()
    bpy.ops.clsplat.import_cameras(filepath=str(FOLDER / "camera_path.json"))
    made.render.filepath = str(FOLDER / "animation_")
    bpy.ops.render.render(animation=True)
    bpy.ops.clsplat.export_cameras(filepath=str(FOLDER / "exported_path.json"), content="PATH")
    made.frame_set(made.frame_start)
    bpy.ops.object.select_all(action="DESELECT")
    bpy.ops.clsplat.export_cameras(filepath=str(FOLDER / "exported_cameras.json"), content="CAMERAS")
    turns = []
    for frame in range(made.frame_start, made.frame_end + 1):
        made.frame_set(frame)
        turns.append(made.camera.rotation_quaternion.copy())
    nearest = min(first.dot(second) for first, second in itertools.pairwise(turns))
    return {
        "frames": [made.frame_start, made.frame_end],
        "nearest": nearest,
        "fps": made.render.fps / made.render.fps_base,
        "files": sorted(str(path) for path in FOLDER.glob("animation_*.png")),
    }


def projections() -> Facts:
    """Project points with the matrix of Blender, for all kinds of lenses."""
    made, rng, cases = scene(), np.random.default_rng(0), []
    data = bpy.data.cameras.new("c")
    item = bpy.data.objects.new("c", data)
    made.collection.objects.link(item)
    made.camera = item
    for fit in ("AUTO", "HORIZONTAL", "VERTICAL"):
        for width, height in ((64, 48), (48, 64)):
            for aspects in ((1.0, 1.0), (1.0, 1.7), (1.4, 1.0)):
                data.sensor_fit = fit
                data.lens, data.sensor_width, data.sensor_height = rng.uniform((20, 20, 15), (60, 40, 30)).tolist()
                data.shift_x, data.shift_y = rng.uniform(-0.4, 0.4, 2).tolist()
                data.clip_start = 0.3
                item.matrix_world = (
                    Matrix.Translation(rng.normal(size=3).tolist())
                    @ Matrix.Rotation(rng.uniform(0, 3), 4, Vector(rng.normal(size=3).tolist()))
                    @ Matrix.Scale(1.5, 4)
                )
                made.render.resolution_x, made.render.resolution_y = width * 2, height * 2
                made.render.resolution_percentage = 50
                made.render.pixel_aspect_x, made.render.pixel_aspect_y = aspects
                bpy.context.view_layer.update()
                matrix = item.calc_matrix_camera(
                    bpy.context.evaluated_depsgraph_get(), x=width, y=height, scale_x=aspects[0], scale_y=aspects[1]
                )
                view = item.matrix_world.normalized().inverted()
                cases.append(
                    {
                        "lens": [data.lens, data.sensor_width, data.sensor_height, fit, data.shift_x, data.shift_y],
                        "raster": [width, height, *aspects],
                        "world": [list(row) for row in item.matrix_world],
                        "view": [list(row) for row in view],
                        "projection": [list(row) for row in matrix],
                    }
                )
    return {"cases": cases}


def faults() -> Facts:
    made, told = scene(), {}
    told["no camera"] = rendered("fault")
    item = splats()
    camera = cameras()
    camera.data.type = "ORTHO"
    told["orthographic"] = rendered("fault")
    camera.data.type = "PANO"
    told["panoramic"] = rendered("fault")
    camera.data.type = "PERSP"
    item.scale = (1, 1, 2)
    told["stretched"] = rendered("fault")
    item.scale = (1, 1, 1)
    item.clsplat_ply = str(FOLDER / "gone.ply")
    told["missing"] = rendered("fault")
    item.clsplat_ply = str(FOLDER / "cameras.json")
    told["no PLY"] = rendered("fault")
    told["import"] = reported(bpy.ops.clsplat.import_splats, filepath=str(FOLDER / "cameras.json"))
    told["cameras"] = reported(bpy.ops.clsplat.import_cameras, filepath=str(FOLDER / "model.ply"))
    made.camera = None
    told["export"] = reported(bpy.ops.clsplat.export_cameras, filepath=str(FOLDER / "x.json"), content="PATH")
    bpy.data.objects.remove(item)
    made.camera = camera
    told["nothing"] = rendered("nothing")
    return told


def clipped() -> Facts:
    made = scene()
    splats()
    camera = cameras()
    camera.data.clip_end = 1e-3 + camera.data.clip_start
    return {"file": rendered("clipped"), "engine": made.render.engine}


def composited() -> Facts:
    """Composite a plane through the middle of the splats that covers the left half of the image."""
    with_plane()
    told = reported(bpy.ops.clsplat.composite, engine="CYCLES")
    return {"told": told, "file": rendered("composited"), "scenes": [each.name for each in bpy.data.scenes]}


def composited_again() -> Facts:
    """Composite, and change the frame, the name and the nodes afterwards. A scene of the user has the usual name."""
    made, others = with_plane(), set(bpy.data.scenes)
    bpy.ops.clsplat.composite(engine="CYCLES")
    (first,) = set(bpy.data.scenes) - others
    first.name = "other name"
    made.name = "Shot"
    mine = bpy.data.scenes.new("Shot splats")
    tree = made.compositing_node_group if bpy.app.version >= (5, 0, 0) else made.node_tree
    tree.nodes.new("CompositorNodeGlare").name = "Mine"
    bpy.ops.clsplat.composite(engine="CYCLES")
    (splats_scene,) = set(bpy.data.scenes) - others - {mine}
    with bpy.context.temp_override(scene=splats_scene):
        told = reported(bpy.ops.clsplat.composite, engine="CYCLES")
    output = made.render
    output.use_border = output.use_crop_to_border = True
    output.border_min_x, output.border_max_x = 0.25, 0.75
    output.border_min_y, output.border_max_y = 0.5, 1.0
    return {
        "file": rendered("composited_again"),
        "told": told,
        "kept": mine.name,
        "nodes": "Mine" in tree.nodes,
        "engines": [made.render.engine, splats_scene.render.engine],
    }


def with_plane() -> Any:
    """Return a new scene with splats, and a plane through their middle that covers the left half of the image."""
    made = scene()
    splats(upright=False)
    camera = cameras()
    made.render.engine = "CYCLES"
    made.cycles.samples, made.cycles.device = 1, "CPU"
    made.cycles.use_denoising = False
    made.world = None
    facing = camera.matrix_world
    depth = json.loads((FOLDER / "facts.json").read_text(encoding="utf-8"))["depth"]
    corners = [facing @ Vector((x, y, -depth)) for x, y in ((-9, -9), (0, -9), (0, 9), (-9, 9))]
    mesh = bpy.data.meshes.new("plane")
    mesh.from_pydata(corners, [], [(0, 1, 2, 3)])
    plane = bpy.data.objects.new("plane", mesh)
    made.collection.objects.link(plane)
    material = bpy.data.materials.new("green")
    if bpy.app.version < (5, 0, 0):
        material.use_nodes = True
    nodes = material.node_tree
    nodes.nodes.clear()
    emission, output = nodes.nodes.new("ShaderNodeEmission"), nodes.nodes.new("ShaderNodeOutputMaterial")
    emission.inputs["Color"].default_value = (0, 1, 0, 1)
    nodes.links.new(emission.outputs[0], output.inputs["Surface"])
    mesh.materials.append(material)
    return made


def gone() -> Facts:
    addon_utils.disable(ADDON)
    left = hasattr(bpy.types.Object, "clsplat_ply")
    addon_utils.enable(ADDON)
    return {"left": left, "again": hasattr(bpy.types.Object, "clsplat_ply")}


def viewport() -> Facts:
    """Draw with the engine in Blender's offscreen buffer: a still view, a moving view, and an orthographic view."""
    import gpu

    engine = sys.modules[f"{ADDON}.engine"]

    class Drawing(engine.ClsplatRenderEngine):  # type: ignore[misc,name-defined]
        bl_idname = "CLSPLAT_TEST"
        bl_label = "viewport"
        bl_use_gpu_context = True

        def render(self, depsgraph: Any) -> None:
            item = depsgraph.scene.camera
            size = depsgraph.scene.render.resolution_x, depsgraph.scene.render.resolution_y
            lens = item.calc_matrix_camera(depsgraph, x=size[0], y=size[1])
            view = item.matrix_world.normalized().inverted()
            data = SimpleNamespace(view_matrix=view, window_matrix=lens)
            context = SimpleNamespace(
                region=SimpleNamespace(width=size[0], height=size[1]),
                region_data=data,
                space_data=SimpleNamespace(clip_start=0.01, clip_end=100.0),
            )
            offscreen = gpu.types.GPUOffScreen(*size, format="RGBA32F")
            across = Matrix(((2 / size[0], 0, 0, -1), (0, 2 / size[1], 0, -1), (0, 0, 1, 0), (0, 0, 0, 1)))
            shown = []
            with offscreen.bind():
                gpu.matrix.load_matrix(Matrix.Identity(4))
                gpu.matrix.load_projection_matrix(across)
                buffer = gpu.state.active_framebuffer_get()
                for index in range(4):
                    if index == 2:  # move aside, with a speed so low that the engine must draw coarsely
                        data.view_matrix = Matrix.Translation((0.1, 0, 0)) @ view
                        self._speed = 1.0
                    buffer.clear(color=(0, 0, 0, 0))
                    self.view_draw(context, depsgraph)
                    pixels = buffer.read_color(0, 0, *size, 4, 0, "FLOAT")
                    pixels.dimensions = 4 * size[0] * size[1]
                    shown.append(np.array(pixels, np.float32).reshape(size[1], size[0], 4)[::-1])
                data.window_matrix = Matrix.OrthoProjection("XY", 4)
                self.view_draw(context, depsgraph)
            np.save(FOLDER / "viewport.npy", shown)

    made = scene()
    splats()
    cameras()
    bpy.utils.register_class(Drawing)
    made.render.engine = "CLSPLAT_TEST"
    bpy.ops.render.render()
    return {"drawn": (FOLDER / "viewport.npy").is_file()}


CASES = (
    install,
    imported,
    frames,
    together,
    animation,
    projections,
    faults,
    clipped,
    composited,
    composited_again,
    gone,
)


def main(cases: Sequence[Callable[[], Facts]], file: str) -> None:
    facts: Facts = {"blender": bpy.app.version_string}
    for case in cases:
        start = time.perf_counter()
        try:
            facts[case.__name__] = case()
        except Exception:
            facts[case.__name__] = {"failed": traceback.format_exc()}
        facts[case.__name__]["took"] = time.perf_counter() - start
    (FOLDER / file).write_text(json.dumps(facts), encoding="utf-8")


if __name__ == "__main__":
    if sys.argv[2:] == ["viewport"]:
        main((install, viewport), "viewport.json")
    else:
        main(CASES, "out.json")
