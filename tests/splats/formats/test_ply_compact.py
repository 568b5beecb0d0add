"""Compact splat files: exact round trips, what they leave out, a first element that stands alone, named faults."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from model_strategies import Arrays, random_arrays

from clsplat.errors import InputError
from clsplat.splats.fields import sh_coefficients
from clsplat.splats.formats.ply import read_ply, write_ply
from clsplat.splats.formats.ply_compact import bands_in_use, movable, plan_layout
from clsplat.splats.shapes import SHAPES
from clsplat.splats.splats import Splats

IN_FOLDER = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
HEAD_BYTES = 4 * (3 + 3 + 1 + 3 + 4)  # mean, constant colour, opacity, scales, rotation


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "model.ply"


def sparse_arrays(shape: str, n: int, seed: int, some: float = 0.3, degree: int = 3) -> Arrays:
    """A model in which every splat uses SH up to a band of its own, and few use the shape's own fields."""
    rng = np.random.default_rng(seed)
    arrays = random_arrays(shape, n, degree, seed)
    for band in range(1, degree + 1):
        arrays["sh"][rng.random(n) >= some, sh_coefficients(band - 1) :] = 0
    for field in movable(SHAPES[shape].schema(degree)):
        arrays[field.name][rng.random(n) >= some] = field.neutral if field.width > 1 else field.neutral[0]
    return arrays


def body_bytes(file: Path) -> int:
    return len(file.read_bytes().split(b"end_header\n", 1)[1])


def same_but_for_bands(read: Arrays, arrays: Arrays) -> None:
    """The same bits, less the bands that no splat uses."""
    assert read.keys() == arrays.keys()
    used = sh_coefficients(int(bands_in_use(arrays["sh"]).max(initial=0)))
    assert not arrays["sh"][:, used:].any()
    for name, values in read.items():
        expected = np.ascontiguousarray(arrays["sh"][:, :used]) if name == "sh" else arrays[name]
        np.testing.assert_array_equal(values.view(np.uint32), expected.view(np.uint32), err_msg=name)


@IN_FOLDER
@given(
    shape=st.sampled_from(sorted(SHAPES)),
    n=st.integers(0, 40),
    seed=st.integers(0, 2**32 - 1),
    some=st.sampled_from([0.0, 0.1, 0.6, 1.0]),
    degree=st.integers(0, 3),
)
def test_round_trip_keeps_every_bit(file: Path, shape: str, n: int, seed: int, some: float, degree: int) -> None:
    arrays = sparse_arrays(shape, n, seed, some, degree)
    write_ply(file, shape, "pdf", arrays, compact=True)
    size = file.stat().st_size
    read = read_ply(file)
    assert (read.shape, read.normalisation) == (shape, "pdf")
    same_but_for_bands(read.arrays, arrays)
    write_ply(file, shape, "pdf", read.arrays, compact=True)
    assert file.stat().st_size == size
    same_but_for_bands(read_ply(file).arrays, arrays)


def test_negative_zeros_are_kept(file: Path) -> None:
    arrays = sparse_arrays("skew-normal", 5, 0, some=0.0)
    arrays["sh"][2, 7, 1] = arrays["skew"][3, 0] = -0.0
    write_ply(file, "skew-normal", "peak", arrays, compact=True)
    same_but_for_bands(read_ply(file).arrays, arrays)


def test_bytes_are_those_in_use(file: Path) -> None:
    arrays = sparse_arrays("skew-normal", 1000, seed=3, some=0.0)
    arrays["skew"][:40] = 0.5
    arrays["sh"][:70, 3] = 1.0
    arrays["sh"][:20, 15, 2] = 1.0
    write_ply(file, "skew-normal", "peak", arrays, compact=True)
    assert body_bytes(file) == 1000 * HEAD_BYTES + 40 * 16 + 50 * (4 + 36) + 20 * (4 + 180)
    assert plan_layout(SHAPES["skew-normal"].schema(3), arrays).base == 0


def test_what_most_splats_use_stays_with_the_vertices(file: Path) -> None:
    arrays = random_arrays("skew-normal", 100, 2, seed=4)
    arrays["sh"][5:, 4:] = 0
    write_ply(file, "skew-normal", "peak", arrays, compact=True)
    assert body_bytes(file) == 100 * (HEAD_BYTES + 36 + 12) + 5 * (4 + 60)
    same_but_for_bands(read_ply(file).arrays, arrays)


def test_the_first_element_stands_alone(file: Path) -> None:
    """A reader of the first element alone gets the base colours and the moment-matched Gaussians."""
    arrays = sparse_arrays("skew-normal", 50, seed=5, some=0.2)
    write_ply(file, "skew-normal", "peak", arrays, compact=True)
    head, body = file.read_bytes().split(b"end_header\n", 1)
    lines = [line for line in head.decode().splitlines() if not line.startswith("comment")]
    ends = [place for place, line in enumerate(lines) if line.startswith("element")][1]
    lines = lines[:ends]
    row = 4 * sum(line.startswith("property float") for line in lines)
    file.write_bytes("\n".join([*lines, "end_header", ""]).encode() + body[: 50 * row])
    read = read_ply(file)
    assert read.shape == "gaussian"
    for name in ("mean", "quat", "log_scale", "opacity_logit"):
        np.testing.assert_array_equal(read.arrays[name], arrays[name])
    base = read.arrays["sh"].shape[1]
    np.testing.assert_array_equal(read.arrays["sh"], arrays["sh"][:, :base])


def test_splats_save_and_load(tmp_path: Path) -> None:
    splats = Splats("skew-normal", sparse_arrays("skew-normal", 300, 6, 0.1))
    splats.save(tmp_path / "whole.ply")
    splats.save(tmp_path / "compact.ply", compact=True)
    loaded = Splats.load(tmp_path / "compact.ply")
    np.testing.assert_array_equal(loaded.skew, splats.skew)
    np.testing.assert_array_equal(loaded.sh, splats.sh[:, : loaded.sh.shape[1]])
    assert (tmp_path / "compact.ply").stat().st_size < 0.5 * (tmp_path / "whole.ply").stat().st_size


def saved(file: Path) -> bytes:
    """Return a compact file of 12 splats with two elements of SH bands; 3 of the splats are skewed."""
    arrays = sparse_arrays("skew-normal", 12, 7, some=0.0)
    arrays["skew"][[1, 5, 9]] = 0.25
    arrays["sh"][[0, 4], 2], arrays["sh"][[7], 12] = 1.0, 1.0
    write_ply(file, "skew-normal", "peak", arrays, compact=True)
    return file.read_bytes()


def test_other_encodings_are_read(file: Path) -> None:
    data = saved(file)
    head, body = data.split(b"end_header\n", 1)
    expected = read_ply(file).arrays
    swapped = np.frombuffer(body, "<u4").astype(">u4").tobytes()
    file.write_bytes(head.replace(b"little", b"big") + b"end_header\n" + swapped)
    same_but_for_bands(read_ply(file).arrays, expected)
    words, lines, at = np.frombuffer(body, "<u4"), [], 0
    for part in head.decode().split("element ")[1:]:
        kinds = [line.split()[1] for line in part.splitlines()[1:]]
        for _ in range(int(part.split()[1])):
            row, at = words[at : at + len(kinds)], at + len(kinds)
            lines.append(
                " ".join(
                    str(word if kind == "uint" else word.view(np.float32))
                    for word, kind in zip(row, kinds, strict=True)
                )
            )
    text = "\n".join(lines).encode()
    head = head.replace(b"binary_little_endian", b"ascii") + b"end_header\n"
    file.write_bytes(head + text)
    same_but_for_bands(read_ply(file).arrays, expected)
    file.write_bytes(head + text.replace(b"\n5 ", b"\n5.5 "))
    with pytest.raises(InputError, match=r"index is 5\.5, expected a whole number"):
        read_ply(file)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("element clsplat_skew 3", "element clsplat_skew 2", "has extra data"),
        ("element clsplat_skew 3", "element clsplat_skew 999999999999", "is truncated"),
        ("element clsplat_skew 3", "element clsplat_skew -3", "count '-3'"),
        ("element clsplat_skew 3", "element clsplat_beta 3", "'clsplat_beta' does not match this shape"),
        ("element clsplat_skew 3", "element chunk 3", "property 'skew_0' is missing"),
        ("element clsplat_sh_1 2", "element clsplat_sh_4 2", "'clsplat_sh_4' does not match"),
        ("element clsplat_sh_1 2", "element clsplat_sh_0 2", "'clsplat_sh_0' does not match"),
        ("element clsplat_sh_1 2", "element clsplat_sh_2 2", "must be uint index and float f_rest_0 to f_rest_23"),
        ("element clsplat_sh_3 1", "element clsplat_sh_1 1", "'clsplat_sh_1' occurs twice"),
        ("uint index", "float index", "must be uint index and float skew_0 to skew_2"),
        ("uint index", "ushort index", "must be uint index and float skew_0 to skew_2"),
        ("float skew_1", "float skew_7", "must be uint index and float skew_0 to skew_2"),
        ("shape=skew-normal", "shape=gaussian", "'clsplat_skew' does not match"),
        ("element vertex 12", "element points 12", "no element 'vertex'"),
    ],
)
def test_faulty_headers_are_named(file: Path, old: str, new: str, said: str) -> None:
    data = saved(file)
    assert old.encode() in data
    file.write_bytes(data.replace(old.encode(), new.encode(), 1))
    with pytest.raises(InputError, match=said) as caught:
        read_ply(file)
    assert str(caught.value).startswith(str(file))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("row", "index", "said"),
    [
        (0, 12, "'clsplat_skew', row 0: index 12 must rise and be below 12"),
        (1, 1, "'clsplat_skew', row 1: index 1 must rise"),
        (2, 2**32 - 1, "row 2: index 4294967295 must rise and be below 12"),
        (3, 7, "splat 7 is in two elements clsplat_sh_"),
    ],
)
def test_faulty_indices_are_named(file: Path, row: int, index: int, said: str) -> None:
    data = saved(file)
    head, body = data.split(b"end_header\n", 1)
    at = 12 * HEAD_BYTES + (16 * row if row < 3 else 3 * 16 + 40)  # row 3: the second of the first element of bands
    changed = bytearray(body)
    changed[at : at + 4] = np.uint32(index).tobytes()
    file.write_bytes(head + b"end_header\n" + bytes(changed))
    with pytest.raises(InputError, match=said):
        read_ply(file)


@settings(IN_FOLDER, max_examples=150)
@given(data=st.data())
def test_fuzz_succeeds_or_says_why(file: Path, data: st.DataObject) -> None:
    raw = bytearray(saved(file))
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, max(len(raw) - 1, 0)))
        kind = data.draw(st.sampled_from(["byte", "cut", "drop", "insert"]))
        if kind == "byte" and raw:
            raw[at] = data.draw(st.integers(0, 255))
        elif kind == "cut":
            del raw[at:]
        elif kind == "drop":
            del raw[at : at + data.draw(st.integers(1, 40))]
        else:
            raw[at:at] = data.draw(st.binary(max_size=8) | st.sampled_from([b"\n", b" 1", b"\0"]))
    file.write_bytes(raw)
    message = str(file)
    try:
        assert all(np.isfinite(values).all() for values in read_ply(file).arrays.values())
    except InputError as error:
        message = str(error)
    assert message.startswith(str(file))
    assert "\n" not in message


def test_a_field_that_most_splats_use_stays_with_them() -> None:
    """A sparse row has an index besides its values. Three values of 80 % of the splats take more words that way."""
    arrays = sparse_arrays("skew-normal", 100, 1)
    for users, is_sparse in ((80, False), (70, True)):
        arrays["skew"][:] = 0
        arrays["skew"][:users] = 0.5
        layout = plan_layout(SHAPES["skew-normal"].schema(3), arrays)
        assert ("skew" in layout.sparse) == is_sparse
