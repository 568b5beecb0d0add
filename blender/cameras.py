"""Import and export of cameras.json and of nerfstudio's camera_path.json.

The files are in the world of the splats. Imported cameras become children of the active object of splats, if there is
one. Exported cameras are written relative to it.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import bpy
from bpy_extras.io_utils import ExportHelper, ImportHelper
from mathutils import Matrix

from .engine import lens_values, raster_of
from .errors import reported

if TYPE_CHECKING:
    from clsplat.cameras.camera import Camera
    from clsplat.cameras.path import CameraPath

_CLIP = (0.01, 1e5)  # world units; from the near plane of clsplat to beyond any sky
_FILTER = bpy.props.StringProperty(default="*.json", options={"HIDDEN"})


def add_camera(context: Any, camera: Camera, name: str, parent: Any = None) -> Any:
    """Add a camera object with the lens and pose of a pinhole."""
    item = bpy.data.objects.new(name, bpy.data.cameras.new(name))
    item.parent = parent
    item.rotation_mode = "QUATERNION"
    item.data.clip_start, item.data.clip_end = _CLIP
    set_camera(item, camera)
    context.collection.objects.link(item)
    return item


def set_camera(item: Any, camera: Camera) -> None:
    """Give a camera object the lens and pose of a pinhole."""
    from .lens import lens_of, matrix_world_of

    lens, _ = lens_of(camera)
    data = item.data
    data.sensor_fit, data.sensor_width, data.sensor_height = lens.sensor_fit, lens.sensor_width, lens.sensor_height
    data.lens, data.shift_x, data.shift_y = lens.lens, lens.shift_x, lens.shift_y
    before = item.rotation_quaternion.copy()
    item.matrix_basis = Matrix(matrix_world_of(camera).tolist())
    if before.dot(item.rotation_quaternion) < 0:  # both signs are the same rotation; animation must take the short way
        item.rotation_quaternion.negate()


def set_output(scene: Any, camera: Camera) -> None:
    """Set the output size and pixel aspect of the scene to those of a pinhole."""
    from .lens import lens_of

    _, (aspect_x, aspect_y) = lens_of(camera)
    render = scene.render
    render.resolution_x, render.resolution_y, render.resolution_percentage = camera.width, camera.height, 100
    render.pixel_aspect_x, render.pixel_aspect_y = aspect_x, aspect_y


def add_path(context: Any, path: CameraPath, name: str, parent: Any = None) -> Any:
    """Add an animated camera with a key for each frame; set the frames, rate, size and camera of the scene."""
    scene = context.scene
    item = add_camera(context, path.cameras[0], name, parent)
    for index, camera in enumerate(path.cameras):
        set_camera(item, camera)
        frame = scene.frame_start + index
        for field in ("location", "rotation_quaternion"):
            item.keyframe_insert(field, frame=frame)
        for field in ("lens", "shift_x", "shift_y"):
            item.data.keyframe_insert(field, frame=frame)
    scene.frame_end = scene.frame_start + len(path.cameras) - 1
    rate = round(path.fps)
    scene.render.fps, scene.render.fps_base = max(1, rate), max(1, rate) / path.fps
    set_output(scene, path.cameras[0])
    scene.camera = item
    scene.frame_set(scene.frame_start)
    return item


def camera_at(context: Any, item: Any, parent: Any = None) -> Camera:
    """Return the pinhole of a camera object at the current frame, in the world of the splats of `parent`.

    Raises
    ------
    clsplat.InputError : the camera is not a perspective camera, or the transform of the parent is not a similarity.
    """
    import numpy as np

    from clsplat.errors import InputError
    from clsplat.splats.similarity import similarity

    from .lens import camera_of, moved

    depsgraph = context.evaluated_depsgraph_get()
    seen = item.evaluated_get(depsgraph)
    raster = raster_of(context.scene.render)
    camera = camera_of(
        lens_values(seen.data),
        type(raster)(raster.width, raster.height, raster.pixel_aspect_x, raster.pixel_aspect_y),
        seen.matrix_world,
        item.name,
    )
    if parent is None:
        return camera
    try:
        return moved(camera, *similarity(np.array(parent.evaluated_get(depsgraph).matrix_world)))
    except InputError as error:
        raise InputError(f"{parent.name}: {error}") from None


def splats_of(context: Any) -> Any:
    """Return the object of splats that files refer to: the active one, or the only one, or None."""
    active = context.view_layer.objects.active
    if active is not None and active.clsplat_ply:
        return active
    found = [item for item in context.scene.objects if item.clsplat_ply]
    return found[0] if len(found) == 1 else None


class ImportCameras(bpy.types.Operator, ImportHelper):  # type: ignore[misc]
    """Import cameras.json as cameras, or camera_path.json as an animated camera"""

    bl_idname = "clsplat.import_cameras"
    bl_label = "Import Cameras"
    bl_options = {"REGISTER", "UNDO"}

    filename_ext = ".json"
    filter_glob: _FILTER  # type: ignore[valid-type]
    animated: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="As Animation",
        default=False,
        description="Make one animated camera from a cameras.json, with one frame for each camera",
    )

    @reported
    def execute(self, context: Any) -> set[str]:
        from clsplat.cameras.cameras_json import cameras_of
        from clsplat.cameras.path import path_of
        from clsplat.files.json_file import read_json

        file = Path(bpy.path.abspath(self.filepath))
        content, parent = read_json(file, "a camera_path.json or a cameras.json"), splats_of(context)
        if self.animated or not isinstance(content, list):
            path = path_of(content, file)
            add_path(context, path, file.stem, parent)
            self.report({"INFO"}, f"{file.name}: {len(path.cameras)} frames")
            return {"FINISHED"}
        named = cameras_of(content, file)
        items = [add_camera(context, each.camera, each.name, parent) for each in named]
        if named:
            set_output(context.scene, named[0].camera)
            context.scene.camera = items[0]
        sizes = {(each.camera.width, each.camera.height) for each in named}
        if len(sizes) > 1:
            self.report({"WARNING"}, f"{file.name}: {len(sizes)} image sizes; the output has the first camera's")
        else:
            self.report({"INFO"}, f"{file.name}: {len(named)} cameras")
        return {"FINISHED"}


class ExportCameras(bpy.types.Operator, ExportHelper):  # type: ignore[misc]
    """Export the cameras as cameras.json, or the scene's camera over its frames as camera_path.json"""

    bl_idname = "clsplat.export_cameras"
    bl_label = "Export Cameras"

    filename_ext = ".json"
    filter_glob: _FILTER  # type: ignore[valid-type]
    content: bpy.props.EnumProperty(  # type: ignore[valid-type]
        name="Content",
        items=[
            ("PATH", "Animation (camera_path.json)", "The camera of the scene in every frame, for nerfstudio"),
            ("CAMERAS", "Cameras (cameras.json)", "The selected cameras, or all, at this frame, for 3DGS"),
        ],
    )

    @reported
    def execute(self, context: Any) -> set[str]:
        from clsplat.cameras.cameras_json import NamedCamera, write_cameras
        from clsplat.errors import InputError

        scene, parent = context.scene, splats_of(context)
        file = Path(bpy.path.abspath(self.filepath))
        if self.content == "PATH":
            if scene.camera is None:
                raise InputError("the scene has no camera: add one, or make one active")
            write_path_of(context, file, parent)
            return {"FINISHED"}
        cameras = [item for item in context.selected_objects if item.type == "CAMERA"] or [
            item for item in scene.objects if item.type == "CAMERA"
        ]
        if not cameras:
            raise InputError("the scene has no cameras: add one")
        write_cameras(file, [NamedCamera(item.name, camera_at(context, item, parent)) for item in cameras])
        return {"FINISHED"}


def write_path_of(context: Any, file: Path, parent: Any = None) -> None:
    """Write the camera of the scene over all frames as camera_path.json; the current frame is restored."""
    from clsplat.cameras.path import CameraPath, write_path

    scene = context.scene
    before, frames = scene.frame_current, []
    try:
        for frame in range(scene.frame_start, scene.frame_end + 1, scene.frame_step):
            scene.frame_set(frame)
            frames.append(camera_at(context, scene.camera, parent))
    finally:
        scene.frame_set(before)
    rate = scene.render.fps / scene.render.fps_base / scene.frame_step
    write_path(file, CameraPath(tuple(frames), rate))


def draw_import(menu: Any, context: Any) -> None:
    """The entry of File > Import."""
    menu.layout.operator(ImportCameras.bl_idname, text="Cameras (cameras.json, camera_path.json)")


def draw_export(menu: Any, context: Any) -> None:
    """The entry of File > Export."""
    menu.layout.operator(ExportCameras.bl_idname, text="Cameras (cameras.json, camera_path.json)")


CLASSES = (ImportCameras, ExportCameras)
