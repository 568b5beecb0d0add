"""Scenes that Blender renders for benchmarks: their cameras, masks and points agree."""

from __future__ import annotations

import subprocess
from pathlib import Path

import numpy as np
import pytest
from blender_python import blenders_python_or_skip

from clsplat.cameras.seen import seen
from clsplat.scenes.scene import Scene, load_scene

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "blender_scenes.py"
SIZE = 48


def rendered(folder: Path, name: str) -> Scene:
    options = ["--scenes", name, "--size", str(SIZE), "--train", "6", "--test", "2"]
    python = blenders_python_or_skip()
    subprocess.run([python, SCRIPT, folder, *options], check=True, capture_output=True, timeout=300)
    return load_scene(folder / name, eval=True)


@pytest.mark.slow
def test_an_object(tmp_path: Path) -> None:
    scene = rendered(tmp_path, "plant")
    assert (len(scene.train), len(scene.test)) == (6, 2)
    for view in (*scene.train, *scene.test):
        assert view.alpha is not None
        assert view.alpha[0].max() == 0, "no part of the object is cut off"
        assert (view.alpha == 0).mean() > 0.5
        _, pixel, inside = seen(view.camera, np.array([[0.0, 0.0, -0.85], [0.0, 0.0, 3.0]]))
        assert inside[0], "the pot"
        column, row = pixel[0].astype(int)
        assert view.alpha[row, column] == 255
    files = sorted(tmp_path.rglob("*.png"))
    before = [file.stat().st_mtime_ns for file in files]
    rendered(tmp_path, "plant")
    assert [file.stat().st_mtime_ns for file in files] == before, "photos that are there are kept"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["room", "garden", "lane"])
def test_a_place(tmp_path: Path, name: str) -> None:
    scene = rendered(tmp_path, name)
    assert scene.points is not None
    assert len(scene.points) > 100
    errors = []
    for view in scene.train:
        assert view.alpha is None
        _, pixel, inside = seen(view.camera, scene.points.xyz)
        column, row = pixel[inside].astype(int).T
        errors.append(np.abs(view.loaded().image[row, column] - scene.points.rgb[inside].astype(float)).mean(axis=1))
    assert np.median(np.concatenate(errors)) < 40, "most points are seen, in their colour"
