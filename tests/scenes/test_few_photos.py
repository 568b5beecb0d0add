"""Scenes with few of their photos: which photos and points stay."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from clsplat.errors import InputError
from clsplat.scenes.few_photos import few_photos
from clsplat.scenes.scene import Scene, load_scene


def test_photos_are_at_equal_steps_and_test_views_stay(scene: Scene) -> None:
    few = few_photos(scene, 3)
    names = [view.name for view in scene.train]
    assert [view.name for view in few.train] == [names[0], names[round((len(names) - 1) / 2)], names[-1]]
    assert [view.name for view in few.test] == [view.name for view in scene.test]
    assert len(few.views) == 3 + len(scene.test)
    assert [view.name for view in few_photos(scene, 1).train] == names[:1]
    assert [view.name for view in few_photos(scene, len(names)).train] == names


def test_points_are_those_that_two_of_the_photos_show(scene: Scene) -> None:
    few = few_photos(scene, 4)
    chosen = {view.name for view in few.train}
    model = pycolmap.Reconstruction(str(scene.path / "sparse" / "0"))
    seen: dict[int, set[str]] = {}
    for image in model.images.values():  # from the photos' side: few_photos reads the points' tracks
        for point in image.points2D:
            if point.has_point3D() and image.name in chosen:
                seen.setdefault(point.point3D_id, set()).add(image.name)
    ids = sorted(number for number, photos in seen.items() if len(photos) >= 2)
    assert 0 < len(ids) < len(scene.points)
    np.testing.assert_array_equal(few.points.xyz, [model.points3D[number].xyz for number in ids])
    np.testing.assert_array_equal(few.points.rgb, [model.points3D[number].color for number in ids])
    assert few.points.track_length.tolist() == [len(seen[number]) for number in ids]


def test_points_without_tracks_stay(scene: Scene, tmp_path: Path) -> None:
    elsewhere = replace(scene, path=tmp_path)
    assert few_photos(elsewhere, 2).points is scene.points


@pytest.mark.parametrize("count", [0, -1, 9])
def test_a_number_that_the_scene_does_not_have(capture_folder: Path, count: int) -> None:
    scene = load_scene(capture_folder, read_photos=False)
    with pytest.raises(InputError, match=rf"{count} photos, but it has 8 training views: choose 1 to 8"):
        few_photos(scene, count)
