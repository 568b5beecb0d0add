"""Registration of classes, properties, menu entries, and of the panels of Blender that suit the engine."""

from __future__ import annotations

from typing import Any

import bpy

from . import cameras, composite, engine, panels, splat_object

CLASSES = (*splat_object.CLASSES, *cameras.CLASSES, *composite.CLASSES, *panels.CLASSES, engine.ClsplatRenderEngine)

# Panels of Blender that have no effect on this engine.
_FOREIGN = (
    "VIEWLAYER_PT_filter",
    "VIEWLAYER_PT_layer_passes",
    "RENDER_PT_gpencil",
    "RENDER_PT_simplify",
    "RENDER_PT_freestyle",
    "DATA_PT_camera_dof",
    "DATA_PT_camera_dof_aperture",
)


def register() -> None:
    """Register everything; Blender raises an error if this is repeated."""
    for cls in CLASSES:
        bpy.utils.register_class(cls)
    bpy.types.Object.clsplat_ply = bpy.props.StringProperty(
        name="Splats",
        description="PLY file of the splats that are rendered at the place of this object",
        subtype="FILE_PATH",
        # Blender 5 warns about paths relative to the .blend file without this option; earlier ones do not know it.
        **({"options": {"PATH_SUPPORTS_BLEND_RELATIVE"}} if bpy.app.version >= (5, 0, 0) else {}),
    )
    bpy.types.Scene.clsplat_background = bpy.props.FloatVectorProperty(
        name="Background",
        description="Display colour behind the splats if the film is not transparent",
        subtype="COLOR_GAMMA",
        size=3,
        min=0.0,
        max=1.0,
        default=(0.0, 0.0, 0.0),
    )
    for panel in _suiting_panels():
        panel.COMPAT_ENGINES.add(engine.IDNAME)
    bpy.types.TOPBAR_MT_file_import.append(splat_object.draw_import)
    bpy.types.TOPBAR_MT_file_import.append(cameras.draw_import)
    bpy.types.TOPBAR_MT_file_export.append(cameras.draw_export)


def unregister() -> None:
    """Unregister everything."""
    bpy.types.TOPBAR_MT_file_export.remove(cameras.draw_export)
    bpy.types.TOPBAR_MT_file_import.remove(cameras.draw_import)
    bpy.types.TOPBAR_MT_file_import.remove(splat_object.draw_import)
    for panel in _suiting_panels():
        panel.COMPAT_ENGINES.discard(engine.IDNAME)
    del bpy.types.Scene.clsplat_background
    del bpy.types.Object.clsplat_ply
    engine.forget()
    for cls in reversed(CLASSES):
        bpy.utils.unregister_class(cls)


def _suiting_panels() -> list[Any]:
    """Return the panels of output, camera and film that Blender shows for simple engines."""
    return [
        panel
        for panel in bpy.types.Panel.__subclasses__()
        if "BLENDER_RENDER" in getattr(panel, "COMPAT_ENGINES", ()) and panel.__name__ not in _FOREIGN
    ]
