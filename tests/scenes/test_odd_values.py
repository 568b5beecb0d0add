"""Odd values in any field of a scene's files: the scene is read, or refused with one line, by all commands alike."""

from __future__ import annotations

import copy
import json
import shutil
import struct
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_runner import run
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st
from small_scene import as_text, cloud, model_views, photo_of

from clsplat.errors import InputError
from clsplat.files.images import write_png
from clsplat.scenes.colmap_binary import write_binary_model
from clsplat.scenes.scene import load_scene

N = 5  # photos
ODD: list[Any] = [float("nan"), float("inf"), -float("inf"), 1e300, -1e300, 1e-300, 10**400, -1, 0, 2.5, True, None]
ODD += ["", "é", "\u202e", "\0", "../x", "/", "a b", [], [[]], [1, "a"], [None] * 4, {}, {"a": 1}]
WORDS = [
    "nan",
    "inf",
    "-inf",
    "1e300",
    "-1e300",
    "1e-300",
    "1" + "0" * 400,
    "é" * 125,
    "-1",
    "0",
    "2.5",
    "",
    "é",
    "x",
    "PINHOLE",
]
REALS = [np.nan, np.inf, -np.inf, 1e300, -1e300, 1e39, 1e-300, 0.0, -1.0]
SETTINGS = settings(max_examples=120, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])


def outcome(root: Path) -> str:
    """Return the error of `load_scene`, or "". Check that the error is one line and that `info` gives no traceback."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        warnings.simplefilter("error", RuntimeWarning)  # such a warning is one of NumPy, not one for a user
        try:
            scene = load_scene(root)
            message = ""
            assert scene.train
            assert np.isfinite(scene.points.xyz).all()
        except InputError as error:
            message = str(error)
    assert "\n" not in message
    assert "Traceback" not in message
    result = run("info", root)
    assert result.exception is None or isinstance(result.exception, SystemExit), repr(result.exception)
    assert result.exit_code in (0, 1)
    assert "Traceback" not in result.output
    lines = [line for line in result.stderr.splitlines() if line.startswith("error: ")]
    assert len(lines) == result.exit_code
    assert bool(message) == bool(result.exit_code), "both read the scene, or both refuse it"
    return message


# --- transforms.json -----------------------------------------------------------------------


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("odd")
    for index, view in enumerate(model_views()[:N]):
        write_png(folder / "images" / view.name, photo_of(index))
        write_png(folder / "masks" / f"{view.name}.png", photo_of(index)[:, :, 1])
    (folder / "points.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
        "0 0 1\n1 1 2\n"
    )
    return folder


def transforms() -> dict[str, Any]:
    flip = np.diag([1.0, -1.0, -1.0, 1.0])
    names = [f"images/{view.name}" for view in model_views()[:N]]
    frames = [
        {
            "file_path": name,
            "transform_matrix": (np.linalg.inv(view.cam_from_world) @ flip).tolist(),
            "mask_path": f"masks/{view.name}.png",
            "fl_x": 33.0,
            "k1": 0.01,
        }
        for name, view in zip(names, model_views(), strict=False)
    ]
    lens = {"w": 40, "h": 30, "fl_y": 31.0, "cx": 20.0, "cy": 15.0, "k2": 0.0, "k3": 0.0, "k4": 0.0, "p1": 0.0}
    more = {"camera_angle_x": 1.0, "camera_angle_y": 0.9, "camera_model": "OPENCV", "is_fisheye": False}
    lists = {"train_filenames": names[:3], "val_filenames": names[3:4], "test_filenames": names[3:]}
    points = {"ply_file_path": "points.ply", "applied_transform": np.eye(4)[:3].tolist(), "applied_scale": 1.0}
    return {**lens, **more, **lists, **points, "frames": frames}


def places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the paths of all values at any depth."""
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, inner in items:
        yield (*path, key)
        yield from places(inner, (*path, key))


PLACES = list(places(transforms()))


@SETTINGS
@given(changes=st.lists(st.tuples(st.sampled_from(PLACES), st.sampled_from(ODD)), min_size=1, max_size=2))
@example(changes=[(("train_filenames",), 0)])
def test_any_value_of_transforms(photos: Path, changes: list[tuple[tuple[Any, ...], Any]]) -> None:
    values = transforms()
    for path, odd in changes:
        inner: Any = values
        for key in path[:-1]:
            # An earlier change may have replaced a list on the way.
            known = key in inner if isinstance(inner, dict) else isinstance(inner, list) and key in range(len(inner))
            inner = inner[key] if known else {}
        if isinstance(inner, dict) or (isinstance(inner, list) and path[-1] in range(len(inner))):
            inner[path[-1]] = copy.deepcopy(odd)
    (photos / "transforms.json").write_text(json.dumps(values))
    message = outcome(photos)
    assert message.startswith(str(photos)) or message.startswith("image ") or not message


# --- COLMAP --------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A scene, and beside it the text files of its model, with rigs and frames."""
    folder = tmp_path_factory.mktemp("odd")
    for index, view in enumerate(model_views()[:N]):
        write_png(folder / "scene" / "images" / view.name, photo_of(index))
    write_binary_model(folder / "binary", model_views()[:N], *cloud())
    as_text(folder / "binary", folder / "text")
    return folder


def put_model(models: Path, source: str, rigs: bool) -> Path:
    target = models / "scene" / "sparse" / "0"
    shutil.rmtree(target, ignore_errors=True)
    target.mkdir(parents=True)
    for file in (models / source).iterdir():
        if rigs or file.stem not in ("rigs", "frames"):
            shutil.copy(file, target)
    return target


@SETTINGS
@given(data=st.data(), rigs=st.booleans())
def test_any_word_of_a_text_model(models: Path, data: st.DataObject, rigs: bool) -> None:
    target = put_model(models, "text", rigs)
    for _ in range(data.draw(st.integers(1, 2))):
        file = data.draw(st.sampled_from(sorted(target.iterdir())))
        lines = file.read_text().splitlines()
        line = data.draw(st.sampled_from([index for index, text in enumerate(lines) if not text.startswith("#")]))
        words = lines[line].split(" ")
        words[data.draw(st.integers(0, min(len(words) - 1, 14)))] = data.draw(st.sampled_from(WORDS))
        lines[line] = " ".join(words)
        file.write_text("\n".join(lines) + "\n")
    outcome(models / "scene")


@SETTINGS
@given(data=st.data())
def test_any_real_of_a_binary_model(models: Path, data: st.DataObject) -> None:
    """Quaternions, translations, parameters of lenses and positions, at their places in the files."""
    target = put_model(models, "binary", rigs=False)
    for _ in range(data.draw(st.integers(1, 3))):
        # Count; then the record up to its first real number, the number of reals, and the size of a record.
        first, reals, size, count = {
            "cameras.bin": (8 + 24, 4, 24 + 32, 1),
            "images.bin": (8 + 4, 7, 4 + 56 + 4 + len("shot_0.png") + 1 + 8 + 8 * 24, N),
            "points3D.bin": (8 + 8, 3, 0, 1),
        }[name := data.draw(st.sampled_from(["cameras.bin", "images.bin", "points3D.bin"]))]
        at = first + size * data.draw(st.integers(0, count - 1)) + 8 * data.draw(st.integers(0, reals - 1))
        content = bytearray((target / name).read_bytes())
        content[at : at + 8] = struct.pack("<d", data.draw(st.sampled_from(REALS)))
        (target / name).write_bytes(content)
    outcome(models / "scene")
