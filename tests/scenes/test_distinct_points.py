"""Points in one place: one of each place counts if many are copies, and few copies change nothing."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from recorded_scenes import scene_and_warnings

from clsplat.scenes.colmap import Points
from clsplat.scenes.distinct_points import distinct, without_copies
from clsplat.scenes.scene import load_scene
from clsplat.training.config import TrainConfig
from clsplat.training.decisions import decide

MESSAGE = "points are in different places"


def cloud(n: int) -> Points:
    """Return points in different places. The track of each is its number."""
    rng = np.random.default_rng(0)
    return Points(rng.normal(size=(n, 3)), rng.integers(0, 256, (n, 3), dtype=np.uint8), np.arange(n))


def repeated(points: Points, rows: np.ndarray) -> Points:
    return Points(points.xyz[rows], points.rgb[rows], points.track_length[rows])


def test_the_first_point_of_each_place_is_used(recwarn: pytest.WarningsRecorder) -> None:
    rows = np.random.default_rng(1).integers(0, 30, 100)
    kept = without_copies(Path("yard"), repeated(cloud(30), rows))
    assert len(np.unique(kept.xyz, axis=0)) == len(kept) == len(np.unique(rows))
    assert list(dict.fromkeys(rows)) == list(kept.track_length)
    assert f"yard: only {len(kept)} of its 100 {MESSAGE}" in str(recwarn.pop().message)


def test_few_copies_change_nothing(recwarn: pytest.WarningsRecorder) -> None:
    points = repeated(cloud(100), np.append(np.arange(100), np.arange(20)))
    assert without_copies(Path("yard"), points) is points
    assert not recwarn.list


@pytest.mark.parametrize("n", [0, 1, 2, 500])
@pytest.mark.parametrize("decimals", [0, 1, 8])
def test_distinct_is_that_of_all_coordinates(n: int, decimals: int) -> None:
    xyz = np.round(np.random.default_rng(n).normal(size=(n, 3)), decimals)
    _, first = np.unique(xyz + 0.0, axis=0, return_index=True)
    assert list(distinct(xyz)) == sorted(first)


def test_a_scene_with_copies_starts_as_one_with_few_points(capture_folder: Path, tmp_path: Path) -> None:
    folder = tmp_path / "copies"
    shutil.copytree(capture_folder, folder)
    import pycolmap

    model = folder / "sparse" / "0"
    reconstruction = pycolmap.Reconstruction(str(model))
    ids = sorted(reconstruction.points3D)
    places = [reconstruction.points3D[number].xyz.copy() for number in ids[:10]]
    for number, point in enumerate(ids):
        reconstruction.points3D[point].xyz = places[number % 10]
    reconstruction.write(str(model))
    scene, said = scene_and_warnings(folder)
    assert f"only 10 of its {len(ids)} {MESSAGE}" in said
    assert len(scene.points) == 10
    assert "the scene has only 10 points" in str(decide(scene, TrainConfig(cap_max=4000)))
    assert MESSAGE not in scene_and_warnings(capture_folder)[1]
    assert len(load_scene(capture_folder).points) == len(ids)
