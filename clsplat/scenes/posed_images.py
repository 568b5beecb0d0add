"""Photos with poses before decoding, the common form of all kinds of scenes, and the reader of COLMAP scenes."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

from ..errors import InputError
from ..files.image_names import IMAGE_SUFFIXES
from ..files.images import image_size, is_render
from .colmap import Points, find_model, read_model
from .colmap_folder import PHOTOS, colmap_folder
from .options import ORIGIN
from .photo_listing import list_images
from .photo_names import place_photos
from .point_cloud import read_point_cloud
from .reduced_photos import with_reduced_photos
from .undistort import RegisteredImage

_FEW_REGISTERED = 0.8  # share of registered photos below which a warning is issued
MIN_USABLE = 0.25  # smallest share of usable photos; a set of NeRF without its test photos has a third
_MAX_REASONS = 3  # largest number of photos that a warning names


@dataclass(frozen=True, eq=False)
class PosedImages:
    """Photos with poses, and points.

    Parameters
    ----------
    photos : registered images with a readable header, sorted by name.
    files : file of each photo, by name, with those left out.
    sizes : (width, height) of each photo as read [px], by name.
    points : point cloud, may be empty.
    test_names : names of the photos that the scene's files hold out for evaluation, with those left out; None if the
        files do not specify any.
    masks : by photo name, functions that look up the mask which the scene's files name. They raise InputError.
    left_out : reason why a photo with a pose cannot be used, by name.
    origin : the point of the file's coordinates that is the origin of the poses and points (origin.py).
    unused : names of those left out that the file itself does not use, such as disabled cameras.
    upright : names of the photos that are turned by their EXIF orientation (turned_photos.py); others are as stored.
    """

    photos: list[RegisteredImage]
    files: dict[str, Path]
    sizes: dict[str, tuple[int, int]]
    points: Points
    test_names: frozenset[str] | None = None
    masks: Mapping[str, Callable[[], Path]] = field(default_factory=dict)
    left_out: dict[str, str] = field(default_factory=dict)
    origin: tuple[float, float, float] = ORIGIN
    unused: frozenset[str] = frozenset()
    upright: frozenset[str] = frozenset()

    @property
    def names(self) -> list[str]:
        """Names of the usable photos."""
        return [photo.name for photo in self.photos]

    @property
    def listed(self) -> list[str]:
        """Names of all photos with poses, sorted, with those left out. Splits follow these names."""
        return sorted([*self.names, *self.left_out])


def read_sizes(files: Mapping[str, Path]) -> tuple[dict[str, tuple[int, int]], dict[str, str]]:
    """Return the size of each photo [px] from its header, and the reasons why other photos cannot be used, by name."""
    sizes, left_out = {}, {}
    for name, file in files.items():
        try:
            sizes[name] = image_size(file)
        except InputError as error:
            left_out[name] = str(error)
    return sizes, left_out


def check_left_out(root: Path, posed: PosedImages, left_out: Mapping[str, str]) -> None:
    """Raise InputError if fewer than a quarter of a scene's photos can be used.

    A quarter of the training photos is enough if the scene's files name the test views. BlenderNeRF writes poses of
    test views without photos. Photos that the scene's file does not use do not count.
    """
    left_out = {name: reason for name, reason in left_out.items() if name not in posed.unused}
    if not left_out:
        return
    listed = set(posed.listed) - posed.unused
    for names in (listed, listed - (posed.test_names or set())):
        if len(names - set(left_out)) >= max(1, MIN_USABLE * len(names)):
            return
    n, used = len(listed), len(listed) - len(left_out)
    number = f"only {used}" if used else "none"
    place = _place_of(root, [posed.files[name] for name in left_out if name in posed.files])
    raise InputError(
        f"{root}: {number} of its {n} photos can be used, at least {math.ceil(MIN_USABLE * n)} must be; "
        f"copy them there, or name another folder of photos{place} ({next(iter(left_out.values()))})"
    )


def _place_of(root: Path, files: Sequence[Path]) -> str:
    """Return words that name a folder beside the scene's, or in it, with the first of the missing photos, or "".

    ScanNet++ has its photos beside the folder of their poses.
    """
    home = root.parent if root.is_file() else root
    missing = next((file.name for file in files if not file.is_file()), None)
    if missing is None:
        return ""
    for folder, way in ((home, ""), (home.absolute().parent, "../")):
        with suppress(OSError):  # the folder above may be closed to this user
            for place in sorted(folder.iterdir()):
                if (place / missing).is_file() and not is_render(place / missing):
                    return f", such as {way}{place.name}"
    return ""


def warn_of_left_out(root: Path, left_out: Mapping[str, str], n: int) -> None:
    """Warn if some of a scene's `n` photos are left out; `left_out` has the reasons by name."""
    if left_out:
        reasons = list(left_out.values())
        warnings.warn(
            f"{root}: {len(reasons)} of {n} photos are left out ({math.ceil(100 * len(reasons) / n)} %): "
            + "; ".join(reasons[:_MAX_REASONS])
            + ("; ..." if len(reasons) > _MAX_REASONS else ""),
            stacklevel=3,
        )


def read_colmap(root: Path, images: str | None) -> PosedImages:
    """Read a folder with photos and a COLMAP model.

    Parameters
    ----------
    root : the scene's folder.
    images : folder of the photos inside it; by default "images". Without it, that of a model beside its photos.

    Warns
    -----
    UserWarning : the model registers fewer than 80 % of the photos in the folder.

    Raises
    ------
    InputError : a folder is missing, or the model is damaged.
    """
    place = find_model(root)
    model = read_model(place)
    beside = colmap_folder(root) == root and not (root / PHOTOS).is_dir()
    folder = photo_folder(root, images or ("." if beside else PHOTOS))
    placed = place_photos(folder, [photo.name for photo in model.photos])
    files = with_reduced_photos(folder, dict(placed.values()))
    sizes, left_out = read_sizes(files)
    _warn_of_unregistered(folder, len(model.photos))
    named = sorted((replace(photo, name=placed[photo.name][0]) for photo in model.photos), key=lambda photo: photo.name)
    photos = [photo for photo in named if photo.name in sizes]
    return PosedImages(photos, files, sizes, _points_of(place, model.points), left_out=left_out)


def _points_of(model: Path, points: Points) -> Points:
    """Return the points of a model, or of the points3D.ply beside it: some programs write no other file of points."""
    file = model / "points3D.ply"
    return points if len(points) or not file.is_file() else read_point_cloud(file)


def photo_folder(root: Path, images: str) -> Path:
    """Return the folder of the photos inside a scene; raises InputError if it is missing."""
    folder = root / images
    if not folder.is_dir():
        others = ", ".join(sorted(other.name for other in root.glob("images*") if other.is_dir()))
        raise InputError(
            f"{folder}: there is no such folder of photos; "
            + (f"choose one of: {others}" if others else "put the photos there, or name their folder")
        )
    return folder


def _warn_of_unregistered(folder: Path, registered: int) -> None:
    photos = len(list_images(folder, IMAGE_SUFFIXES).names)
    if registered < _FEW_REGISTERED * photos:
        warnings.warn(
            f"{folder}: the model registers only {registered} of {photos} photos; parts of the "
            "scene may be missing. More overlap between photos helps.",
            stacklevel=4,
        )
