"""transforms.json of NeRF, instant-ngp and nerfstudio: poses, lenses, splits, points, and refused files."""

from __future__ import annotations

import json
import shutil
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from cli_runner import error_of
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scenes_data import scene_folder
from small_scene import CX, CY, FX, FY, HEIGHT, NAMES, WIDTH, cloud, model_views, photo_of, write_garden

from clsplat.errors import InputError
from clsplat.files.images import write_png
from clsplat.scenes.nerfstudio import read_transforms
from clsplat.scenes.scene import load_scene

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
Values = dict[str, Any]


def opengl(pose: np.ndarray) -> list[list[float]]:
    """Return a world-to-camera pose as camera-to-world with y up and z backwards."""
    return (np.linalg.inv(pose) @ FLIP).tolist()


def frames(folder: str = "images/") -> list[Values]:
    return [
        {"file_path": folder + view.name, "transform_matrix": opengl(view.cam_from_world)} for view in model_views()
    ]


LENS = {"w": WIDTH, "h": HEIGHT, "fl_x": FX, "fl_y": FY, "cx": CX, "cy": CY}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """The small scene without its COLMAP model."""
    root = write_garden(tmp_path)
    shutil.rmtree(root / "sparse")
    return root


def write(folder: Path, values: Values, name: str = "transforms.json") -> Path:
    file = folder / name
    file.write_text(json.dumps(values))
    return file


def test_poses_and_lens_are_those_of_colmap(folder: Path, tmp_path: Path) -> None:
    write(folder, LENS | {"frames": frames()[::-1]})
    scene, other = load_scene(folder), load_scene(write_garden(tmp_path / "other"))
    assert scene.names == [f"images/{name}" for name in other.names]
    assert scene.name == "garden"
    for actual, expected in zip(scene.views, other.views, strict=True):
        np.testing.assert_allclose(actual.camera.cam_from_world, expected.camera.cam_from_world, atol=1e-12)
        assert vars(actual.camera).keys() == vars(expected.camera).keys()
        assert (actual.camera.fx, actual.camera.fy, actual.camera.cx, actual.camera.cy) == (FX, FY, CX, CY)
        np.testing.assert_array_equal(actual.image, expected.image)
    assert scene.test_names == {f"images/{NAMES[0]}", f"images/{NAMES[8]}"}, "every 8th"
    assert len(scene.points) == 0


def test_a_file_can_be_named_and_a_folder_prefers_colmap(folder: Path, tmp_path: Path) -> None:
    both = write_garden(tmp_path / "other")
    file = write(both, LENS | {"frames": frames()[:4]})
    assert len(load_scene(both).views) == len(NAMES), "COLMAP's"
    named = load_scene(file)
    assert (named.name, len(named.views), named.path) == ("garden", 4, file)


def test_the_lens_of_a_frame_takes_precedence(folder: Path) -> None:
    changed_frames = frames()
    changed_frames[2] |= {"fl_x": 50.0, "fl_y": 60.0, "cx": 10.0, "cy": 11.0}
    views = load_scene(write(folder, LENS | {"frames": changed_frames})).views
    assert (views[2].camera.fx, views[2].camera.fy, views[2].camera.cx, views[2].camera.cy) == (50, 60, 10, 11)
    assert views[3].camera.fx == FX


@pytest.mark.parametrize("in_frames", [False, True])
def test_angles_of_view_of_both_axes(folder: Path, in_frames: bool) -> None:
    """Pixels may be other than square: then each axis has its own angle."""
    angles = {"camera_angle_x": 1.0, "camera_angle_y": 0.5}
    size = {"w": WIDTH, "h": HEIGHT}
    if in_frames:
        values = size | {"camera_angle_y": 3.0, "frames": [frame | angles for frame in frames()]}
    else:
        values = size | angles | {"frames": frames()}
    camera = load_scene(write(folder, values)).views[0].camera
    assert camera.fx == pytest.approx(WIDTH / 2 / np.tan(0.5), rel=1e-12)
    assert camera.fy == pytest.approx(HEIGHT / 2 / np.tan(0.25), rel=1e-12)
    of_a_frame = size | {"fl_x": FX, "fl_y": FY, "frames": [frame | angles for frame in frames()]}
    camera = load_scene(write(folder, of_a_frame)).views[0].camera
    assert (camera.fx, camera.fy) == pytest.approx((WIDTH / 2 / np.tan(0.5), HEIGHT / 2 / np.tan(0.25)), rel=1e-12)
    one_angle = size | {"fl_x": FX, "fl_y": FY, "frames": [frame | {"camera_angle_x": 1.0} for frame in frames()]}
    camera = load_scene(write(folder, one_angle)).views[0].camera
    assert camera.fx == camera.fy == pytest.approx(WIDTH / 2 / np.tan(0.5), rel=1e-12), "pixels are square"
    mixed = size | {"fl_x": FX, "camera_angle_y": 0.5, "frames": frames()}
    camera = load_scene(write(folder, mixed)).views[0].camera
    assert (camera.fx, camera.fy) == (FX, pytest.approx(HEIGHT / 2 / np.tan(0.25), rel=1e-12))


def test_lens_is_scaled_to_reduced_photos(folder: Path) -> None:
    for index, name in enumerate(NAMES):
        write_png(folder / "images_2" / name, photo_of(index, WIDTH // 2, HEIGHT // 2))
    write(folder, LENS | {"frames": frames()})
    camera = load_scene(folder, images="images_2").views[0].camera
    assert (camera.width, camera.height, camera.fx, camera.cx) == (WIDTH // 2, HEIGHT // 2, FX / 2, CX / 2)


def test_photos_are_undistorted(folder: Path) -> None:
    """The result is that of the same lens in a COLMAP model."""
    import pycolmap

    from clsplat.scenes.undistort import RegisteredImage

    scene = load_scene(write(folder, LENS | {"k1": 0.1, "p2": 0.01, "frames": frames()}))
    lens = pycolmap.Camera(model="OPENCV", width=WIDTH, height=HEIGHT, params=[FX, FY, CX, CY, 0.1, 0, 0, 0.01])
    image, camera = RegisteredImage("a", np.eye(4), lens).fit(photo_of(0))
    assert scene.views[0].camera.fx == pytest.approx(camera.fx)
    np.testing.assert_array_equal(scene.views[0].image, image)
    listed = {"distortion_params": [0.1, 0, 0, 0, 0, 0.01], "k1": 0.9, "frames": frames()}
    np.testing.assert_array_equal(load_scene(write(folder, LENS | listed)).views[0].image, image)
    fisheye = load_scene(write(folder, LENS | {"camera_model": "OPENCV_FISHEYE", "k1": 0.1, "frames": frames()}))
    assert fisheye.views[0].image.shape != (HEIGHT, WIDTH, 3) or (fisheye.views[0].image != photo_of(0)).any()


def blender_set(folder: Path) -> Path:
    """Write transparent photos in train/ and test/, with one angle of view and without suffixes and sizes."""
    photo = np.zeros((8, 12, 4), np.uint8)
    photo[:, :6] = (200, 100, 0, 128)
    for name, every in (("train", 1), ("test", 3)):
        chosen = model_views()[::every]
        for view in chosen:
            write_png(folder / name / f"{view.name[:-4]}.png", photo)
        entries = [
            {
                "file_path": f"./{name}/{view.name[:-4]}",
                "rotation": 0.1,
                "transform_matrix": opengl(view.cam_from_world),
            }
            for view in chosen
        ]
        write(folder, {"camera_angle_x": 0.7, "frames": entries}, f"transforms_{name}.json")
    return folder


def test_blender_set(tmp_path: Path) -> None:
    folder = blender_set(tmp_path)
    scene = load_scene(folder, background=(1.0, 1.0, 1.0))
    assert len(scene.train) == 9
    assert sorted(view.name for view in scene.test) == ["test/shot_0.png", "test/shot_3.png", "test/shot_6.png"]
    camera = scene.views[0].camera
    assert camera.fx == camera.fy == pytest.approx(6 / np.tan(0.35))
    assert (camera.width, camera.height, camera.cx, camera.cy) == (12, 8, 6, 4)
    np.testing.assert_array_equal(scene.views[0].image[0, 0], [227, 177, 127])
    np.testing.assert_array_equal(scene.views[0].image[0, 11], [255, 255, 255])
    assert len(load_scene(folder, eval=False).train) == 12
    assert load_scene(folder / "transforms_train.json").test_names == scene.test_names


def test_a_choice_of_every_nth_view_has_no_effect_beside_named_test_views(folder: Path) -> None:
    frames_of_test = {"test_frames": frames()[6:]}
    write(folder, LENS | frames_of_test | {"frames": frames()[:6]})
    with pytest.warns(UserWarning, match="test_every 3 has no effect: the scene's files name its test views"):
        scene = load_scene(folder, test_every=3)
    assert scene.test_names == {f"images/{name}" for name in NAMES[6:]}


def test_test_views_without_photos_are_left_out(tmp_path: Path) -> None:
    """BlenderNeRF writes poses of test views whose photos the user has yet to render, and maybe no such pose."""
    folder = blender_set(tmp_path)
    test = json.loads((folder / "transforms_test.json").read_text())
    shutil.rmtree(folder / "test")
    many = [test["frames"][0] | {"file_path": f"./test/{number}"} for number in range(60)]
    write(folder, test | {"frames": many}, "transforms_test.json")
    with pytest.warns(UserWarning, match="60 of 69 photos are left out"):
        scene = load_scene(folder)
    assert (len(scene.train), len(scene.test)) == (9, 0)
    write(folder, test | {"frames": []}, "transforms_test.json")
    assert (len(load_scene(folder).train), len(load_scene(folder).test)) == (9, 0)
    write(folder, test | {"frames": []}, "transforms_train.json")
    with pytest.raises(InputError, match=r"transforms_train\.json: has no list 'frames'"):
        load_scene(folder)


def test_test_frames_of_scannetpp(folder: Path) -> None:
    """They are held out. A mask is looked up only if masks are wanted, and none is in the folder of masks."""
    every = [frame | {"mask_path": Path(frame["file_path"]).with_suffix(".png").name} for frame in frames()]
    write(folder, LENS | {"frames": every[:6], "test_frames": every[6:]})
    scene = load_scene(folder, masks="none")
    assert scene.test_names == {f"images/{name}" for name in NAMES[6:]}
    assert len(scene.train) == 6
    with pytest.raises(InputError, match=r"frame 0: mask_path '.*' is not a file"):
        load_scene(folder)
    for name in NAMES:
        write_png(folder / "masks" / "images" / f"{name}.png", np.full((HEIGHT, WIDTH), 255, np.uint8))
    assert len(load_scene(folder).views) == len(NAMES)
    write(folder, LENS | {"frames": every[:6], "test_frames": 3})
    with pytest.raises(InputError, match="has no list 'frames'"):
        load_scene(folder)
    write(folder, LENS | {"frames": every[:6], "test_frames": [{}]})
    with pytest.raises(InputError, match="test frame 0: has no file_path"):
        load_scene(folder)


@pytest.mark.parametrize("value", [float("-inf"), float("nan")])
def test_a_frame_without_a_finite_pose_is_left_out(folder: Path, value: float) -> None:
    """ScanNet has such poses where tracking failed."""
    all_frames = frames()
    all_frames[3] = all_frames[3] | {"transform_matrix": np.full((4, 4), value).tolist()}
    write(folder, LENS | {"frames": all_frames})
    with pytest.warns(UserWarning, match="1 of 9 photos are left out .*frame 3: its transform_matrix is not finite"):
        scene = load_scene(folder)
    assert scene.names == [f"images/{name}" for index, name in enumerate(NAMES) if index != 3]
    write(
        folder, LENS | {"frames": [frame | {"transform_matrix": np.full((4, 4), value).tolist()} for frame in frames()]}
    )
    with pytest.raises(InputError, match="none of its 9 photos can be used"):
        load_scene(folder)


def test_lists_of_nerfstudio_split(folder: Path) -> None:
    names = [f"images/{name}" for name in NAMES]
    lists = {"train_filenames": names[:5], "val_filenames": names[5:6], "test_filenames": names[6:8]}
    scene = load_scene(write(folder, LENS | lists | {"frames": frames()}))
    assert scene.test_names == set(names[6:8])
    assert scene.names == names[:8], "the last is in no list"
    del lists["test_filenames"]
    assert load_scene(write(folder, LENS | lists | {"frames": frames()})).test_names == set(names[5:6])


@pytest.mark.parametrize("key", ["train_filenames", "val_filenames", "test_filenames"])
def test_lists_that_match_no_frame_are_named(folder: Path, key: str) -> None:
    names = [f"images/{name}" for name in NAMES]
    lists = {"train_filenames": names[:5], "test_filenames": names[5:], key: ["images/x.jpg", "images/y.jpg"]}
    file = write(folder, LENS | lists | {"frames": frames()})
    expected = f"{file}: {key} names no photo of a frame, for example 'images/x.jpg'; name photos such as '{names[0]}'"
    assert expected in error_of("info", file)
    assert expected in error_of("train", file, "-m", folder / "m")


def test_listed_names_without_a_frame_are_left_out(folder: Path) -> None:
    lists = {"train_filenames": [f"images/{NAMES[0]}", "images/x.jpg"], "test_filenames": [f"./images/{NAMES[1]}"]}
    with pytest.warns(UserWarning, match=r"train_filenames names 1 of 2 photos that have no frame.*'images/x\.jpg'"):
        scene = load_scene(write(folder, LENS | lists | {"frames": frames()}))
    assert (len(scene.train), len(scene.test)) == (1, 1)


def test_points_of_a_ply(folder: Path) -> None:
    xyz, rgb = cloud()
    header = "\n".join(
        [
            "ply",
            "format ascii 1.0",
            f"element vertex {len(xyz)}",
            *(f"property float {name}" for name in "xyz"),
            *(f"property uchar {name}" for name in ("red", "green", "blue")),
            "end_header\n",
        ]
    )
    rows = [" ".join(map(str, (*map(float, at), *map(int, colour)))) for at, colour in zip(xyz, rgb, strict=True)]
    (folder / "cloud.ply").write_text(header + "\n".join(rows) + "\n")
    points = load_scene(write(folder, LENS | {"ply_file_path": "cloud.ply", "frames": frames()})).points
    np.testing.assert_allclose(points.xyz, xyz, rtol=1e-6)
    np.testing.assert_array_equal(points.rgb, rgb)


@pytest.mark.parametrize(("kind", "factor"), [("float", 1 / 255), ("float", 1), ("ushort", 257), ("ushort", 1)])
def test_colours_of_points_have_any_type(folder: Path, kind: str, factor: float) -> None:
    """Reals end at 1 or 255, and 16-bit numbers at 65535 or 255."""
    xyz, rgb = cloud()
    kinds = [("float", name) for name in "xyz"] + [(kind, name) for name in ("red", "green", "blue")]
    header = "\n".join(
        [
            "ply",
            "format ascii 1.0",
            f"element vertex {len(xyz)}",
            *(f"property {each} {name}" for each, name in kinds),
            "end_header\n",
        ]
    )
    number = float if kind == "float" else round
    rows = [
        " ".join(map(str, (*map(float, at), *(number(factor * int(part)) for part in color))))
        for at, color in zip(xyz, rgb, strict=True)
    ]
    (folder / "cloud.ply").write_text(header + "\n".join(rows) + "\n")
    points = load_scene(write(folder, LENS | {"ply_file_path": "cloud.ply", "frames": frames()})).points
    np.testing.assert_array_equal(points.rgb, rgb)


@pytest.mark.parametrize("names", [("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b")])
def test_colours_of_points_may_have_other_names(folder: Path, names: tuple[str, ...]) -> None:
    xyz, rgb = cloud()
    properties = [*(f"property float {name}" for name in "xyz"), *(f"property uchar {name}" for name in names)]
    header = "\n".join(["ply", "format ascii 1.0", f"element vertex {len(xyz)}", *properties, "end_header\n"])
    rows = [" ".join(map(str, (*map(float, at), *map(int, color)))) for at, color in zip(xyz, rgb, strict=True)]
    (folder / "cloud.ply").write_text(header + "\n".join(rows) + "\n")
    points = load_scene(write(folder, LENS | {"ply_file_path": "cloud.ply", "frames": frames()})).points
    np.testing.assert_array_equal(points.rgb, rgb)


def test_points_of_the_model_behind_the_poses_are_transformed(folder: Path, tmp_path: Path) -> None:
    shutil.move(write_garden(tmp_path / "other") / "sparse", folder / "colmap" / "sparse")
    moved = [[0, 1, 0, 1], [-1, 0, 0, 2], [0, 0, 1, 3]]
    write(folder, LENS | {"applied_transform": moved, "applied_scale": 0.5, "frames": frames()})
    xyz, matrix = cloud()[0], np.array(moved, float)
    np.testing.assert_allclose(load_scene(folder).points.xyz, 0.5 * (xyz @ matrix[:, :3].T + matrix[:, 3]), atol=1e-12)


def test_missing_photos_are_named_and_left_out(folder: Path) -> None:
    (folder / "images" / NAMES[3]).unlink()
    write(folder, LENS | {"frames": frames()})
    with pytest.warns(UserWarning, match=rf"1 of 9 photos are left out \(12 %\): .*images/{NAMES[3]}: no such"):
        assert len(load_scene(folder).views) == 8
    (folder / "images").rename(folder / "pictures")
    with pytest.raises(InputError, match="none of its 9 photos can be used"):
        load_scene(write(folder, LENS | {"frames": frames("nowhere/")}))


def changed(**values: Any) -> Callable[[Values], Values]:
    return lambda whole: whole | values


def in_frame(**values: Any) -> Callable[[Values], Values]:
    return lambda whole: whole | {"frames": [whole["frames"][0], whole["frames"][1] | values, *whole["frames"][2:]]}


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (changed(frames=[]), "has no list 'frames'"),
        (changed(frames=[3]), "frame 0: has no file_path"),
        (changed(fl_x=None, fl_y=None), "has neither fl_x nor camera_angle_x"),
        (changed(fl_x=-3), "fl_x is -3; it must be above 0"),
        (changed(fl_x=10**400), "it must be a number"),
        (changed(w=1e9), "w x h is 1000000000 x 30"),
        (changed(test_filenames=True), "is not a list of photos"),
        (changed(fl_x="wide"), "fl_x is 'wide'; it must be a number"),
        (changed(fl_x=None, fl_y=None, camera_angle_x=4.0), "camera_angle_x is 4; an angle of view is below pi"),
        (changed(w=0), "w x h is 0 x 30"),
        (changed(k4=0.1), "k4 of a perspective lens"),
        (changed(k6=-0.1), "k6 of a perspective lens"),
        (changed(distortion_params=[0, 0, 0, 0.1, 0, 0]), "k4 of a perspective lens"),
        (changed(distortion_params=[0.1, 0.2]), "distortion_params is .* the numbers k1, k2, k3, k4, p1, p2"),
        (changed(distortion_params=[0.1, 0, 0, 0, 0, "a"]), "distortion_params is"),
        (changed(distortion_params=0.1), "distortion_params is '0.1'"),
        (changed(latlong=True), "frame 0: latlong has no pinhole image; make perspective views first"),
        (in_frame(equirectangular=True), "frame 1: equirectangular has no pinhole image"),
        (changed(ftheta_p0=0.2), "ftheta_p0 has no pinhole image"),
        (changed(camera_model="EQUIRECTANGULAR"), "'EQUIRECTANGULAR' has no pinhole image"),
        (
            changed(camera_model="THIN_PRISM_FISHEYE"),
            "camera_model 'THIN_PRISM_FISHEYE' is not supported here; give the COLMAP model in its place, or undistort",
        ),
        (
            changed(camera_model="OPENCV_FISHEYE", p1=0.01),
            "p1 and p2 of a fisheye lens are not supported; give the COL",
        ),
        (changed(ply_file_path="gone.ply"), r"ply_file_path .gone\.ply. is not a file: copy the points there, or"),
        (changed(ply_file_path="images"), "ply_file_path .images. is not a file"),
        (changed(fl_x=None, fl_y=None, K=[[1, 0], [0, 1]]), "K must be 3 x 3 numbers"),
        (changed(fl_x=None, fl_y=None, K=[[50, 3, 20], [0, 50, 15], [0, 0, 1]]), "has a skew of 3 px; undistort"),
        (changed(sk_x=-2), "has a skew of -2 px; undistort"),
        (changed(test_filenames=[1]), "is not a list of photos"),
        (in_frame(transform_matrix=[[1, 2], [3, 4]]), "frame 1: transform_matrix must be 4 x 4"),
        (in_frame(transform_matrix=np.diag([2.0, 2, 1, 1]).tolist()), "frame 1: .* transform_matrix is not a rotation"),
        (in_frame(transform_matrix=np.diag([1.0, 1, 1, 2]).tolist()), "frame 1: the last row .* is 0 0 0 2, not"),
        (in_frame(transform_matrix=None), "frame 1: transform_matrix must be"),
        (in_frame(file_path=f"./images/{NAMES[0]}"), "has a frame already"),
        (in_frame(cx=float("nan")), "frame 1: cx is 'nan'"),
        (changed(fl_y=1e-300), "focal lengths of .* too short for an image of 40x30 px"),
        (in_frame(fl_x=1e-5), f"focal lengths of '.*{NAMES[1]}' .* too short for an image"),
    ],
)
def test_errors_name_frame_and_key(folder: Path, change: Callable[[Values], Values], message: str) -> None:
    file = write(folder, change(LENS | {"frames": frames()}))
    with pytest.raises(InputError, match=message) as caught:
        load_scene(folder)
    assert str(caught.value).startswith(str(file.parent))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "{", "[]", "[" * 100_000, '{"frames": 3}'])
def test_damaged_files_are_named(folder: Path, text: str) -> None:
    file = folder / "transforms.json"
    file.write_text(text)
    with pytest.raises(InputError, match=r"transforms\.json: (is not JSON|has no list)"):
        read_transforms([file])


@pytest.mark.data
def test_fox_has_the_cameras_of_its_colmap_model() -> None:
    folder = scene_folder("fox")
    actual, expected = load_scene(folder / "transforms.json", resolution=4), load_scene(folder, resolution=4)
    assert [Path(name).name for name in actual.names] == expected.names
    for view, other in zip(actual.views, expected.views, strict=True):
        np.testing.assert_allclose(view.camera.cam_from_world, other.camera.cam_from_world, atol=1e-9)
        assert view.camera.fx == pytest.approx(other.camera.fx)
        np.testing.assert_array_equal(view.image, other.image)
    order = [np.lexsort(points.xyz.astype(np.float32).T) for points in (actual.points, expected.points)]
    np.testing.assert_allclose(actual.points.xyz[order[0]], expected.points.xyz[order[1]], atol=1e-4)


@pytest.mark.data
def test_instant_ngp_fox_skips_missing_photos() -> None:
    with pytest.warns(UserWarning, match="17 of 67 photos are left out"):
        scene = load_scene(scene_folder("fox") / "ngp", resolution=4)
    assert len(scene.views) == 50
    assert scene.views[0].camera.cx != pytest.approx(138.6395 / 4, rel=1e-4), "undistorted"


@pytest.mark.data
def test_lego_has_test_views_in_its_files() -> None:
    scene = load_scene(scene_folder("lego"), resolution=4, background=(1.0, 1.0, 1.0))
    assert (len(scene.train), len(scene.test)) == (100, 25)
    assert scene.views[0].image[0, 0].tolist() == [255, 255, 255]


ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=3),
    max_leaves=6,
)


@settings(max_examples=300, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_random_values_are_read_or_refused_with_one_line(folder: Path, data: st.DataObject) -> None:
    """Values of the file, at any depth, are replaced by random values. The error is one line that names the file."""
    whole = LENS | {
        "k1": 0.0,
        "camera_model": "OPENCV",
        "test_filenames": [f"images/{NAMES[1]}"],
        "ply_file_path": "",
        "applied_transform": np.eye(4).tolist(),
        "frames": frames()[:3],
    }
    for _ in range(data.draw(st.integers(1, 3))):
        inner: Any = whole
        while True:
            keys = list(inner) if isinstance(inner, dict) else list(range(len(inner)))
            if not keys:
                break
            key = data.draw(st.sampled_from(keys))
            if not isinstance(inner[key], (dict, list)) or not inner[key] or data.draw(st.booleans()):
                inner[key] = data.draw(ANYTHING)
                break
            inner = inner[key]
    file = write(folder, whole)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            message = f"{len(read_transforms([file]).photos)} photos"
        except InputError as error:
            message = str(error).removeprefix(str(folder))
    assert message.endswith(" photos") or message.startswith("/"), "the file is named"
    assert "\n" not in message


@pytest.mark.parametrize("name", ["/", "..", "é" * 200, "é" * 200 + "/a.png", "a/" * 1500 + "b", "a\0b", "\ud800"])
@pytest.mark.parametrize("key", ["file_path", "ply_file_path"])
def test_impossible_file_names_are_refused(tmp_path: Path, key: str, name: str) -> None:
    frame = {"file_path": "a.png", "transform_matrix": np.eye(4).tolist()}
    write_png(tmp_path / "a.png", np.zeros((4, 6, 3)))
    values = {"fl_x": 5, "frames": [frame]}
    (frame if key == "file_path" else values)[key] = name
    (tmp_path / "transforms.json").write_text(json.dumps(values))
    with pytest.raises(InputError, match=r"name|cannot be read"):
        load_scene(tmp_path)


def test_names_do_not_lead_out_of_the_folder(tmp_path: Path) -> None:
    """Renders are written under the names of their views, so that such a name could overwrite other files."""
    scene = tmp_path / "scene"
    scene.mkdir()
    frames = []
    for number, name in enumerate(("inside/../a.png", "../b.png")):
        file = scene / name
        (scene / "inside").mkdir(exist_ok=True)
        write_png(file, np.zeros((4, 6, 3)))
        pose = np.eye(4)
        pose[0, 3] = number
        frames.append({"file_path": name, "transform_matrix": pose.tolist()})
    (scene / "transforms.json").write_text(json.dumps({"fl_x": 5, "frames": frames}))
    assert load_scene(scene, eval=False).names == ["a.png", "b.png"]


@pytest.mark.parametrize("suffix", [".jfif", ".avif", ".JPE", ".gif"])
def test_photos_with_rare_suffixes(folder: Path, suffix: str) -> None:
    values = LENS | {"frames": frames()}
    for frame in values["frames"]:
        file = folder / frame["file_path"]
        file.rename(file.with_suffix(suffix))
        frame["file_path"] = str(Path(frame["file_path"]).with_suffix(suffix))
    write(folder, values)
    assert load_scene(folder).names == [frame["file_path"] for frame in values["frames"]]


def test_a_photo_of_an_unknown_format_is_looked_for_under_its_name(folder: Path) -> None:
    values = LENS | {"frames": frames()}
    values["frames"][2]["file_path"] = "images/IMG.CR2"
    write(folder, values)
    with pytest.warns(UserWarning, match=r"images/IMG\.CR2: no such image file"):
        load_scene(folder)


def test_bad_frames_of_scannet_are_left_out(folder: Path) -> None:
    values = LENS | {"frames": frames()}
    for index, frame in enumerate(values["frames"]):
        frame["is_bad"] = index != 5
    write(folder, values)
    with pytest.warns(UserWarning, match=r"frame 0: is marked as bad \(is_bad\)"):
        assert load_scene(folder, eval=False).names == [values["frames"][5]["file_path"]]


def test_no_usable_test_view_is_named(folder: Path, recwarn: pytest.WarningsRecorder) -> None:
    values = LENS | {"frames": frames()}
    for name in NAMES[::8]:
        (folder / "images" / name).unlink()
    write(folder, values)
    text = "none of its 2 test views can be used"
    with pytest.warns(UserWarning, match=text):
        assert load_scene(folder).test == []
    recwarn.clear()
    load_scene(folder, eval=False)
    load_scene(folder, test_every=3)
    assert not [warning for warning in recwarn if text in str(warning.message)]
