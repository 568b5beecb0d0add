"""The photos of a run: they lie over the background that its renders have."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from clsplat.errors import InputError
from clsplat.scenes.read_view import PhotoReader
from clsplat.scenes.scene import Scene, View, load_scene
from clsplat.scenes.split import split_for_run
from clsplat.scenes.view import StoredView
from clsplat.training.config import TrainConfig
from clsplat.training.photos import with_photos
from clsplat.training.run import train

WHITE = (1.0, 1.0, 1.0)


def with_opacity(scene: Scene, lowest: int) -> Scene:
    """Return the scene with one pixel of this opacity in each photo."""

    def changed(view: View) -> View:
        alpha = np.full(view.image.shape[:2], 255, np.uint8)
        alpha[0, 0] = lowest
        return replace(view, alpha=alpha)

    return replace(scene, views=[changed(view.loaded()) for view in scene.views])


def test_transparent_photos_must_lie_over_the_background_of_the_run(scene: Scene, tmp_path: Path) -> None:
    config = TrainConfig(iterations=5, cap_max=50, background=WHITE)
    with pytest.raises(InputError, match=r"transparent photos.*0,0,0.*1,1,1.*background=config.background"):
        train(with_opacity(scene, 254), config, output=tmp_path / "model")
    assert not (tmp_path / "model" / "config.json").exists()
    over_white = replace(with_opacity(scene, 254), background=WHITE)
    assert with_photos(over_white, config).background == WHITE
    for opaque in (scene, with_opacity(scene, 255)):
        assert with_photos(opaque, config).train


@pytest.fixture
def decoded(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the photos in the order in which they are decoded."""
    names: list[str] = []
    read = PhotoReader.read

    def counted(self: PhotoReader, *arguments: Callable[..., None]) -> View | str:
        names.append(self.photo.name)
        return read(self, *arguments)

    monkeypatch.setattr(PhotoReader, "read", counted)
    return names


def test_a_run_decodes_each_of_its_photos_once(capture_folder: Path, decoded: list[str]) -> None:
    """The check of the points, the decisions and the hints look at the same photos."""
    scene = load_scene(capture_folder, read_photos=False)
    assert not decoded
    said: list[str] = []
    config = TrainConfig(iterations=2, cap_max=50, device="cpu")
    train(scene, config, lambda progress: said.append(progress.message))
    assert any(message.startswith("decided") for message in said)
    assert Counter(decoded) == Counter(view.name for view in scene.train)


def test_validation_photos_are_not_kept(capture_folder: Path) -> None:
    """Some of them are looked at before the run, and all are measured in it."""
    scene = load_scene(capture_folder, read_photos=False)
    held: list[str] = []

    def look(trainer: object, stop: object) -> None:
        held.extend(view.name for view in scene.views if isinstance(view, StoredView) and view.is_kept)

    config = TrainConfig(iterations=1, cap_max=50, validate=True)
    train(scene, config, visit=look)
    assert held
    assert not {view.name for view in split_for_run(scene, True).validation} & set(held)


def test_photos_before_a_plain_background_are_in_memory_once(capture_folder: Path) -> None:
    """The cut-out of a photo has its pixels. A photo that stays beside it would keep them when the device has them."""
    scene = load_scene(capture_folder)
    views = scene.train
    assert all(isinstance(view, StoredView) and view.is_kept for view in views)
    found = with_photos(scene, TrainConfig(cut_background=True, background=WHITE))
    assert not any(isinstance(view, StoredView) and view.is_kept for view in views)
    assert all(isinstance(view, StoredView) and view.is_kept for view in found.train)
