"""Where a scene has its COLMAP model: in `sparse`, or beside its photos, where RealityScan writes it."""

from __future__ import annotations

from pathlib import Path

from ..files.image_names import IMAGE_SUFFIXES

FILES = ("cameras", "images", "points3D")
PHOTOS = "images"  # folder of a scene's photos


def colmap_folder(scene: Path) -> Path | None:
    """Return the folder in which a scene has its COLMAP model or models; None without one.

    This is `sparse`. Without it, it is the scene's own folder, if that holds a model and photos.
    """
    sparse = scene / "sparse"
    if sparse.is_dir():
        return sparse
    return scene if model_suffix(scene) and _has_photos(scene) else None


def model_suffix(folder: Path) -> str:
    """Return the suffix of a model's files as pycolmap chooses it, ".bin" or ".txt", or "" without a model."""
    for suffix in (".bin", ".txt"):
        if all((folder / f"{stem}{suffix}").is_file() for stem in FILES[:2]):
            return suffix
    return ""


def _has_photos(scene: Path) -> bool:
    return (scene / PHOTOS).is_dir() or any(file.suffix.lower() in IMAGE_SUFFIXES for file in scene.iterdir())
