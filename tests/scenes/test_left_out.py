"""Photos with poses that are missing or cannot be read: every format names them, leaves them out, and splits alike."""

from __future__ import annotations

import json
import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from cli_runner import clsplat, error_of, run
from small_scene import FX, NAMES, as_text, model_views, photo_of, write_garden

from clsplat.errors import InputError
from clsplat.files.digest import file_digest
from clsplat.files.image_names import READS_HEIC
from clsplat.files.images import image_size, is_render, write_png
from clsplat.models.model import load_model
from clsplat.scenes.info import scene_info
from clsplat.scenes.point_cloud import read_point_cloud
from clsplat.scenes.posed_images import MIN_USABLE
from clsplat.scenes.scene import load_scene

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])


def write_frames(folder: Path, name: str, files: list[str], lens: dict[str, float]) -> None:
    """Write a transforms file with the poses of the small scene's photos."""
    poses = {view.name[:6]: (np.linalg.inv(view.cam_from_world) @ FLIP).tolist() for view in model_views()}
    frames = [{"file_path": file, "transform_matrix": poses[Path(file).stem]} for file in files]
    (folder / name).write_text(json.dumps(lens | {"frames": frames}))


def colmap(parent: Path) -> Path:
    return write_garden(parent)


def colmap_text(parent: Path) -> Path:
    root = write_garden(parent)
    as_text(root / "sparse" / "0", root / "text")
    for file in (root / "sparse" / "0").iterdir():
        file.unlink()
    for file in (root / "text").iterdir():
        file.rename(root / "sparse" / "0" / file.name)
    return root


def photos(parent: Path) -> Path:
    for index, name in enumerate(NAMES):
        write_png(parent / "garden" / "images" / name, photo_of(index))
    return parent / "garden"


def nerfstudio(parent: Path) -> Path:
    root = photos(parent)
    write_frames(root, "transforms.json", [f"images/{name}" for name in NAMES], {"w": 40, "h": 30, "fl_x": FX})
    return root


def instant_ngp(parent: Path) -> Path:
    """Without sizes, which are then those of the photos."""
    root = photos(parent)
    write_frames(root, "transforms.json", [f"./images/{name[:-4]}" for name in NAMES], {"camera_angle_x": 1.0})
    return root


def blender(parent: Path) -> Path:
    root = photos(parent)
    write_frames(root, "transforms_train.json", [f"./images/{name[:-4]}" for name in NAMES[:6]], {"camera_angle_x": 1})
    write_frames(root, "transforms_test.json", [f"./images/{name[:-4]}" for name in NAMES[6:]], {"camera_angle_x": 1})
    return root


FORMATS = [colmap, colmap_text, nerfstudio, instant_ngp, blender]


def bomb(file: Path) -> None:
    """Write a PNG whose header promises 60 000 x 60 000 pixels."""
    header = struct.pack(">IIBBBBB", 60_000, 60_000, 8, 2, 0, 0, 0)
    chunk = struct.pack(">I", len(header)) + b"IHDR" + header + struct.pack(">I", zlib.crc32(b"IHDR" + header))
    file.write_bytes(b"\x89PNG\r\n\x1a\n" + chunk)


def heic(file: Path) -> None:
    file.write_bytes(struct.pack(">I", 24) + b"ftypheic" + bytes(500))


def folder_instead(file: Path) -> None:
    file.unlink()
    file.mkdir()


def pipe(file: Path) -> None:
    file.unlink()
    os.mkfifo(file)


def dangling(file: Path) -> None:
    file.unlink()
    file.symlink_to(file.with_name("nowhere.png"))


FAULTS: dict[str, Callable[[Path], object]] = {
    "missing": Path.unlink,
    "empty": lambda file: file.write_bytes(b""),
    "text": lambda file: file.write_text("no photo"),
    "heic": heic,
    "cut": lambda file: file.write_bytes(file.read_bytes()[:60]),
    "bomb": bomb,
    "pipe": pipe,
    "folder": folder_instead,
    "dangling": dangling,
}


@pytest.mark.parametrize("fault", FAULTS)
@pytest.mark.parametrize("make", FORMATS)
def test_a_photo_that_cannot_be_used_is_left_out(tmp_path: Path, make: Callable[[Path], Path], fault: str) -> None:
    root = make(tmp_path)
    whole = load_scene(root)
    (name,) = (name for name in whole.names if name.endswith(NAMES[3]))
    FAULTS[fault](root / "images" / NAMES[3])
    with pytest.warns(UserWarning, match=rf"garden: 1 of 9 photos are left out \(12 %\): .*{NAMES[3]}") as caught:
        scene = load_scene(root)
    assert len(caught) == 1
    assert "\n" not in str(caught[0].message)
    assert list(scene.left_out) == [name]
    assert [view.name for view in scene.train] == [view.name for view in whole.train if view.name != name]
    assert [view.name for view in scene.test] == [view.name for view in whole.test]
    info = scene_info(root)
    assert info.photos == 9
    assert set(info.test) == {view.name for view in scene.test}
    assert list(info.left_out) == ([] if fault == "cut" else [name]), "info decodes no pixels"


@pytest.mark.parametrize("make", FORMATS)
def test_no_other_photo_changes_sides(tmp_path: Path, make: Callable[[Path], Path]) -> None:
    """The split is that of all names with poses. A split of the remaining names would move training photos."""
    root = make(tmp_path)
    whole = load_scene(root, test_every=3)
    held_out = {view.name for view in whole.test}
    for index in (0, 4):
        (root / "images" / NAMES[index]).unlink()
    with pytest.warns(UserWarning, match="2 of 9 photos are left out"):
        scene = load_scene(root, test_every=3)
    assert {view.name for view in scene.test} == {name for name in scene.names if name in held_out}
    assert scene.test_names == whole.test_names, "the record of the split keeps the names of missing photos"
    listed = scene_info(root, test_every=3)
    assert set(listed.test) == {view.name for view in scene.test}


@pytest.mark.parametrize("make", FORMATS)
def test_too_few_photos_are_refused(tmp_path: Path, make: Callable[[Path], Path]) -> None:
    assert MIN_USABLE == 0.25
    root = make(tmp_path)
    for name in NAMES[1:7]:
        (root / "images" / name).unlink()
    with pytest.warns(UserWarning, match=r"6 of 9 photos are left out \(67 %\)"):
        assert len(load_scene(root, eval=False).views) == 3
    (root / "images" / NAMES[0]).write_bytes(b"")
    with pytest.raises(InputError, match=r"only 2 of its 9 photos can be used, at least 3 must be; .*\.png.*\)$"):
        load_scene(root, eval=False)
    assert "only 2 of its 9 photos can be used" in error_of("info", root)
    for name in NAMES:
        (root / "images" / name).unlink(missing_ok=True)
    assert "none of its 9 photos can be used" in error_of("info", root)
    assert "none of its 9 photos can be used" in error_of("train", root, "-m", tmp_path / "m")


def test_photos_damaged_below_the_header_count(tmp_path: Path) -> None:
    root = colmap(tmp_path)
    for name in NAMES[:7]:
        FAULTS["cut"](root / "images" / name)
    with pytest.raises(InputError, match="only 2 of its 9 photos can be used"):
        load_scene(root)


def test_training_views_must_be_left(tmp_path: Path) -> None:
    root = blender(tmp_path)
    for name in NAMES[:6]:
        (root / "images" / name).unlink()
    with pytest.raises(InputError, match="no training view is left: all 3 photos that can be used are test views"):
        load_scene(root)


def test_info_names_them_with_their_share(tmp_path: Path) -> None:
    root = instant_ngp(tmp_path)
    (root / "images" / NAMES[2]).unlink()
    heic(root / "images" / NAMES[4])
    output = clsplat("info", root)
    assert "9 photos with poses" in output
    assert f"left out        2 (images/{NAMES[2]}, images/{NAMES[4]}), 23 %" in output
    assert f"{NAMES[2]}: no such image file" in output
    reason = (
        "cannot be read as an image" if READS_HEIC else "is a HEIC image: pip install 'clsplat[heic]', or convert it"
    )
    assert f"{NAMES[4]}: {reason}" in output
    assert "5 remain for training" in output
    entry = json.loads(clsplat("info", "--json", root))
    assert list(entry["left_out"]) == [f"images/{NAMES[2]}", f"images/{NAMES[4]}"]


def test_cameras_of_a_scene_are_exported_without_them(tmp_path: Path) -> None:
    root = colmap(tmp_path)
    (root / "images" / NAMES[5]).unlink()
    result = run("cameras", root, tmp_path / "transforms.json")
    assert (result.exit_code, result.stderr.count("\n")) == (0, 1)
    assert "warning: " in result.stderr
    assert "1 of 9 photos are left out" in result.stderr
    assert "8 cameras" in result.stdout


def test_pipes_and_folders_are_not_opened(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.png")
    (tmp_path / "folder.png").mkdir()
    with pytest.raises(InputError, match=r"pipe\.png: is not a regular file, not an image"):
        image_size(tmp_path / "pipe.png")
    with pytest.raises(InputError, match=r"folder\.png: is a folder, not an image"):
        image_size(tmp_path / "folder.png")
    assert not is_render(tmp_path / "pipe.png")
    assert file_digest(tmp_path / "pipe.png") == file_digest(tmp_path / "folder.png")
    with pytest.raises(InputError, match=r"pipe\.png: is not a regular file"):
        read_point_cloud(tmp_path / "pipe.png")


def test_a_model_keeps_its_split(tmp_path: Path) -> None:
    """A photo that is removed after training leaves the other views on their sides."""
    root, model = instant_ngp(tmp_path), tmp_path / "model"
    clsplat("train", root, "-m", model, "--eval", "--iterations", "2", "--cap-max", "20", "-q")
    before = load_model(model).load_scene()
    (root / "images" / NAMES[0]).unlink()
    (root / "images" / NAMES[1]).unlink()
    with pytest.warns(UserWarning, match="2 of 9 photos are left out"):
        after = load_model(model).load_scene()
    assert [view.name for view in after.test] == [view.name for view in before.test[1:]]
    assert [view.name for view in after.train] == [view.name for view in before.train[1:]]
    assert "2 of 9 photos are left out" in run("eval", model, "--no-report").stderr
    assert list(json.loads((model / "per_view.json").read_text())["ours_2"]["PSNR"]) == [f"images/{NAMES[8]}"]
    (root / "images" / NAMES[8]).unlink()
    message = run("eval", model, "--no-report").stderr
    assert "none of its 2 test photos can be used" in message
