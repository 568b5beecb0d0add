"""`.spz` and `.splat` files: what comes back, what the bytes are, and what is refused."""

from __future__ import annotations

import gzip
import struct
import sys
from itertools import pairwise, product
from pathlib import Path

import numpy as np
import pytest
from reference.scenes import random_splats

from clsplat.errors import InputError
from clsplat.files import zstd
from clsplat.splats.formats.spz import _other_axes
from clsplat.splats.formats.spz_streams import SpzHeader, write_container
from clsplat.splats.harmonics import axis_flip_signs, sh_basis
from clsplat.splats.quaternions import rotations
from clsplat.splats.splats import Splats

HEADER = struct.Struct("<IIIBBBB")
SMALL = [(1.0, 0.0, 0.0, 0.0), (0.5, -0.5, 0.5, -0.5), (-0.1, 0.7, -0.7, 0.1), (0.0, 0.0, 0.0, -3.0)]


def gaussians(degree: int = 2, n: int = 12, **fields: object) -> Splats:
    arrays = {name: values.astype(np.float32) for name, values in random_splats(7, n, degree).items() if name != "skew"}
    for name, value in fields.items():
        arrays[name] = np.broadcast_to(np.float32(value), arrays[name].shape)
    return Splats("gaussian", arrays)


def unit(quat: np.ndarray) -> np.ndarray:
    return quat / np.linalg.norm(quat, axis=1, keepdims=True)


@pytest.mark.parametrize("degree", range(4))
def test_spz_comes_back_within_its_rounding(tmp_path: Path, degree: int) -> None:
    splats, file = gaussians(degree), tmp_path / "a.spz"
    splats.save(file)
    read = Splats.load(file)
    assert read.sh_degree == degree
    np.testing.assert_allclose(read.mean, splats.mean, atol=1e-6)
    np.testing.assert_allclose(read.log_scale, splats.log_scale, atol=0.5 / 16 + 1e-6)
    opacity = [1 / (1 + np.exp(-s.opacity_logit)) for s in (read, splats)]
    np.testing.assert_allclose(opacity[0], opacity[1], atol=0.5 / 255 + 1e-6)
    assert np.abs(np.sum(unit(read.quat) * unit(splats.quat), axis=1)).min() > 1 - 1e-5
    np.testing.assert_allclose(read.sh[:, 0], splats.sh[:, 0], atol=0.5 / 38.25 + 1e-6)
    steps = np.where(np.arange(1, read.sh.shape[1]) < 4, 1 / 128, 2 / 128)[:, None]
    assert (np.abs(read.sh - splats.sh)[:, 1:] <= steps + 1e-6).all()


def by_hand(version: int, flags: int = 0, extensions: bytes = b"") -> bytes:
    """The bytes of a file with two splats of SH degree 3, made of the format's description alone.

    Each coefficient and channel of the harmonics has another byte. The axes are x right, y up, z back.
    """
    places = [(-0.5, 4.0, -7.5), (1.0, -2.0, 3.0)]
    if version == 1:
        stored = b"".join(struct.pack("<3e", *place) for place in places)
    else:
        stored = b"".join((int(v * 2**12) & 0xFFFFFF).to_bytes(3, "little") for place in places for v in place)
    # w = 0.8, y = 0.6, then z = -0.6; the largest is left out, the others are x, y, z.
    size = round(0.6 * 511 * 2**0.5)
    packed = [3 << 30 | size << 10, 3 << 30 | 1 << 9 | size]
    small = [bytes([128, round(127.5 + 127.5 * 0.6), 128]), bytes([128, 128, round(127.5 - 127.5 * 0.6)])]
    parts = [
        stored,
        bytes([255, 128]),  # opacities
        bytes([128, 166, 0, 10, 20, 30]),  # colours
        bytes([0, 160, 255, 16, 32, 48]),  # scales
        b"".join(struct.pack("<I", word) for word in packed) if version > 2 else b"".join(small),
        bytes([*range(100, 145), *range(145, 190)]),
    ]
    start = (0x5053474E, version, 2, 3, 12, flags)
    if version < 4:
        return gzip.compress(HEADER.pack(*start, 0) + b"".join(parts) + extensions)
    zstandard = pytest.importorskip("zstandard")
    frames = [zstandard.ZstdCompressor().compress(part) for part in parts]
    table = b"".join(struct.pack("<QQ", len(frame), len(part)) for frame, part in zip(frames, parts, strict=True))
    return struct.pack("<IIIBBBBI12x", *start, 6, 32 + len(extensions)) + extensions + table + b"".join(frames)


# Which harmonics above band 0 are odd in y and z together: 3DGS's order, m = -l ... l in each band.
TURNED = [-1, -1, 1, -1, 1, 1, -1, 1, -1, 1, -1, -1, 1, -1, 1]


@pytest.mark.parametrize("version", [1, 2, 3, 4])
def test_a_file_made_by_hand_is_read(tmp_path: Path, version: int) -> None:
    (tmp_path / "a.spz").write_bytes(by_hand(version))
    read = Splats.load(tmp_path / "a.spz")
    assert (read.shape, read.antialiased) == ("gaussian", False)
    np.testing.assert_array_equal(read.mean, [[-0.5, -4.0, 7.5], [1.0, 2.0, -3.0]])
    rounding = 0.01 if version < 3 else 1e-3
    np.testing.assert_allclose(read.quat, [[0.8, 0, -0.6, 0], [0.8, 0, 0, 0.6]], atol=rounding)
    np.testing.assert_array_equal(read.log_scale, [[-10, 0, 5.9375], [-9, -8, -7]])
    np.testing.assert_allclose(1 / (1 + np.exp(-read.opacity_logit)), [1.0, 128 / 255], atol=1e-6)
    np.testing.assert_allclose(
        read.sh[:, 0], (np.array([[128, 166, 0], [10, 20, 30]]) - 127.5) / 38.25, rtol=0, atol=1e-6
    )
    for splat, first in ((0, 100), (1, 145)):
        stored = np.arange(first, first + 45).reshape(15, 3)  # a coefficient's three channels are side by side
        np.testing.assert_array_equal(read.sh[splat, 1:], (stored - 128) / 128 * np.array(TURNED)[:, None])


@pytest.mark.parametrize("version", [3, 4])
def test_what_is_written_is_the_file_made_by_hand(tmp_path: Path, version: int) -> None:
    """The attributes' bytes; only harmonics are rounded to the writer's steps."""
    (tmp_path / "a.spz").write_bytes(by_hand(version))
    Splats.load(tmp_path / "a.spz").save(tmp_path / "b.spz", spz_version=version)
    wanted, written = attributes(by_hand(version)), attributes((tmp_path / "b.spz").read_bytes())
    assert written[0] == wanted[0][:13] + bytes([20]) + wanted[0][14:]  # fraction bits
    np.testing.assert_array_equal(np.frombuffer(written[1][1:3], "<u2")[0], (-0.5 * 2**20 / 256) % 2**16)
    assert written[2:6] == wanted[2:6]
    steps = np.tile(np.where(np.arange(45) < 9, 2, 4), 2)
    differences = np.frombuffer(written[6], np.uint8).astype(int) - np.frombuffer(wanted[6], np.uint8)
    assert (np.abs(differences) <= steps / 2).all()
    assert not (np.frombuffer(written[6], np.uint8) % steps).any()


def attributes(data: bytes) -> list[bytes]:
    """The header (16 bytes) and the six attributes of a file of two splats, SH degree 3, version 3 or 4."""
    if data[:4] != b"NGSP":
        body = gzip.decompress(data)
        ends = [0, 16, 34, 36, 42, 48, 56, 146]
        assert len(body) == ends[-1]
        return [body[a:b] for a, b in pairwise(ends)]
    zstandard = pytest.importorskip("zstandard")
    table = struct.unpack_from("<12Q", data, 32)
    ends = np.cumsum([128, *table[::2]])
    assert len(data) == ends[-1]
    frames = [zstandard.ZstdDecompressor().decompress(data[a:b]) for a, b in pairwise(ends)]
    assert [len(frame) for frame in frames] == [*table[1::2]]
    return [data[:15] + b"\0", *frames]


def test_bytes_of_spz_are_the_format_s(tmp_path: Path) -> None:
    """One splat, worked out by hand."""
    arrays = {
        "mean": [[-0.5, -4.0, -7.5]],
        "quat": [[-0.8, 0.0, 0.6, 0.0]],
        "log_scale": [[-10.0, 0.0, 9.0]],
        "opacity_logit": [0.0],
        "sh": [[[0.0, 1.0, -9.0]]],
    }
    Splats("gaussian", arrays).save(tmp_path / "a.spz")
    data = gzip.decompress((tmp_path / "a.spz").read_bytes())
    assert HEADER.unpack(data[:16]) == (0x5053474E, 3, 1, 0, 20, 0, 0)
    assert data[16:25] == b"".join((int(v * 2**20) & 0xFFFFFF).to_bytes(3, "little") for v in (-0.5, 4.0, 7.5))
    assert list(data[25:32]) == [128, 128, 166, 0, 0, 160, 255]  # 127.5 goes to the even neighbour
    size = round(0.6 * 511 * 2**0.5)
    # w is the largest. Its sign makes y negative, the flip of the axes makes it positive again.
    assert int.from_bytes(data[32:36], "little") == 3 << 30 | size << 10
    assert len(data) == 36


def test_colours_turn_with_the_axes() -> None:
    """From any side, the stored splats show the colour of the splats."""
    directions = np.random.default_rng(3).normal(size=(20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    sh = np.random.default_rng(4).normal(size=16)
    for signs in product((1.0, -1.0), repeat=3):
        flipped = axis_flip_signs(np.array(signs), 3) * sh
        np.testing.assert_allclose(sh_basis(directions * signs, 3) @ flipped, sh_basis(directions, 3) @ sh, atol=1e-12)


@pytest.mark.parametrize("version", [3, 4])
def test_extensions_are_skipped_or_name_the_axes(tmp_path: Path, version: int) -> None:
    orbit = struct.pack("<II3f", 0xADBE0002, 12, 0.1, 0.2, 1.5)
    right_down_front = struct.pack("<III", 0xADBE0003, 4, 6)
    file = tmp_path / "a.spz"
    file.write_bytes(by_hand(version))
    plain = Splats.load(file)
    file.write_bytes(by_hand(version, 3, orbit))
    known = Splats.load(file)
    assert known.antialiased
    np.testing.assert_array_equal(known.mean, plain.mean)
    file.write_bytes(by_hand(version, 2, orbit + right_down_front))
    unturned = Splats.load(file)
    np.testing.assert_array_equal(unturned.mean, plain.mean * [1, -1, -1])
    np.testing.assert_allclose(unturned.quat, plain.quat * [1, 1, -1, -1])
    np.testing.assert_array_equal(unturned.sh[:, 1:], plain.sh[:, 1:] * np.array(TURNED)[:, None])
    file.write_bytes(by_hand(version, 2, orbit + struct.pack("<III", 0xADBE0003, 4, 12)))
    with pytest.raises(InputError, match="coordinate system 12 is not read; write it with axes RUB"):
        Splats.load(file)
    file.write_bytes(by_hand(version, 2, orbit[:-3]))
    with pytest.raises(InputError, match="its extensions are damaged"):
        Splats.load(file)


def test_band_4_is_left_out(tmp_path: Path) -> None:
    data = bytearray(gzip.decompress(by_hand(3)))
    data[12] = 4
    (tmp_path / "a.spz").write_bytes(gzip.compress(bytes(data[:-90] + bytes(range(144)))))
    with pytest.warns(UserWarning, match="left out SH bands above 3"):
        read = Splats.load(tmp_path / "a.spz")
    stored = np.arange(72, 117).reshape(15, 3)
    np.testing.assert_array_equal(read.sh[1, 1:], (stored - 128) / 128 * np.array(TURNED)[:, None])


def test_half_floats_that_are_not_finite_are_left_out(tmp_path: Path) -> None:
    data = bytearray(gzip.decompress(by_hand(1)))
    data[16:18] = struct.pack("<e", np.inf)
    (tmp_path / "a.spz").write_bytes(gzip.compress(bytes(data)))
    with pytest.warns(UserWarning, match=r"left out 1 of 2 splats \(mean of splat 0: value is -?inf"):
        assert Splats.load(tmp_path / "a.spz").mean.tolist() == [[1.0, 2.0, -3.0]]


def test_version_4_says_what_is_missing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.spz").write_bytes(by_hand(4))
    splats = gaussians()
    monkeypatch.setitem(sys.modules, "zstandard", None)
    with pytest.raises(InputError, match=r"version 4: needs Zstandard: pip install 'clsplat\[spz\]', or write it as"):
        Splats.load(tmp_path / "a.spz")
    with pytest.raises(InputError, match=r"b.spz: version 4 needs Zstandard: pip install"):
        splats.save(tmp_path / "b.spz", spz_version=4)
    with pytest.raises(InputError, match=r"version 2 of .spz is not written: choose 3 or 4"):
        splats.save(tmp_path / "b.spz", spz_version=2)
    assert [path.name for path in tmp_path.iterdir()] == ["a.spz"]


@pytest.mark.filterwarnings("ignore:.*their sizes are clipped")
@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("value", [3e38, -3e38])
@pytest.mark.parametrize("name", ["log_scale", "sh", "opacity_logit"])
def test_huge_values_become_the_nearest_bytes(tmp_path: Path, name: str, value: float) -> None:
    """No warning of NumPy reaches a user."""
    gaussians(**{name: value}).save(tmp_path / "a.spz")
    gaussians(**{name: np.sign(value) * 100}).save(tmp_path / "b.spz")
    assert (tmp_path / "a.spz").read_bytes() == (tmp_path / "b.spz").read_bytes()
    gaussians(**{name: value}).save(tmp_path / "a.splat")


@pytest.mark.parametrize(
    ("scales", "clipped"),
    [
        ((6.0, 0.0, 0.0), True),  # too large along one axis
        ((-10.1, -12.0, -11.0), True),  # too small along all
        ((5.9, 0.0, 0.0), False),
        ((-14.0, -14.0, 0.0), False),  # a needle
    ],
)
def test_sizes_that_spz_does_not_hold_are_named(
    tmp_path: Path, scales: tuple[float, ...], clipped: bool, recwarn: pytest.WarningsRecorder
) -> None:
    arrays = dict(gaussians(n=10).arrays)
    arrays["log_scale"] = np.zeros((10, 3), np.float32)
    arrays["log_scale"][3] = scales
    Splats("gaussian", arrays).save(tmp_path / "a.spz")
    said = [str(warning.message) for warning in recwarn]
    expected = f"{tmp_path / 'a.spz'}: 10.0% of the splats are smaller or larger than .spz holds (4.4e-05 to 391 units)"
    assert [text.startswith(expected) for text in said] == [True] * clipped


def test_every_component_can_be_the_largest(tmp_path: Path) -> None:
    splats = gaussians(0, 4, quat=SMALL)
    splats.save(tmp_path / "a.spz")
    dots = np.sum(unit(Splats.load(tmp_path / "a.spz").quat) * unit(splats.quat), axis=1)
    np.testing.assert_allclose(np.abs(dots), 1.0, atol=1e-5)


def test_far_positions_take_bits_from_the_fraction(tmp_path: Path) -> None:
    for far, error in ((3000.0, 2**-12), (8e6, 1.0)):
        mean = np.linspace(-far, far, 36).reshape(12, 3)
        gaussians(mean=mean).save(tmp_path / "a.spz")
        np.testing.assert_allclose(Splats.load(tmp_path / "a.spz").mean, mean, atol=error, rtol=1e-6)
    with pytest.raises(InputError, match="reach 8388607"):
        gaussians(mean=1e7).save(tmp_path / "b.spz")
    gaussians(n=0).save(tmp_path / "c.spz")
    assert len(Splats.load(tmp_path / "c.spz")) == 0


@pytest.mark.parametrize(("far", "coarse"), [(1e5, False), (1e6, True)])
def test_a_far_splat_that_moves_all_others_is_named(
    tmp_path: Path, far: float, coarse: bool, recwarn: pytest.WarningsRecorder
) -> None:
    arrays = gaussians(n=10).to_numpy()
    arrays["log_scale"][:] = np.log(0.1)
    arrays["mean"][3, 1] = far
    Splats("gaussian", arrays).save(tmp_path / "a.spz")
    said = [str(warning.message) for warning in recwarn]
    expected = (
        f"{tmp_path / 'a.spz'}: a splat lies {far:.3g} units away, so .spz holds positions in steps of 0.12 units"
    )
    assert [text.startswith(expected) for text in said] == [True] * coarse


def test_spz_says_whether_splats_are_antialiased(tmp_path: Path) -> None:
    for antialiased in (False, True):
        splats = Splats("gaussian", gaussians().arrays, antialiased=antialiased)
        splats.save(tmp_path / "a.spz")
        assert Splats.load(tmp_path / "a.spz").antialiased is antialiased


@pytest.mark.parametrize("version", [3, 4])
def test_the_same_splats_are_the_same_bytes(tmp_path: Path, version: int) -> None:
    if version == 4:
        pytest.importorskip("zstandard")
    for name in ("a.spz", "b.spz"):
        gaussians().save(tmp_path / name, spz_version=version)
    assert (tmp_path / "a.spz").read_bytes() == (tmp_path / "b.spz").read_bytes()


def test_damaged_spz_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "a.spz"
    gaussians().save(file)
    data = file.read_bytes()
    whole = gzip.decompress(data)
    lying = HEADER.pack(0x5053474E, 3, 2**32 - 1, 3, 12, 0, 0)
    cases = {
        "ends in the header": gzip.compress(whole[:7]),
        "is not a .spz file; choose": gzip.compress(b"NGSQ" + whole[4:]),
        "has version 5, versions 1 to 4": gzip.compress(whole[:4] + b"\5" + whole[5:]),
        "has version 4, versions 1 to 4": gzip.compress(whole[:4] + b"\4" + whole[5:]),
        "has SH degree 9": gzip.compress(whole[:12] + b"\t" + whole[13:]),
        "too short": gzip.compress(lying + whole[16:]),
        "does not hold the 12": gzip.compress(whole[:-1]),
        "does not hold": gzip.compress(whole + b"1"),
        "damaged": data[:-20],
        "has version 3, versions 1 to 4": whole,
    }
    for said, damaged in cases.items():
        file.write_bytes(damaged)
        with pytest.raises(InputError, match=said):
            Splats.load(file)
    with pytest.raises(InputError, match="cannot be read"):
        Splats.load(tmp_path / "none.spz")


def test_damaged_spz_of_version_4_is_refused(tmp_path: Path) -> None:
    pytest.importorskip("zstandard")
    file = tmp_path / "a.spz"
    gaussians().save(file, spz_version=4)
    data = file.read_bytes()
    cases = {
        "ends in the header": data[:31],
        "table of 6 attributes is damaged": data[:100],
        "table of 5 attributes is damaged": data[:15] + b"\5" + data[16:],
        "does not hold the 4294967295": data[:8] + b"\xff" * 4 + data[12:],
        "does not hold the 12 splats": data[:-1],
        "compressed data are damaged": data[:128] + b"1234" + data[132:],
        "compressed data hold": data[:32] + struct.pack("<QQ", 20, 108) + data[48:],
    }
    for said, damaged in cases.items():
        file.write_bytes(damaged)
        with pytest.raises(InputError, match=said):
            Splats.load(file)


def test_zstd_is_bounded_by_the_size_that_is_asked_for() -> None:
    zstandard = pytest.importorskip("zstandard")
    bomb = zstandard.ZstdCompressor().compress(bytes(1 << 24))
    with pytest.raises(InputError, match="hold more instead of 100 bytes"):
        zstd.decompress(bomb, 100)
    with pytest.raises(InputError, match="hold 16777216 instead of 16777217 bytes"):
        zstd.decompress(bomb, (1 << 24) + 1)
    assert zstd.decompress(bomb, 1 << 24) == bytes(1 << 24)


def test_splat_comes_back_within_its_rounding(tmp_path: Path) -> None:
    splats, file = gaussians(0), tmp_path / "a.splat"
    splats.save(file)
    read = Splats.load(file)
    order = [int(np.abs(splats.mean - mean).sum(axis=1).argmin()) for mean in read.mean]
    np.testing.assert_array_equal(read.mean, splats.mean[order])
    np.testing.assert_allclose(read.log_scale, splats.log_scale[order], atol=1e-5)
    assert np.abs(np.sum(unit(read.quat) * unit(splats.quat)[order], axis=1)).min() > 0.999
    colours = [np.clip(0.5 + 0.28209479 * sh[:, 0], 0, 1) for sh in (read.sh, splats.sh[order])]
    np.testing.assert_allclose(colours[0], colours[1], atol=0.5 / 255 + 1e-6)
    data = file.read_bytes()
    for said, damaged in {
        "multiple of 32": data[:-1],
        "2 of 2 splats are unusable .*finite": (b"\0\0\xc0\x7f" + data[4:32]) * 2,
        "norm is 0": data[:28] + bytes([128] * 4),
    }.items():
        file.write_bytes(damaged)
        with pytest.raises(InputError, match=said):
            Splats.load(file)
    with pytest.raises(InputError, match="cannot be read"):
        Splats.load(tmp_path)


def test_unusable_splats_of_splat_files_are_left_out(tmp_path: Path) -> None:
    file = tmp_path / "a.splat"
    gaussians(0).save(file)
    data = file.read_bytes()
    file.write_bytes(b"\0\0\xc0\x7f" + data[4:])
    with pytest.warns(UserWarning, match=r"left out 1 of 12 splats \(mean of splat 0: value is nan"):
        assert len(Splats.load(file)) == 11
    file.write_bytes(data[:12] + bytes(12) + data[24:27] + b"\xff" + data[28:])  # scales of 0, opacity of 255
    read = Splats.load(file)
    assert len(read) == 12
    assert (np.exp(read.log_scale[0]) < 1e-25).all()
    assert 1 / (1 + np.exp(-read.opacity_logit[0])) == pytest.approx(1, abs=1e-6)


def test_only_gaussians_are_taken(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="hold Gaussians, not skew-normal"):
        Splats("skew-normal", random_splats(7, 3, 0)).save(tmp_path / "a.spz")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("system", range(1, 9))
def test_axes_of_every_system_mirror_the_whole_splat(system: int) -> None:
    """The flips F turn positions p into F p, covariances C into F C F, and colours stay in the flipped directions."""
    rng = np.random.default_rng(system)
    arrays = {
        "mean": rng.normal(size=(5, 3)),
        "quat": rng.normal(size=(5, 4)),
        "log_scale": rng.normal(size=(5, 3)),
        "sh": rng.normal(size=(5, 16, 3)),
    }
    turned, ply = _other_axes(arrays, system), 6
    flips = np.where([(system - 1 ^ ply - 1) >> axis & 1 for axis in range(3)], -1.0, 1.0)

    def covariances(of: dict[str, np.ndarray]) -> np.ndarray:
        axes = rotations(of["quat"]) * np.exp(of["log_scale"])[:, None, :]
        return axes @ axes.transpose(0, 2, 1)

    def colours(of: dict[str, np.ndarray], directions: np.ndarray) -> np.ndarray:
        return np.einsum("nk,nkc->nc", sh_basis(directions, 3), of["sh"])

    directions = rng.normal(size=(5, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    np.testing.assert_allclose(turned["mean"], arrays["mean"] * flips)
    np.testing.assert_allclose(covariances(turned), covariances(arrays) * np.outer(flips, flips), atol=1e-9)
    np.testing.assert_allclose(colours(turned, directions * flips), colours(arrays, directions), atol=1e-12)


def test_the_container_has_no_time() -> None:
    """Bytes 4 to 7 of a gzip stream are the time of the file. The same splats give the same bytes at any time."""
    empty = write_container(SpzHeader(3, 0, 0, 12, 0), [b""] * 6)
    assert empty[:4] == b"\x1f\x8b\x08\x00"
    assert empty[4:8] == bytes(4)
