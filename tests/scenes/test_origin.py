"""Scenes with the coordinates of a map: they are moved, and their models know by how much."""

from __future__ import annotations

import json
import math
import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_runner import clsplat, error_of, run
from small_scene import cloud, model_views, moved, write_garden, write_model

from clsplat.errors import InputError
from clsplat.models.model import SceneChoice, load_model
from clsplat.scenes.colmap_binary import write_binary_model
from clsplat.scenes.origin import is_far
from clsplat.scenes.scene import Scene, load_scene
from clsplat.scenes.source import SceneSource

MAP = 4e6  # coordinates of a map [m]


@pytest.fixture
def garden(tmp_path: Path) -> Path:
    return write_garden(tmp_path)


def write_far(garden: Path, shift: float = MAP, points: bool = True) -> None:
    write_model(garden, moved(shift=shift), shift, points)


@pytest.mark.parametrize("points", [True, False])
@pytest.mark.parametrize("shift", [1e5, -4e6, 1e9])
def test_a_scene_far_from_the_origin_is_moved(garden: Path, shift: float, points: bool) -> None:
    write_model(garden, moved(), 0.0, points)
    expected = load_scene(garden)
    write_far(garden, shift, points)
    with pytest.warns(UserWarning, match=r"which float32 cannot hold: \(-?\d+, .*\) becomes the origin of the scene"):
        scene = load_scene(garden)
    np.testing.assert_allclose(scene.origin, shift, rtol=0, atol=20.0)
    step = 1e-15 * abs(shift) * 10
    for view, other in zip(scene.views, expected.views, strict=True):
        np.testing.assert_allclose(view.camera.position + scene.origin, other.camera.position + shift, atol=step)
        np.testing.assert_array_equal(view.camera.rotation, other.camera.rotation)
    if points:
        np.testing.assert_allclose(scene.points.xyz + scene.origin, cloud()[0] + shift, rtol=0, atol=step)
    assert all(value == round(value) for value in scene.origin), "it is round"


def test_other_scenes_stay_where_they_are(garden: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        for scale, shift, points in ((1e6, 0.0, False), (1.0, 1e3, True), (1.0, 1e3, False)):
            write_model(garden, moved(scale, shift), shift, points)
            scene = load_scene(garden)
            assert scene.origin == (0.0, 0.0, 0.0)
            assert "origin" not in clsplat("info", garden)


@pytest.mark.parametrize("points", [True, False])
def test_a_long_scene_is_moved_for_its_details(garden: Path, points: bool) -> None:
    """Three places far from each other: the distance from the origin is small for the length of the scene."""
    far, apart = 4e6, 4e3
    rng = np.random.default_rng(5)
    cloud = rng.normal(size=(120, 3)) + apart * np.repeat([0, 1, 2], 40)[:, None] * [1.0, 0.0, 0.0]

    def read(shift: float) -> Scene:
        views = []
        for number, (view, pose) in enumerate(zip(model_views(), moved(shift=shift), strict=True)):
            pose[:3, 3] -= pose[:3, :3] @ [apart * (number // 3), 0.0, 0.0]
            seen = view.point_index if points else view.point_index[:0]
            views.append(replace(view, cam_from_world=pose, pixels=view.pixels[: len(seen)], point_index=seen))
        xyz = cloud + shift if points else cloud[:0]
        write_binary_model(garden / "sparse" / "0", views, xyz, np.zeros(xyz.shape, np.uint8))
        return load_scene(garden)

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        near = read(0.0)
        assert near.origin == (0.0, 0.0, 0.0)
    with pytest.warns(UserWarning, match=r"for its size or its details, which float32 cannot hold: \("):
        scene = read(far)
    for view, other in zip(scene.views, near.views, strict=True):
        np.testing.assert_allclose(view.camera.position + scene.origin, other.camera.position + far, atol=1e-6)


def test_splats_of_a_long_scene_that_was_not_moved_are_far() -> None:
    """Models of earlier versions have no origin in their record. Their splats tell that the scene was not moved."""
    xyz = np.random.default_rng(5).normal(size=(80, 3)) + np.repeat([0.0, 4e3], 40)[:, None] * [1.0, 0.0, 0.0]
    assert is_far(xyz + 4e6)
    assert not is_far(xyz)
    assert not is_far(xyz + 1e4), "about as far as the origin of a moved scene may be"


def test_the_origin_can_be_chosen(garden: Path) -> None:
    write_far(garden)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        scene = load_scene(garden, origin=(MAP, MAP, MAP - 7.0))
    np.testing.assert_allclose(scene.points.xyz, cloud()[0] + (0.0, 0.0, 7.0), atol=1e-8)
    assert scene.reading["origin"] == [MAP, MAP, MAP - 7.0]


def test_photos_that_are_missing_do_not_move_it(garden: Path) -> None:
    write_far(garden)
    with pytest.warns(UserWarning, match="becomes the origin"):
        expected = load_scene(garden).origin
    for name in ("shot_2.png", "shot_7.png"):
        (garden / "images" / name).unlink()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        assert load_scene(garden).origin == expected


def test_coordinates_that_no_number_holds_are_refused(garden: Path) -> None:
    write_far(garden, 3e11)
    assert "so float32 cannot hold it; correct the pose" in error_of("info", garden)


def test_a_model_is_evaluated_and_resumed_at_its_origin(garden: Path, tmp_path: Path) -> None:
    write_far(garden)
    result = run("train", garden, "-m", tmp_path / "m", "--iterations", 6, "--eval", "--cap-max", 40)
    assert result.exit_code == 0, result.output
    assert result.stderr.count("becomes the origin of the scene and of its model") == 1
    model = load_model(tmp_path / "m")
    np.testing.assert_allclose(model.origin, MAP, rtol=0, atol=20.0)
    assert np.abs(model.splats.mean).max() < 1e3
    shown = clsplat("info", tmp_path / "m")
    assert f"origin at ({', '.join(f'{value:.0f}' for value in model.origin)}) of the scene's coordinates" in shown
    assert json.loads(clsplat("info", "--json", tmp_path / "m"))["origin"] == list(model.origin)
    near = {view.name: view.camera.position for view in model.load_scene().views}
    # The record counts, even if the photos that are left would give another point.
    config = tmp_path / "m" / "config.json"
    values = json.loads(config.read_text())
    values["scene"]["origin"][0] += 1000.0
    config.write_text(json.dumps(values))
    for view in load_model(tmp_path / "m").load_scene().views:
        np.testing.assert_allclose(view.camera.position, near[view.name] - (1000.0, 0.0, 0.0), atol=1e-6)
    values["scene"]["origin"][0] -= 1000.0
    config.write_text(json.dumps(values))
    for command in (("eval", tmp_path / "m"), ("train", "-m", tmp_path / "m", "--resume", "--iterations", 8)):
        result = run(*command)
        assert result.exit_code == 0, result.output
        assert "becomes the origin" not in result.stderr


def test_splats_with_the_coordinates_of_the_files_are_read_with_them(garden: Path, tmp_path: Path) -> None:
    """So are runs of scenes that lie far away, from before scenes were moved, which have no origin in their record."""
    clsplat("train", garden, "-m", tmp_path / "m", "--iterations", 4, "--cap-max", 40)
    assert json.loads((tmp_path / "m" / "config.json").read_text())["scene"].get("origin") is None
    write_far(garden, 1e5)
    model = load_model(tmp_path / "m")
    assert model.origin == (0.0, 0.0, 0.0)
    with pytest.warns(UserWarning, match="becomes the origin"):
        assert model.load_scene().views[0].camera.position[0] < 1e3
    far = replace(
        model, splats=model.splats.with_arrays({**model.splats.arrays, "mean": model.splats.mean + np.float32(1e5)})
    )
    with pytest.warns(UserWarning, match="loses sharpness in float32"):
        assert far.load_scene().views[0].camera.position[0] > 9e4


def test_a_file_of_splats_of_a_moved_scene_fits_it(garden: Path, tmp_path: Path) -> None:
    write_far(garden)
    assert run("train", garden, "-m", tmp_path / "m", "--iterations", 6, "--eval", "--cap-max", 40).exit_code == 0
    model = load_model(tmp_path / "m")
    clsplat("convert", tmp_path / "m", tmp_path / "small.ply")
    with pytest.warns(UserWarning, match="becomes the origin"):
        scene = load_model(tmp_path / "small.ply").load_scene(SceneChoice(path=garden))
    assert scene.origin == model.origin


@pytest.mark.parametrize("origin", [(1.0, 2.0), "here", (0.0, 0.0, math.nan), 5.0])
def test_a_bad_origin_is_one_line(garden: Path, origin: Any) -> None:
    with pytest.raises(InputError, match="choose three finite numbers"):
        load_scene(garden, origin=origin)


def test_a_scene_is_read_again_at_its_origin(garden: Path) -> None:
    write_far(garden)
    with pytest.warns(UserWarning, match="becomes the origin"):
        scene = load_scene(garden)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        again = SceneSource.of(scene).load()
    assert again.origin == scene.origin
    np.testing.assert_array_equal(again.points.xyz, scene.points.xyz)


@pytest.mark.parametrize("value", [5, [1, 2], [1, 2, "3"], [1, 2, 1e300], {"x": 1}])
def test_a_damaged_record_is_one_line(garden: Path, tmp_path: Path, value: object) -> None:
    clsplat("train", garden, "-m", tmp_path / "m", "--iterations", 4, "--cap-max", 40)
    config = tmp_path / "m" / "config.json"
    values = json.loads(config.read_text())
    values["scene"]["origin"] = value
    config.write_text(json.dumps(values))
    assert "scene.origin is" in error_of("info", tmp_path / "m")
