"""Photographs without poses: which files they are, what they share, how structure from motion gets them."""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from ...errors import InputError
from ...files.image_names import IMAGE_SUFFIXES, JPEG_SUFFIXES
from ...files.images import (
    ImageU8,
    PhotoHeader,
    read_image,
    read_photo_header,
    same_aspect,
    write_photo,
    write_png,
)
from ...files.masks import MASK_FOLDER, Mask, mask_files, read_mask, resize_mask

VIDEO_SUFFIXES = frozenset((".mp4", ".m4v", ".mov", ".mkv", ".avi", ".webm", ".mts", ".mpg", ".mpeg"))
# Photographs of kinds that Pillow does not read.
_FOREIGN = frozenset((".heic", ".heif", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".jxl", ".exr"))
_OPAQUE_ENOUGH = 128  # an alpha below hides a pixel from the search for features


@dataclass(frozen=True, eq=False)
class PhotoFile:
    """A photograph: its name in the scene to be, its file, and the file of its mask."""

    name: str
    file: Path
    mask: Path | None = None


@dataclass(frozen=True, eq=False)
class StagedPhoto:
    """A photograph that was read, as structure from motion gets it: upright, under a plain name.

    Parameters
    ----------
    source : the photograph. facts : of its header. staged : its name in the working folder.
    """

    source: PhotoFile
    facts: PhotoHeader
    staged: str

    def pixels(self) -> ImageU8:
        """(H, W, 3 or 4), upright."""
        return read_image(self.source.file, upright=True)

    def mask(self) -> Mask | None:
        """(H, W), upright; None where there is none."""
        return None if self.source.mask is None else _upright_mask(self.source.mask, self.source.file, self.facts)


def is_video(path: Path) -> bool:
    """Whether the file is a video, by its name."""
    return path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES


def is_photographs(path: Path) -> bool:
    """Whether the path is a video, or a folder with photographs but without poses."""
    if not path.is_dir():
        return is_video(path)
    posed = (path / "sparse").exists() or any(path.glob("transforms*.json"))
    return not posed and bool(_photo_names(_home(path)))


def find_photos(path: Path) -> list[PhotoFile]:
    """The photographs in a folder and below, or those in its `images`, sorted by name; masks from `masks` beside.

    Hidden files and folders are left out.

    Raises
    ------
    InputError : no such folder, or no photograph of a kind that is read.
    """
    if not path.is_dir():
        raise InputError(
            f"{path}: no such folder; give a folder of photos, or a video file ({', '.join(sorted(VIDEO_SUFFIXES))})"
        )
    home = _home(path)
    names = _photo_names(home)
    if not names:
        foreign = _foreign(home)
        mend = f"{foreign}: convert them to JPEG" if foreign else f"looked for {', '.join(sorted(IMAGE_SUFFIXES))}"
        raise InputError(f"{home}: no photos in it or below; {mend}")
    for name in names:
        if not name.isprintable():  # bytes that are no UTF-8, or line ends: no model's files can hold them
            raise InputError(f"{home}: the name {name!a} cannot be written into a model; rename the photo")
    folder = path / MASK_FOLDER
    masks = mask_files(folder, names) if folder.is_dir() else {}
    return [
        PhotoFile(scene_name, home / name, masks.get(name))
        for name, scene_name in zip(names, _scene_names(names), strict=True)
    ]


def unsupported_photos(path: Path) -> str:
    """What a folder holds beside photos that are read: "3 files .heic"; empty where nothing."""
    return _foreign(_home(path)) if path.is_dir() else ""


def fingerprint(path: Path) -> str:
    """Hex digest of a video's, or all photographs' and masks', names, sizes and times of change.

    Raises
    ------
    InputError : as `find_photos`.
    """
    files = (
        [path]
        if is_video(path)
        else [file for photo in find_photos(path) for file in (photo.file, photo.mask) if file is not None]
    )
    digest = hashlib.sha256()
    for file in files:
        try:
            state = file.stat()
            facts = f"{state.st_size}\0{state.st_mtime_ns}"
        except OSError as error:  # a link to nowhere: such a photo is named and left out when it is read
            facts = str(error.errno)
        digest.update(os.fsencode(os.path.relpath(file, path)) + f"\0{facts}\0".encode())
    return digest.hexdigest()


def stage_photo(photo: PhotoFile, number: int, photos: Path, masks: Path) -> StagedPhoto | str:
    """Read a photograph whole and put it into the working folder, upright; a mask into `masks`, under COLMAP's name.

    Returns
    -------
    The photograph, or one line on why it cannot be used.
    """
    try:
        facts, pixels = read_photo_header(photo.file), read_image(photo.file, upright=True)
        staged = f"{number:06}{'.png' if photo.file.suffix.lower() == '.png' and facts.plain else '.jpg'}"
        prepared = StagedPhoto(photo, facts, staged)
        mask = prepared.mask()
    except InputError as error:
        return str(error)
    if facts.plain and photo.file.suffix.lower() in (*JPEG_SUFFIXES, ".png"):
        _link(photo.file, photos / staged)
    else:
        write_photo(photos / staged, pixels[:, :, :3], facts.exif)
    if pixels.shape[2] == 4:
        opaque = pixels[:, :, 3] >= _OPAQUE_ENOUGH
        mask = opaque if mask is None else mask & opaque
    if mask is not None:
        _write_mask(masks, staged, mask)
    return prepared


def complete_masks(photos: Sequence[StagedPhoto], masks: Path) -> Path | None:
    """A mask for every photo, as COLMAP drops those without where others have one; None where none has."""
    if not any(masks.iterdir()):
        return None
    for photo in photos:
        if not (masks / f"{photo.staged}.png").exists():
            _write_mask(masks, photo.staged, np.ones((photo.facts.height, photo.facts.width), bool))
    return masks


def group_by_camera(photos: Sequence[StagedPhoto], mode: str) -> list[list[StagedPhoto]]:
    """Photos grouped by the camera that they share.

    Parameters
    ----------
    mode : "auto": equal size and EXIF (maker, model, focal length); "single", "per-image", "per-folder".

    Raises
    ------
    InputError : "single" or "per-folder", and sizes that differ.
    """
    groups: dict[object, list[StagedPhoto]] = {}
    for photo in photos:
        size = photo.facts.width, photo.facts.height
        folder = PurePosixPath(photo.source.name).parent
        key: object = {
            "auto": (size, photo.facts.camera),
            "single": None,
            "per-image": photo.staged,
            "per-folder": folder,
        }[mode]
        group = groups.setdefault(key, [])
        first = group[0].facts if group else photo.facts
        if (first.width, first.height) != size:
            raise InputError(
                f"{photo.source.file}: is {size[0]}x{size[1]} px, {group[0].source.name} {first.width}x"
                f"{first.height}; photos of one camera have one size: leave out --camera-mode {mode}"
            )
        group.append(photo)
    return list(groups.values())


def _home(path: Path) -> Path:
    """The folder itself, or its `images` where there are photos in that."""
    images = path / "images"
    return images if images.is_dir() and _photo_names(images) else path


def _photo_names(home: Path) -> list[str]:
    return _names(home, IMAGE_SUFFIXES)


def _names(home: Path, suffixes: frozenset[str]) -> list[str]:
    """Files below the folder with one of the suffixes, `/` between folders."""
    found = []
    for folder, folders, files in os.walk(home):
        below = Path(folder).relative_to(home)
        folders[:] = [
            name for name in folders if not name.startswith(".") and not (below == Path() and name == MASK_FOLDER)
        ]
        found += [
            (below / name).as_posix()
            for name in files
            if not name.startswith(".") and Path(name).suffix.lower() in suffixes
        ]
    return sorted(found)


def _foreign(home: Path) -> str:
    names = _names(home, _FOREIGN)
    kinds = sorted({Path(name).suffix.lower() for name in names})
    return f"{len(names)} file{'s' if len(names) > 1 else ''} {', '.join(kinds)}" if names else ""


def _scene_names(names: list[str]) -> list[str]:
    """Names in the scene, where photos are JPEG or PNG: other endings become .png, unless two would be the same."""
    kept = {name for name in names if Path(name).suffix.lower() in (*JPEG_SUFFIXES, ".png")}
    renamed: list[str] = []
    for name in names:
        short = str(PurePosixPath(name).with_suffix(".png"))
        renamed.append(name if name in kept else short if short not in (kept | set(renamed)) else f"{name}.png")
    return renamed


def _upright_mask(path: Path, photo: Path, facts: PhotoHeader) -> Mask:
    """A mask of the photo as stored or of the upright photo, of its size or a reduction of it, at the upright size."""
    mask = read_mask(path)
    rows, columns = mask.shape
    if not same_aspect((columns, rows), (facts.width, facts.height)):
        raise InputError(
            f"{path}: is {columns}x{rows} px, the photo {photo.name} {facts.width}x{facts.height}; "
            "make the mask of the photo's size, upright"
        )
    return resize_mask(mask, facts.width, facts.height)


def _write_mask(folder: Path, staged: str, mask: Mask) -> None:
    write_png(folder / f"{staged}.png", np.where(mask, 255, 0).astype(np.uint8))


def _link(file: Path, target: Path) -> None:
    """A link, or a copy where the system makes none."""
    try:
        target.symlink_to(file.resolve())
    except OSError:
        shutil.copyfile(file, target)
