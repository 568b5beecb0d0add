"""A scene to learn: posed images, points, and the split into training and test views."""

from __future__ import annotations

import inspect
import os
import warnings
from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from ..cameras.camera import Camera
from ..errors import InputError
from ..files.images import ImageU8, read_image, resize_area
from ..files.masks import MASK_FOLDER, NO_MASKS, Mask, mask_files, read_mask, resize_mask
from ..splats.color import BLACK, Color
from .colmap import Points
from .nerfstudio import find_transforms, read_transforms
from .options import ALPHA_USES
from .posed_images import PosedImages, read_colmap
from .undistort import RegisteredImage

MAX_WIDTH = 1600  # 3DGS: with resolution -1, wider images are reduced to this [px]
_EXTENT_MARGIN = 1.1  # 3DGS: extent over the farthest camera's distance from their mean

__all__ = ["MAX_WIDTH", "Points", "Scene", "View", "load_scene"]


@dataclass(frozen=True, eq=False)
class View:
    """One posed image.

    Parameters
    ----------
    name : of the image file, as the model has it.
    camera : pinhole, of the image's size.
    image : (H, W, 3) uint8; a photo with transparency lies over the scene's background.
    mask : (H, W), True where a pixel counts; None where all do.
    alpha : (H, W) uint8, opacity of a photo with transparency; None for others.
    """

    name: str
    camera: Camera
    image: ImageU8
    mask: Mask | None = None
    alpha: ImageU8 | None = None

    def resized(self, width: int, height: int) -> View:
        """The view at another size [px]."""
        if (width, height) == (self.camera.width, self.camera.height):
            return self
        return View(
            self.name,
            self.camera.resized(width, height),
            resize_area(self.image, width, height),
            None if self.mask is None else resize_mask(self.mask, width, height),
            None if self.alpha is None else resize_area(self.alpha, width, height),
        )


@dataclass(frozen=True, eq=False)
class Scene:
    """Posed images with a structure-from-motion point cloud.

    Parameters
    ----------
    name : of the scene's folder.
    path : the scene's folder, or its transforms file.
    views : sorted by name.
    points : may be empty.
    test_names : names of the views held out for evaluation.
    background : colour 0..1 that photos with transparency lie over.
    reading : arguments of `load_scene` that read the scene, which a run records; None stands for a default.
    """

    name: str
    path: Path
    views: list[View]
    points: Points
    test_names: frozenset[str] = frozenset()
    background: Color = BLACK
    reading: Mapping[str, Any] = field(default_factory=dict)

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


def load_scene(
    path: str | os.PathLike[str],
    images: str | None = None,
    resolution: int = -1,
    test_every: int = 8,
    test_list: str | os.PathLike[str] | None = None,
    eval: bool = True,
    background: Color = BLACK,
    masks: str | None = None,
    alpha: str = ALPHA_USES[0],
) -> Scene:
    """Read a scene: a folder with photos and a COLMAP model in `sparse`, or with transforms.json.

    Parameters
    ----------
    path : the scene's folder, or one of its transforms files. A folder with both is read as COLMAP's.
    images : folder of the photos inside it; "images" by default, or what transforms.json says. Reduced photos
        (images_4) scale the cameras.
    resolution : 3DGS's -r: 1, 2, 4, 8 divide the size, another number is the width wanted [px]; -1 keeps the
        size but reduces images wider than 1600 px to that.
    test_every : of the sorted names, each of this many is a test view, from the first on; where the scene's files
        hold views out themselves (transforms_test.json, nerfstudio's lists), these are the test views instead.
    test_list : file with the names of the test views, one a line, instead of `test_every`.
    eval : False: no test view, learn from all.
    background : colour 0..1 under transparent pixels.
    masks : folder inside the scene of masks (masks.py); by default "masks" where there is one, or what
        transforms.json says; "none" for no masks.
    alpha : what the transparency of a photo is: "background", which its colours are laid over, or "mask", which hides
        pixels less than half opaque.

    Warns
    -----
    UserWarning : the model registers fewer than 80 % of the photos in the folder, photos are not there or cannot be
        read, or masks hide all of a photo; those are left out.

    Raises
    ------
    InputError : a missing folder or photo, a damaged model or mask, no readable photo, sizes that do not fit, a bad
        option.
    """
    root = Path(path)
    if alpha not in ALPHA_USES:
        raise InputError(f"alpha {alpha!r}: choose one of {', '.join(ALPHA_USES)}")
    if resolution < 1 and resolution != -1:
        raise InputError(f"resolution {resolution}: use 1, 2, 4, 8, a width in pixels, or -1")
    posed = read_posed_images(root, images)
    test_names = select_test_names(posed, test_every, test_list) if eval else frozenset()

    hiding = find_masks(root, posed, masks)

    def view(photo: RegisteredImage) -> View | str:
        return _view(photo, posed.files[photo.name], resolution, background, hiding.get(photo.name), alpha == "mask")

    with ThreadPoolExecutor() as pool:  # decoding and resizing run outside the interpreter lock
        found = list(pool.map(view, posed.photos))
    views = [view for view in found if isinstance(view, View)]
    _warn_of_left_out(root, [reason for reason in found if isinstance(reason, str)], len(found))
    folder = root.resolve()
    return Scene(
        (folder.parent if root.is_file() else folder).name,
        root,
        views,
        posed.points,
        test_names & {view.name for view in views},
        background,
        _reading(
            images=images,
            resolution=resolution,
            masks=masks,
            alpha=alpha,
            test_every=test_every,
            test_list=None if test_list is None else str(Path(test_list).resolve()),
            eval=eval,
        ),
    )


def _reading(*, eval: bool, **arguments: Any) -> dict[str, Any]:
    """A record of `load_scene`'s arguments: None for those that have their defaults, and always `eval`."""
    parameters = inspect.signature(load_scene).parameters
    record = {name: None if value == parameters[name].default else value for name, value in arguments.items()}
    return record | {"eval": bool(eval)}


def find_masks(root: Path, posed: PosedImages, folder: str | None) -> dict[str, Path]:
    """Files of masks, by the names of their photos."""
    if folder == NO_MASKS:
        return {}
    named = (root.parent if root.is_file() else root) / (folder or MASK_FOLDER)
    if folder is not None and not named.is_dir():
        raise InputError(f"{named}: no such folder of masks; name another, or {NO_MASKS!r} for no masks")
    found = mask_files(named, posed.names)
    if folder is not None and not found:
        raise InputError(f"{named}: no mask of any photo in it; a mask of {posed.names[0]!r} is {posed.names[0]}.png")
    return posed.masks | found


def _warn_of_left_out(root: Path, reasons: list[str], n: int) -> None:
    if len(reasons) == n:
        raise InputError(f"{root}: none of its {n} photos can be used: {reasons[0]}")
    if reasons:
        warnings.warn(
            f"{root}: {len(reasons)} of {n} photos are left out: {'; '.join(reasons[:3])}"
            + ("; ..." if len(reasons) > 3 else ""),
            stacklevel=3,
        )


def read_posed_images(root: Path, images: str | None) -> PosedImages:
    transforms = find_transforms(root)
    if transforms and not (root / "sparse").is_dir():
        return read_transforms(transforms, images)
    return read_colmap(root, images)


def select_test_names(posed: PosedImages, test_every: int, test_list: str | os.PathLike[str] | None) -> frozenset[str]:
    names = posed.names
    if test_list is None and posed.test_names is not None:
        chosen = sorted(posed.test_names)
    elif test_list is None:
        if test_every < 2:
            raise InputError(f"test_every {test_every}: must be at least 2; to learn from all views, turn eval off")
        chosen = names[::test_every]
    else:
        chosen = _read_names(Path(test_list))
        unknown = [name for name in chosen if name not in set(names)]
        if unknown:
            raise InputError(
                f"{test_list}: no view is named {unknown[0]!r} ({len(unknown)} unknown in all); "
                f"names look like {names[0]!r}"
            )
    if len(set(chosen)) == len(names):
        raise InputError(
            f"no training view is left: all {len(names)} views are test views; choose fewer, or turn eval off"
        )
    return frozenset(chosen)


def _read_names(path: Path) -> list[str]:
    try:
        lines = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(
            f"{path}: cannot be read as a list of names ({type(error).__name__}); "
            "give a text file with one image name a line"
        ) from None
    return [line.strip() for line in lines if line.strip()]


def _view(
    photo: RegisteredImage,
    file: Path,
    resolution: int,
    background: Color,
    mask_file: Path | None,
    alpha_hides: bool,
) -> View | str:
    """The view, or why there is none."""
    try:
        stored = read_image(file)
    except InputError as error:
        return str(error)
    height, width = stored.shape[:2]
    counts = [] if mask_file is None else [read_mask(mask_file)]
    alpha = stored[:, :, 3] if stored.shape[2] == 4 else None
    if alpha is not None and alpha_hides:
        counts.append(alpha >= 128)
        alpha, stored = None, stored[:, :, :3]
    image, camera = photo.fit(_opaque(stored, background))
    fitted = [photo.fit_mask(each, width, height) for each in counts]
    mask = np.logical_and.reduce(fitted) if fitted else None
    alpha = None if alpha is None else photo.fit_alpha(alpha)
    view = View(photo.name, camera, image, mask, alpha)
    view = view.resized(*_target_size(camera.width, camera.height, resolution))
    if view.mask is None:
        return view
    if not view.mask.any():
        return f"{file}: its mask hides all of it"
    return replace(view, mask=None) if view.mask.all() else view


def _opaque(image: ImageU8, background: Color) -> ImageU8:
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
