"""clsplat as a render engine of Blender, for images, animations and the viewport."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import bpy

from .errors import message_of

if TYPE_CHECKING:
    from .pictures import Placed, Studio

IDNAME = "CLSPLAT"
MESHES = "clsplat_meshes"  # in the scene of splats of a composite: the scene of meshes
_MOVING_SECONDS = 0.08  # time for a frame of the viewport while the view moves
_studios: dict[str, Studio] = {}


def meshes_of(scene: Any) -> Any:
    """Return the scene of meshes, for a scene of splats that `composite` has made; None for other scenes."""
    return scene.get(MESHES)


def studio() -> Studio:
    """Return the renderer of the device from the preferences; it is kept between frames."""
    from .pictures import Studio

    device = chosen_device()
    if device not in _studios:
        forget()
        _studios[device] = Studio(device or None)
    return _studios[device]


def chosen_device() -> str:
    """Return the device from the preferences; "" means the best one."""
    addon = bpy.context.preferences.addons.get(__package__)
    return addon.preferences.device if addon is not None and addon.preferences else ""


def forget() -> None:
    """Release the device and all splats."""
    _studios.clear()


def objects_of(depsgraph: Any) -> list[Placed]:
    """Return the visible objects of splats in the depsgraph, with instances."""
    import numpy as np

    from .pictures import Placed

    found = []
    for instance in depsgraph.object_instances:
        original = instance.object.original
        if original.clsplat_ply and instance.show_self:
            found.append(
                Placed(
                    original.name,
                    Path(bpy.path.abspath(original.clsplat_ply, library=original.library)),
                    np.array(instance.matrix_world, np.float64),
                )
            )
    return found


def is_linear(scene: Any) -> bool:
    """Whether the view transform converts light to display values; Raw does not."""
    return bool(scene.view_settings.view_transform != "Raw")


class ClsplatRenderEngine(bpy.types.RenderEngine):  # type: ignore[misc]
    """Engine that renders only splats, from the camera of Blender."""

    bl_idname = IDNAME
    bl_label = "clsplat"
    bl_use_preview = False
    bl_use_postprocess = True
    bl_use_shading_nodes_custom = False
    bl_use_eevee_viewport = True  # Material Preview of the viewport shows the meshes

    # Defaults of the instance. They are not set in __init__, because its arguments differ between versions of Blender.
    _drawn: Any = None  # texture of the viewport
    _view: Any = None  # the view that the texture shows
    _speed = 5e-7  # seconds for a pixel of the last frame

    def update_render_passes(self, scene: Any = None, renderlayer: Any = None) -> None:
        """Register the passes for the compositor."""
        self.register_pass(scene, renderlayer, "Combined", 4, "RGBA", "COLOR")
        if renderlayer.use_pass_z:
            self.register_pass(scene, renderlayer, "Depth", 1, "Z", "VALUE")

    def render(self, depsgraph: Any) -> None:
        """Render one frame of one view layer."""
        try:
            self._render(depsgraph)
        except Exception as error:
            message = message_of(error)
            if message is None:
                raise
            self.report({"ERROR"}, message)

    def _render(self, depsgraph: Any) -> None:
        from clsplat.errors import InputError

        from .lens import camera_of
        from .pictures import combined, depths, placement

        objects = objects_of(depsgraph)
        for item in objects:
            placement(item)  # before the camera, which may be a child of a faulty object
        scene = depsgraph.scene
        # The scene of splats of a composite follows the camera and the frame of the scene of meshes.
        first = meshes_of(scene) or scene
        if first.render.use_multiview:
            raise InputError("stereoscopy is not rendered: turn it off, or render one camera after the other")
        camera = first.camera if first != scene else self.camera_override or scene.camera
        if camera is None:
            raise InputError("the scene has no camera: add one, or make one active")
        evaluated = camera.evaluated_get(depsgraph)
        raster = raster_of(first.render, self.resolution_x, self.resolution_y)
        pinhole = camera_of(lens_values(evaluated.data), raster, evaluated.matrix_world, camera.name)
        clip = (evaluated.data.clip_start, evaluated.data.clip_end)
        image = studio().render(objects, pinhole, clip)
        background = None if scene.render.film_transparent else tuple(scene.clsplat_background)
        pixels = combined(image, background, is_linear(scene))
        left, bottom, right, top = (
            raster.pixels
        )  # the whole image is rendered, because the look of a splat depends on its size
        result = self.begin_result(0, 0, right - left, top - bottom, layer=depsgraph.view_layer_eval.name)
        layer = result.layers[0]
        layer.passes["Combined"].rect.foreach_set(pixels[bottom:top, left:right].ravel())
        if "Depth" in layer.passes:
            layer.passes["Depth"].rect.foreach_set(depths(image)[bottom:top, left:right].ravel())
        self.end_result(result)

    def view_update(self, context: Any, depsgraph: Any) -> None:
        """Draw again, because the scene has changed."""
        self._view = None
        self.tag_redraw()

    def view_draw(self, context: Any, depsgraph: Any) -> None:
        """Draw the viewport, at low resolution while the view moves."""
        try:
            self._draw(context, depsgraph)
        except Exception as error:
            message = message_of(error)
            if message is None:
                raise
            self.update_stats("clsplat", message)

    def _draw(self, context: Any, depsgraph: Any) -> None:
        import gpu
        from gpu_extras.presets import draw_texture_2d

        from .lens import camera_of_matrices
        from .pictures import combined

        scene, region, space = depsgraph.scene, context.region, context.space_data
        data = context.region_data
        view = (tuple(map(tuple, data.view_matrix)), tuple(map(tuple, data.window_matrix)), region.width, region.height)
        moving = self._view is not None and self._view[:4] != view
        full = (max(1, region.width), max(1, region.height))
        if self._view is None or moving or not self._view[4]:
            budget = _MOVING_SECONDS / (self._speed * full[0] * full[1]) if moving else 1.0
            share = min(1.0, budget**0.5)
            width, height = (max(1, int(share * side)) for side in full)
            start = time.perf_counter()
            pinhole = camera_of_matrices(data.view_matrix, data.window_matrix, width, height)
            image = studio().render(objects_of(depsgraph), pinhole, (space.clip_start, space.clip_end))
            self._speed = max(1e-9, (time.perf_counter() - start) / (width * height))
            pixels = combined(image, tuple(scene.clsplat_background), is_linear(scene))
            buffer = gpu.types.Buffer("FLOAT", pixels.size, pixels.ravel())
            self._drawn = gpu.types.GPUTexture((width, height), format="RGBA16F", data=buffer)
            self._view = (*view, share == 1.0)
            if share < 1.0:
                self.tag_redraw()
            self.update_stats("clsplat", f"{width}x{height} px")
        gpu.state.blend_set("ALPHA_PREMULT")
        self.bind_display_space_shader(scene)
        draw_texture_2d(self._drawn, (0, 0), *full)
        self.unbind_display_space_shader()
        gpu.state.blend_set("NONE")


def lens_values(data: Any) -> Any:
    """Return the `Lens` of Blender camera data."""
    from .lens import Lens

    return Lens(
        data.lens, data.sensor_width, data.sensor_height, data.sensor_fit, data.shift_x, data.shift_y, data.type
    )


def raster_of(settings: Any, width: int = 0, height: int = 0) -> Any:
    """Return the `Raster` of the output settings of Blender; `width` and `height` [px] replace its size."""
    from .lens import Raster

    border = None
    if settings.use_border:
        border = (settings.border_min_x, settings.border_min_y, settings.border_max_x, settings.border_max_y)
    if width and height:
        return Raster(width, height, settings.pixel_aspect_x, settings.pixel_aspect_y, border)
    return Raster.of_settings(
        settings.resolution_x,
        settings.resolution_y,
        settings.resolution_percentage,
        settings.pixel_aspect_x,
        settings.pixel_aspect_y,
        border,
    )
