"""Names of image files. This module loads no image library, so that the command line can start quickly."""

from __future__ import annotations

from collections.abc import Sequence
from importlib.util import find_spec

READS_HEIC = find_spec("pillow_heif") is not None  # the extra `heic`
JPEG_SUFFIXES = (".jpg", ".jpeg", ".jpe", ".jfif")
HEIC_SUFFIXES = (".heic", ".heif")  # of iPhones
IMAGE_SUFFIXES = frozenset(
    (
        *(".png", *JPEG_SUFFIXES, ".tif", ".tiff", ".bmp", ".webp", ".avif", ".jp2"),
        *(HEIC_SUFFIXES if READS_HEIC else ()),
    )
)
HEIC_REMEDY = "pip install 'clsplat[heic]'"
# Programs that convert formats of photos that are not supported to JPEG.
CONVERTERS = {
    **dict.fromkeys(() if READS_HEIC else HEIC_SUFFIXES, "heif-convert"),
    **dict.fromkeys((".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2"), "darktable-cli"),
    **dict.fromkeys((".jxl", ".exr"), "ImageMagick"),
}


def bare_name(name: str) -> str:
    """Return an image's name without its extension; other names keep their dots."""
    stem, dot, suffix = name.rpartition(".")
    return stem if stem and dot + suffix.lower() in IMAGE_SUFFIXES else name


def match_names(names: Sequence[str], others: Sequence[str]) -> dict[str, str] | None:
    """Return for each of `others` the one of `names` that it stands for; None unless they match one to one.

    Two names match if the parts that both have are equal, counted from the end and without extension: `0001.jpg` and
    `images/0001.png`. COLMAP names photos inside their folder, transforms.json beside it.
    """
    if set(names) == set(others):
        return {name: name for name in others}
    by_stem: dict[str, list[tuple[str, ...]]] = {}
    original = {_parts(name): name for name in names}
    for parts in original:
        by_stem.setdefault(parts[-1], []).append(parts)
    matched: dict[str, str] = {}
    for other in others:
        parts = _parts(other)
        found = [known for known in by_stem.get(parts[-1], []) if _end_alike(known, parts)]
        if parts in found:
            found = [parts]
        if len(found) != 1:
            return None
        matched[other] = original[found[0]]
    return matched if len(set(matched.values())) == len(names) == len(others) else None


def _parts(name: str) -> tuple[str, ...]:
    return tuple(bare_name(name).split("/"))


def _end_alike(one: tuple[str, ...], other: tuple[str, ...]) -> bool:
    shared = min(len(one), len(other))
    return one[-shared:] == other[-shared:]
