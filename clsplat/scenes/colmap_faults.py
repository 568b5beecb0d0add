"""Which line of a text model of COLMAP is wrong. Its library does not say so, and reads wrong poses without a word."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path

from .colmap_text import POINT_WORDS, POSE_WORDS, is_number
from .undistort import colmap_library

_REMEDY = "correct it, or write the model again"


def text_fault(folder: Path) -> str | None:
    """Return what is wrong in cameras.txt or points3D.txt, with file and line; None if nothing is found.

    It takes seconds for millions of points, so it is for models that COLMAP's library has refused.
    """
    return _fault_of_cameras(folder / "cameras.txt") or _fault_of_points(folder / "points3D.txt")


def image_fault(file: Path, poses: Iterable[str]) -> str | None:
    """Return what is wrong in images.txt, given its lines with poses; None if all have a pose, a camera and a name."""
    for pose in poses:
        words = pose.split()
        whole = (words[0], words[POSE_WORDS - 2]) if len(words) >= POSE_WORDS else ()
        if not whole or not all(map(_is_whole, whole)) or not all(map(is_number, words[: POSE_WORDS - 1])):
            start = pose[:40] + ("..." if len(pose) > 40 else "")
            return f"{file}: {start!r} is no image (ID QW QX QY QZ TX TY TZ CAMERA NAME): {_REMEDY}"
    return None


def _fault_of_cameras(file: Path) -> str | None:
    models = colmap_library().CameraModelId.__members__
    for place, words in _lines(file):
        if len(words) < 4 or not all(word.isdecimal() for word in (words[0], *words[2:4])):
            return f"{place} is no camera (ID MODEL WIDTH HEIGHT PARAMETERS, of whole numbers): {_REMEDY}"
        if words[1] not in models or words[1] == "INVALID":
            return f"{place}: COLMAP has no camera model {words[1]!r}: {_REMEDY}"
        params = words[4:]
        if (odd := next((word for word in params if not is_number(word)), None)) is not None:
            return f"{place}: the parameter {odd!r} is not a number: {_REMEDY}"
        names = colmap_library().Camera(model=words[1], width=1, height=1).params_info
        if len(params) != (expected := len(names.split(","))):
            return f"{place}: {words[1]} has {len(params)} parameters instead of {expected} ({names}): {_REMEDY}"
    return None


def _fault_of_points(file: Path) -> str | None:
    if not file.is_file():
        return None
    for place, words in _lines(file):
        head = words[:POINT_WORDS]
        if len(head) < POINT_WORDS or not all(map(is_number, head)) or not all(map(_is_whole, (head[0], *head[4:7]))):
            return f"{place} is no point (ID X Y Z R G B ERROR TRACK, colours of whole numbers): {_REMEDY}"
        if len(words) % 2 or not all(map(_is_whole, words[POINT_WORDS:])):
            return f"{place}: its track is not pairs of an image and an observation: {_REMEDY}"
    return None


def _lines(file: Path) -> Iterator[tuple[str, list[str]]]:
    """Yield the words of each line that is not a comment, with its place for messages."""
    with file.open(encoding="utf-8-sig", errors="replace") as lines:
        for number, line in enumerate(lines, 1):
            words = line.split()
            if words and not words[0].startswith("#"):
                yield f"{file}: line {number}", words


def _is_whole(word: str) -> bool:
    return word.removeprefix("-").isdecimal()
