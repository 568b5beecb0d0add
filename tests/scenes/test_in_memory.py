"""Photos that stay in memory while several runs train on them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from small_scene import write_garden

from clsplat.compression.rules import BudgetOptions
from clsplat.compression.search import train_budget
from clsplat.scenes import in_memory
from clsplat.scenes.in_memory import with_small_photos_in_memory
from clsplat.scenes.read_view import PhotoReader
from clsplat.scenes.scene import Scene, load_scene
from clsplat.scenes.view import View
from clsplat.training.config import TrainConfig


@pytest.fixture
def scene(tmp_path: Path) -> Scene:
    return load_scene(write_garden(tmp_path))


@pytest.fixture
def decoded(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the photos that are decoded."""
    names: list[str] = []
    read = PhotoReader.view

    def counted(self: PhotoReader) -> View:
        names.append(self.photo.name)
        return read(self)

    monkeypatch.setattr(PhotoReader, "view", counted)
    return names


def test_small_photos_are_never_decoded_again(tmp_path: Path, decoded: list[str]) -> None:
    scene = load_scene(write_garden(tmp_path), read_photos=False)
    held = with_small_photos_in_memory(scene)
    assert sorted(decoded) == [view.name for view in scene.train], "each of them once, no test view"
    for view in held.views:
        view.release()
    images = [view.image for view in held.train]
    assert len(decoded) == len(images), "they stay"
    for image, other in zip(images, scene.train, strict=True):
        np.testing.assert_array_equal(image, other.image)
    assert held.test == scene.test
    assert (held.names, held.test_names, held.reading) == (scene.names, scene.test_names, scene.reading)


def test_large_photos_stay_files(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(in_memory, "MOST_BYTES", 100)
    assert with_small_photos_in_memory(scene) is scene


def test_a_search_decodes_no_photo_twice(decoded: list[str], tmp_path: Path) -> None:
    scene = load_scene(write_garden(tmp_path))
    config = TrainConfig(iterations=10, cap_max=60, device="cpu")
    train_budget(scene, config, BudgetOptions(1.0), output=tmp_path / "m")
    assert not decoded, "the scene has decoded them"
