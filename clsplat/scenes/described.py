"""Scenes without a COLMAP model: the reader for each kind of file that describes them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from ..errors import InputError
from .nerfstudio import read_transforms
from .photogrammetry.metashape import read_metashape
from .photogrammetry.opensfm import read_opensfm
from .photogrammetry.opf import read_opf
from .posed_images import PosedImages
from .scene_files import METASHAPE_ENDING, OPF_ENDING, is_opensfm

_READERS = {OPF_ENDING: read_opf, METASHAPE_ENDING: read_metashape}


def read_described(files: Sequence[Path], images: str | None = None) -> PosedImages:
    """Read the photos with poses that files describe, without decoding them.

    Parameters
    ----------
    files : result of `find_scene_files`.
    images : folder of the photos inside the scene, in place of the one that the files name.

    Raises
    ------
    InputError : a file is damaged, or there are several OPF projects or several files of Metashape.
    """
    reader = read_opensfm if is_opensfm(files[0]) else _READERS.get(files[0].suffix.lower())
    if reader is None:
        return read_transforms(list(files), images)
    if len(files) > 1:
        names = ", ".join(file.name for file in files[:3])
        raise InputError(
            f"{files[0].parent}: {len(files)} files describe cameras ({names}); give one of them, such as {files[0]}"
        )
    return reader(files[0], images)
