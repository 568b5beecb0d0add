"""Photos with poses, before they are decoded: what every kind of scene is read into. COLMAP's kind is here."""

from __future__ import annotations

import warnings
from dataclasses import dataclass, field
from pathlib import Path

from ..errors import InputError
from ..files.image_names import IMAGE_SUFFIXES
from .colmap import Points, find_model, read_model
from .undistort import RegisteredImage

_FEW_REGISTERED = 0.8


@dataclass(frozen=True, eq=False)
class PosedImages:
    """Posed photos and points.

    Parameters
    ----------
    photos : sorted by name.
    files : where each photo is, by name.
    points : may be empty.
    test_names : photos that the files themselves hold out for evaluation; None where they do not say.
    masks : files of masks that the files name, by their photos' names.
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
    """A folder with photos and a COLMAP model in `sparse`.

    Parameters
    ----------
    images : folder of the photos inside it; "images" by default.

    Warns
    -----
    UserWarning : the model registers fewer than 80 % of the photos in the folder.

    Raises
    ------
    InputError : a missing folder or photo, or a damaged model.
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
            f"{folder}: no such folder of photos; "
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
