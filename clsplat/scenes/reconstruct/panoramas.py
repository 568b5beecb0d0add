"""Panoramas (equirectangular photos) as pinhole photos: the faces of a cube around the camera.

The camera of a face has an angle of view of 90 degrees. In the frame of the panorama, x is right, y down, and z is the
direction of its middle. A pixel at the share u of the width and v of the height has longitude 2 pi (u - 1/2) and
latitude pi (1/2 - v).

The bottom face is left out, because it shows the tripod or the person with the camera. The other faces show the ground
from further away.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from ...errors import InputError, Remedy
from ...files.images import ImageU8, image_size, read_image, write_photo, write_png
from ...files.masks import MASK_FOLDER, Mask, read_mask, resize_mask
from .photo_files import PhotoFile, StagedPhoto
from .sfm_process import Step, StepCallback
from .sphere_part import ASPECT, SpherePart, sphere_part

Rotation = NDArray[np.float64]

FACE_FOCAL = 0.5  # focal length of a face, in its width

_SIDES = ("front", "right", "back", "left")  # in this order, each turned by 90 degrees
_TOP = "top"
_MAX_FACE = 4096  # largest width of a face [px]


def face_rotations() -> dict[str, Rotation]:
    """Return the rotation (3, 3) from the frame of the panorama to that of each face; the first is the identity."""
    rotations = {}
    for number, name in enumerate(_SIDES):
        s, c = (round(f(0.5 * math.pi * number)) for f in (math.sin, math.cos))
        rotations[name] = np.array([[c, 0.0, -s], [0.0, 1.0, 0.0], [s, 0.0, c]])
    rotations[_TOP] = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    return rotations


def face_size(width: int) -> int:
    """Return width and height of a face [px], so that its middle has the resolution of a panorama of this width."""
    return min(max(2 * round(width / (2.0 * math.pi)), 2), _MAX_FACE)


def has_panorama_size(photo: Path) -> bool:
    """Return whether a photo is twice as wide as high. Raises InputError if it cannot be read."""
    width, height = image_size(photo)
    return width == ASPECT * height


def with_faces(
    source: Path, photos: list[PhotoFile], panoramas: str, folder: Path, report: StepCallback
) -> list[PhotoFile]:
    """Return photos with their faces in place of panoramas.

    Parameters
    ----------
    source : name of the photos, for messages.
    panoramas : as in ReconstructOptions.
    folder : folder to write faces to.

    Warns
    -----
    UserWarning : all photos are twice as wide as high, but do not say that they are panoramas.

    Raises
    ------
    InputError : only some of the photos are panoramas. OutputError : a face cannot be written.
    """
    if panoramas == "no":
        return photos
    readable = [photo.file for photo in photos if _is_readable(photo.file)]
    found = sum(sphere_part(photo) is not None for photo in readable)
    if panoramas == "auto" and found < len(readable):
        if found:
            raise InputError(
                f"{source}: {found} of {len(readable)} photos are panoramas",
                Remedy("put them into a folder of their own"),
                Remedy("do not cut them", "--panoramas no"),
            )
        if all(map(has_panorama_size, readable)):
            warnings.warn(
                f"{source}: the photos are twice as wide as high: if they are panoramas, use "
                "`clsplat reconstruct --panoramas yes`",
                stacklevel=3,
            )
        return photos
    return cut_panoramas(photos, folder, lambda done: report(Step("panoramas cut", done, len(photos))))


def rig_of(photos: Sequence[StagedPhoto]) -> list[tuple[str, Rotation, list[StagedPhoto]]]:
    """Return the faces of staged panoramas: name, rotation from the first one, and photos; none for other photos."""
    by_face: dict[str, list[StagedPhoto]] = {}
    for photo in photos:
        by_face.setdefault(face_of(photo.source), []).append(photo)
    by_face.pop("", None)
    rotations = {name: rotation for name, rotation in face_rotations().items() if name in by_face}
    first = next(iter(rotations.values()), np.eye(3))
    return [(name, rotation @ first.T, by_face[name]) for name, rotation in rotations.items()]


def _is_readable(photo: Path) -> bool:
    try:
        image_size(photo)
    except InputError:
        return False
    return True


def cut_panoramas(photos: Sequence[PhotoFile], folder: Path, progress: Callable[[int], None]) -> list[PhotoFile]:
    """Write the faces of panoramas and of their masks into a folder, and return them as photos.

    Panoramas that cannot be read are returned as they are, so that the caller names them.

    Parameters
    ----------
    photos : the panoramas. They may have different sizes, and show parts of the sphere (sphere_part.py). All faces have
        the size that suits the largest, because a face has one camera in the search for poses.
    folder : folder to write to.
    progress : called with the number of panoramas that are done.

    Raises
    ------
    InputError : a photo is not twice as wide as high, its mask has another shape, or its mask hides all of its faces.
    OutputError : a face cannot be written.
    """
    cut: list[PhotoFile] = []
    parts = [_part_of(photo) if _is_readable(photo.file) else None for photo in photos]
    size = face_size(max((part.whole[0] for part in parts if part is not None), default=0))
    with ThreadPoolExecutor(2) as pool:  # more threads would hold more panoramas in memory
        jobs = [
            pool.submit(lambda n, of, part: list(_faces_of(n, of, part, size, folder)), number, photo, part)
            for number, (photo, part) in enumerate(zip(photos, parts, strict=True))
        ]
        for done, job in enumerate(jobs, start=1):
            cut += job.result()
            progress(done)
    _places.cache_clear()  # it is large
    return cut


def face_of(photo: PhotoFile) -> str:
    """Return the face of a photo that `cut_panoramas` returned."""
    return photo.place.partition("/")[0]


def face_pairs(first: Sequence[str], second: Sequence[str], neighbours: bool) -> Iterator[tuple[int, int]]:
    """Yield the pairs of faces of two panoramas that can show the same things, as indices into both.

    Parameters
    ----------
    first, second : faces of the two panoramas.
    neighbours : the panoramas follow each other, so the camera has turned by less than a right angle.
    """
    for a, one in enumerate(first):
        for b, other in enumerate(second):
            if (one == _TOP) != (other == _TOP):
                continue
            opposite = one != _TOP and (_SIDES.index(one) - _SIDES.index(other)) % 4 == 2
            if not (neighbours and opposite):
                yield a, b


def _part_of(photo: PhotoFile) -> SpherePart:
    """Return the part of the sphere that a panorama shows: all of it, unless it says another one."""
    if (part := sphere_part(photo.file)) is not None:
        return part
    width, height = image_size(photo.file)
    if width != ASPECT * height:
        raise InputError(
            f"{photo.file}: is {width}x{height} px, a panorama is twice as wide as high",
            Remedy("leave it out"),
            Remedy("do not cut the photos", "--panoramas no"),
        )
    return SpherePart((width, height), 0, 0, (width, height))


def _faces_of(number: int, photo: PhotoFile, part: SpherePart | None, size: int, folder: Path) -> Iterator[PhotoFile]:
    """Write the faces of one panorama that show something, and yield them. size : width of a face [px]."""
    try:
        pixels = read_image(photo.file, upright=True)
    except InputError:
        pixels = None
    if pixels is None or part is None:
        yield photo
        return
    if pixels.shape[1::-1] != part.size:
        raise InputError(f"{photo.file}: its EXIF data turn it by 90 degrees, which is no panorama; store it upright")
    mask = None
    if photo.mask is not None:
        mask = read_mask(photo.mask)
        if mask.shape[1] * part.size[1] != part.size[0] * mask.shape[0]:
            raise InputError(f"{photo.mask}: is {mask.shape[1]}x{mask.shape[0]} px; make it as large as the panorama")
        mask = resize_mask(mask, *part.size)
    if not part.is_whole:
        pixels, mask = part.spread(pixels, mask)
    name = PurePosixPath(photo.name)
    ending = ".png" if pixels.shape[2] == 4 or name.suffix.lower() == ".png" else ".jpg"
    masks = {face: None if mask is None else face_mask(mask, face, size) for face in face_rotations()}
    shown = [face for face, shows in masks.items() if shows is None or shows.any()]
    if not shown:
        raise InputError(f"{photo.mask}: hides every face of {photo.file}: leave the photo out")
    for face in shown:
        new = str(name.with_name(f"{name.stem}_{face}{ending}"))
        file = folder / new
        write_photo(file, face_pixels(pixels, face, size))
        mask_file, shows = None, masks[face]
        if shows is not None:
            mask_file = folder / MASK_FOLDER / f"{new}.png"
            write_png(mask_file, np.where(shows, 255, 0).astype(np.uint8))
        yield PhotoFile(new, file, mask_file, place=f"{face}/{number:06}")


def face_pixels(panorama: ImageU8, face: str, size: int) -> ImageU8:
    """Return a face (S, S, C) of a panorama (H, 2 H, C) with bilinear interpolation. size : S."""
    from scipy.ndimage import map_coordinates  # lazy: a slow import

    height, width = panorama.shape[:2]
    rows, columns = _places(face, size, height, width)
    # The left edge continues at the right one.
    wide = np.pad(panorama, ((0, 0), (1, 1), (0, 0)), mode="wrap")
    layers = [
        map_coordinates(layer, (rows, columns + 1.0), np.float32, order=1, mode="nearest")
        for layer in np.moveaxis(wide, 2, 0)
    ]
    return np.rint(np.stack(layers, axis=2)).astype(np.uint8)


def face_mask(mask: Mask, face: str, size: int) -> Mask:
    """Return a face (S, S) of a panorama's mask (H, 2 H) with the nearest pixels. size : S."""
    height, width = mask.shape
    rows, columns = _places(face, size, height, width)
    found: Mask = mask[np.rint(rows).astype(int).clip(0, height - 1), np.rint(columns).astype(int) % width]
    return found


@lru_cache(len(_SIDES) + 1)  # panoramas of one folder usually have one size
def _places(face: str, size: int, height: int, width: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return the rows and columns (S, S) of the panorama that the pixels of a face see; 0 is a pixel's middle."""
    steps = (np.arange(size) + 0.5) / (0.5 * size) - 1.0
    x, y = np.meshgrid(steps, steps)
    directions = np.stack([x, y, np.ones_like(x)], axis=2) @ face_rotations()[face]  # R' of the rays
    longitude = np.arctan2(directions[..., 0], directions[..., 2])
    latitude = np.arctan2(-directions[..., 1], np.hypot(directions[..., 0], directions[..., 2]))
    columns = (longitude / (2.0 * math.pi) + 0.5) * width - 0.5
    rows = (0.5 - latitude / math.pi) * height - 0.5
    columns = columns % width
    columns -= np.where(columns > width - 0.5, width, 0)
    return rows.astype(np.float32), columns.astype(np.float32)
