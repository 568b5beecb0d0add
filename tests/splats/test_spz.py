"""`.spz` and `.splat` files: what comes back, what the bytes are, and what is refused."""

from __future__ import annotations

import gzip
import struct
from pathlib import Path

import numpy as np
import pytest
from reference.scenes import random_splats

from clsplat.errors import InputError
from clsplat.splats.dot_splat import read_splat, write_splat
from clsplat.splats.splats import Splats
from clsplat.splats.spz import read_spz, write_spz

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
    write_spz(file, splats)
    read = read_spz(file)
    assert read.sh_degree == degree
    np.testing.assert_allclose(read.mean, splats.mean, atol=1e-6)
    np.testing.assert_allclose(read.log_scale, splats.log_scale, atol=0.5 / 16 + 1e-6)
    opacity = [1 / (1 + np.exp(-s.opacity_logit)) for s in (read, splats)]
    np.testing.assert_allclose(opacity[0], opacity[1], atol=0.5 / 255 + 1e-6)
    assert np.abs(np.sum(unit(read.quat) * unit(splats.quat), axis=1)).min() > 1 - 1e-5
    np.testing.assert_allclose(read.sh[:, 0], splats.sh[:, 0], atol=0.5 / 38.25 + 1e-6)
    steps = np.where(np.arange(1, read.sh.shape[1]) < 4, 1 / 128, 2 / 128)[:, None]
    assert (np.abs(read.sh - splats.sh)[:, 1:] <= steps + 1e-6).all()


def test_bytes_of_spz_are_the_format_s(tmp_path: Path) -> None:
    """One splat, worked out by hand."""
    arrays = {
        "mean": [[-0.5, 4.0, 7.5]],
        "quat": [[-0.8, 0.6, 0.0, 0.0]],
        "log_scale": [[-10.0, 0.0, 9.0]],
        "opacity_logit": [0.0],
        "sh": [[[0.0, 1.0, -9.0]]],
    }
    write_spz(tmp_path / "a.spz", Splats("gaussian", arrays))
    data = gzip.decompress((tmp_path / "a.spz").read_bytes())
    assert HEADER.unpack(data[:16]) == (0x5053474E, 3, 1, 0, 20, 0, 0)
    assert data[16:25] == b"".join((int(v * 2**20) & 0xFFFFFF).to_bytes(3, "little") for v in (-0.5, 4.0, 7.5))
    assert list(data[25:32]) == [128, 128, 166, 0, 0, 160, 255]  # 127.5 goes to the even neighbour
    size = round(0.6 * 511 * 2**0.5)
    assert int.from_bytes(data[32:36], "little") == 3 << 30 | (512 + size) << 20  # w the largest, x against its sign
    assert len(data) == 36


def test_every_component_can_be_the_largest(tmp_path: Path) -> None:
    splats = gaussians(0, 4, quat=SMALL)
    write_spz(tmp_path / "a.spz", splats)
    dots = np.sum(unit(read_spz(tmp_path / "a.spz").quat) * unit(splats.quat), axis=1)
    np.testing.assert_allclose(np.abs(dots), 1.0, atol=1e-5)


def test_far_positions_take_bits_from_the_fraction(tmp_path: Path) -> None:
    for far, error in ((3000.0, 2**-12), (8e6, 1.0)):
        mean = np.linspace(-far, far, 36).reshape(12, 3)
        write_spz(tmp_path / "a.spz", gaussians(mean=mean))
        np.testing.assert_allclose(read_spz(tmp_path / "a.spz").mean, mean, atol=error, rtol=1e-6)
    with pytest.raises(InputError, match="reach 8388607"):
        write_spz(tmp_path / "b.spz", gaussians(mean=1e7))
    write_spz(tmp_path / "c.spz", gaussians(n=0))
    assert len(read_spz(tmp_path / "c.spz")) == 0


def test_spz_says_whether_splats_are_antialiased(tmp_path: Path) -> None:
    for antialiased in (False, True):
        splats = Splats("gaussian", gaussians().arrays, antialiased=antialiased)
        write_spz(tmp_path / "a.spz", splats)
        assert read_spz(tmp_path / "a.spz").antialiased is antialiased


def test_the_same_splats_are_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a.spz", "b.spz"):
        write_spz(tmp_path / name, gaussians())
    assert (tmp_path / "a.spz").read_bytes() == (tmp_path / "b.spz").read_bytes()


def test_damaged_spz_is_refused(tmp_path: Path) -> None:
    file = tmp_path / "a.spz"
    write_spz(file, gaussians())
    data = file.read_bytes()
    whole = gzip.decompress(data)
    lying = HEADER.pack(0x5053474E, 3, 2**32 - 1, 3, 12, 0, 0)
    cases = {
        "ends in the header": gzip.compress(whole[:7]),
        "of version 3": gzip.compress(b"NGSQ" + whole[4:]),
        "too short": gzip.compress(lying + whole[16:]),
        "does not hold the 12": gzip.compress(whole[:-1]),
        "does not hold": gzip.compress(whole + b"1"),
        "damaged": data[:-20],
        "cannot be read": whole,
    }
    for said, damaged in cases.items():
        file.write_bytes(damaged)
        with pytest.raises(InputError, match=said):
            read_spz(file)
    with pytest.raises(InputError, match="cannot be read"):
        read_spz(tmp_path / "none.spz")


def test_splat_comes_back_within_its_rounding(tmp_path: Path) -> None:
    splats, file = gaussians(0), tmp_path / "a.splat"
    write_splat(file, splats)
    read = read_splat(file)
    order = [int(np.abs(splats.mean - mean).sum(axis=1).argmin()) for mean in read.mean]
    np.testing.assert_array_equal(read.mean, splats.mean[order])
    np.testing.assert_allclose(read.log_scale, splats.log_scale[order], atol=1e-5)
    assert np.abs(np.sum(unit(read.quat) * unit(splats.quat)[order], axis=1)).min() > 0.999
    colours = [np.clip(0.5 + 0.28209479 * sh[:, 0], 0, 1) for sh in (read.sh, splats.sh[order])]
    np.testing.assert_allclose(colours[0], colours[1], atol=0.5 / 255 + 1e-6)
    data = file.read_bytes()
    for said, damaged in {
        "multiple of 32": data[:-1],
        "finite": b"\0\0\xc0\x7f" + data[4:],
        "norm is 0": data[:28] + bytes([128] * 4) + data[32:],
    }.items():
        file.write_bytes(damaged)
        with pytest.raises(InputError, match=said):
            read_splat(file)
    with pytest.raises(InputError, match="cannot be read"):
        read_splat(tmp_path)


def test_only_gaussians_are_taken(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="hold Gaussians, not skew-normal"):
        write_spz(tmp_path / "a.spz", Splats("skew-normal", random_splats(7, 3, 0)))
    assert not list(tmp_path.iterdir())
