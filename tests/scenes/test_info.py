"""`clsplat info` of scenes: contents and missing parts, without decoding a photo."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from cli_runner import clsplat, error_of
from small_scene import HEIGHT, N_POINTS, NAMES, WIDTH, write_garden

from clsplat.cameras.camera import Camera
from clsplat.files import images
from clsplat.files.images import write_png
from clsplat.scenes.info import scene_info
from clsplat.scenes.scene import load_scene


def test_a_scene_is_counted_without_decoding(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    garden = write_garden(tmp_path)
    scene = load_scene(garden)
    monkeypatch.setattr(images, "read_image", None)
    info = scene_info(garden)
    assert (info.kind, info.photos, info.points, info.masked) == ("COLMAP", 9, N_POINTS, 0)
    assert info.sizes == (((WIDTH, HEIGHT), 9),)
    assert info.track_mean == pytest.approx(9 * 8 / N_POINTS)
    assert info.track_median == np.median(scene.points.track_length)
    assert set(info.test) == scene.test_names
    (lens,) = info.lenses
    camera: Camera = scene.cameras[0]
    assert (lens.focal, lens.pinhole, lens.photos) == (camera.fx, True, 9)
    assert lens.field_of_view == pytest.approx(62.4, abs=0.05), "2 atan(20 / 33)"
    assert info.photo_bytes == sum(file.stat().st_size for file in (garden / "images").iterdir())
    assert (info.unregistered, info.left_out) == ((), {})


def test_faults_are_named(tmp_path: Path) -> None:
    garden = write_garden(tmp_path)
    write_png(garden / "images" / "more" / "late.png", np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    (garden / "images" / NAMES[2]).write_bytes(b"no image")
    write_png(garden / "images" / NAMES[4], np.zeros((2 * HEIGHT, 2 * WIDTH, 3), np.uint8))
    write_png(garden / "masks" / f"{NAMES[5]}.png", np.zeros((HEIGHT, WIDTH), np.uint8))
    info = scene_info(garden)
    assert info.unregistered == ("more/late.png",)
    assert list(info.left_out) == [NAMES[2]]
    assert info.sizes == (((WIDTH, HEIGHT), 7), ((2 * WIDTH, 2 * HEIGHT), 1))
    assert info.masked == 1
    output = clsplat("info", garden)
    for text in (
        f"left out        1 ({NAMES[2]}), 12 %",
        "without a pose  1 (more/late.png)",
        "masks           of 1 photos",
    ):
        assert text in output
    entry = json.loads(clsplat("info", "--json", garden))
    assert entry["scene"] == str(garden)
    assert entry["sizes"][1] == {"width": 2 * WIDTH, "height": 2 * HEIGHT, "photos": 1}
    assert entry["lenses"][0]["model"] == "PINHOLE"
    assert len(entry["test"]) == 2


def test_transforms_with_distortion(tmp_path: Path) -> None:
    frames = []
    for index, name in enumerate(("a.png", "b.png", "c.png")):
        write_png(tmp_path / name, np.zeros((30, 40, 3), np.uint8))
        frames.append({"file_path": name, "transform_matrix": np.eye(4).tolist(), "k1": 0.1 if index else 0.0})
    file = tmp_path / "transforms.json"
    file.write_text(json.dumps({"w": 40, "h": 30, "fl_x": 40.0, "fl_y": 40.0, "frames": frames}))
    info = scene_info(tmp_path)
    assert [(lens.pinhole, lens.photos) for lens in info.lenses] == [(False, 2), (True, 1)]
    assert info.kind == "transforms.json"
    assert info.track_mean == 0
    for path in (tmp_path, file):
        output = clsplat("info", path)
        assert "FULL_OPENCV, 40x30 px, focal length 40.0 px (53 degrees across): 2 photos, undistorted" in output
        assert "points          0\n" in output


def test_a_reconstructed_scene_shows_its_record(tmp_path: Path) -> None:
    garden = write_garden(tmp_path)
    record = garden / "reconstruct.json"
    record.write_text('{"photos": 12, "registered": 9, "error": 0.254}')
    assert "reconstructed   9 of 12 photos, 0.25 px off" in clsplat("info", garden)
    assert json.loads(clsplat("info", "--json", garden))["placed"] == {"photos": 9, "of": 12, "error": 0.254}
    for bad in ('{"photos": 12}', "[]", '{"photos": "x", "registered": 9, "error": 1e999}'):
        record.write_text(bad)
        assert "reconstruct.json: registered, photos and error must be numbers" in error_of("info", garden)
    shutil.copytree(garden / "images", tmp_path / "photos")
    assert "photographs without poses: clsplat reconstruct" in error_of("info", tmp_path / "photos")


def test_a_lens_without_a_focal_length_is_named(tmp_path: Path) -> None:
    garden = write_garden(tmp_path)
    file = garden / "sparse" / "0" / "cameras.bin"
    data = bytearray(file.read_bytes())
    for focal in (0.0, float("nan")):
        data[32:40] = np.float64(focal).tobytes()  # after the count, id, model, width and height
        file.write_bytes(data)
        messages = [error_of("info", garden), error_of("train", garden, "-m", garden / "m")]
        assert messages[0] == messages[1]
        assert re.search(r"'shot_0\.png': .*(focal lengths must be above 0|parameter that is not finite)", messages[0])


def test_models_and_scenes_are_distinguished(tmp_path: Path, capture_folder: Path, model_folder: Path) -> None:
    model, scene = model_folder, capture_folder
    output = clsplat("info", model, scene)
    assert re.search(r"\b(39\d|400) splats, shape", output)
    assert "10 photos with poses" in output
    kinds = [next(iter(json.loads(line))) for line in clsplat("info", "--json", model, scene).splitlines()]
    assert kinds == ["model", "scene"]
    assert "neither a model (point_cloud/) nor a scene" in error_of("info", tmp_path)
    (tmp_path / "config.json").write_text("{}")
    assert "train a model first" in error_of("info", tmp_path)
    assert "no such model folder or file of splats" in error_of("info", tmp_path / "none")


def test_one_photo_has_no_test_views(tmp_path: Path) -> None:
    write_png(tmp_path / "a.png", np.zeros((9, 9, 3)))
    frames = [{"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}]
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 30.0, "frames": frames}))
    assert "test views      none: clsplat train --eval needs at least 2 photos\n" in clsplat("info", tmp_path)
