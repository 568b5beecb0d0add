"""A scene as another process reads it: from the same files, which must have the same content."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..errors import InputError
from ..files.real_path import real_path
from ..splats.color import Color
from .colmap import NO_POINTS
from .options import READING_OPTIONS
from .scene import Scene, load_scene


@dataclass(frozen=True)
class SceneSource:
    """Where a scene was read, and what must be found there. It can be pickled, and has no pixels.

    Attributes
    ----------
    name, path, background, test_names, validation_names : as of `Scene`; the path is absolute.
    reading : arguments of `load_scene`.
    names : names of all views.
    photo_digests : as of `Scene`.
    points_digest : digest of the points; None without points, which may be in the files but do not fit the poses.
    points_fit : as of `Scene`. The program that asks has looked at the photos, so that no other program has to.
    """

    name: str
    path: str
    background: Color
    reading: Mapping[str, Any]
    names: tuple[str, ...]
    test_names: frozenset[str]
    validation_names: frozenset[str]
    photo_digests: Mapping[str, str]
    points_digest: str | None
    points_fit: bool

    @classmethod
    def of(cls, scene: Scene) -> SceneSource:
        """Return the source of a scene that `load_scene` has read."""
        reading = {key: scene.reading[key] for key in READING_OPTIONS if scene.reading.get(key) is not None}
        return cls(
            scene.name,
            str(real_path(scene.path)),
            scene.background,
            {**reading, "eval": bool(scene.test_names)},
            tuple(scene.names),
            scene.test_names,
            scene.validation_names,
            dict(scene.photo_digests),
            _points_digest(scene),
            scene.points_fit,
        )

    def load(self, read_photos: bool = True) -> Scene:
        """Read the scene again. read_photos : as of `load_scene`.

        Raises
        ------
        InputError : the files are missing, or they are not those that the scene was read from.
        """
        loaded = load_scene(
            self.path,
            background=self.background,
            only=frozenset(self.names),
            read_photos=read_photos,
            **self.reading,
        )
        views = {view.name: view for view in loaded.views}
        if missing := [name for name in self.names if name not in views]:
            raise InputError(f"{self.path}: the photo {missing[0]} is missing here: copy the scene's files again")
        changed = [name for name in self.names if loaded.photo_digests.get(name) != self.photo_digests.get(name)]
        if changed:
            raise InputError(f"{self.path}: the photo {changed[0]} is another one here: copy the scene's files again")
        if self.points_digest is None:
            loaded = replace(loaded, points=NO_POINTS)
        elif _points_digest(loaded) != self.points_digest:
            raise InputError(
                f"{self.path}: the points are others here than in the program that asks: copy the scene's files again, "
                "and do not change a scene between reading and training"
            )
        return self.part_of(replace(loaded, points_fit=self.points_fit))

    def of_views(self, names: Sequence[str]) -> SceneSource:
        """Return the source of a scene with some of the views, all for training."""
        digests = {name: self.photo_digests[name] for name in names if name in self.photo_digests}
        nothing: frozenset[str] = frozenset()
        return replace(
            self, names=tuple(sorted(names)), test_names=nothing, validation_names=nothing, photo_digests=digests
        )

    def part_of(self, scene: Scene) -> Scene:
        """Return this scene as a part of one from the same files."""
        views = {view.name: view for view in scene.views}
        return replace(
            scene,
            name=self.name,
            views=[views[name] for name in self.names],
            test_names=self.test_names,
            validation_names=self.validation_names,
        )


def _points_digest(scene: Scene) -> str | None:
    if not len(scene.points):
        return None
    result = hashlib.sha256(np.ascontiguousarray(scene.points.xyz).data)
    result.update(np.ascontiguousarray(scene.points.rgb).data)
    return result.hexdigest()
