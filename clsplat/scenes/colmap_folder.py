"""Where a scene has its COLMAP model: in `sparse`, beside its photos (RealityScan), or in a folder of another name."""

from __future__ import annotations

from pathlib import Path

from ..files.image_names import IMAGE_SUFFIXES

FILES = ("cameras", "images", "points3D")
PHOTOS = "images"  # folder of a scene's photos
_OTHER_FOLDERS = ("colmap/sparse", "colmap_sparse", "colmap_text")  # of nerfstudio and of instant-ngp


def colmap_folder(scene: Path) -> Path | None:
    """Return the folder in which a scene has its COLMAP model or models; None without one.

    This is `sparse`. Without it, it is the scene's own folder or one of _OTHER_FOLDERS, if that holds a model, and the
    scene's folder holds photos.
    """
    sparse = scene / "sparse"
    if sparse.is_dir():
        return sparse
    if model_suffix(scene):
        return scene if _has_photos(scene) else None
    found = next((scene / name for name in _OTHER_FOLDERS if models_in(scene / name)), None)
    return found if found is not None and _has_photos(scene) else None


def models_in(folder: Path) -> list[Path]:
    """Return the folders with a model, of a folder and its subfolders."""
    if not folder.is_dir():
        return []
    try:
        places = [folder, *sorted(path for path in folder.iterdir() if path.is_dir())]
    except OSError:
        return []
    return [place for place in places if model_suffix(place)]


def model_suffix(folder: Path) -> str:
    """Return the suffix of a model's files as pycolmap chooses it, ".bin" or ".txt", or "" without a model."""
    for suffix in (".bin", ".txt"):
        if all((folder / f"{stem}{suffix}").is_file() for stem in FILES[:2]):
            return suffix
    return ""


def _has_photos(scene: Path) -> bool:
    return (scene / PHOTOS).is_dir() or any(file.suffix.lower() in IMAGE_SUFFIXES for file in scene.iterdir())
