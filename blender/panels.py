"""Panels and preferences of the add-on."""

from __future__ import annotations

import sys
from typing import Any

import bpy

from .engine import IDNAME


class Preferences(bpy.types.AddonPreferences):  # type: ignore[misc]
    """The source of clsplat, and its device."""

    bl_idname = __package__

    device: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="Device",
        description='OpenCL device: "cpu", "gpu", an index such as 0:1, or part of a name; empty for the best',
    )

    def draw(self, context: Any) -> None:
        self.layout.prop(self, "device")
        try:
            import clsplat
        except ImportError:
            column = self.layout.column(align=True)
            column.alert = True
            column.label(text="clsplat is not installed in Blender's Python. In a terminal:", icon="ERROR")
            column.label(text=f'"{sys.executable}" -m pip install FOLDER_OF_CLSPLAT')
            column.label(text="or build this add-on with its wheels: clsplat blender-addon --wheels DIR")
        else:
            self.layout.label(text=f"clsplat {clsplat.__version__}")


class RenderPanel(bpy.types.Panel):  # type: ignore[misc]
    """Panel for the background behind the splats."""

    bl_idname = "RENDER_PT_clsplat"
    bl_label = "clsplat"
    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "render"
    COMPAT_ENGINES = {IDNAME}

    @classmethod
    def poll(cls, context: Any) -> bool:
        return context.engine in cls.COMPAT_ENGINES

    def draw(self, context: Any) -> None:
        self.layout.use_property_split = True
        column = self.layout.column()
        column.active = not context.scene.render.film_transparent
        column.prop(context.scene, "clsplat_background")
        self.layout.prop(context.scene.render, "film_transparent", text="Transparent")
        self.layout.operator("clsplat.composite")


class ObjectPanel(bpy.types.Panel):  # type: ignore[misc]
    """Panel for the PLY file of an object."""

    bl_idname = "OBJECT_PT_clsplat"
    bl_label = "Splats"
    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "object"
    bl_options = {"DEFAULT_CLOSED"}

    def draw(self, context: Any) -> None:
        self.layout.prop(context.object, "clsplat_ply")


CLASSES = (Preferences, RenderPanel, ObjectPanel)
