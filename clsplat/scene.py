"""A scene to learn: posed images, points, and the split into training and test views."""

from __future__ import annotations

import os
import warnings
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from .camera import Camera
from .cameras_json import IMAGE_SUFFIXES
from .colmap import Photo, Points, find_model, read_model
from .errors import InputError
from .images import ImageU8, read_image, resize_area

MAX_WIDTH = 1600                # 3DGS: with resolution -1, wider images are reduced to this [px]
_EXTENT_MARGIN = 1.1            # 3DGS: extent over the farthest camera's distance from their mean
_FEW_REGISTERED = 0.8

__all__ = ["MAX_WIDTH", "Points", "Scene", "View", "load_scene"]


@dataclass(frozen=True, eq=False)
class View:
    """One posed image.

    Parameters
    ----------
    name : of the image file, as the model has it.
    camera : pinhole, of the image's size.
    image : (H, W, 3) uint8.
    """

    name: str
    camera: Camera
    image: ImageU8


@dataclass(frozen=True, eq=False)
class Scene:
    """Posed images with a structure-from-motion point cloud.

    Parameters
    ----------
    name : of the scene's folder.
    path : the scene's folder.
    views : sorted by name.
    points : may be empty.
    test_names : names of the views held out for evaluation.
    """

    name: str
    path: Path
    views: list[View]
    points: Points
    test_names: frozenset[str] = frozenset()

    @property
    def cameras(self) -> list[Camera]:
        """Cameras of all views."""
        return [view.camera for view in self.views]

    @property
    def images(self) -> list[ImageU8]:
        """Images of all views, each (H, W, 3) uint8."""
        return [view.image for view in self.views]

    @property
    def names(self) -> list[str]:
        """Names of all views."""
        return [view.name for view in self.views]

    @cached_property
    def train(self) -> list[View]:
        """Views to learn from."""
        return [view for view in self.views if view.name not in self.test_names]

    @cached_property
    def test(self) -> list[View]:
        """Views held out for evaluation."""
        return [view for view in self.views if view.name in self.test_names]

    @cached_property
    def extent(self) -> float:
        """Size of the scene: 1.1 times the training cameras' largest distance from their mean [world units].

        As in 3DGS, where it scales the positions' learning rate; 1 where all cameras stand in one place.
        """
        centres = np.array([view.camera.position for view in self.train])
        reach = float(np.linalg.norm(centres - centres.mean(axis=0), axis=1).max())
        return _EXTENT_MARGIN * reach if reach > 0 else 1.0


def load_scene(path: str | os.PathLike[str], images: str | None = None, resolution: int = -1,
               test_every: int = 8, test_list: str | os.PathLike[str] | None = None, eval: bool = True,
               background: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Scene:
    """Read a scene: a folder with photos and a COLMAP model in `sparse`.

    Parameters
    ----------
    path : the scene's folder.
    images : folder of the photos inside it; "images" by default. Reduced photos (images_4) scale the cameras.
    resolution : 3DGS's -r: 1, 2, 4, 8 divide the size, another number is the width wanted [px]; -1 keeps the
        size but reduces images wider than 1600 px to that.
    test_every : of the sorted names, each of this many is a test view, from the first on.
    test_list : file with the names of the test views, one a line, instead of `test_every`.
    eval : False: no test view, learn from all.
    background : colour 0..1 under transparent pixels.

    Warns
    -----
    UserWarning : the model registers fewer than 80 % of the photos in the folder.

    Raises
    ------
    InputError : a missing folder or photo, a damaged model or photo, sizes that do not fit, a bad option.
    """
    root = Path(path)
    if resolution < 1 and resolution != -1:
        raise InputError(f"resolution {resolution}: use 1, 2, 4, 8, a width in pixels, or -1")
    model = read_model(find_model(root))
    folder = _photo_folder(root, images or "images")
    files = _photo_files(folder, [photo.name for photo in model.photos])
    _warn_of_unregistered(folder, len(files))
    names = [photo.name for photo in model.photos]
    test_names = _test_names(names, test_every, test_list) if eval else frozenset()

    def view(photo: Photo) -> View:
        return _view(photo, files[photo.name], resolution, background)

    with ThreadPoolExecutor() as pool:          # decoding and resizing run outside the interpreter lock
        views = list(pool.map(view, model.photos))
    return Scene(root.resolve().name, root, views, model.points, test_names)


def _photo_folder(root: Path, images: str) -> Path:
    folder = root / images
    if not folder.is_dir():
        others = ", ".join(sorted(other.name for other in root.glob("images*") if other.is_dir()))
        raise InputError(f"{folder}: no such folder of photos; " + (f"choose one of: {others}" if others else
                         "put the photos there, or name their folder"))
    return folder


def _photo_files(folder: Path, names: list[str]) -> dict[str, Path]:
    files = {name: folder / name for name in names}
    missing = [name for name, file in files.items() if not file.is_file()]
    if missing:
        some = ", ".join(missing[:3]) + (", ..." if len(missing) > 3 else "")
        raise InputError(f"{folder}: {len(missing)} of the model's {len(names)} images are missing: {some}; "
                         "copy them there, or name another folder of photos")
    return files


def _warn_of_unregistered(folder: Path, registered: int) -> None:
    photos = sum(1 for file in folder.rglob("*") if file.suffix.lower() in IMAGE_SUFFIXES)
    if registered < _FEW_REGISTERED * photos:
        warnings.warn(f"{folder}: the model registers only {registered} of {photos} photos; parts of the "
                      "scene may be missing. More overlap between photos helps.", stacklevel=3)


def _test_names(names: list[str], test_every: int,
                test_list: str | os.PathLike[str] | None) -> frozenset[str]:
    if test_list is None:
        if test_every < 2:
            raise InputError(f"test_every {test_every}: must be at least 2; "
                             "to learn from all views, turn eval off")
        chosen = names[::test_every]
    else:
        chosen = _read_names(Path(test_list))
        unknown = [name for name in chosen if name not in set(names)]
        if unknown:
            raise InputError(f"{test_list}: no view is named {unknown[0]!r} ({len(unknown)} unknown in all); "
                             f"names look like {names[0]!r}")
    if len(set(chosen)) == len(names):
        raise InputError(f"no training view is left: all {len(names)} views are test views; "
                         "choose fewer, or turn eval off")
    return frozenset(chosen)


def _read_names(path: Path) -> list[str]:
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path}: cannot be read as a list of names ({type(error).__name__}); "
                         "give a text file with one image name a line") from None
    return [line.strip() for line in lines if line.strip()]


def _view(photo: Photo, file: Path, resolution: int, background: tuple[float, float, float]) -> View:
    image, camera = photo.fit(_opaque(read_image(file), background))
    width, height = _target_size(camera.width, camera.height, resolution)
    if (width, height) != (camera.width, camera.height):
        image, camera = resize_area(image, width, height), camera.resized(width, height)
    return View(photo.name, camera, image)


def _opaque(image: ImageU8, background: tuple[float, float, float]) -> ImageU8:
    """(H, W, 3 or 4) with straight alpha, composited over the background."""
    if image.shape[2] == 3:
        return image
    alpha = image[:, :, 3:].astype(np.float32) / 255.0
    under = 255.0 * np.clip(np.asarray(background, np.float32), 0.0, 1.0)
    blended = alpha * image[:, :, :3].astype(np.float32) + (1.0 - alpha) * under
    opaque: ImageU8 = np.rint(blended).astype(np.uint8)
    return opaque


def _target_size(width: int, height: int, resolution: int) -> tuple[int, int]:
    """3DGS's rule: divisors round, widths truncate."""
    if resolution in (1, 2, 4, 8):
        return max(1, round(width / resolution)), max(1, round(height / resolution))
    if resolution == -1 and width <= MAX_WIDTH:
        return width, height
    target = MAX_WIDTH if resolution == -1 else resolution
    return target, max(1, int(height * target / width))
