"""Copies of COLMAP models for pycolmap, which refuses files that other programs or people have changed."""

from __future__ import annotations

import codecs
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from .colmap_binary import binary_without_observations
from .colmap_folder import FILES

_POINT_WORDS = 8  # words before the track in a line of points3D.txt


@contextmanager
def complete_model(folder: Path, suffix: str) -> Iterator[Path]:
    """Yield a model's folder, or a copy that pycolmap reads.

    pycolmap refuses a model without points3D, and text that begins with a byte order mark. The copy has an empty file
    of points, and no mark. Pipes are left out, because opening one would wait for ever.
    """
    files = [file for file in folder.glob(f"*{suffix}") if file.is_file()]
    points = folder / f"{FILES[2]}{suffix}"
    if points in files and not (suffix == ".txt" and any(map(_is_marked, files))):
        yield folder
        return
    with tempfile.TemporaryDirectory() as temporary:
        whole = Path(temporary)
        (whole / points.name).write_bytes(bytes(8) if suffix == ".bin" else b"")
        for file in files:
            content = file.read_bytes()
            (whole / file.name).write_bytes(content.removeprefix(codecs.BOM_UTF8) if suffix == ".txt" else content)
        yield whole


@contextmanager
def without_observations(folder: Path, suffix: str) -> Iterator[tuple[Path, dict[int, set[int]]]]:
    """Yield a copy of a model whose images and points do not name each other, and the image ids of each point.

    The copy has no rigs and no frames, which name images, too. The images have poses of their own.
    """
    images, points = (folder / f"{stem}{suffix}" for stem in FILES[1:])
    with tempfile.TemporaryDirectory() as temporary:
        bare, cameras = Path(temporary), f"{FILES[0]}{suffix}"
        (bare / cameras).write_bytes((folder / cameras).read_bytes())
        read = binary_without_observations if suffix == ".bin" else _text
        bare_images, bare_points, tracks = read(images, points)
        (bare / images.name).write_bytes(bare_images)
        (bare / points.name).write_bytes(bare_points)
        yield bare, {number: set(track) for number, track in tracks.items()}


def image_lines(images: Path, errors: str) -> Iterator[str]:
    """Yield the lines of images.txt with a pose and a name. errors : what to do with names that are not UTF-8.

    An image has two lines: its pose and name, then its observations, which may be empty.
    """
    with images.open(encoding="utf-8", errors=errors) as lines:
        for line in lines:
            if line.strip() and not line.startswith("#"):
                yield line.strip()
                next(lines, None)


def _is_marked(file: Path) -> bool:
    with file.open("rb") as stream:
        return stream.read(len(codecs.BOM_UTF8)) == codecs.BOM_UTF8


def _text(images: Path, points: Path) -> tuple[bytes, bytes, dict[int, list[int]]]:
    """As `binary_without_observations`, for text."""
    bare, tracks = [], {}
    with points.open(encoding="utf-8", errors="replace") as lines:
        for line in lines:
            words = line.split()
            if words and not words[0].startswith("#"):
                bare.append(" ".join(words[:_POINT_WORDS]))
                tracks[int(words[0])] = [int(word) for word in words[_POINT_WORDS::2]]
    named = "".join(f"{line}\n\n" for line in image_lines(images, "surrogateescape"))
    return named.encode("utf-8", "surrogateescape"), "\n".join(bare).encode(), tracks
