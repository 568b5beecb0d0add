"""Photos with poses before decoding, the common form of all kinds of scenes, and the reader of COLMAP scenes."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from pathlib import Path

from ..errors import InputError
from ..files.image_names import IMAGE_SUFFIXES
from .colmap import Points, find_model, read_model
from .undistort import RegisteredImage

_FEW_REGISTERED = 0.8  # share of registered photos below which a warning is issued


@dataclass(frozen=True, eq=False)
class PosedImages:
    """Photos with poses, and points.

    Parameters
    ----------
    photos : registered images, sorted by name.
    files : file of each photo, by name.
    points : point cloud, may be empty.
    test_names : names of the photos that the scene's files hold out for evaluation; None if they do not specify any.
    masks : mask files named in the scene's files, by photo name.
    """

    photos: list[RegisteredImage]
    files: dict[str, Path]
    points: Points
    test_names: frozenset[str] | None = None
    masks: dict[str, Path] = field(default_factory=dict)

    @property
    def names(self) -> list[str]:
        """Names of all photos."""
        return [photo.name for photo in self.photos]


def read_colmap(root: Path, images: str | None) -> PosedImages:
    """Read a folder with photos and a COLMAP model in `sparse`.

    Parameters
    ----------
    root : the scene's folder.
    images : folder of the photos inside it; "images" by default.

    Warns
    -----
    UserWarning : the model registers fewer than 80 % of the photos in the folder.

    Raises
    ------
    InputError : a folder or photo is missing, or the model is damaged.
    """
    model = read_model(find_model(root))
    folder = _photo_folder(root, images or "images")
    files = _photo_files(folder, [photo.name for photo in model.photos])
    _warn_of_unregistered(folder, len(files))
    return PosedImages(model.photos, files, model.points)


def _photo_folder(root: Path, images: str) -> Path:
    folder = root / images
    if not folder.is_dir():
        others = ", ".join(sorted(other.name for other in root.glob("images*") if other.is_dir()))
        raise InputError(
            f"{folder}: there is no such folder of photos; "
            + (f"choose one of: {others}" if others else "put the photos there, or name their folder")
        )
    return folder


def _photo_files(folder: Path, names: list[str]) -> dict[str, Path]:
    files = {name: folder / name for name in names}
    missing = [name for name, file in files.items() if not file.is_file()]
    if missing:
        some = ", ".join(missing[:3]) + (", ..." if len(missing) > 3 else "")
        raise InputError(
            f"{folder}: {len(missing)} of the model's {len(names)} images are missing: {some}; "
            "copy them there, or name another folder of photos"
        )
    return files


def _warn_of_unregistered(folder: Path, registered: int) -> None:
    photos = sum(1 for file in folder.rglob("*") if file.suffix.lower() in IMAGE_SUFFIXES)
    if registered < _FEW_REGISTERED * photos:
        warnings.warn(
            f"{folder}: the model registers only {registered} of {photos} photos; parts of the "
            "scene may be missing. More overlap between photos helps.",
            stacklevel=4,
        )
