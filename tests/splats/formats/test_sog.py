"""SOG files of PlayCanvas: values worked out by hand, and named faults."""

from __future__ import annotations

import copy
import math
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sog_files

from clsplat.errors import InputError
from clsplat.splats.splats import Splats


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "model.sog"


@pytest.mark.parametrize("name", ["model.sog", "model.zip", "meta.json"])
def test_values_are_those_of_the_format(tmp_path: Path, name: str) -> None:
    meta, images = sog_files.some(13, 2)
    images["means_l.webp"][0, 0], images["means_u.webp"][0, 0] = 0, 0
    images["means_l.webp"][0, 0, 3] = images["means_u.webp"][0, 0, 3] = 255
    images["means_l.webp"][0, 1] = images["means_u.webp"][0, 1] = 255
    images["quats.webp"][0, 0] = [255, 128, 128, 253]  # w = sqrt(1/2), the largest is x
    images["scales.webp"][0, 0], images["sh0.webp"][0, 0] = [0, 255, 51, 255], [255, 0, 51, 255]
    sog_files.write(tmp_path / name, meta, images)
    read = Splats.load(tmp_path / name)
    assert (len(read), read.shape, read.sh_degree, read.antialiased) == (13, "gaussian", 2, False)
    np.testing.assert_allclose(read.mean[0], [-math.expm1(1), -math.expm1(2), -math.expm1(3)], rtol=1e-6)
    np.testing.assert_allclose(read.mean[1], np.expm1([4, 5, 6]), rtol=1e-6)
    np.testing.assert_allclose(read.quat[0], [0.5**0.5, 0.5**0.5, 0, 0], atol=4e-3)
    np.testing.assert_allclose(read.log_scale[0], [-1, 1, -0.6], rtol=1e-6)
    np.testing.assert_allclose(read.sh[0, 0], [1, -1, -0.6], rtol=1e-6)
    opacity = 1 / (1 + np.exp(-read.opacity_logit.astype(float)))
    np.testing.assert_allclose(opacity, images["sh0.webp"].reshape(-1, 4)[:13, 3] / 255, atol=1e-6)
    codebook = np.array(meta["shN"]["codebook"])
    for splat in (0, 7, 12):
        entry = int(images["shN_labels.webp"].reshape(-1, 4)[splat, 0])
        pixels = images["shN_centroids.webp"][entry // 64, entry % 64 * 8 : entry % 64 * 8 + 8, :3]
        np.testing.assert_allclose(read.sh[splat, 1:], codebook[pixels], rtol=1e-6)
        share = (
            images["means_l.webp"].reshape(-1, 4)[splat] + 256.0 * images["means_u.webp"].reshape(-1, 4)[splat]
        ) / 65535
        place = np.array([-1, -2, -3]) + share[:3] * np.array([5, 7, 9])
        np.testing.assert_allclose(read.mean[splat], np.sign(place) * np.expm1(np.abs(place)), rtol=1e-5)


def test_antialiased_files_and_files_without_bands(file: Path) -> None:
    meta, images = sog_files.some(5, 0)
    sog_files.write(file, meta | {"antialias": True}, images)
    read = Splats.load(file)
    assert (read.sh_degree, read.antialiased) == (0, True)


def test_wrong_rotations_and_limits_are_left_out(file: Path) -> None:
    meta, images = sog_files.some(12, 0)
    images["quats.webp"][1, 2, 3] = 251
    sog_files.write(file, meta, images)
    with pytest.warns(UserWarning, match=r"left out 1 of 12 splats \(quat of splat 7: norm is 0"):
        assert len(Splats.load(file)) == 11
    meta["means"]["mins"][1] = None
    sog_files.write(file, meta, images)
    with pytest.raises(InputError, match=r"12 of 12 splats are unusable \(mean of splat 0: value is nan"):
        Splats.load(file)


def changed(*keys: str, value: Any) -> Callable[[dict[str, Any]], None]:
    """Return a function that replaces a value of meta.json."""

    def change(meta: dict[str, Any]) -> None:
        found = meta
        for key in keys[:-1]:
            found = found[key]
        found[keys[-1]] = value

    return change


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (changed("version", value=1), "has version 1, version 2 of SOG is read"),
        (changed("version", value=None), "has version None"),
        (changed("count", value=1e9), "count in meta.json is '1000000000.0', expected 0 to"),
        (changed("count", value=16), "image 0 of means has 15 pixels for 16 splats"),
        (changed("means", "mins", value=[1, 2]), "means.mins in meta.json is not 3 numbers"),
        (changed("means", "files", value=["means_l.webp"]), "means.files in meta.json has no file 1"),
        (changed("means", "files", value="means_l.webp"), "means.files in meta.json has no file 0"),
        (changed("means", "files", value=["gone.webp", "x"]), "has no file 'gone.webp'"),
        (changed("means", "files", value=["meta.json", "x"]), "'meta.json': cannot be read as an image"),
        (changed("scales", "codebook", value=["x"] * 256), "scales.codebook in meta.json is not 256 numbers"),
        (changed("scales", value=[]), "scales.codebook in meta.json is not 256 numbers"),
        (changed("quats", value=None), "quats.files in meta.json has no file 0"),
        (changed("shN", "bands", value=4), "bands in meta.json is '4', expected 0 to 3"),
        (changed("shN", "bands", value=2), "its palette is too small for 70 entries of 2 bands"),
        (changed("shN", "count", value=200), "its palette is too small for 200 entries"),
        (changed("shN", "count", value=1), "is not in the palette"),
    ],
)
def test_faulty_files_are_named(file: Path, change: Callable[[dict[str, Any]], None], said: str) -> None:
    meta, images = sog_files.some(13, 1)
    meta = copy.deepcopy(meta)
    change(meta)
    sog_files.write(file, meta, images)
    with pytest.raises(InputError, match=said) as caught:
        Splats.load(file)
    assert str(caught.value).startswith(str(file))
    assert "\n" not in str(caught.value)


def test_damaged_archives_and_folders_are_named(file: Path, tmp_path: Path) -> None:
    meta, images = sog_files.some(13, 1)
    sog_files.write(file, meta, images)
    data = file.read_bytes()
    for damaged in (data[:-30], data[:100], b"PK\3\4"):
        file.write_bytes(damaged)
        with pytest.raises(InputError, match=r"is not a sound .sog file"):
            Splats.load(file)
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("ä.webp", b"")
    file.write_bytes(file.read_bytes().replace("ä".encode(), b"\xff\xff"))
    with pytest.raises(InputError, match=r"is not a sound .sog file"):
        Splats.load(file)
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("meta.json", "[1")
    with pytest.raises(InputError, match=r"meta.json is not JSON"):
        Splats.load(file)
    sog_files.write(tmp_path / "meta.json", meta, images)
    (tmp_path / "quats.webp").unlink()
    with pytest.raises(InputError, match=r"quats.webp: cannot be read \(No such file"):
        Splats.load(tmp_path / "meta.json")


def test_an_image_that_is_far_too_large_is_not_decoded(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    meta, images = sog_files.some(12, 0)
    images["quats.webp"] = np.zeros((400, 400, 4), np.uint8)
    sog_files.write(file, meta, images)
    with pytest.raises(InputError, match=r"'quats.webp': is 400x400 px, far more than its splats need"):
        Splats.load(file)
    images["quats.webp"] = np.full((200, 200, 4), 252, np.uint8)
    sog_files.write(file, meta, images)
    assert len(Splats.load(file)) == 12, "writers may add rows"


def test_files_of_a_folder_lie_in_it(tmp_path: Path) -> None:
    """A meta.json of another place must not name files outside its folder."""
    meta, images = sog_files.some(5, 0)
    (tmp_path / "inner").mkdir()
    sog_files.write(tmp_path / "meta.json", meta, images)
    meta["quats"]["files"] = ["../quats.webp"]
    sog_files.write(tmp_path / "inner" / "meta.json", meta, images)
    (tmp_path / "inner" / "quats.webp").unlink()
    with pytest.raises(InputError, match=r"inner/quats.webp: cannot be read"):
        Splats.load(tmp_path / "inner" / "meta.json")


def test_near_plane_and_low_pass_are_kept_where_other_programs_do_not_look(file: Path) -> None:
    Splats("gaussian", Splats.load(written(file)).arrays, near_plane=0.2, low_pass=0.1).save(file)
    assert (Splats.load(file).near_plane, Splats.load(file).low_pass) == (0.2, 0.1)
    meta, images = sog_files.some(5, 0)
    for depth in (0, -1, "x", None, True):
        sog_files.write(file, meta | {"clsplat": {"nearPlane": depth}}, images)
        with pytest.raises(InputError, match=r"clsplat\.nearPlane in meta\.json is .*; give a depth above 0"):
            Splats.load(file)
        sog_files.write(file, meta | {"clsplat": {"lowPass": depth}}, images)
        with pytest.raises(InputError, match=r"clsplat\.lowPass in meta\.json is .*; give a variance above 0"):
            Splats.load(file)


def written(file: Path) -> Path:
    sog_files.write(file, *sog_files.some(5, 0))
    return file
