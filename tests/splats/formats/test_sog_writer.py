"""SOG files that clsplat writes: what comes back, what the numbers in the images are, and what is refused."""

from __future__ import annotations

import io
import json
import math
import zipfile
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, features
from reference.scenes import random_splats

from clsplat._version import __version__
from clsplat.errors import InputError, OutputError
from clsplat.files.images import decode_pixels, encode_pixels
from clsplat.splats.formats import sog_writer
from clsplat.splats.formats.codebooks import palette
from clsplat.splats.formats.sog_writer import write_sog
from clsplat.splats.morton import morton_order
from clsplat.splats.quaternions import rotations
from clsplat.splats.shapes import SKEW_MAX
from clsplat.splats.splats import Splats
from clsplat.splats.stored import StoredSplats

pytestmark = pytest.mark.filterwarnings("error")

STEP = 1 / 64  # of the coefficients above band 0


def gaussians(n: int = 60, degree: int = 1, **fields: np.ndarray) -> StoredSplats:
    """Random Gaussians, in Morton order, so that the file has their order."""
    arrays = {name: values.astype(np.float32) for name, values in random_splats(3, n, degree).items() if name != "skew"}
    arrays |= {name: values.astype(np.float32) for name, values in fields.items()}
    order = morton_order(arrays["mean"])
    return StoredSplats("gaussian", "peak", False, {name: values[order] for name, values in arrays.items()})


def content(file: Path) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return meta.json and the pixels of each image by its name, read by Pillow alone."""
    with zipfile.ZipFile(file) as archive:
        names = archive.namelist()
        assert all(entry.compress_type == zipfile.ZIP_STORED for entry in archive.infolist())
        images = {
            name.removesuffix(".webp"): np.array(Image.open(io.BytesIO(archive.read(name))).convert("RGBA"))
            for name in names
            if name.endswith(".webp")
        }
        return json.loads(archive.read("meta.json"), parse_constant=pytest.fail), images


def pixels(images: dict[str, np.ndarray], name: str, n: int) -> np.ndarray:
    return images[name].reshape(-1, 4)[:n].astype(np.float64)


def logarithmic(mean: np.ndarray) -> np.ndarray:
    wide = mean.astype(np.float64)
    return np.copysign(np.log(1.0 + np.abs(wide)), wide)


def opacity(logit: np.ndarray) -> np.ndarray:
    return 1.0 / (1.0 + np.exp(-logit.astype(np.float64)))


def covariances(log_scale: np.ndarray, quat: np.ndarray) -> np.ndarray:
    axes = rotations(quat.astype(np.float64)) * np.exp(log_scale.astype(np.float64))[:, None, :]
    return axes @ axes.transpose(0, 2, 1)


def nearest_distance(levels: list[float], values: np.ndarray) -> np.ndarray:
    return np.abs(values.astype(np.float64)[..., None] - np.array(levels)).min(axis=-1)


@pytest.mark.parametrize("degree", range(4))
def test_files_come_back_within_their_rounding(tmp_path: Path, degree: int) -> None:
    splats, file = gaussians(300, degree), tmp_path / "a.sog"
    write_sog(file, splats)
    read, wanted = Splats.load(file), splats.arrays
    assert (len(read), read.shape, read.sh_degree, read.antialiased) == (300, "gaussian", degree, False)
    place = logarithmic(wanted["mean"])
    half_steps = 0.5 * np.ptp(place, axis=0) / 65535
    assert (np.abs(logarithmic(read.mean) - place) <= half_steps + 1e-7).all()
    np.testing.assert_allclose(opacity(read.opacity_logit), opacity(wanted["opacity_logit"]), atol=0.5 / 255 + 1e-6)
    # Equal steps over the range of 2 would have errors of 1/256. Levels depend on the weights, so some steps are wider.
    np.testing.assert_allclose(read.log_scale, wanted["log_scale"], atol=3 / 256)
    np.testing.assert_allclose(read.sh[:, 0], wanted["sh"][:, 0], atol=0.05)
    np.testing.assert_allclose(read.sh[:, 1:], wanted["sh"][:, 1:], atol=STEP)
    # Half a turn about an axis of a splat changes the signs of two columns of its rotation, and no covariance.
    between = rotations(read.quat.astype(np.float64)).transpose(0, 2, 1) @ rotations(wanted["quat"].astype(np.float64))
    np.testing.assert_allclose(np.abs(between), np.broadcast_to(np.eye(3), between.shape), atol=0.02)
    found, exact = covariances(read.log_scale, read.quat), covariances(wanted["log_scale"], wanted["quat"])
    assert np.abs(found - exact).max() < 0.04 * np.exp(2 * wanted["log_scale"].max())


def test_numbers_in_the_images_are_the_nearest_ones(tmp_path: Path) -> None:
    """A float64 reference of each step of the quantisation, on the bytes of the images."""
    n = 400
    splats, file = gaussians(n, 2), tmp_path / "a.sog"
    write_sog(file, splats)
    meta, images = content(file)
    wanted, get = splats.arrays, partial(pixels, images, n=n)

    place = logarithmic(wanted["mean"])
    lower, upper = np.array(meta["means"]["mins"]), np.array(meta["means"]["maxs"])
    np.testing.assert_allclose([lower, upper], [place.min(axis=0), place.max(axis=0)], rtol=1e-15)
    number = get("means_l")[:, :3] + 256 * get("means_u")[:, :3]
    assert np.abs(number - 65535 * (place - lower) / (upper - lower)).max() <= 0.5 + 1e-6
    assert number.min(axis=0).tolist() == [0] * 3
    assert number.max(axis=0).tolist() == [65535] * 3

    levels = meta["scales"]["codebook"]
    chosen = np.array(levels)[get("scales")[:, :3].astype(int)]
    np.testing.assert_allclose(np.abs(chosen - wanted["log_scale"]), nearest_distance(levels, wanted["log_scale"]))
    levels = meta["sh0"]["codebook"]
    chosen = np.array(levels)[get("sh0")[:, :3].astype(int)]
    np.testing.assert_allclose(np.abs(chosen - wanted["sh"][:, 0]), nearest_distance(levels, wanted["sh"][:, 0]))
    assert np.abs(get("sh0")[:, 3] - 255 * opacity(wanted["opacity_logit"])).max() <= 0.5 + 1e-5

    levels = meta["shN"]["codebook"]
    label = (get("shN_labels")[:, 0] + 256 * get("shN_labels")[:, 1]).astype(int)
    assert label.tolist() == list(range(n))  # each splat has its own entry, in its order
    entries = images["shN_centroids"].reshape(-1, 8, 4)[label, :, :3]
    chosen = np.array(levels)[entries]
    np.testing.assert_allclose(np.abs(chosen - wanted["sh"][:, 1:]), nearest_distance(levels, wanted["sh"][:, 1:]))
    assert [len(meta[name]["codebook"]) for name in ("scales", "sh0", "shN")] == [256] * 3


def test_every_largest_component_comes_to_the_front(tmp_path: Path) -> None:
    """The stored quaternion is q, q i, q j or q k, whose first component is w, -x, -y or -z."""
    rng = np.random.default_rng(0)
    quat = rng.normal(size=(64, 4))
    quat[np.arange(64), np.arange(64) % 4] += np.where(np.arange(64) % 8 < 4, 5.0, -5.0)
    splats, file = gaussians(64, 0, quat=quat), tmp_path / "a.sog"
    write_sog(file, splats)
    stored = pixels(content(file)[1], "quats", 64)
    assert (stored[:, 3] == 252).all()
    unit = splats.arrays["quat"].astype(np.float64)
    unit /= np.linalg.norm(unit, axis=1, keepdims=True)
    w, x, y, z = unit.T
    products = np.stack([[w, x, y, z], [-x, w, z, -y], [-y, -z, w, x], [-z, y, -x, w]]).transpose(2, 0, 1)
    assert set(np.abs(unit).argmax(axis=1)) == {0, 1, 2, 3}
    best = products[np.arange(64), np.abs(products[:, :, 0]).argmax(axis=1)]
    best *= np.sign(best[:, :1])
    assert np.abs(stored[:, :3] - 255 * (best[:, 1:] / math.sqrt(2) + 0.5)).max() <= 0.5 + 1e-6


def test_meta_says_what_the_file_holds(tmp_path: Path) -> None:
    splats = gaussians(70, 3)
    write_sog(tmp_path / "a.sog", StoredSplats("gaussian", "peak", True, splats.arrays))
    meta, images = content(tmp_path / "a.sog")
    assert meta["version"] == 2
    assert meta["asset"] == {"generator": f"clsplat {__version__}"}
    assert (meta["count"], meta["antialias"]) == (70, True)
    assert (meta["shN"]["count"], meta["shN"]["bands"]) == (70, 3)
    assert images["shN_centroids"].shape == (2, 64 * 15, 4)
    assert {images[name].shape for name in images if name != "shN_centroids"} == {(6, 12, 4)}
    assert Splats.load(tmp_path / "a.sog").antialiased
    write_sog(tmp_path / "b.sog", gaussians(70, 0))
    meta, images = content(tmp_path / "b.sog")
    assert "shN" not in meta
    assert sorted(images) == ["means_l", "means_u", "quats", "scales", "sh0"]


def test_splats_are_written_in_morton_order(tmp_path: Path) -> None:
    arrays = gaussians(50).arrays
    order = np.random.default_rng(1).permutation(50)
    write_sog(tmp_path / "a.sog", gaussians(50))
    write_sog(tmp_path / "b.sog", StoredSplats("gaussian", "peak", False, {k: v[order] for k, v in arrays.items()}))
    assert (tmp_path / "a.sog").read_bytes() == (tmp_path / "b.sog").read_bytes()
    mean = Splats.load(tmp_path / "b.sog").mean
    np.testing.assert_allclose(mean, arrays["mean"], atol=1e-4)


def test_equal_splats_give_equal_bytes_and_files_have_no_time(tmp_path: Path) -> None:
    for name in ("a.sog", "b.sog"):
        write_sog(tmp_path / name, gaussians(500, 3))
    assert (tmp_path / "a.sog").read_bytes() == (tmp_path / "b.sog").read_bytes()
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        assert archive.namelist()[0] == "meta.json"
        for entry in archive.infolist():
            assert entry.date_time == (1980, 1, 1, 0, 0, 0)
            assert (entry.create_system, entry.external_attr >> 16) == (3, 0o644)


def test_labels_have_two_bytes_and_a_small_palette_stays_near(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    splats = gaussians(900, 1)
    write_sog(tmp_path / "exact.sog", splats)
    labels = content(tmp_path / "exact.sog")[1]["shN_labels"].reshape(-1, 4)
    assert labels[899].tolist() == [899 % 256, 899 // 256, 0, 255]
    monkeypatch.setattr(sog_writer, "palette", partial(palette, n=300))
    write_sog(tmp_path / "small.sog", splats)
    assert content(tmp_path / "small.sog")[0]["shN"]["count"] <= 300
    errors = [
        np.mean((Splats.load(tmp_path / name).sh - splats.arrays["sh"])[:, 1:] ** 2)
        for name in ("exact.sog", "small.sog")
    ]
    assert errors[0] < STEP**2 / 12 * 1.1
    assert errors[0] * 4 < errors[1] < 0.25 * splats.arrays["sh"][:, 1:].var()


def test_large_and_opaque_splats_have_smaller_errors(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(2)
    n, heavy = 3000, np.arange(3000) < 300
    log_scale = np.where(heavy[:, None], rng.normal(2.0, 0.5, (n, 3)), rng.normal(-4.0, 1.0, (n, 3)))
    splats = gaussians(n, 1, log_scale=log_scale, opacity_logit=np.where(heavy, 3.0, -3.0))
    monkeypatch.setattr(sog_writer, "palette", partial(palette, n=500))
    write_sog(tmp_path / "a.sog", splats)
    read = Splats.load(tmp_path / "a.sog")
    heavy = splats.arrays["opacity_logit"] > 0
    for found, wanted in (
        (read.log_scale, splats.arrays["log_scale"]),
        (read.sh[:, 1:].reshape(n, -1), splats.arrays["sh"][:, 1:].reshape(n, -1)),
    ):
        errors = np.mean((found - wanted) ** 2, axis=1)
        assert errors[heavy].mean() < 0.5 * errors[~heavy].mean()


def test_colours_of_transparent_splats_are_kept(tmp_path: Path) -> None:
    splats = gaussians(40, 0, opacity_logit=np.full(40, -30.0))
    write_sog(tmp_path / "a.sog", splats)
    _, images = content(tmp_path / "a.sog")
    assert not pixels(images, "sh0", 40)[:, 3].any()
    np.testing.assert_allclose(Splats.load(tmp_path / "a.sog").sh, splats.arrays["sh"], atol=0.05)


def test_images_come_back_exactly() -> None:
    image = np.random.default_rng(0).integers(0, 256, (7, 12, 4), dtype=np.uint8)
    image[2:5, :, 3] = 0
    np.testing.assert_array_equal(decode_pixels(encode_pixels(image), "image", 84), image)
    with pytest.raises(InputError, match=r"^image: is 12x7 px, far more than its splats need"):
        decode_pixels(encode_pixels(image), "image", 83)


@pytest.mark.parametrize("n", [0, 1, 2])
@pytest.mark.parametrize("degree", [0, 2])
def test_few_splats_come_back(tmp_path: Path, n: int, degree: int) -> None:
    splats = gaussians(n, degree)
    write_sog(tmp_path / "a.sog", splats)
    read = Splats.load(tmp_path / "a.sog")
    assert (len(read), read.sh_degree) == (n, degree)
    np.testing.assert_allclose(read.mean, splats.arrays["mean"], rtol=1e-6)
    np.testing.assert_allclose(read.log_scale, splats.arrays["log_scale"], rtol=1e-6)
    np.testing.assert_allclose(read.sh[:, 0], splats.arrays["sh"][:, 0], rtol=1e-6)


@pytest.mark.parametrize(("entries", "error"), [(1 << 16, STEP), (100, 1.2)])
def test_extreme_values_spoil_no_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, entries: int, error: float
) -> None:
    monkeypatch.setattr(sog_writer, "palette", partial(palette, n=entries))
    plain = gaussians(200, 1).arrays
    arrays = {name: values.copy() for name, values in plain.items()}
    arrays["sh"][0] = [[3e38] * 3, [-3e38] * 3, *np.zeros((2, 3))]
    arrays["log_scale"][1], arrays["log_scale"][2] = 79.0, -79.0
    arrays["opacity_logit"][3], arrays["opacity_logit"][4] = 1e30, -1e30
    arrays["mean"][5] = 3e38
    write_sog(tmp_path / "a.sog", StoredSplats("gaussian", "peak", False, arrays))
    read = Splats.load(tmp_path / "a.sog")
    assert len(read) == 200
    assert read.mean.max(axis=0) == pytest.approx([3e38] * 3, rel=1e-3)
    order = morton_order(arrays["mean"])
    others = order >= 6
    wanted = {name: values[order[others]] for name, values in plain.items()}
    np.testing.assert_allclose(read.sh[others, 0], wanted["sh"][:, 0], atol=0.05)
    np.testing.assert_allclose(read.sh[others, 1:], wanted["sh"][:, 1:], atol=error)
    np.testing.assert_allclose(read.log_scale[others], wanted["log_scale"], atol=3 / 256)
    found = opacity(read.opacity_logit[others])
    np.testing.assert_allclose(found, opacity(wanted["opacity_logit"]), atol=0.5 / 255 + 1e-6)


def test_other_shapes_and_too_many_splats_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "a.sog"
    with pytest.raises(InputError, match="hold Gaussians and skew-normals, not student-t") as caught:
        write_sog(file, StoredSplats("student-t", "peak", False, random_splats(0, 3, 0)))
    assert str(caught.value).startswith(str(file))
    monkeypatch.setattr(sog_writer, "_MAX_SIDE", 4)
    write_sog(tmp_path / "full.sog", gaussians(16, 0))
    with pytest.raises(InputError, match=r"a\.sog: \.sog files hold at most 16 splats, not 17: write a \.ply$"):
        write_sog(file, gaussians(17, 0))
    assert [path.name for path in tmp_path.iterdir()] == ["full.sog"]


def test_the_largest_image_fits_webp() -> None:
    image = np.zeros((1, sog_writer._MAX_SIDE, 4), np.uint8)
    assert decode_pixels(encode_pixels(image), "image", image.size).shape == image.shape
    width = 4 * math.ceil(math.sqrt(sog_writer._MAX_SIDE**2) / 4)
    assert width == sog_writer._MAX_SIDE <= 16383


def test_a_pillow_without_webp_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(features, "check", lambda name: name != "webp")
    with pytest.raises(
        OutputError, match=r"a\.sog: this Pillow cannot write WebP images: install it anew with"
    ) as caught:
        write_sog(tmp_path / "a.sog", gaussians(3, 0))
    assert "\n" not in str(caught.value)
    assert not list(tmp_path.iterdir())


def test_a_place_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match=r"cannot be written .*; choose another place"):
        write_sog(tmp_path / "file" / "a.sog", gaussians(3, 0))


def test_the_skew_comes_back_in_an_image_of_its_own(tmp_path: Path) -> None:
    """Rotations get half turns; what the splats show in space stays."""
    arrays = {name: values.astype(np.float32) for name, values in random_splats(3, 200, 1).items()}
    arrays["skew"][:20] = 0
    arrays["skew"][20] = [0, 0, 1.32]  # above the limit of the kernels
    before = Splats("skew-normal", arrays, "pdf", near_plane=0.3).select(morton_order(arrays["mean"]))
    before.save(tmp_path / "a.sog")
    after = Splats.load(tmp_path / "a.sog")
    assert (after.shape, after.normalisation, after.near_plane) == ("skew-normal", "pdf", 0.3)

    def in_world(splats: Splats) -> np.ndarray:
        """Skews in space, in deviations, so that the rounding of scales does not count."""
        return np.einsum("nij,nj->ni", rotations(splats.quat.astype(np.float64)), splats.skew)

    length = np.linalg.norm(before.skew, axis=1, keepdims=True)
    shorter = before.skew * np.minimum(SKEW_MAX / np.maximum(length, 1e-9), 1)
    bounded = before.with_arrays(before.to_numpy() | {"skew": shorter})
    np.testing.assert_allclose(in_world(after), in_world(bounded), atol=0.04)
    assert (after.skew[length[:, 0] == 0] == 0).all()
    # Other programs see Gaussians with the mean and the covariance of the skew-normals.
    meta, images = content(tmp_path / "a.sog")
    assert meta["clsplat"]["skew"]["files"] == ["skew.webp"]
    limit = meta["clsplat"]["skew"]["limit"]
    stored = (pixels(images, "skew", 200)[:, :3] - 127) / 127 * limit
    np.testing.assert_allclose(np.linalg.norm(stored, axis=1), np.minimum(length[:, 0], SKEW_MAX), atol=0.02)
    assert np.abs(stored).max() == pytest.approx(limit)


def test_gaussians_have_no_image_of_skews(tmp_path: Path) -> None:
    write_sog(tmp_path / "a.sog", gaussians())
    meta, images = content(tmp_path / "a.sog")
    assert set(meta["clsplat"]) == {"nearPlane", "lowPass"}
    assert "skew" not in images


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"skew": {"limit": 2.0, "files": ["skew.webp"]}}, "skew.limit in meta.json is '2.0'"),
        ({"skew": {"files": ["skew.webp"]}}, "skew.limit in meta.json is 'None'"),
        ({"skew": {"limit": 1.0}}, "files in meta.json has no file 0"),
        ({"skew": {"limit": 1.0, "files": ["no.webp"]}}, "has no file 'no.webp'"),
        ({"normalisation": "sum"}, "normalisation 'sum' in meta.json is unknown"),
    ],
)
def test_damaged_skews_are_named(tmp_path: Path, change: dict[str, Any], message: str) -> None:
    arrays = {name: values.astype(np.float32) for name, values in random_splats(3, 20, 1).items()}
    Splats("skew-normal", arrays).save(tmp_path / "a.sog")
    with zipfile.ZipFile(tmp_path / "a.sog") as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    meta = json.loads(files["meta.json"])
    meta["clsplat"] |= change
    with zipfile.ZipFile(tmp_path / "b.sog", "w") as archive:
        for name, data in (files | {"meta.json": json.dumps(meta).encode()}).items():
            archive.writestr(name, data)
    with pytest.raises(InputError, match=message):
        Splats.load(tmp_path / "b.sog")
