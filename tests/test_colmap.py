"""Lenses that are undistorted or refused, and damaged model files."""

from __future__ import annotations

import shutil
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from small_scene import CX, CY, FX, FY, HEIGHT, WIDTH, cloud, model_views, write_garden

from clsplat.colmap import Photo, read_model
from clsplat.colmap_files import check_binary_model, write_binary_model
from clsplat.errors import InputError
from clsplat.scene import load_scene


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A small scene."""
    return write_garden(tmp_path)


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


@pytest.mark.parametrize(("model", "params"), [
    ("PINHOLE", [300, 310, 190, 155]),
    ("OPENCV", [300, 310, 190, 155, -0.2, 0.05, 0.002, -0.003]),
    ("OPENCV_FISHEYE", [200, 205, 202, 149, 0.02, 0.01, 0, 0]),
])
@pytest.mark.parametrize("reduced", [1, 2])
def test_mask_follows_the_photo(model: str, params: list[float], reduced: int) -> None:
    """A mask that is a threshold of the photo is that threshold of the fitted photo, but along edges."""
    import pycolmap

    photo = Photo("disc", np.eye(4), pycolmap.Camera(model=model, width=400, height=300, params=params))
    y, x = np.mgrid[:300, :400] // reduced * reduced
    mask = ((x - 120) ** 2 + (y - 100) ** 2 < 90**2) | (x > 330)
    flat, camera = photo.fit(np.repeat(np.where(mask, 255, 0).astype(np.uint8)[..., None], 3, axis=2))
    fitted = photo.fit_mask(mask[::reduced, ::reduced], 400, 300)
    assert fitted.dtype == bool
    assert fitted.shape == (camera.height, camera.width)
    assert not (fitted[flat[..., 0] == 0]).any()
    assert fitted[flat[..., 0] == 255].all()
    assert 0.2 < fitted.mean() < 0.6


def test_mask_is_false_outside_the_photo() -> None:
    import pycolmap

    # This lens leaves a sliver of the fitted image blank.
    params = [300, 310, 190, 155, -0.2, 0.05, 0.002, -0.003]
    photo = Photo("sliver", np.eye(4), pycolmap.Camera(model="OPENCV", width=400, height=300, params=params))
    white, _ = photo.fit(np.full((300, 400, 3), 255, np.uint8))
    fitted = photo.fit_mask(np.ones((300, 400), bool), 400, 300)
    assert 0 < (~fitted).sum() < 100
    np.testing.assert_array_equal(fitted, white[..., 0] == 255)
    with pytest.raises(InputError, match=r"its mask is 300x400 px, the photo 400x300"):
        photo.fit_mask(np.ones((400, 300), bool), 400, 300)


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
    assert "\n" not in str(error.value)


# --- damage ----------------------------------------------------------------------

@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, bytes]]:
    """Bytes of the same model as COLMAP writes it today (with rigs and frames), by kind of file."""
    import pycolmap

    root = tmp_path_factory.mktemp("whole")
    write_binary_model(root / "ours", model_views()[:4], *cloud())
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
