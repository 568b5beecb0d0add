"""COLMAP models and scenes: what is read, how it is split and sized, and what is refused."""

from __future__ import annotations

import shutil
import struct
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from scenes_data import scene_folder

from clsplat.colmap import Photo, find_model, read_model
from clsplat.colmap_files import ModelView, check_binary_model, write_binary_model
from clsplat.errors import InputError
from clsplat.images import write_png
from clsplat.scene import load_scene

WIDTH, HEIGHT, N_VIEWS, N_POINTS = 40, 30, 9, 12
FX, FY, CX, CY = 33.0, 31.0, 18.5, 16.25
NAMES = [f"shot_{index}.png" for index in range(N_VIEWS)]


def _model_views() -> list[ModelView]:
    rng = np.random.default_rng(1)
    views = []
    for index, name in enumerate(NAMES):
        angle = 0.1 * index
        pose = np.eye(4)
        pose[:3, :3] = [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
        pose[:3, 3] = (0.3 * index, -0.2, 4.0)
        seen = rng.permutation(N_POINTS)[:8]
        pixels = rng.random((8, 2)) * HEIGHT
        views.append(ModelView(name, (WIDTH, HEIGHT), (FX, FY, CX, CY), pose, pixels, seen))
    return views


def _cloud() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(2)
    return rng.normal(size=(N_POINTS, 3)), rng.integers(0, 256, (N_POINTS, 3)).astype(np.uint8)


def _photo_of(index: int, width: int = WIDTH, height: int = HEIGHT) -> np.ndarray:
    image = np.zeros((height, width, 3), np.uint8)
    image[..., 0], image[: height // 2, :, 1] = 20 * index, 200
    return image


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A small scene, written backwards so that order in the files is not the order of names."""
    root = tmp_path / "garden"
    for index, name in enumerate(NAMES):
        write_png(root / "images" / name, _photo_of(index))
    write_binary_model(root / "sparse" / "0", _model_views()[::-1], *_cloud())
    return root


def _as_text(model: Path, target: Path) -> None:
    import pycolmap

    target.mkdir(parents=True, exist_ok=True)
    pycolmap.Reconstruction(str(model)).write_text(str(target))


def _message(error: pytest.ExceptionInfo[InputError]) -> str:
    message = str(error.value)
    assert "\n" not in message
    return message


# --- reading -------------------------------------------------------------------------------

def test_scene_holds_what_was_written(folder: Path) -> None:
    scene = load_scene(folder)
    xyz, rgb = _cloud()
    assert scene.name == "garden"
    assert scene.names == NAMES
    for index, (view, written) in enumerate(zip(scene.views, _model_views(), strict=True)):
        camera = view.camera
        assert (camera.width, camera.height) == (WIDTH, HEIGHT)
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == (FX, FY, CX, CY)
        np.testing.assert_allclose(camera.cam_from_world, written.cam_from_world, atol=1e-14)
        np.testing.assert_array_equal(view.image, _photo_of(index))
    np.testing.assert_array_equal(scene.points.xyz, xyz)
    np.testing.assert_array_equal(scene.points.rgb, rgb)
    expected = np.bincount(np.concatenate([view.point_index for view in _model_views()]), minlength=N_POINTS)
    np.testing.assert_array_equal(scene.points.track_length, expected)


def test_text_model_equals_binary(folder: Path, tmp_path: Path) -> None:
    _as_text(folder / "sparse" / "0", tmp_path / "text")
    binary, text = read_model(folder / "sparse" / "0"), read_model(tmp_path / "text")
    assert [photo.name for photo in text.photos] == [photo.name for photo in binary.photos]
    for one, other in zip(binary.photos, text.photos, strict=True):
        np.testing.assert_allclose(other.cam_from_world, one.cam_from_world, atol=1e-12)
    np.testing.assert_allclose(text.points.xyz, binary.points.xyz, atol=1e-12)
    np.testing.assert_array_equal(text.points.rgb, binary.points.rgb)
    np.testing.assert_array_equal(text.points.track_length, binary.points.track_length)


def test_largest_model_is_chosen(folder: Path) -> None:
    write_binary_model(folder / "sparse" / "1", _model_views()[:2], *_cloud())
    shutil.move(folder / "sparse" / "0", folder / "sparse" / "2")
    assert find_model(folder).name == "2"
    _as_text(folder / "sparse" / "2", folder / "sparse" / "text")
    shutil.rmtree(folder / "sparse" / "2")
    assert find_model(folder).name == "text"


def test_model_directly_in_sparse(folder: Path) -> None:
    for file in (folder / "sparse" / "0").iterdir():
        shutil.move(file, folder / "sparse" / file.name)
    (folder / "sparse" / "0").rmdir()
    assert len(load_scene(folder).views) == N_VIEWS


@pytest.mark.parametrize("suffix", [".bin", ".txt"])
def test_missing_points_give_an_empty_cloud(folder: Path, suffix: str) -> None:
    model = folder / "sparse" / "0"
    if suffix == ".txt":
        _as_text(model, folder / "sparse" / "t")
        shutil.rmtree(model)
        model = folder / "sparse" / "t"
    (model / f"points3D{suffix}").unlink()
    scene = load_scene(folder)
    assert len(scene.points) == 0
    assert scene.points.xyz.shape == scene.points.rgb.shape == (0, 3)
    assert len(scene.views) == N_VIEWS


def test_few_registered_images_warn(folder: Path) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        load_scene(folder)
    for index in range(3):
        write_png(folder / "images" / f"other_{index}.png", _photo_of(0))
    with pytest.warns(UserWarning, match="only 9 of 12 photos"):
        load_scene(folder)


def test_pillow_is_loaded_before_pycolmap() -> None:
    code = ("import sys, clsplat.scene\n"
            "sys.exit(0 if 'PIL.Image' in sys.modules and 'pycolmap' not in sys.modules else 1)")
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


# --- split, extent -------------------------------------------------------------------------

def test_split_holds_out_every_eighth(folder: Path) -> None:
    scene = load_scene(folder)
    assert [view.name for view in scene.test] == [NAMES[0], NAMES[8]]
    assert [view.name for view in scene.train] == NAMES[1:8]
    assert [view.name for view in load_scene(folder, test_every=4).test] == [NAMES[0], NAMES[4], NAMES[8]]
    everything = load_scene(folder, eval=False)
    assert everything.test == []
    assert [view.name for view in everything.train] == NAMES


def test_split_by_list(folder: Path, tmp_path: Path) -> None:
    names = tmp_path / "test.txt"
    names.write_text(f"{NAMES[3]}\n\n{NAMES[1]}\r\n", encoding="utf-8")
    assert [view.name for view in load_scene(folder, test_list=names).test] == [NAMES[1], NAMES[3]]
    names.write_text("nobody.png\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"nobody\.png"):
        load_scene(folder, test_list=names)
    names.write_text("\n".join(NAMES), encoding="utf-8")
    with pytest.raises(InputError, match="no training view"):
        load_scene(folder, test_list=names)
    with pytest.raises(InputError, match="list of names"):
        load_scene(folder, test_list=tmp_path / "absent.txt")


def test_extent_is_of_the_training_cameras(folder: Path) -> None:
    scene = load_scene(folder)
    centres = np.array([camera.position for camera in scene.cameras[1:8]])
    farthest = max(np.linalg.norm(centre - centres.mean(axis=0)) for centre in centres)
    assert scene.extent == pytest.approx(1.1 * farthest, rel=1e-12)


# --- sizes ---------------------------------------------------------------------------------

@pytest.mark.parametrize(("resolution", "size"), [
    (-1, (40, 30)), (1, (40, 30)), (2, (20, 15)), (4, (10, 8)), (8, (5, 4)), (13, (13, 9)), (30, (30, 22))])
def test_resolution(folder: Path, resolution: int, size: tuple[int, int]) -> None:
    view = load_scene(folder, resolution=resolution).views[2]
    assert (view.camera.width, view.camera.height) == size
    assert view.image.shape == (size[1], size[0], 3)
    assert view.camera.fx == pytest.approx(FX * size[0] / WIDTH)
    assert view.camera.cy == pytest.approx(CY * size[1] / HEIGHT)


def test_wide_images_are_reduced_to_1600(folder: Path) -> None:
    for index, name in enumerate(NAMES):
        write_png(folder / "images" / name, _photo_of(index, 1640, 1230))
    small, large = load_scene(folder).views[0], load_scene(folder, resolution=1).views[0]
    assert (small.camera.width, small.camera.height) == (1600, 1200)
    assert small.camera.fx == pytest.approx(FX * 40)
    assert large.image.shape == (1230, 1640, 3)


@pytest.mark.parametrize("size", [(20, 15), (13, 10), (14, 10), (5, 4)])
def test_reduced_photos_scale_the_camera(folder: Path, size: tuple[int, int]) -> None:
    for index, name in enumerate(NAMES):
        write_png(folder / "images_s" / name, _photo_of(index, *size))
    view = load_scene(folder, images="images_s").views[0]
    assert (view.camera.width, view.camera.height) == size
    assert view.image.shape == (size[1], size[0], 3)
    np.testing.assert_allclose([view.camera.fx, view.camera.cx], np.array([FX, CX]) * size[0] / WIDTH)
    np.testing.assert_allclose([view.camera.fy, view.camera.cy], np.array([FY, CY]) * size[1] / HEIGHT)


@pytest.mark.parametrize("size", [(30, 40), (20, 20), (40, 20)])
def test_photo_of_another_aspect_is_refused(folder: Path, size: tuple[int, int]) -> None:
    write_png(folder / "images" / NAMES[4], _photo_of(0, *size))
    with pytest.raises(InputError) as error:
        load_scene(folder)
    assert NAMES[4] in _message(error)
    assert f"{size[0]}x{size[1]}" in _message(error)
    assert "40x30" in _message(error)


def test_transparent_photos_get_the_background(folder: Path) -> None:
    image = np.zeros((HEIGHT, WIDTH, 4), np.uint8)
    image[..., 0], image[: HEIGHT // 2, :, 3], image[HEIGHT // 2:, :, 3] = 200, 255, 51
    write_png(folder / "images" / NAMES[0], image)
    black, white = load_scene(folder).images[0], load_scene(folder, background=(1, 1, 1)).images[0]
    np.testing.assert_array_equal(black[0, 0], [200, 0, 0])
    np.testing.assert_array_equal(black[-1, 0], [40, 0, 0])
    np.testing.assert_array_equal(white[0, 0], [200, 0, 0])
    np.testing.assert_array_equal(white[-1, 0], [244, 204, 204])


# --- lenses --------------------------------------------------------------------------------

@pytest.mark.parametrize("scale", [1.0, 0.5])
@pytest.mark.parametrize(("model", "params"), [
    ("SIMPLE_RADIAL", [300, 205, 148, -0.2]),
    ("RADIAL", [300, 205, 148, 0.15, 0.02]),
    ("OPENCV", [300, 310, 190, 155, -0.2, 0.05, 0.002, -0.003]),
    ("OPENCV_FISHEYE", [200, 205, 202, 149, 0.02, 0.01, 0, 0]),
])
def test_undistorted_photo_shows_points_where_its_camera_says(model: str, params: list[float],
                                                              scale: float) -> None:
    """Round dots drawn where the lens puts them must lie where the pinhole camera puts them."""
    import pycolmap

    lens = pycolmap.Camera(model=model, width=400, height=300, params=params)
    rays = np.array([(x, y) for y in np.linspace(-0.35, 0.35, 5) for x in np.linspace(-0.5, 0.5, 7)])
    y, x = np.mgrid[: int(300 * scale), : int(400 * scale)] + 0.5
    image = np.zeros(x.shape)
    for ray in rays:
        at = np.ravel(lens.img_from_cam(np.array([[*ray, 1.0]]))) * scale
        image += 200 * np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / 4.5)
    picture = np.repeat(np.clip(image, 0, 255).astype(np.uint8)[..., None], 3, axis=2)
    flat, camera = Photo("dots", np.eye(4), lens).fit(picture)
    assert flat.shape == (camera.height, camera.width, 3)
    checked = 0
    for ray in rays:
        expected = ray * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        if (expected < 9).any() or (expected > np.array([camera.width, camera.height]) - 9).any():
            continue
        column, row = expected.astype(int)
        window = flat[row - 6 : row + 7, column - 6 : column + 7, 0].astype(float)
        rows, columns = np.mgrid[row - 6 : row + 7, column - 6 : column + 7] + 0.5
        found = np.array([(columns * window).sum(), (rows * window).sum()]) / window.sum()
        assert np.linalg.norm(found - expected) < 0.15
        checked += 1
    assert checked >= 15
    assert (flat[:4].sum(), flat[-4:].sum()) == (0, 0)      # the ground is black, so is what the border gets


def test_zero_distortion_is_a_plain_pinhole() -> None:
    import pycolmap

    lens = pycolmap.Camera(model="OPENCV", width=40, height=30, params=[30, 31, 18, 16, 0, 0, 0, 0])
    image = np.random.default_rng(0).integers(0, 256, (30, 40, 3)).astype(np.uint8)
    same, camera = Photo("plain", np.eye(4), lens).fit(image)
    np.testing.assert_array_equal(same, image)
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (30, 31, 18, 16)


def test_distorted_scene_loads(folder: Path) -> None:
    cameras = folder / "sparse" / "0" / "cameras.bin"
    cameras.write_bytes(struct.pack("<QIiQQ4d", 1, 1, 2, WIDTH, HEIGHT, FX, CX, CY, -0.1))
    view = load_scene(folder).views[0]
    assert view.camera.fx == view.camera.fy == pytest.approx(FX)
    assert view.image.shape == (view.camera.height, view.camera.width, 3)
    assert (view.camera.width, view.camera.height) != (WIDTH, HEIGHT)


@pytest.mark.parametrize(("model", "params", "word"), [
    (17, [40.0, 30.0], "EQUIRECTANGULAR"), (1, [np.nan, FY, CX, CY], "not finite"),
    (99, [1.0] * 4, "model id 99"), (1, [-FX, FY, CX, CY], "focal")])
def test_unusable_lens_is_refused(folder: Path, model: int, params: list[float], word: str) -> None:
    cameras = folder / "sparse" / "0" / "cameras.bin"
    cameras.write_bytes(struct.pack(f"<QIiQQ{len(params)}d", 1, 1, model, WIDTH, HEIGHT, *params))
    with pytest.raises(InputError, match=word) as error:
        load_scene(folder)
    _message(error)


# --- refusals ------------------------------------------------------------------------------

def test_missing_parts_are_named(folder: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such folder"):
        load_scene(tmp_path / "nowhere")
    with pytest.raises(InputError, match=r"images_4.*choose one of: images$"):
        load_scene(folder, images="images_4")
    for name in NAMES[:5]:
        (folder / "images" / name).unlink()
    with pytest.raises(InputError, match=r"5 of the model's 9 images are missing: shot_0\.png"):
        load_scene(folder)
    (folder / "sparse" / "0" / "images.bin").unlink()
    with pytest.raises(InputError, match="no COLMAP model"):
        load_scene(folder)
    shutil.rmtree(folder / "sparse")
    with pytest.raises(InputError, match="no folder 'sparse'"):
        load_scene(folder)


@pytest.mark.parametrize(("option", "value"), [("resolution", 0), ("resolution", -2), ("test_every", 1)])
def test_bad_options(folder: Path, option: str, value: int) -> None:
    with pytest.raises(InputError, match=f"{option} {value}"):
        load_scene(folder, **{option: value})


def test_model_without_images(folder: Path) -> None:
    write_binary_model(folder / "sparse" / "0", [], np.zeros((0, 3)), np.zeros((0, 3), np.uint8))
    with pytest.raises(InputError, match="registers no image"):
        load_scene(folder)


def test_damaged_photo_is_named(folder: Path) -> None:
    photo = folder / "images" / NAMES[2]
    photo.write_bytes(photo.read_bytes()[:60])
    with pytest.raises(InputError, match=NAMES[2]):
        load_scene(folder)


def test_points_that_are_not_finite(folder: Path) -> None:
    xyz, rgb = _cloud()
    xyz[3, 1] = np.nan
    write_binary_model(folder / "sparse" / "0", _model_views(), xyz, rgb)
    with pytest.raises(InputError, match="1 points have a position that is not finite"):
        load_scene(folder)


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, bytes]]:
    """Bytes of the same model as COLMAP writes it today (with rigs and frames), by kind of file."""
    import pycolmap

    root = tmp_path_factory.mktemp("whole")
    write_binary_model(root / "ours", _model_views()[:4], *_cloud())
    model = pycolmap.Reconstruction(str(root / "ours"))
    files: dict[str, dict[str, bytes]] = {}
    for suffix, write in ((".bin", model.write_binary), (".txt", model.write_text)):
        (root / suffix).mkdir()
        write(str(root / suffix))
        files[suffix] = {file.name: file.read_bytes() for file in (root / suffix).iterdir()}
    return files


def _put(folder: Path, files: dict[str, bytes]) -> Path:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    for name, content in files.items():
        (folder / name).write_bytes(content)
    return folder


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin"])
def test_every_truncation_is_refused(whole: dict[str, dict[str, bytes]], tmp_path: Path, name: str) -> None:
    files = whole[".bin"]
    check_binary_model(_put(tmp_path / "m", files))
    for end in range(0, len(files[name]), 7):
        (tmp_path / "m" / name).write_bytes(files[name][:end])
        with pytest.raises(InputError, match=name):
            read_model(tmp_path / "m")
    (tmp_path / "m" / name).write_bytes(files[name] + b"\0")
    with pytest.raises(InputError, match="1 bytes follow"):
        read_model(tmp_path / "m")


@pytest.mark.parametrize("name", ["cameras.bin", "images.bin", "points3D.bin", "rigs.bin", "frames.bin"])
def test_lying_counts_are_refused(whole: dict[str, dict[str, bytes]], tmp_path: Path, name: str) -> None:
    content = whole[".bin"][name]
    count = struct.unpack_from("<Q", content)[0]
    for lie in (0, count - 1, count + 1, 1 << 40, (1 << 64) - 1):
        if lie != count:
            damaged = struct.pack("<Q", lie) + content[8:]
            with pytest.raises(InputError, match=name):
                read_model(_put(tmp_path / "m", {**whole[".bin"], name: damaged}))


@pytest.mark.parametrize("suffix", [".bin", ".txt"])
@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_damage_gives_a_model_or_a_message(whole: dict[str, dict[str, bytes]], tmp_path: Path, suffix: str,
                                           data: st.DataObject) -> None:
    files = whole[suffix]
    name = data.draw(st.sampled_from(sorted(files)))
    content = bytearray(files[name])
    for _ in range(data.draw(st.integers(1, 3))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    message = ""
    try:
        model = read_model(_put(tmp_path / "m", {**files, name: bytes(content)}))
    except InputError as error:
        message = str(error)
    assert "\n" not in message
    assert message or np.isfinite(model.points.xyz).all()


# --- the real scenes -----------------------------------------------------------------------

@pytest.mark.data
@pytest.mark.parametrize(("name", "n_views", "size", "n_points", "track", "reprojection_px"), [
    ("fox", 50, (400, 713), 13204, 6.1, 0.28),
    ("sceaux_castle", 11, (400, 296), 8865, 4.7, 0.07),
    ("kitchen", 25, (400, 267), 21014, 3.0, 0.21),
])
def test_real_scene_reprojects(name: str, n_views: int, size: tuple[int, int], n_points: int, track: float,
                               reprojection_px: float) -> None:
    import pycolmap

    folder = scene_folder(name)
    scene = load_scene(folder)
    assert (len(scene.views), len(scene.points)) == (n_views, n_points)
    assert scene.points.track_length.mean() == pytest.approx(track, abs=0.05)
    truth = pycolmap.Reconstruction(str(folder / "sparse" / "0"))
    errors = []
    for view in scene.views:
        camera = view.camera
        assert (camera.width, camera.height) == size == view.image.shape[1::-1]
        observed = truth.find_image_with_name(view.name).get_observation_points2D()
        world = np.array([truth.points3D[point.point3D_id].xyz for point in observed])
        local = world @ camera.rotation.T + camera.translation
        pixels = local[:, :2] / local[:, 2:] * (camera.fx, camera.fy) + (camera.cx, camera.cy)
        errors.append(np.linalg.norm(pixels - np.array([point.xy for point in observed]), axis=1))
    assert np.concatenate(errors).mean() == pytest.approx(reprojection_px, abs=0.006)
