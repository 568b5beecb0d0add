"""A scene that another process reads again: the same one, or a line that says what is different there."""

from __future__ import annotations

import pickle
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.files.images import write_png
from clsplat.scenes.read_view import PhotoReader
from clsplat.scenes.scene import Points, Scene, load_scene
from clsplat.scenes.source import SceneSource
from clsplat.scenes.split import hold_out, with_validation
from clsplat.splats.color import WHITE


@pytest.fixture
def folder(capture_folder: Path, tmp_path: Path) -> Path:
    """A copy of the small capture, which a test may change."""
    return Path(shutil.copytree(capture_folder, tmp_path / "yard"))


def again(scene: Scene) -> Scene:
    """Return the scene as another process reads it."""
    source: SceneSource = pickle.loads(pickle.dumps(SceneSource.of(scene)))
    return source.load()


@pytest.mark.parametrize("reading", [{}, {"resolution": 2}, {"test_every": 3}, {"eval": False}, {"background": WHITE}])
def test_the_scene_comes_back(folder: Path, reading: dict) -> None:
    scene = load_scene(folder, **reading)
    found = again(scene)
    assert found.names == scene.names
    assert (found.name, found.background, found.test_names) == (scene.name, scene.background, scene.test_names)
    assert all((a.image == b.image).all() for a, b in zip(found.views, scene.views, strict=True))
    assert all(
        (a.camera.cam_from_world == b.camera.cam_from_world).all() and a.camera.width == b.camera.width
        for a, b in zip(found.views, scene.views, strict=True)
    )
    assert (found.points.xyz == scene.points.xyz).all()


@pytest.mark.parametrize("points_fit", [False, True])
def test_points_are_looked_at_by_one_program(folder: Path, points_fit: bool) -> None:
    assert again(replace(load_scene(folder), points_fit=points_fit)).points_fit == points_fit


@pytest.mark.parametrize("change", [hold_out, with_validation])
def test_views_that_are_held_out_stay_so(folder: Path, change) -> None:
    scene = change(load_scene(folder))
    found = again(scene)
    for kind in ("train", "test", "validation"):
        assert [view.name for view in getattr(found, kind)] == [view.name for view in getattr(scene, kind)]


def test_files_that_are_missing_or_others_are_named(folder: Path) -> None:
    source = SceneSource.of(load_scene(folder))
    photo = folder / "images" / source.names[3]
    shape = load_scene(folder).views[3].image.shape
    write_png(photo, np.zeros(shape, np.uint8))
    with pytest.raises(InputError, match=rf"{photo.name} is another one here: copy the scene's files again"):
        source.load()
    photo.unlink()
    with pytest.raises(InputError, match=rf"{photo.name}"), pytest.warns(UserWarning, match="left out"):
        source.load()
    shutil.rmtree(folder)
    with pytest.raises(InputError, match="yard"):
        source.load()


def test_a_scene_that_was_changed_in_memory_is_refused(folder: Path) -> None:
    scene = load_scene(folder)
    points = scene.points
    moved = replace(scene, points=Points(points.xyz + 1, points.rgb, points.track_length))
    with pytest.raises(InputError, match="the points are others here"):
        again(moved)


def test_a_part_opens_only_its_own_photos(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Photos of other parts may be damaged, and cost neither reading nor memory."""
    scene = load_scene(folder)
    names = [view.name for view in scene.train[1:4]]
    source = SceneSource.of(scene).of_views(names)
    for name in scene.names:
        if name not in names:
            file = folder / "images" / name
            file.write_bytes(file.read_bytes()[:200])  # the size is still there
    opened: list[str] = []
    read = PhotoReader.read
    monkeypatch.setattr(PhotoReader, "read", lambda self, *look: opened.append(self.photo.name) or read(self, *look))
    part = source.load()
    assert sorted(opened) == sorted(part.names) == sorted(names)
    assert set(part.photo_digests) == set(names)
    assert [view.name for view in part.train] == sorted(names)
    for view in part.train:
        assert (view.image == next(other.image for other in scene.views if other.name == view.name)).all()


def test_a_part_whose_photos_are_missing(folder: Path) -> None:
    scene = load_scene(folder)
    source = SceneSource.of(scene).of_views([scene.train[0].name])
    (folder / "images" / scene.train[0].name).unlink()
    with (
        pytest.raises(InputError, match=f"the photo {scene.train[0].name} is missing here"),
        pytest.warns(UserWarning, match="left out"),
    ):
        source.load()
