"""Rounded and scaled rotations in files: every reader corrects or refuses the same matrices."""

from __future__ import annotations

import json
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_scene import photo_of

from clsplat.cameras.camera import Camera
from clsplat.cameras.cameras_json import read_cameras
from clsplat.cameras.path import read_path
from clsplat.cameras.rotations import TOLERANCE, nearest_rotation
from clsplat.errors import InputError
from clsplat.files.images import write_png
from clsplat.scenes.scene import load_scene

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def turned(angles: list[float]) -> np.ndarray:
    """Return a rotation about x, y and z."""
    matrix = np.eye(3)
    for axis, angle in enumerate(angles):
        i, j = (axis + 1) % 3, (axis + 2) % 3
        step = np.eye(3)
        step[i, i] = step[j, j] = np.cos(angle)
        step[i, j], step[j, i] = -np.sin(angle), np.sin(angle)
        matrix = matrix @ step
    return matrix


ROTATIONS = [turned([0.3 + 0.5 * index, 1.1 * index, 2.0 - 0.7 * index]) for index in range(9)]


@settings(max_examples=200, deadline=None)
@given(
    angles=st.lists(st.floats(-3.2, 3.2), min_size=3, max_size=3),
    decimals=st.integers(2, 9),
    scale=st.sampled_from([1e-3, 1.0, 250.0]),
)
def test_rounded_rotations_come_back(angles: list[float], decimals: int, scale: float) -> None:
    exact = turned(angles)
    found = nearest_rotation(scale * np.round(exact, decimals))
    if found.deviation:
        np.testing.assert_allclose(found.matrix @ found.matrix.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(found.matrix) == pytest.approx(1.0, abs=1e-4)
    assert np.abs(found.matrix - exact).max() < 3 * 10.0**-decimals
    assert found.scale == pytest.approx(scale, rel=0.02)


def test_exact_rotations_keep_their_bits() -> None:
    for angle in np.linspace(-3, 3, 50):
        exact = turned([angle, 2 * angle, 1.0]).astype(np.float32).astype(np.float64)
        np.testing.assert_array_equal(nearest_rotation(exact).matrix, exact)


@pytest.mark.parametrize(
    ("matrix", "word"),
    [
        (np.diag([1.0, 1.0, -1.0]), "mirrored"),
        (np.diag([1.0, 1.0, 1.0 + 4 * TOLERANCE]), "different scales along its axes, from 1 to 1.08"),
        (np.array([[1.0, 0.1, 0], [0, 1, 0], [0, 0, 1]]), "sheared"),
        (np.zeros((3, 3)), "its scale is 0"),
        (1e9 * np.eye(3), r"its scale is 1e\+09"),
        (np.ones((3, 3)), "sheared"),
    ],
)
def test_other_matrices_are_refused(matrix: np.ndarray, word: str) -> None:
    with pytest.raises(InputError, match=word):
        nearest_rotation(matrix)


# --- the readers ---------------------------------------------------------------------------


def transforms(folder: Path, rotations: list[np.ndarray]) -> list[Camera]:
    frames = []
    for index, rotation in enumerate(rotations):
        write_png(folder / f"{index}.png", photo_of(index))
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, (index, 0.0, 0.0)
        frames.append({"file_path": f"{index}.png", "transform_matrix": (pose @ FLIP).tolist()})
    (folder / "transforms.json").write_text(json.dumps({"fl_x": 30.0, "frames": frames}))
    return load_scene(folder, eval=False).cameras


def cameras_json(folder: Path, rotations: list[np.ndarray]) -> list[Camera]:
    lens = {"width": 40, "height": 30, "fx": 30.0, "fy": 30.0}
    entries = [
        {"img_name": f"{index}", "position": [index, 0.0, 0.0], "rotation": rotation.tolist()} | lens
        for index, rotation in enumerate(rotations)
    ]
    (folder / "cameras.json").write_text(json.dumps(entries))
    return [named.camera for named in read_cameras(folder / "cameras.json")]


def camera_path(folder: Path, rotations: list[np.ndarray]) -> list[Camera]:
    frames = []
    for index, rotation in enumerate(rotations):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, (index, 0.0, 0.0)
        frames.append({"camera_to_world": (pose @ FLIP).ravel().tolist(), "fov": 50.0})
    (folder / "path.json").write_text(json.dumps({"render_width": 40, "render_height": 30, "camera_path": frames}))
    return list(read_path(folder / "path.json").cameras)


READERS = [transforms, cameras_json, camera_path]
Reader = Callable[[Path, list[np.ndarray]], list[Camera]]


@pytest.mark.parametrize("read", READERS)
@pytest.mark.parametrize("decimals", [2, 3, 4, 16])
def test_readers_accept_rounded_rotations(tmp_path: Path, read: Reader, decimals: int) -> None:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        cameras = read(tmp_path, [np.round(rotation, decimals) for rotation in ROTATIONS])
    for index, (camera, rotation) in enumerate(zip(cameras, ROTATIONS, strict=True)):
        np.testing.assert_allclose(camera.rotation.T, rotation, atol=2 * 10.0**-decimals)
        np.testing.assert_allclose(camera.rotation @ camera.rotation.T, np.eye(3), atol=2e-5)
        np.testing.assert_allclose(camera.position, [index, 0, 0], atol=1e-3)
    messages = [str(warning.message) for warning in caught]
    assert len(messages) == (1 if decimals <= 3 else 0)
    if messages:
        assert "of 9 rotations are rounded, most of all that of" in messages[0]


@pytest.mark.parametrize("read", READERS)
def test_readers_remove_a_scale_and_say_so(tmp_path: Path, read: Reader) -> None:
    with pytest.warns(UserWarning, match=r"9 of 9 rotations have a scale, for example .*0\]? \(2.5\); it is removed"):
        cameras = read(tmp_path, [2.5 * rotation for rotation in ROTATIONS])
    for index, (camera, rotation) in enumerate(zip(cameras, ROTATIONS, strict=True)):
        np.testing.assert_allclose(camera.rotation.T, rotation, atol=1e-9)
        np.testing.assert_allclose(camera.position, [index, 0, 0], atol=1e-9)


@pytest.mark.parametrize("read", READERS)
@pytest.mark.parametrize("fault", [np.diag([1.0, 1, -1]), np.diag([1.0, 1, 1.2]), np.zeros((3, 3))])
def test_readers_refuse_the_same_matrices(tmp_path: Path, read: Reader, fault: np.ndarray) -> None:
    with pytest.raises(InputError, match=r"(frame |entry |\[)1.*is not a rotation: ") as caught:
        read(tmp_path, [ROTATIONS[0], ROTATIONS[1] @ fault, ROTATIONS[2]])
    assert "\n" not in str(caught.value)
