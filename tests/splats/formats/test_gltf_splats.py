"""Splats in glTF (splats/formats/gltf_splats.py): stored values by the document, what comes back, named faults."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import glb_files
import numpy as np
import pytest
from same_splats import model, same

from clsplat.errors import InputError
from clsplat.splats.axes import LUF, flipped
from clsplat.splats.harmonics import SH_C0
from clsplat.splats.quaternions import rotations
from clsplat.splats.splats import Splats
from clsplat.splats.transform import joined, transformed

KHR = "KHR_gaussian_splatting"
SKEWED = "CLSPLAT_gaussian_splatting_kernel_skew_normal"
EXPONENTIAL = "CLSPLAT_gaussian_splatting_kernel_generalised_exponential"


def primitive(document: dict[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = document["meshes"][0]["primitives"][0]
    return found


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return tmp_path / "model.glb"


@pytest.mark.parametrize("degree", range(4))
@pytest.mark.parametrize("shape", ["gaussian", "skew-normal", "generalised-exponential"])
def test_the_model_comes_back(file: Path, shape: str, degree: int) -> None:
    before = model(shape, degree, antialiased=degree > 1, near_plane=0.07, low_pass=0.1 * degree + 0.1)
    before.save(file)
    same(Splats.load(file), before)


@pytest.mark.parametrize("normalisation", ["pdf", "none"])
def test_the_normalisation_comes_back(file: Path, normalisation: str) -> None:
    before = model(normalisation=normalisation)
    before.save(file)
    same(Splats.load(file), before)


def test_values_are_those_of_the_extension(file: Path) -> None:
    splats = model()
    splats.save(file)
    document, _ = glb_files.parts(file.read_bytes())
    found = glb_files.attributes(file)
    assert document["extensionsUsed"] == [KHR, SKEWED]
    assert "extensionsRequired" not in document  # other programs show the ellipse
    assert primitive(document)["mode"] == 0
    assert primitive(document)["extensions"][KHR] == {
        "kernel": "skewNormal",
        "colorSpace": "srgb_rec709_display",
        "projection": "perspective",
        "sortingMethod": "cameraDistance",
        "extensions": {SKEWED: {"normalisation": "peak"}},
    }
    luf = np.diag([-1.0, -1.0, 1.0])
    np.testing.assert_array_equal(found["POSITION"], splats.mean @ luf.astype(np.float32))
    place = document["accessors"][primitive(document)["attributes"]["POSITION"]]
    np.testing.assert_array_equal(
        [place["min"], place["max"]], [f(found["POSITION"], axis=0) for f in (np.min, np.max)]
    )
    # The covariance of the ellipse, with the matrix of the document for a quaternion x, y, z, w.
    x, y, z, w = found[f"{KHR}:ROTATION"].T.astype(np.float64)
    np.testing.assert_allclose(x * x + y * y + z * z + w * w, 1, atol=1e-6)
    turn = np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    ).transpose(2, 0, 1)
    frame = luf @ rotations(splats.quat.astype(np.float64))
    wanted = np.einsum("nij,nj,nkj->nik", frame, np.exp(2.0 * splats.log_scale), frame)
    scale = found[f"{KHR}:SCALE"].astype(np.float64)
    np.testing.assert_allclose(np.einsum("nij,nj,nkj->nik", turn, scale**2, turn), wanted, rtol=1e-4, atol=1e-9)
    # The skew in the frame of the ellipse points where it pointed.
    skew = np.einsum("nij,nj,nj->ni", turn, scale, found[f"{SKEWED}:SKEW"])
    wanted_skew = np.einsum("nij,nj,nj->ni", frame, np.exp(splats.log_scale), splats.skew)
    np.testing.assert_allclose(skew, wanted_skew, atol=1e-6)
    opacity = 1 / (1 + np.exp(-splats.opacity_logit.astype(np.float64)))
    np.testing.assert_allclose(found[f"{KHR}:OPACITY"][:, 0], opacity, atol=1e-7)
    np.testing.assert_array_equal(found[f"{KHR}:SH_DEGREE_0_COEF_0"], splats.sh[:, 0])
    sh = flipped(splats.arrays, LUF)["sh"]
    for index, (degree, place_in) in enumerate([(1, 0), (1, 1), (1, 2), (2, 0), (2, 1), (2, 2), (2, 3), (2, 4)], 1):
        np.testing.assert_array_equal(found[f"{KHR}:SH_DEGREE_{degree}_COEF_{place_in}"], sh[:, index])
    assert f"{KHR}:SH_DEGREE_3_COEF_0" not in found
    color = np.rint(255 * np.clip(0.5 + SH_C0 * splats.sh[:, 0], 0, 1))
    np.testing.assert_allclose(found["COLOR_0"][:, :3], color, atol=1)
    np.testing.assert_allclose(found["COLOR_0"][:, 3], 255 * opacity, atol=0.51)


def test_without_our_extension_the_ellipse_has_the_moments(file: Path) -> None:
    splats = model()
    splats.save(file)

    def remove(document: dict[str, Any]) -> None:
        del primitive(document)["extensions"][KHR]["extensions"]

    glb_files.rewrite(file, remove)
    with pytest.warns(UserWarning, match="kernel 'skewNormal' is unknown; its splats are read as Gaussians"):
        read = Splats.load(file)
    same(read, Splats("gaussian", {name: values for name, values in splats.arrays.items() if name != "skew"}))


def test_beta_has_its_own_attribute(file: Path) -> None:
    splats = model("generalised-exponential")
    splats.save(file)
    document, _ = glb_files.parts(file.read_bytes())
    assert primitive(document)["extensions"][KHR]["kernel"] == "generalisedExponential"
    beta = glb_files.attributes(file)[f"{EXPONENTIAL}:BETA"]
    np.testing.assert_array_equal(beta[:, 0], splats.arrays["beta"])


NODE = {
    "translation": [1.0, -2.0, 0.5],
    "rotation": [0.18257419, 0.36514837, 0.54772256, 0.73029674],
    "scale": [2.0] * 3,
}


@pytest.mark.parametrize("as_matrix", [False, True])
def test_splats_move_with_their_nodes(file: Path, as_matrix: bool) -> None:
    from scipy.spatial.transform import Rotation

    splats = model(near_plane=0.1)
    splats.save(file)
    matrix = np.eye(4)
    matrix[:3, :3] = 2.0 * Rotation.from_quat(NODE["rotation"]).as_matrix()
    matrix[:3, 3] = NODE["translation"]
    outer = {"matrix": matrix.T.ravel().tolist()} if as_matrix else NODE

    def place(document: dict[str, Any]) -> None:
        document["nodes"] = [outer | {"children": [1]}, {"translation": [0, 3, 0], "mesh": 0}]

    glb_files.rewrite(file, place)
    inner = np.eye(4)
    inner[1, 3] = 3.0
    # The model's own axes are those of a PLY: into the axes of glTF, through the nodes, and back.
    flips = np.diag([*LUF, 1])
    wanted = transformed(splats, flips @ matrix @ inner @ flips)
    same(Splats.load(file), wanted, 2e-5)


def test_splats_of_several_nodes_are_one_model(file: Path) -> None:
    splats = model("gaussian")
    splats.save(file)

    def twice(document: dict[str, Any]) -> None:
        document["nodes"] = [{"mesh": 0}, {"mesh": 0, "translation": [5, 0, 0]}, {"mesh": 0}]
        document["scenes"] = [{"nodes": [2]}, {"nodes": [0, 1]}]
        document["scene"] = 1

    glb_files.rewrite(file, twice)
    shift = np.eye(4)
    shift[0, 3] = -5.0  # x points to the left in glTF
    same(Splats.load(file), joined([splats, transformed(splats, shift)]), 1e-5)

    def no_scene(document: dict[str, Any]) -> None:
        del document["scenes"], document["scene"]

    glb_files.rewrite(file, no_scene)
    assert len(Splats.load(file)) == 3 * len(splats)


def test_whole_numbers_are_read(file: Path) -> None:
    splats = model("gaussian", 0)
    splats.save(file)
    document, _ = glb_files.parts(file.read_bytes())
    stored = glb_files.attributes(file)
    n = len(splats)
    short = np.rint(stored[f"{KHR}:ROTATION"] * 32767).astype("<i2")
    opacity = np.rint(stored[f"{KHR}:OPACITY"] * 255).astype("<u1")
    steps = np.rint(stored["POSITION"] / 0.01).astype(
        "<i2"
    )  # quantised positions, with the step as a scale of the node
    positions = np.zeros((n, 4), "<i2")
    positions[:, :3] = steps
    blocks = [positions, short, opacity, stored[f"{KHR}:SCALE"] / 0.01, stored[f"{KHR}:SH_DEGREE_0_COEF_0"]]
    binary, views = b"", []
    for block in blocks:
        binary += bytes(-len(binary) % 4)
        views.append({"buffer": 0, "byteOffset": len(binary), "byteLength": block.nbytes})
        binary += np.ascontiguousarray(block).tobytes()
    views[0]["byteStride"] = 8
    kinds = [("VEC3", 5122, False), ("VEC4", 5122, True), ("SCALAR", 5121, True), ("VEC3", 5126, False)]
    document["accessors"] = [
        {"bufferView": i, "componentType": code, "type": kind, "normalized": norm, "count": n}
        for i, (kind, code, norm) in enumerate([*kinds, ("VEC3", 5126, False)])
    ]
    document["bufferViews"], document["buffers"] = views, [{"byteLength": len(binary)}]
    names = ["POSITION", *(f"{KHR}:{name}" for name in ("ROTATION", "OPACITY", "SCALE", "SH_DEGREE_0_COEF_0"))]
    primitive(document)["attributes"] = {name: index for index, name in enumerate(names)}
    document["nodes"][0]["scale"] = [0.01] * 3
    document["extensionsRequired"] = ["KHR_mesh_quantization"]
    file.write_bytes(glb_files.whole(document, binary))
    read = Splats.load(file)
    np.testing.assert_allclose(read.mean, splats.mean, atol=0.0051)
    np.testing.assert_allclose(read.log_scale, splats.log_scale, atol=1e-5)
    turns = [rotations(each.quat.astype(np.float64)) for each in (read, splats)]
    np.testing.assert_allclose(*turns, atol=2e-4)
    opacities = [1 / (1 + np.exp(-each.opacity_logit.astype(np.float64))) for each in (read, splats)]
    np.testing.assert_allclose(*opacities, atol=0.0021)


@pytest.mark.parametrize("uri", ["data", "arrays%20of.bin", "../elsewhere/arrays%20of.bin"])
def test_gltf_with_its_arrays_beside_it(file: Path, uri: str) -> None:
    splats = model()
    splats.save(file)
    document, binary = glb_files.parts(file.read_bytes())
    if uri == "data":
        uri = "data:application/octet-stream;base64," + base64.b64encode(binary).decode()
    else:
        (file.parent / "arrays of.bin").write_bytes(binary)
    document["buffers"][0]["uri"] = uri
    text = file.with_suffix(".gltf")
    text.write_text(json.dumps(document))
    same(Splats.load(text), splats)


def test_linear_colours_are_named(file: Path) -> None:
    model("gaussian").save(file)
    glb_files.rewrite(
        file, lambda document: primitive(document)["extensions"][KHR].update(colorSpace="lin_rec709_display")
    )
    with pytest.warns(UserWarning, match="linear colours"):
        Splats.load(file)


def test_what_glb_files_do_not_hold(file: Path) -> None:
    with pytest.raises(InputError, match="files hold gaussian, skew-normal, generalised-exponential splats, not stud"):
        model("student-t").save(file)
    with pytest.raises(InputError, match="has no splats, and glTF has no empty arrays"):
        model().select([]).save(file)
    assert not file.exists()


Change = Callable[[dict[str, Any]], Any]
FAULTS: dict[str, tuple[Change, str]] = {
    "no splats": (lambda d: primitive(d).pop("extensions"), "has no splats"),
    "compressed": (
        lambda d: primitive(d)["extensions"][KHR].update(extensions={f"{KHR}_compression_spz_2": {}}),
        r"compressed \(KHR_gaussian_splatting_compression_spz_2\)",
    ),
    "required": (
        lambda d: d.update(extensionsRequired=["EXT_meshopt_compression"]),
        "needs the glTF extension EXT_mesho",
    ),
    "required text": (lambda d: d.update(extensionsRequired="x"), "needs the glTF extension"),
    "no skew": (lambda d: primitive(d)["attributes"].pop(f"{SKEWED}:SKEW"), "kernel_skew_normal:SKEW is missing"),
    "no rotation": (lambda d: primitive(d)["attributes"].pop(f"{KHR}:ROTATION"), "ROTATION is missing"),
    "hole in SH": (
        lambda d: primitive(d)["attributes"].pop(f"{KHR}:SH_DEGREE_1_COEF_1"),
        "SH_DEGREE_1_COEF_1 is missing",
    ),
    "wrong width": (
        lambda d: primitive(d)["attributes"].update({f"{KHR}:SCALE": primitive(d)["attributes"][f"{KHR}:ROTATION"]}),
        "SCALE is missing, or not 3 numbers",
    ),
    "logs": (
        lambda d: primitive(d)["attributes"].update({f"{KHR}:SCALE": primitive(d)["attributes"]["POSITION"]}),
        "SCALE is below 0 .drafts",
    ),
    "negative index": (lambda d: primitive(d)["attributes"].update(POSITION=-1), r"has no accessors\[-1\]"),
    "text index": (lambda d: primitive(d)["attributes"].update(POSITION="a"), r"has no accessors\[a\]"),
    "lying count": (lambda d: [a.update(count=2**31) for a in d["accessors"]], "bytes, its buffer has fewer"),
    "negative count": (lambda d: d["accessors"][0].update(count=-1), "its count is '-1'"),
    "huge stride": (lambda d: d["bufferViews"][0].update(byteStride=2**30), "bytes, its buffer has fewer"),
    "small stride": (lambda d: d["bufferViews"][0].update(byteStride=1), "its buffer has fewer"),
    "view behind": (lambda d: d["bufferViews"][0].update(byteOffset=2**30), "its buffer has fewer"),
    "unknown type": (lambda d: d["accessors"][0].update(type="MAT4"), "unknown type"),
    "unhashable type": (lambda d: d["accessors"][0].update(componentType=[]), "unknown type"),
    "sparse": (lambda d: d["accessors"][0].update(sparse={}), "is sparse or empty"),
    "empty": (lambda d: d["accessors"][0].pop("bufferView"), "is sparse or empty"),
    "own child": (lambda d: d["nodes"][0].update(children=[0]), "two parents"),
    "no node": (lambda d: d["scenes"][0].update(nodes=[7]), r"no nodes\[7\]"),
    "no list": (lambda d: d["scenes"][0].update(nodes=7), "not a list"),
    "mirrored": (lambda d: d["nodes"][0].update(scale=[-1, 1, 1]), "mirrored"),
    "stretched": (lambda d: d["nodes"][0].update(scale=[2, 1, 1]), "scaled by"),
    "no turn": (lambda d: d["nodes"][0].update(rotation=[0, 0, 0, 0]), "rotation of a node is 0"),
    "no number": (lambda d: d["nodes"][0].update(translation=["a", 1, 1]), "translation of a node is not 3 numbers"),
    "near plane": (lambda d: primitive(d).update(extras={"clsplat": {"nearPlane": -1}}), "nearPlane is '-1'"),
    "low pass": (lambda d: primitive(d).update(extras={"clsplat": {"lowPass": "x"}}), "lowPass is 'x'"),
    "normalisation": (
        lambda d: primitive(d)["extensions"][KHR]["extensions"].update({SKEWED: {"normalisation": "sum"}}),
        "normalisation 'sum'",
    ),
    "meshes": (lambda d: d.update(meshes={"a": 1}), "its meshes are not a list of objects"),
    "no data": (
        lambda d: d.update(buffers=[{}, {}], bufferViews=[v | {"buffer": 1} for v in d["bufferViews"]]),
        "no data",
    ),
    "no base64": (lambda d: d["buffers"][0].update(uri="data:,!"), "not base64"),
    "uri": (lambda d: d["buffers"][0].update(uri=3), "no text as its uri"),
    "missing file": (lambda d: d["buffers"][0].update(uri="a\0/b.bin"), "needs the file 'b.bin' beside it"),
    "old": (lambda d: d["asset"].update(version="1.0"), "has version '1.0', version 2 of glTF"),
    "no asset": (lambda d: d.pop("asset"), "has version 'None'"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_faults_are_named(file: Path, name: str) -> None:
    change, message = FAULTS[name]
    model().save(file)
    glb_files.rewrite(file, change)
    with pytest.raises(InputError, match=message) as caught:
        Splats.load(file)
    assert str(caught.value).startswith(f"{file}: ")
    assert "\n" not in str(caught.value)


def test_different_kernels_in_one_file(file: Path) -> None:
    model().save(file)

    def change(document: dict[str, Any]) -> None:
        first = primitive(document)
        plain = {"kernel": "ellipse", "colorSpace": "srgb_rec709_display"}
        document["meshes"][0]["primitives"] = [first, first | {"extensions": {KHR: plain}}]

    glb_files.rewrite(file, change)
    with pytest.raises(InputError, match="has splats of several kernels; export each"):
        Splats.load(file)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (b"glTF\2", "ends in its header"),
        (b"glTF\3\0\0\0\14\0\0\0", "version 3, version 2 of .glb"),
        (b"glTF\2\0\0\0\xff\0\0\0", "has 12 of its 255 bytes"),
        (b"glTF\2\0\0\0\x14\0\0\0\xff\xff\xff\xffJSON", "chunk of 4294967295 bytes"),
        (b"glTF\2\0\0\0\x14\0\0\0\0\0\0\0JSON", "its JSON is damaged"),
        (b"glTF\2\0\0\0\x18\0\0\0\4\0\0\0JSON[1] ", "its JSON is not an object"),
        (b"[" * 100_000, "its JSON is damaged"),
    ],
)
def test_damaged_containers(file: Path, data: bytes, message: str) -> None:
    file.write_bytes(data)
    with pytest.raises(InputError, match=message):
        Splats.load(file)


def test_every_truncation_is_named(file: Path) -> None:
    model(n=4, degree=0).save(file)
    data = file.read_bytes()
    for length in range(0, len(data), 7):
        file.write_bytes(data[:length])
        with pytest.raises(InputError):
            Splats.load(file)
