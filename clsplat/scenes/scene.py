"""Scenes for training: posed images, points, and the split into training and test views."""

from __future__ import annotations

import inspect
import os
import warnings
from collections.abc import Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from ..cameras.camera import Camera
from ..errors import InputError, check_choice
from ..files.digest import file_digest
from ..files.images import ImageU8
from ..files.masks import MASK_FOLDER, NO_MASKS, mask_files, masks_beside, warn_of_unused
from ..files.real_path import real_path
from ..splats.color import BLACK, Color
from .bars import NO_BARS, checked_bars, commonest_size
from .colmap import Points
from .colmap_folder import colmap_folder, model_suffix
from .described import read_described
from .distinct_points import without_copies
from .extent import extent_of
from .held_out import select_test_names
from .options import ALPHA_USES, ORIGIN, TEST_EVERY
from .origin import near_origin, size_of
from .photo_size import check_memory, check_resolution
from .pose_checks import (
    check_lenses,
    check_poses,
    warn_of_lone_cameras,
    without_far_points,
    without_unseen_points,
)
from .posed_images import PosedImages, check_left_out, read_colmap, warn_of_left_out
from .read_view import PhotoReader, read_views
from .rims import rim_of
from .scene_files import SCENE_ENDINGS, described_by
from .turned_photos import with_upright_photos
from .view import View
from .without_data import bars_of, use_of_alpha
from .wrong_folder import describe_file, of_other_program, scene_hint

__all__ = ["Points", "Scene", "View", "load_scene"]


@dataclass(frozen=True, eq=False)
class Scene:
    """Images with cameras, and a point cloud from structure from motion.

    Parameters
    ----------
    name : name of the scene's folder.
    path : the scene's folder, or the file of its cameras.
    views : all views, sorted by name.
    points : point cloud, may be empty.
    test_names : names of the views held out for evaluation, with those left out.
    background : colour 0..1 under photos with transparency.
    reading : arguments of `load_scene` that a run records to read the scene again; None stands for a default.
    left_out : reason why a photo with a pose is not among the views, by name.
    photo_digests : digest of each photo's file and its mask's file (`file_digest`) by name; empty without files.
    photo_files : files of the photos and their masks.
    validation_names : names of the views held out to choose between models; they are no training views.
    origin : the point of the files' coordinates that is the origin of cameras and points (`load_scene`).
    points_fit : whether a run has found that the points fit the photos (training/point_fit.py), or has left them out.
    """

    name: str
    path: Path
    views: list[View]
    points: Points
    test_names: frozenset[str] = frozenset()
    background: Color = BLACK
    reading: Mapping[str, Any] = field(default_factory=dict)
    left_out: Mapping[str, str] = field(default_factory=dict)
    photo_digests: Mapping[str, str] = field(default_factory=dict)
    photo_files: Sequence[Path] = ()
    validation_names: frozenset[str] = frozenset()
    origin: tuple[float, float, float] = ORIGIN
    points_fit: bool = False

    @property
    def cameras(self) -> list[Camera]:
        """Cameras of all views."""
        return [view.camera for view in self.views]

    @property
    def images(self) -> list[ImageU8]:
        """Images of all views, each (H, W, 3) uint8; photos that are not in memory are decoded."""
        return [view.image for view in self.views]

    @property
    def names(self) -> list[str]:
        """Names of all views."""
        return [view.name for view in self.views]

    @cached_property
    def train(self) -> list[View]:
        """Training views."""
        held_out = self.test_names | self.validation_names
        return [view for view in self.views if view.name not in held_out]

    @cached_property
    def test(self) -> list[View]:
        """Test views, held out for evaluation."""
        return [view for view in self.views if view.name in self.test_names]

    @cached_property
    def validation(self) -> list[View]:
        """Validation views, held out to choose between models."""
        return [view for view in self.views if view.name in self.validation_names]

    @cached_property
    def extent(self) -> float:
        """Size of the scene [world units], by which learning rates of positions are scaled (extent.py)."""
        return extent_of([view.camera for view in self.train], self.points.xyz)


def load_scene(
    path: str | os.PathLike[str],
    images: str | None = None,
    resolution: int = -1,
    test_every: int = TEST_EVERY,
    test_list: str | os.PathLike[str] | None = None,
    eval: bool = True,
    background: Color = BLACK,
    masks: str | None = None,
    alpha: str | None = None,
    read_photos: bool = True,
    only: Collection[str] | None = None,
    origin: Sequence[float] | None = None,
    bars: Sequence[float] | None = None,
    rim: bool | None = None,
) -> Scene:
    """Read a scene: a folder with photos and their cameras.

    The cameras are a COLMAP model in `sparse`, transforms.json, an OPF project (.opf), or the XML file of Metashape. A
    folder with several of them is read as the first in this order.

    Parameters
    ----------
    path : the scene's folder, or the file of its cameras.
    images : folder of the photos inside the scene, by default "images", or the folder that the file names. If its
        photos are reduced (images_4), the cameras are scaled.
    resolution : 3DGS's -r. The values 1, 2, 4 and 8 divide the size; -1 keeps the size but reduces images wider than
        1600 px to that width; another number, at least 24, is the width [px].
    test_every : every n-th name of the sorted names, from the first on, is a test view. Names of photos that are left
        out count, so a missing photo moves no other photo between training and test views. If the scene's files hold
        views out (transforms_test.json, nerfstudio's lists), those are the test views instead.
    test_list : text file with the names of the test views, one per line; replaces `test_every`.
    eval : whether to hold out test views; if False, all views are training views.
    background : colour 0..1 under transparent pixels.
    masks : folder of masks inside the scene (see files/masks.py), or "none" for no masks. By default "masks" if it
        exists, the masks named in transforms.json, and masks beside photos. "none" keeps bars and rims, too.
    alpha : use of a photo's transparency. "background" composites the photo over the background, "mask" masks out
        pixels that are less than half opaque, and "ignore" takes all as opaque. By default the photos and points
        decide: see `use_of_alpha` in without_data.py.
    read_photos : whether to decode the training photos now and keep them. Photos of test views, or all of them, are
        decoded at each use instead (`View.loaded`).
    only : names of the photos to read, for a part of a large scene. The files of the others are not opened, except for
        their sizes. Test views are chosen among all photos.
    origin : the point of the files' coordinates that becomes the origin, (3,). By default, a scene that is too far from
        the origin for float32 gets a round point inside it, and other scenes are not moved.
    bars : parts of the height and width, 0 to 1, at the top, right, bottom and left that are masked out, (4,). They are
        those of photos of the commonest size. By default, bars of one colour that all photos have are masked out if
        points lie there.
    rim : whether a rim of one colour around all photos of the commonest size is masked out, as that of a fisheye lens.
        By default it is if points lie there, and neither `bars` are named nor others found.

    Warns
    -----
    UserWarning : the model registers fewer than 80 % of the photos in the folder. Photos that are missing, unreadable
        or hidden by their masks are left out. Rotations, poses or lenses look wrong (`check_poses`). The scene is
        moved, and `origin` is None. `test_every` has no effect. No test view can be used. A camera is far from all
        others. The photos show none of the points, which are left out then. Test photos are among the training photos.

    Raises
    ------
    InputError : a folder is missing, a model or mask is damaged, sizes do not fit, or an option has a bad value.
        Fewer than a quarter of the photos can be used, no training view is left, or memory is too small.
    """
    root = Path(path)
    if alpha is not None:
        check_choice("alpha", alpha, ALPHA_USES)
    check_resolution(resolution)
    posed = read_posed_images(root, images, origin)
    check_lenses(root, posed)
    test_names = select_test_names(posed, test_every, test_list) if eval else frozenset()
    mask_of = find_masks(root, posed, masks)
    photos = [photo for photo in posed.photos if only is None or photo.name in only]
    decoded = [read_photos and photo.name not in test_names for photo in photos]
    sizes = [posed.sizes[photo.name] for photo, now in zip(photos, decoded, strict=True) if now]
    check_memory(root, sizes, resolution)
    known: Mapping[str, View] = {}
    if alpha is None:
        kept = {photo.name for photo, now in zip(photos, decoded, strict=True) if now} - mask_of.keys()
        alpha, known = use_of_alpha(root, posed, resolution, background, kept)
    if masks == NO_MASKS:
        bars, rim = NO_BARS, False
    looks_for_rim = bars is None if rim is None else rim
    bars = bars_of(root, posed, mask_of) if bars is None else checked_bars(bars)
    found = rim_of(root, posed, mask_of, known=bool(rim)) if looks_for_rim and bars == NO_BARS else None
    usual_size = commonest_size(posed.sizes)
    readers = [
        PhotoReader.of(
            posed,
            photo,
            resolution,
            background,
            mask_of.get(photo.name),
            alpha,
            *((bars, found) if posed.sizes[photo.name] == usual_size else (NO_BARS, None)),
        )
        for photo in photos
    ]
    results = read_views(readers, decoded, known)
    names = [result.name for result in results if isinstance(result, View)]
    with ThreadPoolExecutor() as pool:
        digests = list(pool.map(lambda name: file_digest(*_files_of(name, posed, mask_of)), names))
    views = [view for view in results if isinstance(view, View)]
    unusable = {photo.name: view for photo, view in zip(photos, results, strict=True) if isinstance(view, str)}
    left_out, n = dict(sorted((posed.left_out | unusable).items())), len(posed.listed)
    check_left_out(root, posed, left_out)
    warn_of_left_out(root, left_out, n)
    digest_of = dict(zip(names, digests, strict=True))
    points = posed.points if only is not None else _points_of_whole(root, views, posed.points, test_names, digest_of)
    folder = real_path(root)
    return Scene(
        (folder.parent if root.is_file() else folder).name,
        root,
        views,
        points,
        test_names,
        background,
        _reading(
            images=images,
            resolution=resolution,
            masks=masks,
            alpha=alpha,
            test_every=test_every,
            test_list=None if test_list is None else str(real_path(test_list)),
            eval=eval,
            origin=list(posed.origin) if any(posed.origin) else None,
            bars=list(bars),
            rim=found is not None,
        ),
        left_out,
        digest_of,
        [file for name in names for file in _files_of(name, posed, mask_of)],
        origin=posed.origin,
    )


def _points_of_whole(
    root: Path, views: Sequence[View], points: Points, test_names: Collection[str], digests: Mapping[str, str]
) -> Points:
    """Check the views of a whole scene, and return its points, without them if no photo shows any.

    Parameters
    ----------
    views : all views that can be used.
    digests : of the files of each view, by name.

    Raises
    ------
    InputError : no training view is left.
    """
    names = [view.name for view in views]
    if all(name in test_names for name in names):
        raise InputError(
            f"{root}: no training view is left: all {len(views)} photos that can be used are test views; "
            "add photos, or turn eval off"
        )
    if test_names and set(test_names).isdisjoint(names):
        warnings.warn(
            f"{root}: none of its {len(test_names)} test views can be used, so nothing will be measured; change "
            "test_every, or name test views",
            stacklevel=3,
        )
    cameras = [view.camera for view in views]
    points = without_unseen_points(root, points, cameras)
    warn_of_lone_cameras(root, names, cameras)
    _warn_of_copies(root, digests, test_names)
    return points


def _warn_of_copies(root: Path, digests: Mapping[str, str], test_names: Collection[str]) -> None:
    """Warn if training photos are copies of test photos: the metrics would be those of training. digests : by name."""
    trained = {digest: name for name, digest in digests.items() if name not in test_names}
    copies = [(name, trained[digests[name]]) for name in digests if name in test_names and digests[name] in trained]
    if copies:
        name, copy = copies[0]
        warnings.warn(
            f"{root}: {len(copies)} of {len(test_names)} test photos are training photos, too, for example {name!r} "
            f"and {copy!r}: remove the copies, or their metrics are too good",
            stacklevel=4,
        )


def _files_of(name: str, posed: PosedImages, mask_of: Mapping[str, Path]) -> list[Path]:
    """Return the file of a photo, and the file of its mask if it has one."""
    return [posed.files[name], *([mask_of[name]] if name in mask_of else [])]


def _reading(*, eval: bool, **arguments: Any) -> dict[str, Any]:
    """Return a record of `load_scene`'s arguments: None for defaults. `eval`, `alpha`, `bars`, `rim` have values."""
    parameters = inspect.signature(load_scene).parameters
    record = {name: None if value == parameters[name].default else value for name, value in arguments.items()}
    return record | {"eval": bool(eval), "alpha": arguments["alpha"]}


def find_masks(root: Path, posed: PosedImages, folder: str | None) -> dict[str, Path]:
    """Return the mask files of a scene by photo name.

    Parameters
    ----------
    folder : folder of masks inside the scene, NO_MASKS, or None for the default folder and masks beside the photos.

    Raises
    ------
    InputError : the named folder is missing or contains no mask of any photo.
    """
    if folder == NO_MASKS:
        return {}
    path = (root.parent if root.is_file() else root) / (folder or MASK_FOLDER)
    if folder is not None and not path.is_dir():
        raise InputError(f"{path}: no such folder of masks; name another, or {NO_MASKS!r} for no masks")
    files = {name: posed.files[name] for name in posed.names}
    masks = mask_files(path, files)
    if folder is not None and posed.names and not masks:
        raise InputError(f"{path}: no mask of any photo in it; a mask of {posed.names[0]!r} is {posed.names[0]}.png")
    if not posed.masks:
        warn_of_unused(path, files, masks)
    named = {name: find() for name, find in posed.masks.items() if name not in masks}
    return (masks_beside(files) if folder is None else {}) | named | masks


def read_posed_images(root: Path, images: str | None, origin: Sequence[float] | None = None) -> PosedImages:
    """Read a scene's photos with poses, without decoding them; parameters and errors as `load_scene`."""
    if root.is_file() and (root.suffix.lower() not in SCENE_ENDINGS or of_other_program(root)):
        raise InputError(f"{root}: {describe_file(root)}")
    if files := described_by(root):
        posed = read_described(files, images)
    elif root.is_dir() and _needs_hint(root, images) and (hint := scene_hint(root)) is not None:
        raise InputError(hint)
    else:
        posed = read_colmap(root, images)
    check_left_out(root, posed, posed.left_out)
    size = size_of(posed)
    posed = with_upright_photos(near_origin(root, posed, size, origin))
    check_poses(root, posed, size)
    return replace(posed, points=without_copies(root, without_far_points(root, posed.points)))


def _needs_hint(root: Path, images: str | None) -> bool:
    """Return whether a folder cannot be read as a scene. A model alone is one if its folder of photos is named."""
    return colmap_folder(root) is None and not (images is not None and model_suffix(root))
