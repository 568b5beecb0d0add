"""Copies of COLMAP models for pycolmap, which refuses files that other programs or people have changed."""

from __future__ import annotations

import codecs
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from .colmap_binary import binary_without_observations
from .colmap_folder import FILES
from .colmap_text import text_without_observations, with_observation_lines


@contextmanager
def complete_model(folder: Path, suffix: str) -> Iterator[Path]:
    """Yield a model's folder, or a copy that pycolmap reads.

    pycolmap refuses a model without points3D, frames without rigs, and text that begins with a byte order mark. It
    reads every second image of an images.txt with one line for each image. The copy has an empty file of points, no
    such frames (images have poses of their own), no mark, and two lines for each image. Pipes are left out, because
    opening one would wait for ever.
    """
    files = found = [file for file in folder.glob(f"*{suffix}") if file.is_file()]
    if not (folder / f"rigs{suffix}").is_file():
        files = [file for file in found if file.stem != "frames"]
    images, points = (folder / f"{stem}{suffix}" for stem in FILES[1:])
    marked = suffix == ".txt" and any(map(_is_marked, files))
    lines = with_observation_lines(images) if suffix == ".txt" else None
    if points in files and files == found and not marked and lines is None:
        yield folder
        return
    with tempfile.TemporaryDirectory() as temporary:
        whole = Path(temporary)
        (whole / points.name).write_bytes(bytes(8) if suffix == ".bin" else b"")
        for file in files:
            content = file.read_bytes()
            if lines is not None and file == images:
                content = lines
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
        read = binary_without_observations if suffix == ".bin" else text_without_observations
        bare_images, bare_points, tracks = read(images, points)
        (bare / images.name).write_bytes(bare_images)
        (bare / points.name).write_bytes(bare_points)
        yield bare, {number: set(track) for number, track in tracks.items()}


def _is_marked(file: Path) -> bool:
    with file.open("rb") as stream:
        return stream.read(len(codecs.BOM_UTF8)) == codecs.BOM_UTF8
