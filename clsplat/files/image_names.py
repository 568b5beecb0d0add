"""Names of image files. This module loads no image library, so that the command line can start quickly."""

from __future__ import annotations

IMAGE_SUFFIXES = frozenset((".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp"))
JPEG_SUFFIXES = (".jpg", ".jpeg")


def bare_name(name: str) -> str:
    """Return an image's name without its extension; other names keep their dots."""
    stem, dot, suffix = name.rpartition(".")
    return stem if stem and dot + suffix.lower() in IMAGE_SUFFIXES else name
