"""Folders one level too high or too low: every command names the scene."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from cli_runner import error_of, run
from small_scene import NAMES, write_garden

from clsplat.errors import InputError
from clsplat.files.images import write_png
from clsplat.scenes.reconstruct.model_scene import plan_scene
from clsplat.scenes.scene import load_scene
from clsplat.scenes.wrong_folder import scene_above, scene_hint, scenes_below


@pytest.fixture
def data(tmp_path: Path) -> Path:
    """A folder with a COLMAP scene, a scene with transforms.json two levels down, and a folder of photos."""
    garden = write_garden(tmp_path / "data")
    frames = [{"file_path": f"shots/{NAMES[0]}", "transform_matrix": np.eye(4).tolist()}]
    other = tmp_path / "data" / "more" / "other"
    (other / "shots").mkdir(parents=True)
    shutil.copy(garden / "images" / NAMES[0], other / "shots")
    (other / "transforms.json").write_text(json.dumps({"fl_x": 30.0, "frames": frames}))
    write_png(tmp_path / "data" / "loose" / "a.png", np.zeros((4, 4, 3)))
    return tmp_path / "data"


COMMANDS = {
    "train": ("train", "{}", "-m", "OUT"),
    "info": ("info", "{}"),
    "compare": ("compare", "{}", "-o", "OUT"),
    "reconstruct": ("reconstruct", "{}", "-o", "OUT"),
}


def refusal(command: str, path: Path, out: Path) -> str:
    arguments = [path if part == "{}" else out if part == "OUT" else part for part in COMMANDS[command]]
    message = error_of(*arguments)
    assert not out.exists() or not any(out.rglob("*.ply"))
    return message


@pytest.mark.parametrize("command", COMMANDS)
def test_the_folder_above_scenes(data: Path, tmp_path: Path, command: str) -> None:
    message = refusal(command, data, tmp_path / "out")
    assert "the subfolders garden, more/other are scenes: give one of them, such as " in message
    shutil.rmtree(data / "more")
    assert "the subfolder garden is a scene: give " in refusal(command, data, tmp_path / "out")


@pytest.mark.parametrize("below", ["sfm", "work/distorted"])
def test_a_model_in_a_subfolder_beside_its_photos(data: Path, tmp_path: Path, below: str) -> None:
    garden = data / "garden"
    (garden / below).mkdir(parents=True)
    (garden / "sparse").rename(garden / below / "sparse")
    photos = "../" * len(Path(below).parts) + "images"
    message = refusal("info", garden, tmp_path / "out")
    assert message.endswith(f"is a scene: give {garden / below}, and its folder of photos: {photos}")
    assert run("info", garden / below, "-i", photos).exit_code == 0


@pytest.mark.parametrize("name", ["colmap/sparse", "colmap_sparse", "colmap_text"])
def test_models_in_folders_of_other_names(data: Path, name: str) -> None:
    """Those of nerfstudio and of instant-ngp."""
    garden = data / "garden"
    expected = load_scene(garden)
    (garden / name).parent.mkdir(parents=True, exist_ok=True)
    (garden / "sparse").rename(garden / name)
    found = load_scene(garden)
    assert found.names == expected.names
    assert len(found.points) == len(expected.points)
    assert run("info", garden).exit_code == 0


@pytest.mark.parametrize("photos", ["images", "input", "."])
@pytest.mark.parametrize("model", ["sfm", "glomap/0", "work/distorted/sparse/0"])
def test_photos_are_not_reconstructed_beside_a_model(data: Path, tmp_path: Path, photos: str, model: str) -> None:
    """The message names the two folders, and they are read together."""
    garden = data / "garden"
    for file in (garden / "images").iterdir():
        (garden / photos).mkdir(exist_ok=True)
        file.rename(garden / photos / file.name)
    (garden / model).parent.mkdir(parents=True, exist_ok=True)
    (garden / "sparse" / "0").rename(garden / model)
    shutil.rmtree(garden / "sparse")
    if photos != "images":
        shutil.rmtree(garden / "images")
    message = error_of("train", garden, "-m", tmp_path / "out")
    found = re.search(r"give (\S+), and its folder of photos: (\S+), or find new poses with clsplat recon", message)
    assert found, message
    assert load_scene(found[1], images=found[2]).names == NAMES


def test_a_model_without_photos_beside_it_has_them_named(data: Path, tmp_path: Path) -> None:
    (data / "garden" / "sparse" / "0").rename(tmp_path / "model")
    (data / "garden" / "images").rename(tmp_path / "pictures")
    assert load_scene(tmp_path / "model", images="../pictures").names == NAMES
    with pytest.raises(InputError, match="there is no such folder of photos; put the photos there, or name their"):
        load_scene(tmp_path / "model")
    message = error_of("info", next((tmp_path / "model").glob("cameras.*")))
    assert message.endswith("is a file of a COLMAP model; give the folder of the scene")


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("sfm_data.json", "OpenMVG; export it as a COLMAP model (openMVG_main_openMVG2Colmap)"),
        ("poses_bounds.npy", "LLFF; give its COLMAP model, or find the poses again with clsplat reconstruct"),
        ("a.nvm", "VisualSFM; export it as a COLMAP model"),
    ],
)
def test_reconstructions_of_other_programs(data: Path, tmp_path: Path, name: str, said: str) -> None:
    file = data / "loose" / name
    file.write_text("{}")
    assert error_of("info", file).endswith(f"is a reconstruction of {said}")
    with pytest.warns(UserWarning, match=re.escape(f"{file}: is a reconstruction of {said}")):
        plan_scene(data / "loose", tmp_path / "out")


def test_the_cameras_of_a_model_are_no_scene(tmp_path: Path) -> None:
    file = tmp_path / "cameras.json"
    file.write_text(json.dumps([{"id": 0, "img_name": "a", "position": [0, 0, 0]}]))
    assert "cameras.json: has the cameras of a model, without a scene; give the scene's folder" in error_of(
        "info", file
    )


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("part", ["sparse", "sparse/0"])
def test_the_folder_of_a_colmap_model(data: Path, tmp_path: Path, command: str, part: str) -> None:
    message = refusal(command, data / "garden" / part, tmp_path / "out")
    assert message.endswith(f"{part}: is a part of the scene {data / 'garden'}: give that folder")


@pytest.mark.parametrize("command", ["train", "info", "compare"])
@pytest.mark.parametrize("part", ["garden/images", "more/other/shots"])
def test_the_photos_of_a_scene(data: Path, tmp_path: Path, command: str, part: str) -> None:
    """The command `reconstruct` may find new poses for them."""
    message = refusal(command, data / part, tmp_path / "out")
    assert str((data / part).parent) in message.partition(str(data / part))[2].partition(str(data / part))[0]
    assert "give that folder" in message


def test_folders_that_have_no_scene_to_name(data: Path) -> None:
    assert scene_above(data / "loose") is None
    assert scene_hint(data / "loose") is None
    write_png(data / "garden" / "drafts" / "z.png", np.zeros((4, 4, 3)))
    assert scene_above(data / "garden" / "drafts") is None, "the scene has no photo there"
    assert scenes_below(data) == ["garden", "more/other"]
    (data / "garden" / "sparse" / "0" / "images.bin").write_bytes(b"damaged")
    assert scene_above(data / "garden" / "images") is None


def test_relative_paths_stay_relative(data: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(data)
    assert scene_above(Path("garden/images")) == Path("garden")
    monkeypatch.chdir(data / "garden" / "images")
    assert scene_above(Path()) == data / "garden"


@pytest.mark.parametrize(
    ("name", "remedy"),
    [
        ("a.jpg", "is one photo; give the folder of the photos"),
        ("points.ply", "is a model or a point cloud, not a scene; give the scene's folder"),
        (
            "cameras.csv",
            "is a table, which says too little about lenses; export the cameras of RealityScan as a COLMAP",
        ),
        ("notes.txt", "is not a scene; give a folder with photos, a video, a transforms.json, an OPF project"),
    ],
)
def test_files_that_are_not_scenes(tmp_path: Path, name: str, remedy: str) -> None:
    (tmp_path / name).write_bytes(b"something")
    for command in ("train", "compare"):
        assert f"{name}: {remedy}" in refusal(command, tmp_path / name, tmp_path / "out")
    if name != "points.ply":
        assert f"{name}: {remedy}" in error_of("info", tmp_path / name)
    assert f"{name}: is a file; give a folder" in refusal("reconstruct", tmp_path / name, tmp_path / "out")
