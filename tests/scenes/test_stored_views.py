"""Views that are decoded when they are used: their pixels, their cameras, when photos are read, and in what memory."""

from __future__ import annotations

import json
import subprocess
import sys
import zlib
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from small_scene import FX, HEIGHT, NAMES, WIDTH, model_views, photo_of, write_garden

import clsplat
from clsplat.activity import listening
from clsplat.errors import InputError
from clsplat.evaluation.evaluate import evaluate
from clsplat.files.images import is_whole, read_image, resize_area, write_png
from clsplat.files.masks import resize_mask
from clsplat.scenes import read_view
from clsplat.scenes.read_view import decoding_threads, keep_photos
from clsplat.scenes.scene import load_scene
from clsplat.scenes.view import StoredView, View

FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
SIZE = (160, 120)


def transparent_photo(index: int) -> NDArray[np.uint8]:
    """A photo with every pair of colour and opacity somewhere."""
    rng = np.random.default_rng(index)
    return rng.integers(0, 256, (SIZE[1], SIZE[0], 4)).astype(np.uint8)


def write_frames(folder: Path, distortion: float, transparent: bool, masked: bool) -> Path:
    """Write a scene with transforms.json and return its folder."""
    frames = []
    for index, view in enumerate(model_views()):
        pixels = transparent_photo(index)
        write_png(folder / "images" / view.name, pixels if transparent else pixels[:, :, :3])
        if masked:
            write_png(folder / "masks" / "images" / view.name, pixels[:, :, 3] // 128 * 255)
        pose = (np.linalg.inv(view.cam_from_world) @ FLIP).tolist()
        frames.append({"file_path": f"images/{view.name}", "transform_matrix": pose})
    lens = {"w": SIZE[0], "h": SIZE[1], "fl_x": 4 * FX, "cx": 78.0, "cy": 62.0, "k1": distortion}
    (folder / "transforms.json").write_text(json.dumps(lens | {"frames": frames}))
    return folder


@pytest.fixture
def decoded(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the photos in the order in which they are decoded."""
    names: list[str] = []

    def read(path: Path, **options: object) -> NDArray[np.uint8]:
        names.append(path.name)
        return read_image(path, **options)  # type: ignore[arg-type]

    monkeypatch.setattr(read_view, "read_image", read)
    return names


def test_only_training_photos_are_decoded(tmp_path: Path, decoded: list[str]) -> None:
    garden = write_garden(tmp_path)
    said: list[str] = []
    with listening(said.append):
        scene = load_scene(garden)
    assert [view.name for view in scene.test] == [NAMES[0], NAMES[8]]
    assert sorted(decoded) == NAMES[1:8]
    assert sorted(said) == [f"reading photo {number} of 7" for number in range(1, 8)]
    for view in scene.train:
        np.testing.assert_array_equal(view.image, photo_of(NAMES.index(view.name)))
    assert len(decoded) == 7, "training photos stay in memory"
    for _ in range(2):
        np.testing.assert_array_equal(scene.test[1].image, photo_of(8))
    assert decoded[7:] == [NAMES[8]] * 2, "test photos do not"
    decoded.clear()
    assert len(load_scene(garden, read_photos=False).views) == 9
    assert not decoded


def test_photos_that_were_only_checked_are_not_kept(tmp_path: Path, decoded: list[str]) -> None:
    """Transparency might hide everything, so even test photos are decoded once."""
    scene = load_scene(write_frames(tmp_path, 0.0, True, False), alpha="mask")
    assert Counter(decoded) == Counter(Path(name).name for name in scene.names)
    assert [view.is_kept for view in scene.test if isinstance(view, StoredView)] == [False] * len(scene.test)


@pytest.mark.parametrize("reading", [{}, {"bars": (0.1, 0.0, 0.0, 0.0)}, {"alpha": "mask"}])
def test_masks_are_checked_without_their_photos(tmp_path: Path, decoded: list[str], reading: dict[str, object]) -> None:
    """Those of files and of bars, and of photos that cannot be transparent."""
    folder = write_frames(tmp_path, 0.0, False, True)
    hidden = sorted((folder / "masks" / "images").iterdir())[0]
    write_png(hidden, np.zeros((SIZE[1], SIZE[0]), np.uint8))
    with pytest.warns(UserWarning, match=r"1 of 9 photos .* its mask hides every pixel"):
        scene = load_scene(folder, read_photos=False, **reading)  # type: ignore[arg-type]
    assert not decoded
    assert list(scene.left_out) == [f"images/{hidden.name}"]
    assert all(view.may_hide_pixels for view in scene.views)


def test_photos_are_kept_and_released_on_demand(tmp_path: Path, decoded: list[str]) -> None:
    scene = load_scene(write_garden(tmp_path), read_photos=False)
    views = [view for view in scene.views if isinstance(view, StoredView)]
    assert len(views) == 9
    keep_photos(scene.views[:3])
    keep_photos(scene.views[:3])
    assert sorted(decoded) == NAMES[:3]
    assert [view.is_kept for view in views] == [True] * 3 + [False] * 6
    scene.views[0].release()
    assert not views[0].is_kept
    np.testing.assert_array_equal(views[0].image, photo_of(0))
    assert len(decoded) == 4


@pytest.mark.parametrize("resolution", [-1, 2, 50])
@pytest.mark.parametrize("masked", [False, True])
@pytest.mark.parametrize("transparent", [False, True])
@pytest.mark.parametrize("distortion", [0.0, 0.1])
def test_pixels_are_those_of_the_steps_one_by_one(
    tmp_path: Path, distortion: float, transparent: bool, masked: bool, resolution: int
) -> None:
    """The oracle composites the whole photo, then undistorts it, then reduces it."""
    folder = write_frames(tmp_path, distortion, transparent, masked)
    scene = load_scene(folder, resolution=resolution, background=(0.2, 0.5, 1.0))
    posed = {photo.name: photo for photo in clsplat.scenes.scene.read_posed_images(folder, None).photos}
    for index in (0, 3):  # a test view and a training view
        view, photo = scene.views[index].loaded(), posed[scene.names[index]]
        pixels = transparent_photo(index)
        colour, alpha = pixels[:, :, :3].astype(np.float64), pixels[:, :, 3:] / 255.0
        if transparent:
            colour = alpha * colour + (1 - alpha) * (51.0, 127.5, 255.0)
        whole, camera = photo.fit(np.rint(colour.astype(np.float32)).astype(np.uint8))
        size = view.camera.width, view.camera.height
        expected = whole if resolution == -1 else resize_area(whole, *size)
        assert (camera.width, camera.height) == (whole.shape[1], whole.shape[0])
        if resolution == -1:
            assert size == (camera.width, camera.height)
        for key in ("fx", "fy", "cx", "cy"):
            scale = size["xy".index(key[1])] / (camera.width, camera.height)["xy".index(key[1])]
            assert getattr(view.camera, key) == pytest.approx(scale * getattr(camera, key))
        np.testing.assert_allclose(view.image.astype(int), expected, atol=int(transparent))  # halves may round down
        assert (np.abs(view.image.astype(int) - expected) > 0).mean() < 0.01
        assert (view.alpha is not None) == transparent
        assert (view.mask is not None) == masked
        if view.mask is not None:
            hidden = photo.fit_mask(pixels[:, :, 3] >= 128, *SIZE)
            np.testing.assert_array_equal(view.mask, resize_mask(hidden, *size))
        if view.alpha is not None:
            moved = photo.fit(np.repeat(pixels[:, :, 3:], 3, axis=2))[0][:, :, 0]
            np.testing.assert_array_equal(view.alpha, resize_area(moved, *size))


@pytest.mark.parametrize("distortion", [0.0, 0.1])
def test_no_pixels_stay_beside_the_view(tmp_path: Path, distortion: float) -> None:
    """A slice of the photo would keep all of its channels."""
    for view in load_scene(write_frames(tmp_path, distortion, True, False)).train:
        for array in (view.image, view.alpha):
            assert array is not None
            base = array if array.base is None else array.base
            assert memoryview(base).nbytes == array.nbytes  # type: ignore[arg-type]


@pytest.mark.parametrize("mode", ["RGB", "L", "P", "CMYK", "I;16", "RGBA", "LA"])
@pytest.mark.parametrize("size", [(30, 20), (25, 17), (60, 40)])
def test_reduction_while_reading_gives_the_same_pixels(tmp_path: Path, mode: str, size: tuple[int, int]) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (40, 60, 3)).astype(np.uint8)
    if mode == "I;16":
        image = Image.fromarray(pixels[:, :, 0].astype(np.uint16) * 200)
    else:
        image = Image.fromarray(pixels).convert(mode)
    file = tmp_path / ("a.jpg" if mode in ("RGB", "CMYK") else "a.png")
    image.save(file)
    whole, found = read_image(file), read_image(file, opaque_size=size)
    np.testing.assert_array_equal(found, whole if whole.shape[2] == 4 else resize_area(whole, *size))


def damage(file: Path) -> None:
    """Replace the pixels of a PNG. Its header and its end stay."""
    data = file.read_bytes()
    at = data.index(b"IDAT")
    length = int.from_bytes(data[at - 4 : at], "big")
    noise = b"IDAT" + b"\xff" * length
    file.write_bytes(data[:at] + noise + zlib.crc32(noise).to_bytes(4, "big") + data[at + 8 + length :])


def test_a_test_photo_that_cannot_be_decoded_is_not_measured(tmp_path: Path) -> None:
    garden = write_garden(tmp_path)
    rng = np.random.default_rng(0)
    splats = clsplat.Splats.from_points(rng.normal(size=(20, 3)), rng.integers(0, 256, (20, 3)).astype(np.uint8))
    damage(garden / "images" / NAMES[0])
    assert is_whole(garden / "images" / NAMES[0])
    scene = load_scene(garden)
    with pytest.raises(InputError, match=rf"{NAMES[0]}: cannot be read as an image"):
        scene.test[0].loaded()
    renderer = clsplat.Renderer()
    with pytest.warns(UserWarning, match=rf"1 of 2 photos are not measured: .*{NAMES[0]}: cannot be read"):
        assert list(evaluate(renderer, splats, scene.test).per_view) == [NAMES[8]]
    with pytest.raises(InputError, match="none of the 1 photos can be used"):
        evaluate(renderer, splats, scene.test[:1])
    with pytest.raises(InputError, match=rf"{NAMES[0]}: cannot be read"):
        keep_photos(scene.test)


def test_photos_that_do_not_end_are_known_without_decoding(tmp_path: Path) -> None:
    for name in ("a.png", "a.jpg", "a.webp"):
        Image.fromarray(photo_of(0)).save(tmp_path / name)
    assert [is_whole(tmp_path / name) for name in ("a.png", "a.jpg", "a.webp")] == [True, True, False]
    for name in ("a.png", "a.jpg"):
        data = (tmp_path / name).read_bytes()
        for end in (-1, len(data) // 2, 5, 0):
            (tmp_path / name).write_bytes(data[:end])
            assert not is_whole(tmp_path / name)
    assert not is_whole(tmp_path / "none.png")


def test_replacing_a_field_gives_a_view_in_memory(tmp_path: Path) -> None:
    view = load_scene(write_garden(tmp_path)).test[0]
    changed = replace(view, name="other")
    assert type(changed) is View
    assert changed.name == "other"
    np.testing.assert_array_equal(changed.image, view.image)
    assert view.resized(WIDTH // 2, HEIGHT // 2).image.shape == (HEIGHT // 2, WIDTH // 2, 3)
    assert repr(view).startswith(f"StoredView('{NAMES[0]}'")


def test_large_photos_are_decoded_by_fewer_threads(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(read_view.os, "cpu_count", lambda: 16)
    assert decoding_threads([8 * 10**6] * 50) == 16
    assert decoding_threads([1, 12 * 8 * 10**6]) == 5
    assert decoding_threads([400 * 16 * 10**6]) == 1
    assert decoding_threads([]) == 16


# The child loads a scene and prints its peak memory before and after [bytes].
CHILD = """
import resource, sys
from clsplat.scenes.scene import load_scene
from clsplat.scenes import undistort
undistort.colmap_library()
peak = lambda: 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
before = peak()
scene = load_scene(sys.argv[1], eval=False)
print(before, peak(), sum(view.image.nbytes for view in scene.views))
"""
MANY, LARGE = 24, (4000, 3000)


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="reads the peak memory in KiB")
@pytest.mark.parametrize(("distortion", "masked"), [(0.0, False), (0.0, True), (0.02, False)])
def test_large_photos_load_in_bounded_memory(tmp_path: Path, distortion: float, masked: bool) -> None:
    """24 photos of 12 megapixels would need 864 MB at their stored size. They are reduced to a width of 1600 px."""
    rng = np.random.default_rng(0)
    small = rng.integers(0, 256, (LARGE[1] // 100, LARGE[0] // 100, 3)).astype(np.uint8)
    image = Image.fromarray(small).resize(LARGE, Image.Resampling.BICUBIC)
    (tmp_path / "images").mkdir()
    (tmp_path / "masks" / "images").mkdir(parents=True)
    frames = []
    for index in range(MANY):
        name = f"{index:02}.jpg"
        image.save(tmp_path / "images" / name, quality=90)
        if masked:
            Image.fromarray(np.asarray(image)[:, :, 0] // 128 * 255).save(tmp_path / "masks" / "images" / name)
        pose = np.eye(4)
        pose[:3, 3] = (index, 0, 0)
        frames.append({"file_path": f"images/{name}", "transform_matrix": pose.tolist()})
    lens = {"w": LARGE[0], "h": LARGE[1], "fl_x": 3000.0, "k1": distortion}
    (tmp_path / "transforms.json").write_text(json.dumps(lens | {"frames": frames}))
    done = subprocess.run(
        [sys.executable, "-c", CHILD, str(tmp_path)], capture_output=True, text=True, check=True, timeout=300
    )
    before, after, kept = map(int, done.stdout.split())
    assert kept == pytest.approx(MANY * 1600 * 1200 * 3, rel=0.02)
    assert after - before < kept + (512 << 20)
