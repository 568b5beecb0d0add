"""Cameras and points of a scene or a model as files for other programs."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from ..cameras.cameras_json import NamedCamera, named_cameras, read_cameras, write_cameras
from ..cameras.path import read_path
from ..errors import InputError, check_choice
from ..files.existing import refuse_existing
from ..files.json_file import read_json
from ..scenes.colmap import Points
from ..scenes.export import points_file, relative_files, write_colmap, write_transforms
from ..scenes.options import CAMERA_FORMATS
from ..scenes.posed_images import warn_of_left_out
from ..scenes.scene import find_masks, read_posed_images
from ..scenes.scene_files import PHOTOGRAMMETRY_ENDINGS, is_opensfm
from ..scenes.undistort import RegisteredImage, is_pinhole, make_lens, pinhole_camera
from ..splats.harmonics import SH_C0
from ..splats.shapes import shape_named
from ..splats.splats import Splats
from .model import load_model

OPAQUE = 0.5  # splats of at least this opacity become points of a model
_COLMAP_FILES = ("cameras", "images", "points3D")


@dataclass(frozen=True, eq=False)
class _Exported:
    """What is written: registered photos, points, and of each photo its file, its mask, and whether it is held out."""

    photos: list[RegisteredImage]
    points: Points
    files: list[Path]
    masks: list[Path | None]
    held_out: list[bool]


@dataclass(frozen=True)
class ExportedCameras:
    """Numbers of the cameras and points that `export_cameras` wrote."""

    cameras: int
    points: int


def export_cameras(
    source: str | os.PathLike[str],
    output: str | os.PathLike[str],
    form: str | None = None,
    *,
    images: str | None = None,
    iteration: int | None = None,
    overwrite: bool = False,
) -> ExportedCameras:
    """Write the cameras and points of a scene or a model for another program, and return their numbers.

    Cameras of a scene keep their lenses. Cameras of a model are those of its training images: without distortion, and
    at the reduced size.

    Parameters
    ----------
    source : a scene or the file of its cameras, a model folder, a file of splats, a cameras.json or a camera path.
    output : a .json file, or the folder of a COLMAP model.
    form : one of `scenes.options.CAMERA_FORMATS`; by default "cameras" for cameras.json, "transforms" for other .json
        files, else "colmap".
    images : folder of the photos inside a scene.
    iteration : as for `load_model`.
    overwrite : replace existing files.

    Raises
    ------
    InputError : the source has no cameras, or the format does not support a lens. `iteration` names one of a scene, or
        `images` a folder of a model.
    OutputError : a file exists or cannot be written.
    """
    source, output = Path(source), Path(output)
    if form is None:
        form = "cameras" if output.name == "cameras.json" else "transforms" if output.suffix == ".json" else "colmap"
    check_choice("form", form, CAMERA_FORMATS)
    suffix = ".txt" if form == "colmap-text" else ".bin"
    files = [output / f"{name}{suffix}" for name in _COLMAP_FILES] if form.startswith("colmap") else [output]
    refuse_existing(files, overwrite)
    is_scene = _is_scene(source)
    if is_scene and iteration is not None:
        raise InputError(f"{source}: is a scene, which has no iterations; name a model, or leave out the iteration")
    if images is not None and not is_scene:
        raise InputError(f"{source}: is not a scene with photos; name a scene, or leave out the folder of photos")
    found = _of_scene(source, images) if is_scene else _of_model(source, iteration, output.parent / "images")
    if form == "cameras":
        _write_3dgs(output, found.photos)
        return ExportedCameras(len(found.photos), 0)
    if form == "transforms":
        if len(found.points):
            refuse_existing([points_file(output)], overwrite)
        place = output.parent
        masks = [None if mask is None else relative_files([mask], place)[0] for mask in found.masks]
        names = relative_files(found.files, place)
        write_transforms(output, found.photos, names, found.points, masks, found.held_out)
    else:
        write_colmap(output, found.photos, found.points, form == "colmap-text")
    return ExportedCameras(len(found.photos), len(found.points))


def _is_scene(source: Path) -> bool:
    """Return whether the source is a folder without a model, or a file of cameras that is a scene."""
    if source.is_dir():
        return not (source / "point_cloud").is_dir()
    if source.suffix.lower() in PHOTOGRAMMETRY_ENDINGS or is_opensfm(source):
        return source.is_file()
    if not source.is_file() or source.suffix != ".json":
        return False
    content = read_json(source, "a cameras.json or a transforms.json")
    return isinstance(content, dict) and "frames" in content


def _of_scene(scene: Path, images: str | None) -> _Exported:
    """Return what is written of a scene. Names of photos omit a folder that all photos are in."""
    posed = read_posed_images(scene, images)
    warn_of_left_out(scene, posed.left_out, len(posed.listed))
    masks = find_masks(scene, posed, None)
    folders = {photo.name.partition("/")[0] if "/" in photo.name else None for photo in posed.photos}
    cut = len(folders.pop() or "") + 1 if len(folders) == 1 and None not in folders else 0
    return _Exported(
        [replace(photo, name=photo.name[cut:]) for photo in posed.photos],
        posed.points,
        [posed.files[photo.name] for photo in posed.photos],
        [masks.get(photo.name) for photo in posed.photos],
        [photo.name in (posed.test_names or ()) for photo in posed.photos],
    )


def _of_model(source: Path, iteration: int | None, images: Path) -> _Exported:
    """Return the cameras of a model or a file as photos, and the opaque splats of a model as points.

    images : folder that the photos would be in.
    """
    if source.is_file() and source.suffix == ".json":
        named, points = _of_file(source), _points(np.empty((0, 3)), np.empty((0, 3), np.uint8))
    else:
        model = load_model(source, iteration)
        named, points = model.read_cameras(), _opaque_splats(model.splats)
    if not named:
        raise InputError(f"{source}: has no cameras: give a scene, a model's folder with cameras.json, or such a file")
    photos = []
    for entry in named:
        camera = entry.camera
        lens = make_lens("PINHOLE", camera.width, camera.height, [camera.fx, camera.fy, camera.cx, camera.cy])
        photos.append(RegisteredImage(f"{entry.name}.png", camera.cam_from_world, lens))
    files = [images / photo.name for photo in photos]
    return _Exported(photos, points, files, [None] * len(photos), [False] * len(photos))


def _of_file(path: Path) -> list[NamedCamera]:
    if isinstance(read_json(path, "a cameras.json"), list):
        return read_cameras(path)
    return [NamedCamera(f"{index:05d}", camera) for index, camera in enumerate(read_path(path).cameras)]


def _opaque_splats(splats: Splats) -> Points:
    opaque = shape_named(splats.shape).strength(splats.arrays) >= OPAQUE
    rgb = np.rint(255 * np.clip(0.5 + SH_C0 * splats.sh[opaque, 0], 0, 1)).astype(np.uint8)
    return _points(splats.mean[opaque].astype(np.float64), rgb)


def _points(xyz: np.ndarray, rgb: np.ndarray) -> Points:
    return Points(xyz, rgb, np.zeros(len(rgb), np.int64))


def _write_3dgs(output: Path, photos: Sequence[RegisteredImage]) -> None:
    distorted = [photo for photo in photos if not is_pinhole(photo.lens)]
    if distorted:
        raise InputError(
            f"image {distorted[0].name!r}: 3DGS's cameras.json does not support distorted lenses: "
            "write transforms or a COLMAP model"
        )
    cameras = [
        pinhole_camera(photo.lens, photo.cam_from_world, photo.lens.width, photo.lens.height) for photo in photos
    ]
    write_cameras(output, named_cameras([photo.name for photo in photos], cameras))
