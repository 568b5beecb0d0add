"""Contents of a scene, read from the headers of its files without decoding a photo."""

from __future__ import annotations

import math
import os
from collections import Counter
from collections.abc import Iterable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import InputError
from ..files.image_names import IMAGE_SUFFIXES
from ..files.json_file import read_json, to_real
from ..files.real_path import real_path
from .colmap_folder import colmap_folder
from .held_out import select_test_names
from .options import TEST_EVERY
from .photo_listing import list_images
from .pose_checks import check_lenses
from .posed_images import PosedImages
from .reconstruct.options import RECORD
from .scene import find_masks, read_posed_images
from .scene_files import SCENE_ENDINGS, described_by, find_scene_files
from .undistort import is_pinhole

_DIGITS = 6  # significant digits of a focal length; lenses that agree to these digits count as one


@dataclass(frozen=True)
class LensUse:
    """A lens and the number of its photos.

    Parameters
    ----------
    model : COLMAP's name of the lens model.
    pinhole : whether its photos need no undistortion.
    width, height : size of its photos [px].
    focal : horizontal focal length [px].
    field_of_view : horizontal field of view of a pinhole with this focal length [degrees].
    photos : number of photos.
    """

    model: str
    pinhole: bool
    width: int
    height: int
    focal: float
    field_of_view: float
    photos: int = 0


@dataclass(frozen=True)
class SceneInfo:
    """Contents of a scene.

    Parameters
    ----------
    kind : "COLMAP" or the names of the files that describe the cameras.
    photos : number of photos with poses.
    unregistered : names of photos in the same folder without a pose.
    left_out : reason why a photo with a pose is missing or cannot be read, by name. Pixels are not decoded.
    sizes : number of photos by (width, height) as stored [px], the most frequent size first.
    photo_bytes : total size of the files of the photos that can be used.
    lenses : lenses, the most used first.
    points : number of points.
    origin : the point of the files' coordinates that is the origin of the scene, as of `Scene`.
    track_mean, track_median : number of photos that see a point; 0 without points.
    test : names of the test views.
    masked : number of photos with a mask.
    placed : photos with a pose, all photos and mean reprojection error [px] of a scene that `reconstruct` made;
        None for other scenes.
    """

    kind: str
    photos: int
    unregistered: tuple[str, ...]
    left_out: dict[str, str]
    sizes: tuple[tuple[tuple[int, int], int], ...]
    photo_bytes: int
    lenses: tuple[LensUse, ...]
    points: int
    origin: tuple[float, float, float]
    track_mean: float
    track_median: float
    test: tuple[str, ...]
    masked: int
    placed: tuple[int, int, float] | None = None

    def to_json(self) -> dict[str, Any]:
        """Return plain values, as `clsplat info --json` prints them."""
        return {
            "kind": self.kind,
            "photos": self.photos,
            "unregistered": list(self.unregistered),
            "left_out": self.left_out,
            "photo_bytes": self.photo_bytes,
            "sizes": [{"width": size[0], "height": size[1], "photos": n} for size, n in self.sizes],
            "lenses": [asdict(lens) for lens in self.lenses],
            "points": self.points,
            "origin": list(self.origin),
            "track_mean": self.track_mean,
            "track_median": self.track_median,
            "test": list(self.test),
            "masked": self.masked,
            "placed": self.placed and dict(zip(("photos", "of", "error"), self.placed, strict=True)),
        }


def is_scene(path: Path) -> bool:
    """Return whether a path looks like a scene: a folder with a COLMAP model or a file of cameras, or such a file."""
    if path.is_file():
        return path.suffix.lower() in SCENE_ENDINGS
    return colmap_folder(path) is not None or bool(find_scene_files(path))


def scene_info(path: str | os.PathLike[str], images: str | None = None, test_every: int = TEST_EVERY) -> SceneInfo:
    """Return the contents of a scene; parameters as of `load_scene`.

    Raises
    ------
    InputError : a folder is missing, the model is damaged, or too few photos can be used.
    """
    root = Path(path)
    posed = read_posed_images(root, images)
    check_lenses(root, posed)
    sizes = Counter(posed.sizes.values())
    tracks = posed.points.track_length
    masks = find_masks(root, posed, None)
    held_out = select_test_names(posed, test_every, None) if len(posed.listed) > 1 else frozenset()
    described = described_by(root)
    return SceneInfo(
        " and ".join(file.name for file in described) or "COLMAP",
        len(posed.listed),
        _unregistered(root, posed, masks.values()),
        posed.left_out,
        tuple(sizes.most_common()),
        sum(posed.files[name].stat().st_size for name in posed.names),
        _lenses(posed),
        len(posed.points),
        posed.origin,
        float(tracks.mean()) if len(tracks) else 0.0,
        float(np.median(tracks)) if len(tracks) else 0.0,
        tuple(sorted(held_out - set(posed.left_out))),
        len(masks),
        _placed(root),
    )


def _unregistered(root: Path, posed: PosedImages, masks: Iterable[Path]) -> tuple[str, ...]:
    """Return photos without a pose, as paths relative to the common folder of the posed photos in the scene's folder.

    Other folders are not looked into, even if the scene has photos there.
    """
    home = Path(os.path.abspath(root.parent if root.is_file() else root))
    places = [Path(os.path.abspath(file)).parent for file in posed.files.values()]
    inside = [place for place in places if place.is_relative_to(home)]
    if not inside:
        return ()
    folder = Path(os.path.commonpath(inside))
    known = {real_path(file) for file in (*posed.files.values(), *masks)}
    names = list_images(folder, IMAGE_SUFFIXES).names
    return tuple(name for name in names if real_path(folder / name) not in known)


def _placed(root: Path) -> tuple[int, int, float] | None:
    if not (root / RECORD).is_file():
        return None
    record = read_json(root / RECORD, "a scene of clsplat reconstruct")
    values = record if isinstance(record, dict) else {}
    numbers = [to_real(values.get(key)) for key in ("registered", "photos", "error")]
    registered, photos, error = (value if value is not None and math.isfinite(value) else -1.0 for value in numbers)
    if min(registered, photos, error) < 0:
        raise InputError(f"{root / RECORD}: registered, photos and error must be numbers; remove the file")
    return int(registered), int(photos), error


def _lenses(posed: PosedImages) -> tuple[LensUse, ...]:
    uses: Counter[LensUse] = Counter()
    for photo in posed.photos:
        lens = photo.lens
        focal = float(f"{lens.params[0]:.{_DIGITS}g}")  # every supported model has it first
        angle = math.degrees(2.0 * math.atan(lens.width / (2.0 * focal)))
        uses[LensUse(lens.model.name, is_pinhole(lens), lens.width, lens.height, focal, round(angle, 1))] += 1
    return tuple(replace(lens, photos=n) for lens, n in uses.most_common())
