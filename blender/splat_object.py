"""A splat PLY file as an object: points to see and select, and the file name to render from."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import bpy
from bpy_extras.io_utils import ImportHelper

from .errors import reported

_UPRIGHT = (-math.pi / 2, 0.0, 0.0)  # the y axis of a 3DGS world points down, as that of a camera


def add_splats(context: Any, path: Path, upright: bool = True, points: int = 100_000) -> Any:
    """Add an object for a PLY file to the active collection, and make it selected and active.

    Its mesh has a point for each splat, or an even selection of at most `points`. Points have the attributes `color`,
    `opacity`, `scale` (standard deviations), `rotation` and `splat` (its number in the file).

    Raises
    ------
    clsplat.InputError : the file is not a splat PLY file.
    """
    import numpy as np

    from clsplat.splats.harmonics import SH_C0
    from clsplat.splats.shapes import shape_named
    from clsplat.splats.splats import Splats

    from .pictures import to_linear

    splats = Splats.load(path)
    chosen = np.arange(0, len(splats), max(1, -(-len(splats) // points)))
    mesh = bpy.data.meshes.new(path.stem)
    mesh.vertices.add(len(chosen))
    mesh.vertices.foreach_set("co", splats.mean[chosen].astype(np.float32).ravel())
    colour = np.clip(splats.sh[chosen, 0] * SH_C0 + 0.5, 0.0, 1.0).astype(np.float32)
    opacity = shape_named(splats.shape).opacity(splats.opacity_logit[chosen].astype(np.float64))
    rotation = splats.quat[chosen] / np.linalg.norm(splats.quat[chosen], axis=1, keepdims=True)
    attributes = {
        "color": ("FLOAT_COLOR", "color", np.concatenate([to_linear(colour), np.ones((len(chosen), 1))], axis=1)),
        "opacity": ("FLOAT", "value", opacity),
        "scale": ("FLOAT_VECTOR", "vector", np.exp(splats.log_scale[chosen])),
        "rotation": ("QUATERNION", "value", rotation),
        "splat": ("INT", "value", chosen),
    }
    for name, (kind, field, values) in attributes.items():
        dtype = np.int32 if kind == "INT" else np.float32
        mesh.attributes.new(name, kind, "POINT").data.foreach_set(field, values.astype(dtype).ravel())
    mesh.update()
    item = bpy.data.objects.new(path.stem, mesh)
    item.clsplat_ply = str(path)
    if upright:
        item.rotation_euler = _UPRIGHT
    context.collection.objects.link(item)
    for other in context.selected_objects:
        other.select_set(False)
    item.select_set(True)
    context.view_layer.objects.active = item
    return item


class ImportSplats(bpy.types.Operator, ImportHelper):  # type: ignore[misc]
    """Import Gaussian or skew-normal splats (PLY files of 3DGS or clsplat)"""

    bl_idname = "clsplat.import_splats"
    bl_label = "Import Splats"
    bl_options = {"REGISTER", "UNDO"}

    filename_ext = ".ply"
    filter_glob: bpy.props.StringProperty(default="*.ply", options={"HIDDEN"})  # type: ignore[valid-type]
    upright: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Upright",
        default=True,
        description="Turn the y axis of the file, which points down, to the downward z axis of Blender",
    )
    points: bpy.props.IntProperty(  # type: ignore[valid-type]
        name="Points",
        default=100_000,
        min=1,
        description="Largest number of points that show the splats in the viewport; all splats are rendered",
    )
    use_engine: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Render with clsplat",
        default=True,
        description="Make clsplat the render engine of the scene, with the view transform Standard, which shows the "
        "splats' own colours",
    )

    @reported
    def execute(self, context: Any) -> set[str]:
        item = add_splats(context, Path(bpy.path.abspath(self.filepath)), self.upright, self.points)
        if self.use_engine:
            context.scene.render.engine = "CLSPLAT"
            context.scene.view_settings.view_transform = "Standard"
        self.report({"INFO"}, f"{item.name}: {len(item.data.vertices)} points")
        return {"FINISHED"}


def draw_import(menu: Any, context: Any) -> None:
    """The entry of File > Import."""
    menu.layout.operator(ImportSplats.bl_idname, text="Splats (.ply)")


CLASSES = (ImportSplats,)
