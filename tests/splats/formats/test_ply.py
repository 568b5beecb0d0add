"""Splat PLY: exact round trips, 3DGS's byte layout, other encodings, and named faults in damaged files."""

from __future__ import annotations

import re
import struct
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from model_strategies import Arrays, models, random_arrays
from scenes_data import scene_folder

from clsplat.errors import InputError
from clsplat.splats.fields import Field
from clsplat.splats.formats.ply import read_ply, write_ply
from clsplat.splats.near_plane import NEAR_PLANE
from clsplat.splats.shapes import SHAPES
from clsplat.splats.splats import Splats

IN_FOLDER = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
ORDER_DEGREE_1 = (
    "x y z nx ny nz f_dc_0 f_dc_1 f_dc_2 " + " ".join(f"f_rest_{i}" for i in range(9)) + " opacity "
    "scale_0 scale_1 scale_2 rot_0 rot_1 rot_2 rot_3 skew_0 skew_1 skew_2"
).split()


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "model.ply"


def save(
    file: Path,
    columns: dict[str, list[float]],
    fmt: str = "binary_little_endian",
    kind: str = "float",
    comments: tuple[str, ...] = (),
) -> Path:
    """A PLY written by this test's own few lines, to be independent of the writer."""
    n = len(next(iter(columns.values())))
    head = ["ply", f"format {fmt} 1.0", *(f"comment {c}" for c in comments), f"element vertex {n}"]
    head += [f"property {kind} {name}" for name in columns] + ["end_header", ""]
    rows = list(zip(*columns.values(), strict=True))
    if fmt == "ascii":
        body = "".join(" ".join(repr(float(v)) for v in row) + "\n" for row in rows).encode()
    else:
        code = ("<" if "little" in fmt else ">") + ("f" if kind == "float" else "d") * len(columns)
        body = b"".join(struct.pack(code, *row) for row in rows)
    file.write_bytes("\n".join(head).encode() + body)
    return file


def plain(n: int = 2, normals: bool = True, skew: bool = False) -> dict[str, list[float]]:
    """Columns of a usable SH-degree-1 file; value = 100 * splat + column."""
    names = [name for name in ORDER_DEGREE_1 if (normals or name[0] != "n") and (skew or "skew" not in name)]
    columns = {name: [100.0 * i + j for i in range(n)] for j, name in enumerate(names)}
    for name in ("skew_0", "skew_1", "skew_2") if skew else ():
        columns[name] = [0.1 * int(name[-1])] * n
    return columns


def same(a: Arrays, b: Arrays) -> None:
    assert a.keys() == b.keys()
    for name in a:
        assert a[name].dtype == b[name].dtype, name
        np.testing.assert_array_equal(a[name], b[name], err_msg=name)


@pytest.mark.parametrize("compact", [False, True])
def test_the_near_plane_is_stored_unless_it_is_the_usual_one(file: Path, compact: bool) -> None:
    splats = Splats.load(save(file, plain()))
    splats.save(file, compact)
    assert b"near_plane" not in file.read_bytes()
    assert Splats.load(file).near_plane == NEAR_PLANE == 0.01
    for near in (0.2, 0.1 + 0.2, 1e-9):
        splats.with_near_plane(near).save(file, compact)
        assert Splats.load(file).near_plane == near


@IN_FOLDER
@given(model=models())
def test_round_trip_is_exact(file: Path, model: tuple[str, str, Arrays]) -> None:
    shape, normalisation, arrays = model
    write_ply(file, shape, normalisation, arrays)
    read = read_ply(file)
    assert (read.shape, read.normalisation) == (shape, normalisation)
    same(read.arrays, arrays)
    assert [p.name for p in file.parent.iterdir()] == [file.name]


def test_bytes_are_3dgs_layout(file: Path) -> None:
    arrays = random_arrays("skew-normal", 3, 1, seed=1)
    write_ply(file, "skew-normal", "pdf", arrays)
    head, body = file.read_bytes().split(b"end_header\n")
    expected = ["ply", "format binary_little_endian 1.0"]
    expected += ["comment clsplat shape=skew-normal normalisation=pdf", "element vertex 3"]
    expected += [*(f"property float {name}" for name in ORDER_DEGREE_1)]
    assert head.decode().splitlines() == expected
    rows = dict(zip(ORDER_DEGREE_1, np.frombuffer(body, "<f4").reshape(3, -1).T, strict=True))
    for i, name in enumerate("xyz"):
        np.testing.assert_array_equal(rows[name], arrays["mean"][:, i])
        np.testing.assert_array_equal(rows["n" + name], 0)
    np.testing.assert_array_equal(rows["rot_0"], arrays["quat"][:, 0])
    np.testing.assert_array_equal(rows["scale_2"], arrays["log_scale"][:, 2])
    np.testing.assert_array_equal(rows["opacity"], arrays["opacity_logit"])
    np.testing.assert_array_equal(rows["f_dc_1"], arrays["sh"][:, 0, 1])
    np.testing.assert_array_equal(rows["f_rest_2"], arrays["sh"][:, 3, 0])  # the last of red
    np.testing.assert_array_equal(rows["f_rest_3"], arrays["sh"][:, 1, 1])  # the first of green
    np.testing.assert_array_equal(rows["f_rest_7"], arrays["sh"][:, 2, 2])


def test_degree_3_gaussian_is_248_bytes_a_splat(file: Path) -> None:
    write_ply(file, "gaussian", "peak", random_arrays("gaussian", 5, 3, seed=2))
    assert len(file.read_bytes().split(b"end_header\n")[1]) == 5 * 248


@pytest.mark.parametrize("fmt", ["binary_little_endian", "binary_big_endian", "ascii"])
@pytest.mark.parametrize("kind", ["float", "double"])
@pytest.mark.parametrize("normals", [True, False])
def test_every_encoding_reads_the_same(file: Path, fmt: str, kind: str, normals: bool) -> None:
    columns = plain(normals=normals)
    read = read_ply(save(file, columns, fmt, kind))
    assert (read.shape, read.normalisation) == ("gaussian", "peak")
    assert read.arrays["mean"].tolist() == [[columns[c][i] for c in "xyz"] for i in range(2)]
    assert read.arrays["quat"][1].tolist() == [columns[f"rot_{i}"][1] for i in range(4)]
    assert read.arrays["opacity_logit"].tolist() == columns["opacity"]
    rest = [[columns[f"f_rest_{3 * channel + k}"][1] for channel in range(3)] for k in range(3)]
    assert read.arrays["sh"][1].tolist() == [[columns[f"f_dc_{i}"][1] for i in range(3)], *rest]
    assert {a.dtype for a in read.arrays.values()} == {np.dtype("f4" if kind == "float" else "f8")}


def test_properties_are_found_by_name(file: Path) -> None:
    columns = plain()
    shuffled = {name: columns[name] for name in sorted(columns)}
    same(read_ply(save(file, shuffled)).arrays, read_ply(save(file, columns)).arrays)


def test_crlf_header_other_comments_and_obj_info(file: Path) -> None:
    save(file, plain(), comments=("made elsewhere", "clsplat is mentioned here"))
    head, body = file.read_bytes().split(b"end_header\n")
    head = head.replace(b"element", b"obj_info scanner\nelement").replace(b"\n", b"\r\n")
    file.write_bytes(head + b"end_header\r\n" + body)
    assert read_ply(file).shape == "gaussian"


def test_kernel_from_comment_or_columns(file: Path) -> None:
    read = read_ply(save(file, plain(skew=True)))
    assert (read.shape, read.normalisation) == ("skew-normal", "peak")
    np.testing.assert_array_equal(read.arrays["skew"], np.tile(np.float32([0, 0.1, 0.2]), (2, 1)))
    comment = ("clsplat shape=skew-normal normalisation=none",)
    read = read_ply(save(file, plain(skew=True), comments=comment))
    assert (read.shape, read.normalisation) == ("skew-normal", "none")


def own_columns(shape: str) -> dict[str, list[float]]:
    """Columns of a usable file of any shape."""
    columns = plain()
    for field in SHAPES[shape].fields:
        columns |= dict(zip(field.ply, ([value] * 2 for value in field.neutral), strict=True))
    return columns


@pytest.mark.parametrize("shape", SHAPES)
def test_every_shape_is_known_by_its_columns(file: Path, shape: str) -> None:
    columns = own_columns(shape)
    first = next(name for name in SHAPES if own_columns(name).keys() == columns.keys())
    assert read_ply(save(file, columns)).shape == first
    assert read_ply(save(file, columns, comments=(f"clsplat shape={shape}",))).shape == shape


@pytest.mark.parametrize(
    ("shape", "column"), [(shape.name, name) for shape in SHAPES.values() for f in shape.fields for name in f.ply]
)
def test_a_shape_named_without_its_columns_is_an_error(file: Path, shape: str, column: str) -> None:
    columns = own_columns(shape)
    del columns[column]
    with pytest.raises(InputError, match=f"property '{column}' is missing; shape {shape} has it") as caught:
        read_ply(save(file, columns, comments=(f"clsplat shape={shape}",)))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("shape", "field"), [(shape.name, f) for shape in SHAPES.values() for f in shape.fields if f.bounds], ids=str
)
def test_values_out_of_bounds_are_named(file: Path, shape: str, field: Field) -> None:
    assert field.bounds is not None
    low, high = field.bounds
    for value in (low, high):
        read_ply(save(file, own_columns(shape) | {field.name: [value, value]}))
    for value in (0.0, -low, 0.99 * low, 1.01 * high):
        said = f"property {field.name}, vertex 1: value is {value:.6g}, must be {low:g} to {high:g}"
        with pytest.raises(InputError, match=re.escape(said)):
            read_ply(save(file, own_columns(shape) | {field.name: [low, value]}))


@pytest.mark.parametrize(
    ("shape", "field"), [(shape.name, f) for shape in SHAPES.values() for f in shape.fields if f.nonzero], ids=str
)
def test_directions_of_no_length_are_named(file: Path, shape: str, field: Field) -> None:
    columns = own_columns(shape) | {name: [0.0, 0.0] for name in field.ply}
    with pytest.raises(InputError, match=r"2 of 2 splats are unusable .*vertex 0: norm is 0, must be above 0"):
        read_ply(save(file, columns))


def test_float64_is_rounded_on_writing(file: Path) -> None:
    arrays = random_arrays("gaussian", 4, 0, seed=3, dtype=np.float64)
    write_ply(file, "gaussian", "peak", arrays)
    same(read_ply(file).arrays, {name: values.astype(np.float32) for name, values in arrays.items()})
    arrays["mean"][2, 1] = 1e300
    with pytest.raises(InputError, match=r"mean\[2, 1\].*inf"):
        write_ply(file, "gaussian", "peak", arrays)


def test_surfels_become_flat_splats(file: Path) -> None:
    """2DGS has two scales. A file of clsplat has three, so that one without is damaged."""
    columns = plain()
    del columns["scale_2"]
    with pytest.warns(UserWarning, match="holds surfels"):
        splats = Splats.load(save(file, columns))
    np.testing.assert_array_equal(splats.log_scale[:, :2].T, [columns["scale_0"], columns["scale_1"]])
    assert splats.log_scale[:, 2] == pytest.approx(np.log(1e-6))
    with pytest.raises(InputError, match="property 'scale_2' is missing"):
        Splats.load(save(file, columns, comments=("clsplat shape=gaussian normalisation=peak",)))


def without(name: str) -> dict[str, list[float]]:
    columns = plain(skew=True)
    del columns[name]
    return columns


def with_value(name: str, value: float) -> dict[str, list[float]]:
    columns = plain(3, skew=True)
    columns[name][1] = value
    return columns


ZERO_QUAT = plain(3) | {f"rot_{i}": [1.0, 1.0, 0.0] for i in range(4)}


@pytest.mark.parametrize(
    ("columns", "said"),
    [
        (without("scale_1"), "'scale_1' is missing"),
        (without("skew_1"), "'skew_1' is missing"),
        (without("f_rest_4"), "has 8 properties f_rest"),
        (without("f_rest_4") | {"f_rest_9": [0.0, 0.0]}, "'f_rest_4' is missing"),
        (with_value("skew_2", 1.5), r"skew_0\.\.skew_2, vertex 1: norm is 1.50333, must be at most 1.32"),
        ({"x": [0.0], "y": [0.0], "z": [0.0]}, "is a point cloud"),
    ],
)
def test_faulty_models_are_named(file: Path, columns: dict[str, list[float]], said: str) -> None:
    with pytest.raises(InputError, match=said) as caught:
        read_ply(save(file, columns))
    assert str(caught.value).startswith(str(file))


@pytest.mark.parametrize(
    ("columns", "said"),
    [
        (with_value("opacity", np.nan), "property opacity, vertex 1: value is nan"),
        (with_value("x", np.inf), "property x, vertex 1: value is inf"),
        (with_value("scale_2", np.inf), "property scale_2, vertex 1: value is inf"),
        (with_value("f_rest_5", -np.inf), "property f_rest_5, vertex 1: value is -inf"),
        (with_value("f_dc_2", np.nan), "property f_dc_2, vertex 1"),
        (with_value("skew_0", np.nan), "property skew_0, vertex 1"),
        (ZERO_QUAT, "property rot_0..rot_3, vertex 2: norm is 0, must be above 0"),
    ],
)
def test_unusable_splats_are_left_out_and_counted(file: Path, columns: dict[str, list[float]], said: str) -> None:
    lost = 2 if columns is ZERO_QUAT else 1
    sound = {name: [values[i] if i != lost else 0.5 for i in range(3)] for name, values in columns.items()}
    whole = read_ply(save(file, sound)).arrays
    with pytest.warns(UserWarning, match=re.escape(f"{file}: left out 1 of 3 splats ({said}")):
        read = read_ply(save(file, columns)).arrays
    same(read, {name: np.delete(values, lost, axis=0) for name, values in whole.items()})


def test_a_file_of_mostly_unusable_splats_is_refused(file: Path) -> None:
    columns = plain(4) | {"y": [1.0, np.nan, np.inf, 2.0]}
    with pytest.warns(UserWarning, match="left out 2 of 4 splats"):
        assert len(read_ply(save(file, columns)).arrays["mean"]) == 2
    columns["z"][3] = np.nan
    with pytest.raises(InputError, match=r"3 of 4 splats are unusable \(property y, vertex 1: value is nan"):
        read_ply(save(file, columns))


def test_faults_of_kept_splats_have_their_number_in_the_file(file: Path) -> None:
    columns = plain(4, skew=True) | {"x": [np.nan, 0.0, 0.0, 0.0], "skew_1": [0.0, 0.0, 9.0, 0.0]}
    with (
        pytest.warns(UserWarning, match="left out 1 of 4"),
        pytest.raises(InputError, match=r"skew_0\.\.skew_2, vertex 2: norm is"),
    ):
        read_ply(save(file, columns))


def test_infinite_opacities_and_scales_of_0_are_kept(file: Path, recwarn: pytest.WarningsRecorder) -> None:
    """Converters of .splat files write an opacity of 255 as infinity; flat splats have scales of 0."""
    columns = plain(3) | {"opacity": [np.inf, -np.inf, 1.0], "scale_1": [0.0, -np.inf, 1.0]}
    read = read_ply(save(file, columns)).arrays
    assert not recwarn.list
    opacity = 1 / (1 + np.exp(-read["opacity_logit"].astype(np.float64)))
    np.testing.assert_allclose(opacity, [1.0, 0.0, opacity[2]], atol=1e-6)
    assert np.isfinite(read["log_scale"]).all()
    assert 0 < np.exp(read["log_scale"][1, 1]) < 1e-25


def test_other_columns_are_left_out_and_named(file: Path) -> None:
    """Mip-Splatting adds filter_3D, mesh tools add colours in bytes."""
    data = save(file, plain() | {"filter_3D": [0.1, 0.2], "red": [1.0, 2.0]}).read_bytes()
    wanted = read_ply(save(file, plain())).arrays
    file.write_bytes(data)
    with pytest.warns(UserWarning, match=r"left out columns filter_3D, red, which gaussian splats do not have"):
        same(read_ply(file).arrays, wanted)
    head, body = data.split(b"end_header\n", 1)
    width = len(body) // 2
    rows = [body[i * width : (i + 1) * width - 4] + bytes([200 + i]) for i in range(2)]
    file.write_bytes(head.replace(b"float red", b"uchar red") + b"end_header\n" + b"".join(rows))
    with pytest.warns(UserWarning, match="columns filter_3D, red"):
        same(read_ply(file).arrays, wanted)


@pytest.mark.parametrize("fmt", ["binary_little_endian", "binary_big_endian", "ascii"])
def test_faces_and_other_elements_are_left_out_and_named(file: Path, fmt: str) -> None:
    """Elements before and after the vertices; those with lists only after them."""
    wanted = read_ply(save(file, plain(), fmt)).arrays
    head, body = file.read_bytes().split(b"end_header\n", 1)
    order = ">" if "big" in fmt else "<"
    text = fmt == "ascii"
    first = b"7 8\n" if text else struct.pack(order + "Bf", 7, 8.0)
    faces = b"3 0 1 0\n" if text else struct.pack(order + "Biii", 3, 0, 1, 0)
    scan = b"element scan 1\nproperty uchar a\nproperty float b\nelement vertex"
    face = b"element face 1\nproperty list uchar int vertex_indices\n"
    file.write_bytes(head.replace(b"element vertex", scan) + face + b"end_header\n" + first + body + faces)
    with pytest.warns(UserWarning, match="left out elements scan, face, which gaussian splats do not have"):
        same(read_ply(file).arrays, wanted)
    file.write_bytes(head.replace(b"element vertex", face + b"element vertex") + b"end_header\n" + faces + body)
    with pytest.raises(InputError, match="element 'vertex' comes before 'vertex' or after lists"):
        read_ply(file)
    file.write_bytes(head + face + b"end_header\n" + body[: len(body) // 2])
    with pytest.raises(InputError, match="is truncated"):
        read_ply(file)


def test_normals_may_hold_anything(file: Path, recwarn: pytest.WarningsRecorder) -> None:
    read_ply(save(file, plain() | {"nx": [np.nan, np.inf]}))
    assert not recwarn.list


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("ply\n", "plx\n", "not a PLY file"),
        ("binary_little_endian", "binary_middle_endian", "'binary_middle_endian' is unknown"),
        ("format binary_little_endian 1.0\n", "", "no format line"),
        ("element vertex 2", "element vertex 2\nelement face 0", "'x' is missing"),
        ("element vertex 2", "element chunk 2", "no element 'vertex'"),
        ("element vertex 2", "element vertex -2", "count '-2'"),
        ("element vertex 2", "element vertex 999999999999", "is truncated: 999999999999 vertices"),
        ("element vertex 2", "element vertex 1", "has extra data"),
        ("property float x", "property list uchar float x", "'x' is a list"),
        ("property float x", "property uchar x", "'x' has type uchar"),
        ("property float x", "property half x", "unknown type 'half'"),
        ("property float x", "property float y", "'y' occurs twice"),
        ("property float x", "propertyfloat x", "'propertyfloat x' is not a PLY header line"),
        ("end_header\n", "", "header"),
        ("element vertex 2", "comment clsplat shape=cube\nelement vertex 2", "unknown shape 'cube'"),
        ("element", "comment clsplat shape=gaussian normalisation=x\nelement", "normalisation 'x'"),
        ("element", "comment clsplat near_plane=0\nelement", "'clsplat near_plane=0': give a depth above 0"),
        ("element", "comment clsplat near_plane=far\nelement", "'clsplat near_plane=far': give a depth above 0"),
    ],
)
def test_faulty_headers_are_named(file: Path, old: str, new: str, said: str) -> None:
    data = save(file, plain()).read_bytes()
    assert old.encode() in data
    file.write_bytes(data.replace(old.encode(), new.encode(), 1))
    with pytest.raises(InputError, match=said) as caught:
        read_ply(file)
    assert str(caught.value).startswith(str(file))
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("fmt", ["binary_little_endian", "ascii"])
def test_truncation_is_an_input_error(file: Path, fmt: str) -> None:
    data = save(file, plain(), fmt).read_bytes().rstrip(b"\n")
    last_value = len(data.split()[-1])
    for length in range(0, len(data) - last_value, 3):
        file.write_bytes(data[:length])
        with pytest.raises(InputError):
            read_ply(file)
    file.write_bytes(data)
    read_ply(file)


def test_ascii_bodies(file: Path) -> None:
    data = save(file, plain(), "ascii").read_bytes()
    for damaged, said in ((data + b"7\n", "extra data"), (data.replace(b" 101.0 ", b" one "), "not a number")):
        file.write_bytes(damaged)
        with pytest.raises(InputError, match=said):
            read_ply(file)


def test_missing_file_and_folder(tmp_path: Path) -> None:
    for path in (tmp_path / "none.ply", tmp_path):
        with pytest.raises(InputError, match="cannot be read"):
            read_ply(path)


@settings(IN_FOLDER, max_examples=300)
@given(data=st.data(), fmt=st.sampled_from(["binary_little_endian", "binary_big_endian", "ascii"]))
def test_fuzz_succeeds_or_says_why(file: Path, data: st.DataObject, fmt: str) -> None:
    raw = bytearray(save(file, plain(skew=True), fmt, comments=("clsplat shape=skew-normal",)).read_bytes())
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, max(len(raw) - 1, 0)))
        kind = data.draw(st.sampled_from(["byte", "cut", "drop", "insert", "double", "swap words"]))
        if kind == "byte" and raw:
            raw[at] = data.draw(st.integers(0, 255))
        elif kind == "cut":
            del raw[at:]
        elif kind == "drop":
            del raw[at : at + data.draw(st.integers(1, 40))]
        elif kind == "insert":
            odd = st.sampled_from([b"\n", b" 1", b"nan ", b"\0", b"1e999 "])
            raw[at:at] = data.draw(st.binary(max_size=8) | odd)
        elif kind == "double":
            raw[at:at] = raw[at : at + 30]
        else:
            words = bytes(raw).split(b" ")
            i, j = data.draw(st.integers(0, len(words) - 1)), data.draw(st.integers(0, len(words) - 1))
            words[i], words[j] = words[j], words[i]
            raw = bytearray(b" ".join(words))
    file.write_bytes(raw)
    message = str(file)
    try:
        read = read_ply(file)
        assert all(np.isfinite(values).all() for values in read.arrays.values())
    except InputError as error:
        message = str(error)
    assert message.startswith(str(file))
    assert "\n" not in message


@pytest.mark.data
def test_real_point_cloud_is_no_splats() -> None:
    with pytest.raises(InputError, match="is a point cloud, not splats"):
        read_ply(scene_folder("fox") / "sparse_pc.ply")
