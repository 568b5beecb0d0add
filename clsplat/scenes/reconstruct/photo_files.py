"""Photos without poses: finding files, grouping by camera, and preparing them for structure from motion."""

from __future__ import annotations

import hashlib
import os
import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import numpy as np

from ...errors import InputError
from ...files.digest import file_digest
from ...files.file_names import name_key
from ...files.image_names import CONVERTERS, HEIC_REMEDY, HEIC_SUFFIXES, IMAGE_SUFFIXES, JPEG_SUFFIXES
from ...files.images import (
    ImageU8,
    PhotoHeader,
    read_image,
    read_photo_header,
    same_aspect,
    write_photo,
    write_png,
)
from ...files.masks import MASK_FOLDER, Mask, mask_files, masks_beside, read_mask, resize_mask, warn_of_unused
from ...files.real_path import real_path
from ..colmap_folder import colmap_folder
from ..photo_listing import Listing, has_images, list_images
from ..scene_files import find_scene_files
from ..wrong_folder import describe_scenes, scene_hint

VIDEO_SUFFIXES = frozenset((".mp4", ".m4v", ".mov", ".mkv", ".avi", ".webm", ".mts", ".mpg", ".mpeg"))
# Polycam's raw data has maps of depth beside its photos, which are no photos, and may have the same photos undistorted.
_PHOTO_FOLDERS = ("images", "keyframes/corrected_images", "keyframes/images")
_MIN_ALPHA = 128  # features are not searched for in pixels with a smaller alpha


@dataclass(frozen=True, eq=False)
class PhotoFile:
    """A photo without a pose.

    Parameters
    ----------
    name : its name in the new scene.
    file, mask : the files of the photo and of its mask.
    place : its path in the working folder of a reconstruction, without an ending; by default its number.
    """

    name: str
    file: Path
    mask: Path | None = None
    place: str = ""


@dataclass(frozen=True, eq=False)
class StagedPhoto:
    """A photo in the working folder of a reconstruction: upright, with a number as its name.

    Parameters
    ----------
    source : the original photo.
    header : the original photo's header.
    staged : name in the working folder.
    """

    source: PhotoFile
    header: PhotoHeader
    staged: str

    def pixels(self) -> ImageU8:
        """Return the upright pixels, (H, W, 3) or (H, W, 4)."""
        return read_image(self.source.file, upright=True)

    def mask(self) -> Mask | None:
        """Return the upright mask, (H, W), or None."""
        return None if self.source.mask is None else _upright_mask(self.source.mask, self.source.file, self.header)


def is_video(path: Path) -> bool:
    """Return whether the file is a video, by its suffix."""
    return path.is_file() and path.suffix.lower() in VIDEO_SUFFIXES


def is_photographs(path: Path) -> bool:
    """Return whether the path is a video, or a folder with photos but without poses."""
    if not path.is_dir():
        return is_video(path)
    posed = colmap_folder(path) is not None or any(path.glob("transforms*.json")) or bool(find_scene_files(path))
    return not posed and has_images(_photo_folder(path), {*IMAGE_SUFFIXES, *CONVERTERS})


def find_photos(path: Path) -> list[PhotoFile]:
    """Return the photos in a folder and its subfolders, sorted by name, with their masks.

    If a folder of _PHOTO_FOLDERS inside it has photos, only those are returned. Masks are in the folder `masks`, or
    beside the photos.
    Hidden files and folders are ignored. Scenes, models and renders below the folder are left out (`left_out_below`).

    Raises
    ------
    InputError : the folder does not exist, has no photo of a supported format, or is a folder of scenes.
    """
    files = _files_by_name(path)
    in_folder = mask_files(path / MASK_FOLDER, files)
    warn_of_unused(path / MASK_FOLDER, files, in_folder)
    masks = masks_beside(files) | in_folder
    return [
        PhotoFile(scene_name, file, masks.get(name))
        for (name, file), scene_name in zip(files.items(), _scene_names(list(files)), strict=True)
    ]


def _files_by_name(path: Path) -> dict[str, Path]:
    """Return the photos of `find_photos` by their names in the folder, sorted. Errors are those of `find_photos`."""
    if not path.is_dir():
        known = ", ".join(sorted(VIDEO_SUFFIXES))
        kind = "is a file" if path.is_file() else "no such folder"
        raise InputError(f"{path}: {kind}; give a folder of photos, or a video file ({known})")
    home = _photo_folder(path)
    listing = list_images(home, IMAGE_SUFFIXES)
    names = listing.names
    if listing.scenes and listing.in_subfolders:
        raise InputError(f"{home}: {describe_scenes(home, listing.scenes)}")
    if not names:
        if (hint := scene_hint(path)) is not None:
            raise InputError(hint)
        unsupported = _count_unsupported(home)
        suffixes = ", ".join(sorted(IMAGE_SUFFIXES))
        remedy = unsupported or f"looked for {suffixes}"
        raise InputError(f"{home}: no photos in this folder or below; {remedy}")
    for name in names:
        if not name.isprintable():  # a model's files cannot store line ends and names that are not UTF-8
            raise InputError(f"{home}: the name {name!a} cannot be written into a model; rename the photo")
    return {name: home / name for name in names}


def left_out_below(path: Path) -> str:
    """Return a text that names the scenes, models and renders below a folder of photos, or an empty text."""
    listing = list_images(_photo_folder(path), IMAGE_SUFFIXES) if path.is_dir() else Listing(())
    folders = [*listing.outputs, *listing.scenes]
    return ", ".join(folders[:5]) + (", ..." if len(folders) > 5 else "")


def unsupported_photos(path: Path) -> str:
    """Return the number and kinds of a folder's unsupported photos and how to convert them, or an empty text."""
    return _count_unsupported(_photo_folder(path)) if path.is_dir() else ""


def fingerprint(path: Path) -> str:
    """Return a hex digest of the names and contents of a video, or of photos and masks (see `file_digest`).

    Raises
    ------
    InputError : as `find_photos`.
    """
    if is_video(path):
        return file_digest(path)
    photos = _files_by_name(path)
    masks = masks_beside(photos) | mask_files(path / MASK_FOLDER, photos)
    files = [file for name, photo in photos.items() for file in (photo, masks.get(name)) if file is not None]
    digest = hashlib.sha256()
    for file in files:
        digest.update(os.fsencode(Path(os.path.relpath(file, path)).as_posix()) + f"\0{file_digest(file)}\0".encode())
    return digest.hexdigest()


def stage_photo(photo: PhotoFile, number: int, photos: Path, masks: Path) -> StagedPhoto | str:
    """Read a photo and put it upright into the working folder, and its mask into `masks` with COLMAP's name.

    Parameters
    ----------
    photo : the original photo.
    number : its number, which becomes its name.
    photos, masks : folders to write to.

    Returns
    -------
    The staged photo, or one line that says why it cannot be used.
    """
    try:
        header, pixels = read_photo_header(photo.file), read_image(photo.file, upright=True)
        ending = ".png" if photo.file.suffix.lower() == ".png" and header.plain else ".jpg"
        staged = f"{photo.place or f'{number:06}'}{ending}"
        result = StagedPhoto(photo, header, staged)
        mask = result.mask()
    except InputError as error:
        return str(error)
    if pixels.shape[2] == 4:
        opaque = pixels[:, :, 3] >= _MIN_ALPHA
        mask = opaque if mask is None else mask & opaque
    if mask is not None and not mask.any():
        return f"{photo.file}: " + (
            "every pixel is transparent" if photo.mask is None else f"its mask {photo.mask} hides every pixel"
        )
    (photos / staged).parent.mkdir(parents=True, exist_ok=True)
    if header.plain and photo.file.suffix.lower() in (*JPEG_SUFFIXES, ".png"):
        _link(photo.file, photos / staged)
    else:
        write_photo(photos / staged, pixels[:, :, :3], header.exif)
    if mask is not None:
        _write_mask(masks, staged, mask)
    return result


def complete_masks(photos: Sequence[StagedPhoto], masks: Path) -> Path | None:
    """Write white masks for photos without a mask, and return the folder; None if no photo has a mask.

    COLMAP drops photos without a mask if other photos have one.
    """
    if not any(masks.iterdir()):
        return None
    for photo in photos:
        if not (masks / f"{photo.staged}.png").exists():
            _write_mask(masks, photo.staged, np.ones((photo.header.height, photo.header.width), bool))
    return masks


def group_by_camera(photos: Sequence[StagedPhoto], mode: str) -> list[list[StagedPhoto]]:
    """Return photos grouped by shared cameras.

    Parameters
    ----------
    mode : "single", "per-image", "per-folder", or "auto". With "auto", photos of one camera have equal sizes and
        equal EXIF data (maker, model, focal length).

    Raises
    ------
    InputError : photos of one camera have different sizes.
    """
    groups: dict[object, list[StagedPhoto]] = {}
    for photo in photos:
        size = photo.header.width, photo.header.height
        folder = PurePosixPath(photo.source.name).parent
        key: object = {
            "auto": (size, photo.header.camera),
            "single": None,
            "per-image": photo.staged,
            "per-folder": folder,
        }[mode]
        group = groups.setdefault(key, [])
        first = group[0].header if group else photo.header
        if (first.width, first.height) != size:
            raise InputError(
                f"{photo.source.file}: is {size[0]}x{size[1]} px, {group[0].source.name} {first.width}x"
                f"{first.height}; photos of one camera have one size: leave out --camera-mode {mode}"
            )
        group.append(photo)
    return list(groups.values())


def _photo_folder(path: Path) -> Path:
    """Return the first folder of _PHOTO_FOLDERS inside a folder that has photos, or else the folder itself."""
    for images in (path / name for name in _PHOTO_FOLDERS):
        if images.is_dir() and has_images(images, IMAGE_SUFFIXES):
            return images
    return path


def _count_unsupported(home: Path) -> str:
    names = list_images(home, CONVERTERS.keys()).names
    if not names:
        return ""
    kinds = sorted({Path(name).suffix.lower() for name in names})
    tools = " or ".join(dict.fromkeys(CONVERTERS[kind] for kind in kinds))
    count = f"{len(names)} file{'s' if len(names) > 1 else ''} {', '.join(kinds)}"
    also = f"; or {HEIC_REMEDY}" if any(kind in HEIC_SUFFIXES for kind in kinds) else ""
    return f"{count}: convert them to JPEG, for example with {tools}{also}"


def _scene_names(names: Sequence[str]) -> list[str]:
    """Return the names in the scene: suffixes other than JPEG and PNG become .png, in a way that keeps names unique."""
    kept = {name for name in names if Path(name).suffix.lower() in (*JPEG_SUFFIXES, ".png")}
    taken, renamed = set(map(name_key, kept)), []
    for name in names:
        short = str(PurePosixPath(name).with_suffix(".png"))
        renamed.append(name if name in kept else short if name_key(short) not in taken else f"{name}.png")
        taken.add(name_key(renamed[-1]))
    return renamed


def _upright_mask(path: Path, photo: Path, header: PhotoHeader) -> Mask:
    """Return a photo's mask at the photo's upright size; raises InputError for another aspect ratio."""
    mask = read_mask(path)
    rows, columns = mask.shape
    if not same_aspect((columns, rows), (header.width, header.height)):
        raise InputError(
            f"{path}: is {columns}x{rows} px, the photo {photo.name} {header.width}x{header.height}; "
            "make the mask as large as the upright photo"
        )
    return resize_mask(mask, header.width, header.height)


def _write_mask(folder: Path, staged: str, mask: Mask) -> None:
    write_png(folder / f"{staged}.png", np.where(mask, 255, 0).astype(np.uint8))


def _link(file: Path, target: Path) -> None:
    """Make a link to a file, or a copy if the system does not allow links."""
    try:
        target.symlink_to(real_path(file))
    except OSError:
        shutil.copyfile(file, target)
