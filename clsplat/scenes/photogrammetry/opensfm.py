"""Scenes of OpenSfM, as OpenDroneMap and WebODM make them: `reconstruction.json`.

Format: https://opensfm.org/docs ("Dataset structure" and "Geometric models"). The file is a list of reconstructions.
Each has cameras (lenses), shots (a photo's pose and the name of its camera) and points. A pose is world-to-camera, an
angle-axis vector [rad] and a translation; the camera looks along z, with y down. Lenses are in units of the longer side
of the image, with the origin in its middle.
"""

from __future__ import annotations

import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError, named_place
from ...files.json_file import MAX_NUMBER, get_matrix, get_number, get_size, get_text, get_value, read_json
from ...splats.quaternions import rotations
from ..colmap import Points
from ..photo_size import MAX_SIDE
from ..posed_images import PosedImages, read_sizes
from ..undistort import Lens, RegisteredImage, brown_lens, make_lens
from .named_photos import find_named_photos

REMEDY = "run OpenSfM again"
_OWN_FOLDER = "opensfm"  # of a project of OpenDroneMap, whose photos are in `images` beside it
_RADIAL = {"perspective": ("k1", "k2"), "simple_radial": ("k1",), "radial": ("k1", "k2"), "brown": ("k1", "k2", "k3")}
_FISHEYE = {"fisheye": ("k1", "k2"), "fisheye_opencv": ("k1", "k2", "k3", "k4")}
_ONE_FOCAL = ("perspective", "fisheye")  # lenses with one focal length, and with the centre in the middle of the image


def read_opensfm(path: Path, images: str | None = None) -> PosedImages:
    """Read the photos with poses of a reconstruction, the largest one if the file has several.

    Parameters
    ----------
    path : a reconstruction.json.
    images : folder of the photos, relative to that of the file. By default the folder `images`, or that of the file. If
        the file is in a folder `opensfm`, they are looked for beside that folder, too.

    Warns
    -----
    UserWarning : the file has several reconstructions.

    Raises
    ------
    InputError : the file is damaged, a key is missing or has a bad value, or a lens has no counterpart. The message
        names file, entry and key.
    """
    whole = _largest(path)
    lenses, poses = _objects(path, whole, "cameras"), _objects(path, whole, "shots")
    if not poses:
        raise InputError(f"{path}: no photo has a pose; run OpenSfM again, with photos that overlap more")
    found = find_named_photos(_place(path) if images is None else path, list(poses), images)
    files = dict(found.values())
    sizes, left_out = read_sizes(files)
    photos = []
    for stored, shot in poses.items():
        name = found[stored][0]
        if name not in sizes:
            continue
        with named_place(f"{path}: shot {stored!r}"):
            camera, pose = get_text(shot, "camera", REMEDY), _pose(shot)
            if camera not in lenses:
                raise InputError(f"its camera {camera[:60]!r} is not among the cameras; {REMEDY}")
        with named_place(f"{path}: camera {camera[:60]!r}"):
            photos.append(RegisteredImage(name, pose, _lens(lenses[camera], sizes[name])))
    photos.sort(key=lambda photo: photo.name)
    return PosedImages(photos, files, sizes, _points(path, whole), left_out=left_out)


def _largest(path: Path) -> dict[str, Any]:
    """Return the reconstruction with the most shots."""
    parts = read_json(path, "a reconstruction.json of OpenSfM")
    if not isinstance(parts, list) or not parts or not all(isinstance(part, dict) for part in parts):
        raise InputError(f"{path}: is not a list of reconstructions; give a reconstruction.json of OpenSfM")
    counts = [len(_objects(path, part, "shots")) for part in parts]
    largest = max(range(len(parts)), key=counts.__getitem__)
    if len(parts) > 1:
        warnings.warn(
            f"{path}: has {len(parts)} reconstructions; the one with {counts[largest]} of {sum(counts)} photos is read",
            stacklevel=5,
        )
    return dict(parts[largest])


def _objects(path: Path, entry: dict[str, Any], key: str) -> dict[str, dict[str, Any]]:
    """Return the objects at a key, by their names."""
    with named_place(str(path)):
        found = get_value(entry, key, REMEDY)
        if not isinstance(found, dict) or not all(isinstance(each, dict) for each in found.values()):
            raise InputError(f"key {key!r} has the wrong form; expected objects by name")
    return found


def _place(path: Path) -> Path:
    """Return the file beside whose folder of photos it belongs: in OpenDroneMap, that of the folder above."""
    above = path.parent.parent
    if path.parent.name != _OWN_FOLDER or (path.parent / "images").is_dir() or not (above / "images").is_dir():
        return path
    return above / path.name


def _pose(shot: dict[str, Any]) -> NDArray[np.float64]:
    """Return the world-to-camera matrix of a shot, (4, 4)."""
    turn, translation = (_numbers(shot, key) for key in ("rotation", "translation"))
    half = 0.5 * float(np.linalg.norm(turn))
    pose = np.eye(4)
    pose[:3, :3] = rotations(np.array([[np.cos(half), *(0.5 * np.sinc(half / np.pi) * turn)]]))[0]
    pose[:3, 3] = translation
    return pose


def _numbers(entry: dict[str, Any], key: str) -> NDArray[np.float64]:
    """Return the three numbers at a key, all below 1e30."""
    found = get_matrix(entry, key, (3,), REMEDY)
    if np.abs(found).max() >= MAX_NUMBER:
        raise InputError(f"key {key!r} has a number above {MAX_NUMBER:g}; {REMEDY}")
    return found


def _lens(camera: dict[str, Any], stored: tuple[int, int]) -> Lens:
    """Return the lens of a camera whose photo is stored with this size [px]. The camera may name another size."""
    kind = get_text({"projection_type": "perspective"} | camera, "projection_type", REMEDY)
    if kind not in _RADIAL and kind not in _FISHEYE:
        raise InputError(
            f"its projection_type is {kind[:40]!r}; only {', '.join((*_RADIAL, *_FISHEYE))} have a pinhole image: use "
            "one of them, or undistort the photos first"
        )
    given_size = camera.get("width") and camera.get("height")
    width, height = (get_size(camera, key, REMEDY) for key in ("width", "height")) if given_size else stored
    side = max(width, height)
    if side > MAX_SIDE:
        raise InputError(f"its size is {width}x{height} px; a side has at most {MAX_SIDE} px")

    def optional(key: str) -> float:
        return get_number({key: 0.0} | camera, key, REMEDY)

    if kind in _ONE_FOCAL:
        focal, centre = [get_number(camera, "focal", REMEDY)] * 2, [0.0, 0.0]
    else:
        focal = [get_number(camera, key, REMEDY) for key in ("focal_x", "focal_y")]
        centre = [optional("c_x"), optional("c_y")]
    if min(focal) <= 0.0:
        raise InputError(f"its focal length is not above 0, but {min(focal):g}; {REMEDY}")
    core = [side * focal[0], side * focal[1], width / 2 + side * centre[0], height / 2 + side * centre[1]]
    factors = [optional(key) for key in _RADIAL.get(kind) or _FISHEYE[kind]]
    if kind in _FISHEYE:
        return make_lens("OPENCV_FISHEYE", width, height, [*core, *factors, *[0.0] * (4 - len(factors))])
    tangential = [optional(key) for key in ("p1", "p2")] if kind == "brown" else [0.0, 0.0]
    return brown_lens(width, height, core, [*factors, *[0.0] * (3 - len(factors))], tangential)


def _points(path: Path, whole: dict[str, Any]) -> Points:
    """Return the points. The file does not say how many photos show each."""
    points = _objects(path, {"points": {}} | whole, "points")
    xyz, rgb = np.empty((len(points), 3)), np.empty((len(points), 3), np.uint8)
    for row, (name, point) in enumerate(points.items()):
        with named_place(f"{path}: point {name!r}"):
            xyz[row] = _numbers(point, "coordinates")
            rgb[row] = np.clip(np.rint(_numbers({"color": [128, 128, 128]} | point, "color")), 0, 255)
    return Points(xyz, rgb, np.ones(len(points), np.int64))
