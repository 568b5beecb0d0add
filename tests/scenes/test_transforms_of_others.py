"""transforms.json as other programs write it: paths from elsewhere, lenses as matrices or angles, other axes."""

from __future__ import annotations

import json
import math
import re
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_scene import CX, CY, FX, FY, HEIGHT, WIDTH, model_views, write_garden

from clsplat.errors import InputError
from clsplat.files.images import write_png
from clsplat.scenes.scene import Scene, load_scene

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
LENS = {"w": WIDTH, "h": HEIGHT, "fl_x": FX, "fl_y": FY, "cx": CX, "cy": CY}
Values = dict[str, Any]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The small scene; its COLMAP model has another name."""
    root = write_garden(tmp_path)
    (root / "sparse").rename(root / "unused")
    return root


def frames(path: str = "images/{}") -> list[Values]:
    return [
        {
            "file_path": path.format(view.name),
            "transform_matrix": (np.linalg.inv(view.cam_from_world) @ FLIP).tolist(),
        }
        for view in model_views()
    ]


def load(folder: Path, values: Values, **options: Any) -> Scene:
    (folder / "transforms.json").write_text(json.dumps(values))
    return load_scene(folder, **options)


@pytest.mark.parametrize(
    ("path", "images"),
    [
        ("./../../data/dtu/images/{}", None),  # relative to the folder of a script
        ("./garden/images/{}", None),  # colmap2nerf.py, and the file was moved into the scene
        ("../elsewhere/{}", None),
        ("./garden/images/{}", "images"),
        ("./uploads\\photos/{}", "images"),
    ],
)
def test_relative_paths_that_begin_elsewhere(folder: Path, path: str, images: str | None) -> None:
    scene = load(folder, LENS | {"frames": frames(path)}, images=images)
    assert scene.names == [f"images/{view.name}" for view in model_views()]


def test_a_path_that_is_there_comes_first(folder: Path) -> None:
    """A photo of the same name in `images` is not taken instead."""
    (folder / "other" / "images").mkdir(parents=True)
    for file in (folder / "images").iterdir():
        (folder / "other" / "images" / file.name).write_bytes(file.read_bytes())
    scene = load(folder, LENS | {"frames": frames("other/images/{}")})
    assert scene.names[0] == f"other/images/{model_views()[0].name}"


def test_photos_of_another_format(folder: Path) -> None:
    """After the object was cut out, say."""
    renamed = [entry | {"file_path": entry["file_path"].replace(".png", ".JPG")} for entry in frames()]
    assert len(load(folder, LENS | {"frames": renamed}).views) == len(model_views())


@pytest.mark.parametrize(("place", "named"), [("garden/pictures", "pictures"), ("resized", "../resized")])
def test_photos_in_another_folder_are_named(folder: Path, place: str, named: str) -> None:
    (folder / "images").rename(folder.parent / place)
    with pytest.raises(InputError, match=rf"or name another folder of photos, such as {re.escape(named)} \("):
        load(folder, LENS | {"frames": frames("{}")})
    assert len(load_scene(folder, images=named).views) == len(model_views())


def test_a_folder_of_renders_is_not_named_for_photos(folder: Path) -> None:
    """Training on them would learn the faults of the model that rendered them."""
    (folder / "images").rename(folder.parent / "kept")
    for view in model_views():
        write_png(folder.parent / "aa_renders" / view.name, np.zeros((30, 40, 3), np.uint8), render=True)
    with pytest.raises(InputError, match=r"or name another folder of photos, such as ../kept \("):
        load(folder, LENS | {"frames": frames("{}")})


def test_axes_of_opencv(folder: Path) -> None:
    poses = [entry | {"transform_matrix": (np.array(entry["transform_matrix"]) @ FLIP).tolist()} for entry in frames()]
    scene, same = load(folder, LENS | {"from_na": True, "frames": poses}), load(folder, LENS | {"frames": frames()})
    for actual, expected in zip(scene.cameras, same.cameras, strict=True):
        np.testing.assert_allclose(actual.cam_from_world, expected.cam_from_world, atol=1e-12)


MATRIX = [[FX, 0.1, CX], [0.0, FY, CY], [0.0, 0.0, 1.0]]


@pytest.mark.parametrize(
    "lens",
    [
        {"K": MATRIX},
        {"intrinsic_matrix": MATRIX},
        {"intrinsic_matrix": [[*row, 0.0] for row in MATRIX] + [[0.0, 0.0, 0.0, 1.0]]},
        {"x_fov": math.degrees(2 * math.atan(WIDTH / 2 / FX)), "y_fov": math.degrees(2 * math.atan(HEIGHT / 2 / FY))}
        | {"cx": CX, "cy": CY},
    ],
)
@pytest.mark.parametrize("of_frame", [False, True])
def test_lenses_in_other_words(folder: Path, lens: Values, of_frame: bool) -> None:
    whole: Values = {"frames": [entry | lens for entry in frames()]} if of_frame else lens | {"frames": frames()}
    for camera in load(folder, whole).cameras:
        np.testing.assert_allclose((camera.fx, camera.fy, camera.cx, camera.cy), (FX, FY, CX, CY), atol=1e-9)


def test_one_angle_of_view_is_enough(folder: Path) -> None:
    camera = load(folder, {"camera_angle_y": 2 * math.atan(HEIGHT / 2 / FY), "frames": frames()}).cameras[0]
    np.testing.assert_allclose((camera.fx, camera.fy), (FY, FY), atol=1e-9)


def test_frames_without_a_photo_are_left_out(folder: Path) -> None:
    path = {"file_path": None, "transform_matrix": np.eye(4).tolist()}
    with pytest.warns(UserWarning, match=r"1 frames have no photo \(file_path null\); they are left out"):
        scene = load(folder, LENS | {"frames": [*frames(), path]})
    assert len(scene.views) == len(model_views())


def test_scenes_that_move_are_named(folder: Path) -> None:
    moving = [entry | {"time": 0.1 * number} for number, entry in enumerate(frames())]
    with pytest.warns(UserWarning, match=r"different times \(time\); what moves will be blurred"):
        load(folder, LENS | {"frames": moving})
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load(folder, LENS | {"frames": [entry | {"time": 0.0} for entry in frames()]})


def test_no_lens_at_all(folder: Path) -> None:
    with pytest.raises(InputError, match="frame 0: has neither fl_x nor camera_angle_x; add the focal length"):
        load(folder, {"frames": frames()})
