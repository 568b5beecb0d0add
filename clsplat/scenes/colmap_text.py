"""Text models of COLMAP: the lines of images.txt and points3D.txt."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

POSE_WORDS = 10  # words of a line of images.txt with a pose; the last one is the name
POINT_WORDS = 8  # words before the track in a line of points3D.txt
_LONGEST_POSE = 5000  # characters; longer lines are observations


class ImageLines(NamedTuple):
    """An image in images.txt. pose : id, pose, camera and name. observations : x, y and point id of each, or None."""

    pose: str
    observations: str | None


def read_image_lines(images: Path, errors: str) -> Iterator[ImageLines]:
    """Yield the images of images.txt. errors : what to do with names that are not UTF-8.

    An image has two lines: its pose and name, then its observations, which may be empty. Other programs leave the
    second line out if it would be empty; then the observations are None.
    """
    pose = None
    with images.open(encoding="utf-8-sig", errors=errors) as lines:
        for line in map(str.strip, lines):
            if pose is not None and _is_observations(line):
                yield ImageLines(pose, line)
                pose = None
                continue
            if pose is not None:
                yield ImageLines(pose, None)
                pose = None
            if line and not line.startswith("#"):
                pose = line
    if pose is not None:
        yield ImageLines(pose, None)


def with_observation_lines(images: Path) -> bytes | None:
    """Return images.txt with two lines for each image, as COLMAP reads it; None if the file has them already."""
    if all(image.observations is not None for image in read_image_lines(images, "replace")):
        return None
    found = read_image_lines(images, "surrogateescape")
    text = "".join(f"{image.pose}\n{image.observations or ''}\n" for image in found)
    return text.encode("utf-8", "surrogateescape")


def names_with_spaces(poses: Iterable[str]) -> dict[int, str]:
    """Return the names with spaces in the lines of images.txt that have poses, by image id.

    COLMAP ends a name at the first space, but other programs write whole names.
    """
    names = {}
    for pose in poses:
        words = pose.split(maxsplit=POSE_WORDS - 1)
        if len(words) == POSE_WORDS and words[0].isdecimal() and len(words[-1].split()) > 1:
            names[int(words[0])] = words[-1]
    return names


def text_without_observations(images: Path, points: Path) -> tuple[bytes, bytes, dict[int, list[int]]]:
    """Return both files without observations and tracks, and the image ids of each point."""
    bare, tracks = [], {}
    with points.open(encoding="utf-8", errors="replace") as lines:
        for line in lines:
            words = line.split()
            if words and not words[0].startswith("#"):
                bare.append(" ".join(words[:POINT_WORDS]))
                tracks[int(words[0])] = [int(word) for word in words[POINT_WORDS::2]]
    named = "".join(f"{image.pose}\n\n" for image in read_image_lines(images, "surrogateescape"))
    return named.encode("utf-8", "surrogateescape"), "\n".join(bare).encode(), tracks


def _is_observations(line: str) -> bool:
    """Return whether a line has three numbers for each observation. A line with a name has not."""
    if len(line) > _LONGEST_POSE:
        return True
    words = line.split()
    return len(words) % 3 == 0 and all(map(is_number, words))


def is_number(word: str) -> bool:
    """Return whether a word of a text model is a number."""
    try:
        float(word)
    except ValueError:
        return False
    return True
