"""How the scenes of a set are found in a folder and read, and where that differs from the published protocol."""

from __future__ import annotations

import os
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from ..errors import InputError, Remedy
from ..files.masks import NO_MASKS
from ..scenes.few_photos import few_photos
from ..scenes.held_out import select_test_names
from ..scenes.options import TEST_EVERY
from ..scenes.photo_size import target_size
from ..scenes.scene import Scene, load_scene, read_posed_images
from ..scenes.transforms_files import TEST, TRAIN
from ..splats.color import Color
from .sets import BLENDER, BenchmarkSet, SetScene

_SAME_SIZE = 2  # largest difference of two sizes that count as equal [px]: programs round differently


@dataclass(frozen=True)
class BenchmarkScene:
    """A scene of a set in a folder, and how it is read.

    Attributes
    ----------
    scene : the scene as the set defines it.
    path : its folder.
    images : folder of photos inside it; None for scenes of transforms files.
    resolution : as for `load_scene`.
    identity : name, size of the first photo and numbers of views: what identifies the scene in runs.jsonl.
    differences : how this differs from the published protocol, in a few words each.
    photos : training views that are used; None for all.
    """

    scene: SetScene
    path: Path
    images: str | None
    resolution: int
    identity: Mapping[str, Any]
    differences: Sequence[str]
    photos: int | None = None

    def load(self, background: Color) -> Scene:
        """Return the scene with its test views. Errors and warnings are those of `load_scene` and `few_photos`."""
        return with_photos(self.load_all(background), self.photos)

    def load_all(self, background: Color) -> Scene:
        """Return the scene with all of its training views."""
        loaded = load_scene(
            _source(self.path, self.images),
            self.images,
            self.resolution,
            TEST_EVERY,
            background=background,
            masks=NO_MASKS,  # the protocols measure all pixels, even if there is a folder of masks
        )
        return replace(loaded, name=self.scene.name)


def with_photos(scene: Scene, photos: int | None) -> Scene:
    """Return a scene with this number of training views; None for all."""
    return scene if photos is None else few_photos(scene, photos)


def find_scenes(
    chosen: BenchmarkSet, folder: str | os.PathLike[str], images: str | None = None, resolution: int | None = None
) -> list[BenchmarkScene]:
    """Return the scenes of a set that a folder holds, in the order of the set. No photo is decoded.

    Parameters
    ----------
    folder : holds folders with the names of the scenes in any case, or is one of them.
    images : folder of photos inside the scenes, instead of the one of the protocol. For "images", the original photos,
        the factor of the protocol is applied here.
    resolution : as for `load_scene`; None for the size of the protocol.

    Warns
    -----
    UserWarning : a folder has the name of a scene but no poses. It is left out.

    Raises
    ------
    InputError : there is no such folder or no scene of the set in it, or a scene's photos are missing.
    """
    root = Path(folder)
    if not root.is_dir():
        raise InputError(f"{root}: no such folder: name the folder with the scenes of {chosen.title}")
    if images is not None and chosen.layout == BLENDER:
        raise InputError(f"images {images!r}: the scenes of {chosen.title} have one size of photos: leave it out")
    places = _places(chosen, root)
    posed = {name: path for name, path in places.items() if _has_poses(chosen, path)}
    for name in places.keys() - posed.keys() if posed else ():
        warnings.warn(f"{places[name]}: left out: {_lacks(chosen)}", stacklevel=2)
    if not posed:
        found = "".join(f"; {path.name} is there, but {_lacks(chosen)}" for path in places.values())
        raise InputError(
            f"{root}: no scene of {chosen.title} in it{found}: expected folders called {', '.join(chosen.scenes)}"
        )
    return [
        _scene_at(chosen, scene, posed[scene.name], images, resolution)
        for scene in chosen.scenes.values()
        if scene.name in posed
    ]


def _places(chosen: BenchmarkSet, root: Path) -> dict[str, Path]:
    """Return the folders by scene: `root` itself if it has a scene's name and poses, else the folders in it."""
    name = Path(os.path.abspath(root)).name.casefold()
    if name in chosen.scenes and _has_poses(chosen, root):
        return {name: root}
    inside = sorted(path for path in root.iterdir() if path.is_dir())
    return {path.name.casefold(): path for path in inside if path.name.casefold() in chosen.scenes}


def _has_poses(chosen: BenchmarkSet, path: Path) -> bool:
    return (path / TRAIN).is_file() if chosen.layout == BLENDER else (path / "sparse").is_dir()


def _lacks(chosen: BenchmarkSet) -> str:
    return f"it has no {TRAIN}" if chosen.layout == BLENDER else "it has no folder sparse"


def _source(path: Path, images: str | None) -> Path:
    """Return what `load_scene` reads. A transforms file is named, because a COLMAP model beside it would come first."""
    return path / TRAIN if images is None else path


def _scene_at(
    chosen: BenchmarkSet, scene: SetScene, path: Path, images: str | None, resolution: int | None
) -> BenchmarkScene:
    differences = []
    folder = images or scene.images
    if folder is None and not (path / TEST).is_file():
        raise InputError(f"{path}: no {TEST}: copy the test views of {chosen.title} there")
    if folder is not None and not (path / folder).is_dir():
        folder = next((other for other in chosen.other_images if images is None and (path / other).is_dir()), None)
        if folder is None:
            raise _missing_photos(scene, path, images or scene.images)
    if folder != scene.images:
        differences.append(f"photos of {folder}, not of {scene.images}")
    if resolution is None:
        resolution = scene.factor if folder == "images" and scene.factor > 1 else -1
        if resolution != -1:
            differences.append(f"photos reduced here by {resolution}")
    posed = read_posed_images(_source(path, folder), folder)
    test_names = select_test_names(posed, TEST_EVERY, None)
    width, height = target_size(*posed.sizes[posed.names[0]], resolution)
    identity = {
        "name": scene.name,
        "width": width,
        "height": height,
        "train": sum(name not in test_names for name in posed.names) if chosen.photos is None else chosen.photos,
        "test": sum(name in test_names for name in posed.names),
    }
    if max(abs(width - scene.size[0]), abs(height - scene.size[1])) > _SAME_SIZE:
        differences.append(f"{width}x{height} px, not {scene.size[0]}x{scene.size[1]}")
    for key, number in (("train", scene.train), ("test", scene.test)):
        if identity[key] != number:
            kind = "training" if key == "train" else "test"
            differences.append(f"{identity[key]} {kind} views, not {number}")
    return BenchmarkScene(scene, path, folder, resolution, identity, tuple(differences), chosen.photos)


def _missing_photos(scene: SetScene, path: Path, folder: str | None) -> InputError:
    remedies = [Remedy("copy the folder of the set there")]
    if scene.factor > 1 and folder == scene.images and (path / "images").is_dir():
        remedies.append(Remedy("reduce the photos of images, which is not the published protocol", "-i images"))
    return InputError(f"{path / (folder or '')}: no such folder of photos", *remedies)
