"""Norms of quaternions, names in text files, and poses and lenses that cannot be right."""

from __future__ import annotations

import filecmp
import json
import re
import struct
import warnings
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from cli_runner import clsplat, error_of, run
from scipy.spatial.transform import Rotation
from small_scene import as_text, cloud, model_views, moved, photo_of, write_garden, write_model

from clsplat.errors import InputError
from clsplat.files.images import read_image, write_png
from clsplat.scenes.colmap import read_model
from clsplat.scenes.colmap_binary import write_binary_model
from clsplat.scenes.origin import camera_centres, size_of
from clsplat.scenes.posed_images import PosedImages
from clsplat.scenes.scene import load_scene
from clsplat.scenes.source import SceneSource


@pytest.fixture
def garden(tmp_path: Path) -> Path:
    return write_garden(tmp_path)


def text_model(garden: Path, rigs: bool = False) -> Path:
    """Replace the binary model by text files and return images.txt."""
    model = garden / "sparse" / "0"
    as_text(model, garden / "text")
    for file in model.iterdir():
        file.unlink()
    for file in (garden / "text").iterdir():
        if rigs or file.stem not in ("rigs", "frames"):
            file.rename(model / file.name)
    return model / "images.txt"


def scale_quaternions(file: Path, factor: float, first: int = 1, only: int | None = None) -> None:
    """Multiply the quaternions in the lines of images.txt or frames.txt."""
    lines, row = file.read_text().splitlines(), 0
    step = 2 if file.stem == "images" else 1
    body = [index for index, line in enumerate(lines) if not line.startswith("#")]
    for row, index in enumerate(body[::step]):
        if only is None or row == only:
            words = lines[index].split(" ")
            words[first : first + 4] = [repr(factor * float(word)) for word in words[first : first + 4]]
            lines[index] = " ".join(words)
    file.write_text("\n".join(lines) + "\n")


@pytest.mark.parametrize("rigs", [False, True])
@pytest.mark.parametrize("factor", [1000.0, 1e-3, -1.0, 1e200])
def test_quaternions_have_any_norm(garden: Path, factor: float, rigs: bool) -> None:
    expected = load_scene(garden)
    file = text_model(garden, rigs)
    if rigs:
        scale_quaternions(file.with_name("frames.txt"), factor, first=2)
    else:
        scale_quaternions(file, factor)
    for view, other in zip(load_scene(garden).views, expected.views, strict=True):
        np.testing.assert_allclose(view.camera.cam_from_world, other.camera.cam_from_world, atol=1e-12)


def test_a_quaternion_of_norm_zero_is_named(garden: Path) -> None:
    scale_quaternions(text_model(garden), 0.0, only=2)
    for message in (error_of("info", garden), error_of("train", garden, "-m", garden / "m")):
        assert "image 'shot_6.png' has a quaternion of norm 0; rebuild the model" in message


@pytest.mark.parametrize(("place", "value"), [(0, 0.0), (0, np.nan), (0, np.inf), (5, np.nan), (6, np.inf)])
def test_binary_poses_that_are_no_poses_are_named(garden: Path, place: int, value: float) -> None:
    file = garden / "sparse" / "0" / "images.bin"
    data = bytearray(file.read_bytes())
    width = 4 if place == 0 else 1
    data[12 + 8 * place : 12 + 8 * (place + width)] = struct.pack(f"<{width}d", *[value] * width)
    file.write_bytes(data)
    with pytest.raises(InputError, match=r"image 'shot_8\.png' has a (quaternion of norm 0|pose that is not finite)"):
        load_scene(garden)
    assert "shot_8.png" in error_of("info", garden)


def test_names_with_spaces_are_read_from_text_models(garden: Path) -> None:
    """Other programs write them; COLMAP itself ends a name at the first space."""
    file = text_model(garden)
    text, expected = file.read_text(), load_scene(garden)
    images = expected.images
    for name in expected.names:
        (garden / "images" / name).rename(garden / "images" / name.replace("shot_", "my  shot "))
    file.write_text(text.replace("shot_", "my  shot "))
    scene = load_scene(garden)
    assert scene.names == [name.replace("shot_", "my  shot ") for name in expected.names]
    for view, other, image in zip(scene.views, expected.views, images, strict=True):
        np.testing.assert_array_equal(view.camera.cam_from_world, other.camera.cam_from_world)
        np.testing.assert_array_equal(view.image, image)


def test_text_models_with_spaces_are_not_written(garden: Path) -> None:
    data = (garden / "sparse" / "0" / "images.bin").read_bytes()
    (garden / "sparse" / "0" / "images.bin").write_bytes(data.replace(b"shot_3", b"shot 3"))
    (garden / "images" / "shot_3.png").rename(garden / "images" / "shot 3.png")
    target = garden / "out"
    message = error_of("cameras", garden, target, "--format", "colmap-text")
    assert "image 'shot 3.png': a name ends at the first space in COLMAP's text files; write a binary model" in message
    assert not target.exists()
    assert "9 cameras" in clsplat("cameras", garden, target, "--format", "colmap")
    assert "shot 3.png" in [photo.name for photo in read_model(target).photos]


# --- poses and lenses that cannot be right -------------------------------------------------


@pytest.mark.parametrize("scale", [1e13, 1e30, 1e200])
def test_poses_beyond_float32_are_named(garden: Path, scale: float) -> None:
    write_model(garden, moved(scale))
    for message in (error_of("info", garden), error_of("train", garden, "-m", garden / "m")):
        assert re.search(r"the translation of 'shot_\d.png' is \d\.?\d*e\+\d+, more than 1e\+12; scale the", message)


def test_a_camera_far_from_the_scene_is_named(garden: Path) -> None:
    poses = moved()
    poses[4][:3, 3] += 1e9
    write_model(garden, poses)
    with pytest.raises(InputError, match=r"the translation of 'shot_\d.png' .* so float32 cannot hold it; correct the"):
        load_scene(garden)
    poses[4][:3, 3] += 1e5 - 1e9
    write_model(garden, poses)
    with pytest.warns(UserWarning, match=r"times the size of the scene .*; its image loses sharpness in float32"):
        load_scene(garden)


def test_cameras_in_one_place_away_from_the_origin() -> None:
    """Their centres differ by rounding, which is not the size of a scene."""
    turns = [Rotation.from_euler("zyx", [0.7 * index, 0.3 * index, 0.1]).as_matrix() for index in range(9)]
    poses = [np.vstack([np.c_[turn, -turn @ (3.6, 0.1, 0.7)], [0, 0, 0, 1]]) for turn in turns]
    photos = [SimpleNamespace(cam_from_world=pose) for pose in poses]
    posed = cast(PosedImages, SimpleNamespace(points=SimpleNamespace(xyz=np.zeros((0, 3))), photos=photos))
    assert np.ptp(camera_centres(posed), axis=0).max() > 0
    assert size_of(posed) == 1


def test_cameras_far_from_their_points_are_named(garden: Path) -> None:
    write_model(garden, moved(scale=1e11))
    with pytest.raises(InputError, match="times the size of the scene"):
        load_scene(garden)


def test_equal_poses_of_different_photos_are_named(garden: Path) -> None:
    write_model(garden, [np.eye(4)] * 9)
    text = "8 of 9 photos have the pose of another photo but show something else, for example 'shot_1.png' and 'shot_0"
    with pytest.warns(UserWarning, match=text):
        load_scene(garden)
    assert text in run("info", garden).stderr
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*test photos are training photos")
        for index in range(9):
            (garden / "images" / f"shot_{index}.png").write_bytes((garden / "images" / "shot_0.png").read_bytes())
        load_scene(garden)
        pixels = read_image(garden / "images" / "shot_0.png")
        write_png(garden / "images" / "shot_1.png", pixels, render=True)
        assert not filecmp.cmp(garden / "images" / "shot_0.png", garden / "images" / "shot_1.png", shallow=False)
        load_scene(garden)  # with another description in the file


@pytest.mark.parametrize(("k1", "size"), [(1e6, "8x6"), (-10.0, "80x60")])
def test_lenses_beyond_undistortion_are_named(tmp_path: Path, k1: float, size: str) -> None:
    for index, view in enumerate(model_views()):
        write_png(tmp_path / view.name, photo_of(index))
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    frames = [
        {"file_path": view.name, "transform_matrix": (np.linalg.inv(view.cam_from_world) @ flip).tolist(), "k1": k}
        for view, k in zip(model_views(), [0.1, k1] + [0.0] * 7, strict=True)
    ]
    (tmp_path / "transforms.json").write_text(json.dumps({"fl_x": 33.0, "frames": frames}))
    match = rf"the lens of 1 of 9 photos distorts too much .*'shot_1\.png': 40x30 px become {size} px\. .*{k1:g}"
    with pytest.warns(UserWarning, match=match.replace("+", r"\+")):
        load_scene(tmp_path)
    assert f"40x30 px become {size} px" in run("info", tmp_path).stderr


@pytest.mark.parametrize(
    ("lens", "fault"),
    [
        ({"fl_x": 132.0, "cx": 80.0, "cy": 60.0}, r"its principal point at \(80, 60\) px in an image of 40x30 px"),
        ({"fl_x": 33.0, "cx": 0.5, "cy": 0.5}, r"its principal point at \(0\.5, 0\.5\) px in an image of 40x30 px"),
        ({"fl_x": 0.8, "fl_y": 1.1}, r"focal lengths of 0\.8 and 1\.1 px for an image of 40x30 px"),
        ({"fl_x": 33.0, "cx": 10.0, "cy": 22.0}, ""),
        ({"fl_x": 4.0}, ""),
    ],
)
def test_lenses_of_another_size_are_named(tmp_path: Path, lens: dict[str, float], fault: str) -> None:
    """Keys may be those of the unreduced photos, or in parts of their size. What was cut out has a usual lens."""
    for index, view in enumerate(model_views()):
        write_png(tmp_path / view.name, photo_of(index))
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    frames = [
        {"file_path": view.name, "transform_matrix": (np.linalg.inv(view.cam_from_world) @ flip).tolist()}
        for view in model_views()
    ]
    (tmp_path / "transforms.json").write_text(json.dumps({**lens, "frames": frames}))
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        load_scene(tmp_path)
    said = [str(one.message) for one in caught if "the lens of" in str(one.message)]
    assert len(said) == bool(fault)
    assert all(
        re.search(rf"the lens of '.*shot_0\.png' has {fault}: it is wrong, or of another size", one) for one in said
    )


def test_points_that_no_photo_shows_are_left_out(garden: Path) -> None:
    """They are of other poses. Splats that start there would have to be removed first."""
    write_model(garden, moved(), shift=-500.0)
    with pytest.warns(UserWarning, match=r"its photos show 0\.0% of its 12 points, so the points do not fit the poses"):
        scene = load_scene(garden)
    assert len(scene.points) == 0
    assert len(SceneSource.of(scene).load().points) == 0, "a worker leaves them out, too"
    write_model(garden, moved())
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert len(load_scene(garden).points) == 12


def test_a_camera_far_from_all_others_is_named(garden: Path) -> None:
    poses = moved()
    poses[3][:3, 3] += 40.0
    write_model(garden, poses)
    with pytest.warns(UserWarning, match=r"1 of 9 photos have a camera far from all others, for example 'shot_3\.png'"):
        load_scene(garden)


def test_copies_of_test_photos_among_the_training_photos_are_named(garden: Path) -> None:
    (garden / "images" / "shot_1.png").write_bytes((garden / "images" / "shot_0.png").read_bytes())
    with pytest.warns(UserWarning, match=r"1 of 2 test photos are training photos, too, for example 'shot_0\.png'"):
        load_scene(garden)


def test_points_far_away_are_read(garden: Path) -> None:
    """Sparse models have such outliers. They are no reason to refuse a scene."""
    xyz, rgb = cloud()
    xyz[3] = 1e30
    write_binary_model(garden / "sparse" / "0", model_views(), xyz, rgb)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert load_scene(garden).points.xyz.max() == 1e30
    xyz[3] = 1e300
    write_binary_model(garden / "sparse" / "0", model_views(), xyz, rgb)
    with pytest.warns(UserWarning, match=r"1 of 12 points are further away than 1e\+30; they are left out"):
        points = load_scene(garden).points
    np.testing.assert_array_equal(points.xyz, np.delete(xyz, 3, axis=0))
    np.testing.assert_array_equal(points.rgb, np.delete(rgb, 3, axis=0))
    assert len(points.track_length) == 11
