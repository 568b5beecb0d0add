"""Cameras and points for other programs: a COLMAP model, or transforms.json of nerfstudio and instant-ngp.

COLMAP's text files follow its documentation (https://colmap.github.io/format.html); colmap_binary.py writes the binary
files. Points are written without tracks.
"""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from ..cameras.path import opengl_pose
from ..errors import InputError
from ..files.atomic import atomic_writer
from ..files.real_path import real_path
from .colmap import Points
from .colmap_binary import ModelView, write_binary_model
from .point_cloud import write_point_cloud
from .undistort import Lens, RegisteredImage, make_lens

TRANSFORMS, POINTS_FILE = "transforms.json", "sparse_pc.ply"  # nerfstudio's file names
# Keys of transforms.json for the parameters of each COLMAP model; "f" stands for both focal lengths.
_KEYS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fl_x", "fl_y", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2"),
    "FULL_OPENCV": ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "OPENCV_FISHEYE": ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4"),
}
_FISHEYE = "OPENCV_FISHEYE"
_DENOMINATOR = ("k4", "k5", "k6")  # parameters of FULL_OPENCV that readers of transforms.json do not support


def points_file(transforms: Path) -> Path:
    """Return the file of the points beside a file of cameras: nerfstudio's for transforms.json, else one of its own."""
    return transforms.parent / POINTS_FILE if transforms.name == TRANSFORMS else transforms.with_suffix(".ply")


def write_transforms(
    path: Path,
    photos: Sequence[RegisteredImage],
    files: Sequence[str],
    points: Points,
    masks: Sequence[str | None] | None = None,
    held_out: Sequence[bool] | None = None,
) -> None:
    """Write a transforms.json with poses and lenses, and the points as a PLY file beside it.

    Parameters
    ----------
    path : the transforms.json to write.
    photos : registered images.
    files : `file_path` of each photo, relative to the folder of `path`.
    points : point cloud; not written if empty.
    masks : `mask_path` of each photo, relative as `files`; None for photos without a mask.
    held_out : whether each photo is a test photo. Without any, the file has no lists of photos.

    Raises
    ------
    InputError : the format has no keys for a lens.
    OutputError : a file cannot be written.
    """
    frames = []
    for photo, file, mask in zip(photos, files, masks or [None] * len(files), strict=True):
        pose = opengl_pose(photo.cam_from_world)
        named = {"file_path": file} | ({} if mask is None else {"mask_path": mask})
        frames.append(named | _lens_keys(photo) | {"transform_matrix": pose.tolist()})
    head: dict[str, Any] = {}
    if held_out is not None and any(held_out):
        for key, kind in (("train_filenames", False), ("test_filenames", True)):
            head[key] = [file for file, is_test in zip(files, held_out, strict=True) if is_test is kind]
    if len(points):
        stored = points_file(path)
        write_point_cloud(stored, points)
        head["ply_file_path"] = stored.name
    # Values that all frames share are written once, above the frames.
    shared = {
        key: value
        for key, value in (frames[0] if frames else {}).items()
        if key not in ("file_path", "mask_path") and all(frame.get(key) == value for frame in frames[1:])
    }
    if len(frames) > 1:
        shared.pop("transform_matrix", None)
        head |= shared
        frames = [{key: value for key, value in frame.items() if key not in shared} for frame in frames]
    lines = [f"{json.dumps(key)}: {json.dumps(value)}" for key, value in head.items()]
    lines.append('"frames": [\n  ' + ",\n  ".join(map(json.dumps, frames)) + "\n]")
    with atomic_writer(path) as stream:
        stream.write(("{\n" + ",\n".join(lines) + "\n}\n").encode("utf-8"))


def write_colmap(folder: Path, photos: Sequence[RegisteredImage], points: Points, text: bool = False) -> None:
    """Write a COLMAP model: cameras, images and points3D, as .bin or .txt files.

    Parameters
    ----------
    folder : created if it does not exist.
    photos : registered images.
    points : point cloud, written without tracks.
    text : whether to write text files.

    Raises
    ------
    InputError : the name of a photo has a space, which COLMAP's text files cannot store, or a
        line end, or is not UTF-8.
    OutputError : a file cannot be written.
    """
    unwritable = next((photo.name for photo in photos if not photo.name.isprintable()), None)
    if unwritable is not None:
        raise InputError(f"image {unwritable!a}: a COLMAP model cannot store this name; rename the photo")
    views, names = [], {}
    for photo in photos:
        lens = _plainest(photo.lens)
        names[int(lens.model)] = str(lens.model.name)
        views.append(
            ModelView(
                photo.name,
                (lens.width, lens.height),
                tuple(map(float, lens.params)),
                photo.cam_from_world,
                np.empty((0, 2)),
                np.empty(0, np.int64),
                int(lens.model),
            )
        )
    if text:
        spaced = next((photo.name for photo in photos if len(photo.name.split()) != 1), None)
        if spaced is not None:
            raise InputError(
                f"image {spaced!r}: a name ends at the first space in COLMAP's text files; write a binary model, or "
                "rename the photo"
            )
        _write_text(folder, views, names, points)
    else:
        write_binary_model(folder, views, points.xyz, points.rgb)


def relative_files(files: Sequence[Path], folder: Path) -> list[str]:
    """Return paths relative to a folder, with `/` between names; absolute paths for files on another drive."""

    def relative(file: Path) -> str:
        try:
            return Path(os.path.relpath(real_path(file), real_path(folder))).as_posix()
        except ValueError:
            return real_path(file).as_posix()

    return [relative(file) for file in files]


def _plainest(lens: Lens) -> Lens:
    """Return the lens in the model with the fewest parameters. Many programs support only PINHOLE and OPENCV."""
    for longer, model, kept in (("FULL_OPENCV", "OPENCV", 8), ("OPENCV", "PINHOLE", 4)):
        if lens.model.name == longer and not np.any(lens.params[kept:]):
            lens = make_lens(model, lens.width, lens.height, list(lens.params[:kept]))
    return lens


def _lens_keys(photo: RegisteredImage) -> dict[str, Any]:
    """Return the keys of a lens in transforms.json; raises InputError for unsupported lenses."""
    lens = _plainest(photo.lens)
    model = str(lens.model.name)
    if model not in _KEYS:
        raise InputError(
            f"image {photo.name!r}: transforms.json does not support COLMAP's lens model {model}: undistort the "
            "photos first, or write a COLMAP model"
        )
    values = dict(zip(_KEYS[model], map(float, lens.params), strict=True))
    if any(values.pop(key, 0.0) for key in _DENOMINATOR if model != _FISHEYE):
        raise InputError(
            f"image {photo.name!r}: transforms.json does not support k4, k5 and k6 of a perspective lens: undistort "
            "the photos first, or write a COLMAP model"
        )
    if "f" in values:
        values = {"fl_x": values["f"], "fl_y": values.pop("f")} | values
    kind = _FISHEYE if model == _FISHEYE else "OPENCV" if len(values) > 4 else "PINHOLE"
    return {"camera_model": kind, "w": int(lens.width), "h": int(lens.height)} | values


def _write_text(folder: Path, views: Sequence[ModelView], names: dict[int, str], points: Points) -> None:
    from scipy.spatial.transform import Rotation  # imported late: slow to load

    cameras: dict[tuple[Any, ...], int] = {}
    images = []
    for number, view in enumerate(views, 1):
        lens = (names[view.model], *view.size, *view.intrinsics)
        camera = cameras.setdefault(lens, len(cameras) + 1)
        x, y, z, w = Rotation.from_matrix(view.cam_from_world[:3, :3]).as_quat().tolist()
        images += [_line(number, w, x, y, z, *view.cam_from_world[:3, 3].tolist(), camera, view.name), ""]
    rows = [
        _line(number, *xyz, *rgb, 0.0)
        for number, (xyz, rgb) in enumerate(zip(points.xyz.tolist(), points.rgb.tolist(), strict=True), 1)
    ]
    tables = {"cameras": [_line(number, *lens) for lens, number in cameras.items()], "images": images, "points3D": rows}
    for name, lines in tables.items():
        with atomic_writer(folder / f"{name}.txt") as stream:
            stream.write("".join(f"{line}\n" for line in lines).encode("utf-8"))


def _line(*values: object) -> str:
    """Return values as one line. `str` writes the shortest form of a float that reads back as the same float."""
    return " ".join(map(str, values))
