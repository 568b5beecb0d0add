"""Compressed PLY files of PlayCanvas: values worked out by hand, and named faults."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import packed_ply
import pytest

from clsplat.errors import InputError
from clsplat.splats.harmonics import SH_C0
from clsplat.splats.splats import Splats


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "model.compressed.ply"


def by_hand(colors: bool = True) -> packed_ply.Packed:
    """Two splats of SH degree 1: one at the least values of its chunk, one at the greatest."""
    limits = [-1, -2, -3, 4, 5, 6, -7, -8, -9, 0, 1, 2] + [0.25, 0.5, -0.5, 0.75, 1.5, 1.0] * colors
    # The rotations have their largest component at w, and at z with x = sqrt(1/2).
    words = [
        [0, 512 << 20 | 512 << 10 | 512, 0, 0],
        [0xFFFFFFFF, 3 << 30 | 512 << 20 | 1023 << 10 | 512, 0xFFFFFFFF, 0xFFFFFFFF],
    ]
    rest = [[0, 255, 128, 127, *range(10, 15)], [1, 254, 64, 192, *range(20, 25)]]
    return packed_ply.Packed(np.array([limits], "<f4"), np.array(words, "<u4"), np.array(rest, np.uint8))


def test_an_element_of_bands_without_columns(file: Path) -> None:
    """gsplat's exporter names the element of the bands also if there are none."""
    model = by_hand()
    packed_ply.write(file, model._replace(rest=model.rest[:, :0]))
    wanted = Splats.load(file)
    file.write_bytes(file.read_bytes().replace(b"end_header", b"element sh 2\nend_header", 1))
    found = Splats.load(file)
    assert found.sh_degree == 0
    assert (found.sh == wanted.sh).all()
    assert (found.mean == wanted.mean).all()


@pytest.mark.parametrize("colors", [True, False])
def test_a_file_made_by_hand_is_read(file: Path, colors: bool) -> None:
    packed_ply.write(file, by_hand(colors))
    read = Splats.load(file)
    assert (read.shape, read.sh_degree) == ("gaussian", 1)
    np.testing.assert_allclose(read.mean, [[-1, -2, -3], [4, 5, 6]], rtol=1e-6)
    np.testing.assert_allclose(read.log_scale, [[-7, -8, -9], [0, 1, 2]], rtol=1e-6)
    np.testing.assert_allclose(read.quat, [[1, 0, 0, 0], [0, 0.5**0.5, 0, 0.5**0.5]], atol=2e-3)
    np.testing.assert_allclose(1 / (1 + np.exp(-read.opacity_logit)), [0, 1], atol=1e-6)
    color = [[0.25, 0.5, -0.5], [0.75, 1.5, 1.0]] if colors else [[0, 0, 0], [1, 1, 1]]
    np.testing.assert_allclose(0.5 + SH_C0 * read.sh[:, 0], color, atol=1e-6)
    # Channel by channel, as in any PLY: red has bytes 0 to 2.
    np.testing.assert_allclose(read.sh[0, 1:, 0], [-4, 4, 128.5 / 32 - 4])
    np.testing.assert_allclose(read.sh[1, 1:, 1], [192.5 / 32 - 4, 20.5 / 32 - 4, 21.5 / 32 - 4])


def test_each_word_has_11_10_and_11_bits_and_each_256_splats_their_limits(file: Path) -> None:
    packed = packed_ply.some(600, 0)
    packed_ply.write(file, packed)
    read = Splats.load(file)
    for row in (0, 255, 256, 599):
        low, high = packed.limits[row // 256, 0:3].astype(float), packed.limits[row // 256, 3:6].astype(float)
        word = int(packed.words[row, 0])
        share = np.array([(word >> 21) / 2047, (word >> 11 & 1023) / 1023, (word & 2047) / 2047])
        wanted = low + share * (high - low)
        np.testing.assert_allclose(read.mean[row], wanted, atol=1e-6)
        np.testing.assert_allclose(np.linalg.norm(read.quat[row]), 1, atol=1e-6)
        largest = int(packed.words[row, 1]) >> 30
        assert np.abs(read.quat[row]).argmax() == largest
        assert 255 / (1 + np.exp(-read.opacity_logit[row])) == pytest.approx(int(packed.words[row, 3]) & 255, abs=1e-3)


def test_splats_of_a_damaged_chunk_are_left_out(file: Path) -> None:
    packed = packed_ply.some(600, 1)
    packed.limits[2, 4] = np.nan
    packed_ply.write(file, packed)
    with pytest.warns(UserWarning, match=r"left out 88 of 600 splats \(mean of splat 512: value is nan"):
        assert len(Splats.load(file)) == 512


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("uint packed_scale", "uint packed_size", "element 'vertex' needs packed_scale as uint32"),
        ("uint packed_scale", "float packed_scale", "element 'vertex' needs packed_scale as uint32"),
        ("float max_scale_y", "float most_scale_y", "element 'chunk' needs max_scale_y as float32"),
        ("uchar f_rest_8", "uchar f_rest_9", "element 'sh' needs f_rest_8 as uint8"),
        ("uchar f_rest_8", "char f_rest_8", "element 'sh' needs f_rest_8 as uint8"),
        ("element chunk", "element clump", "needs 1 rows of element 'chunk' for its 2 splats"),
        ("element vertex 2", "element vertex 3", "is truncated"),
        ("element sh 2", "element sh 1", "extra data"),
        ("float min_x", "list uchar int min_x", "element 'vertex' comes before 'vertex' or after lists"),
    ],
)
def test_faulty_headers_are_named(file: Path, old: str, new: str, said: str) -> None:
    packed_ply.write(file, by_hand())
    data = file.read_bytes()
    assert old.encode() in data
    file.write_bytes(data.replace(old.encode(), new.encode(), 1))
    with pytest.raises(InputError, match=said) as caught:
        Splats.load(file)
    assert str(caught.value).startswith(str(file))


def test_tables_of_wrong_lengths_are_named(file: Path) -> None:
    packed = by_hand()
    packed_ply.write(file, packed._replace(limits=np.repeat(packed.limits, 2, axis=0)))
    with pytest.raises(InputError, match="needs 1 rows of element 'chunk'"):
        Splats.load(file)
    packed_ply.write(file, packed._replace(rest=packed.rest[:1]))
    with pytest.raises(InputError, match="element 'sh' needs a row for each of the 2 splats"):
        Splats.load(file)
    packed_ply.write(file, packed._replace(rest=packed.rest[:, :8]))
    with pytest.raises(InputError, match="element 'sh' has 8 columns, expected 9, 24 or 45"):
        Splats.load(file)
