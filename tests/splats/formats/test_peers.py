"""Files of clsplat in the readers of other programs: the tests compare the values that these read.

The readers are npm packages, which clsplat does not install:

    npm install @playcanvas/splat-transform @adobe/spz @mkkellogg/gaussian-splats-3d gsplat @sparkjsdev/spark
    CLSPLAT_NODE_MODULES=$PWD/node_modules pytest tests/splats/formats/test_peers.py

Spark runs in Chromium (extra `test-view`); `pip install plyfile` adds that reader.
"""

from __future__ import annotations

import json
import shutil
import sys
import threading
from collections.abc import Callable
from functools import partial
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
from node_packages import MODULES, node, package, transform
from reference.scenes import for_shape, random_splats

from clsplat.splats.axes import RUB, flipped
from clsplat.splats.formats.streamed_sog import LOD_META, write_streamed_sog
from clsplat.splats.harmonics import SH_C0, axis_flip_signs
from clsplat.splats.quaternions import rotations
from clsplat.splats.splats import Splats
from clsplat.splats.stored import StoredSplats

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser")
N = 40
Found = dict[str, np.ndarray]

# What a browser has and Node has not, as far as these packages ask for it when they are loaded.
PRELUDE = """
import fs from 'fs';
globalThis.window = globalThis; globalThis.self = globalThis; globalThis.document = {createElement: () => ({})};
const file = process.argv[2];
const bytes = fs.readFileSync(file);
const buffer = bytes.buffer.slice(bytes.byteOffset, bytes.byteOffset + bytes.byteLength);
"""
GS3D = (
    PRELUDE
    + """
const G = await import('@mkkellogg/gaussian-splats-3d');
const read = file.endsWith('.ply') ? G.PlyParser.parseToUncompressedSplatArray(buffer, 3)
                                   : G.SplatParser.parseStandardSplatToUncompressedSplatArray(buffer);
console.log(JSON.stringify(read.splats));
"""
)
GSPLAT = (
    PRELUDE
    + """
const G = await import('gsplat');
const loader = file.endsWith('.ply') ? G.PLYLoader : G.Loader;
const data = loader.LoadFromArrayBuffer(buffer, new G.Scene()).data;
console.log(JSON.stringify([data.positions, data.scales, data.rotations, data.colors].map(a => Array.from(a))));
"""
)
# The library of the format's authors, compiled for the web. It also writes versions 2 to 4.
SPZ_LIBRARY = """
import fs from 'fs';
console.log = () => {};
const M = await (await import('@adobe/spz')).default();
const [file, output, version] = process.argv.slice(2);
const cloud = M.loadSpzFromBuffer(new Uint8Array(fs.readFileSync(file)), {to: M.CoordinateSystem.RDF});
if (output) {
  const options = {from: M.CoordinateSystem.RDF, version: +version, sh1Bits: 8, shRestBits: 8};
  fs.writeFileSync(output, M.saveSpzToBuffer(cloud, options));
}
const fields = ['positions', 'scales', 'rotations', 'alphas', 'colors', 'sh'];
process.stdout.write(JSON.stringify(fields.map(name => Array.from(cloud[name]))));
"""
SPARK = """
<script type="importmap">
{"imports": {"three": "/three/build/three.module.js", "three/addons/": "/three/examples/jsm/"}}
</script>
<script type="module">
import { PackedSplats } from "/@sparkjsdev/spark/dist/spark.module.js";
window.read = async (file) => {
  const bytes = new Uint8Array(await (await fetch("/files/" + file)).arrayBuffer());
  const splats = new PackedSplats({ fileBytes: bytes, fileName: file });
  await splats.initialized;
  const rows = [];
  splats.forEachSplat((i, c, s, q, o, k) =>
    rows.push([c.x, c.y, c.z, s.x, s.y, s.z, q.w, q.x, q.y, q.z, o, k.r, k.g, k.b]));
  return rows;
};
window.ready = true;
</script>
"""


def by_splat_transform(tmp_path: Path, file: Path) -> Found:
    rows = np.genfromtxt(transform(file, tmp_path / "read.csv"), delimiter=",", names=True)

    def columns(*names: str) -> np.ndarray:
        return np.stack([rows[name] for name in names], axis=1)

    found = {
        "mean": columns("x", "y", "z"),
        "scale": np.exp(columns("scale_0", "scale_1", "scale_2")),
        "quat": columns("rot_0", "rot_1", "rot_2", "rot_3"),
        "opacity": 1 / (1 + np.exp(-rows["opacity"])),
        "colour": 0.5 + SH_C0 * columns("f_dc_0", "f_dc_1", "f_dc_2"),
    }
    if "f_rest_44" in rows.dtype.names:
        found["rest"] = columns(*(f"f_rest_{i}" for i in range(45))).reshape(-1, 3, 15).transpose(0, 2, 1)
    if file.suffix == ".spz" and shows_spz_as_stored():
        found["mean"], found["quat"] = found["mean"] * RUB, found["quat"] * [1, *RUB]
        found["rest"] = found["rest"] * axis_flip_signs(np.array(RUB), 3)[1:, None]
    return found


def transform_version() -> int:
    """Return the first number of splat-transform's version."""
    about = json.loads((MODULES / "@playcanvas/splat-transform" / "package.json").read_text(encoding="utf-8"))
    return int(about["version"].split(".")[0])


def shows_spz_as_stored() -> bool:
    """Whether splat-transform takes the axes of an .spz file for those of a PLY, as it does since version 3."""
    return transform_version() >= 3


def by_gaussian_splats_3d(tmp_path: Path, file: Path) -> Found:
    package("@mkkellogg/gaussian-splats-3d")
    rows = json.loads(node(tmp_path, GS3D, file))
    table = np.array([[row[str(i)] if isinstance(row, dict) else row[i] for i in range(14)] for row in rows])
    return {
        "mean": table[:, :3],
        "scale": table[:, 3:6],
        "quat": table[:, 6:10],
        "colour": table[:, 10:13] / 255,
        "opacity": table[:, 13] / 255,
    }


def by_gsplat(tmp_path: Path, file: Path) -> Found:
    package("gsplat")
    places, scales, rotations, colours = (np.array(part) for part in json.loads(node(tmp_path, GSPLAT, file)))
    colours = colours.reshape(-1, 4) / 255
    return {
        "mean": places.reshape(-1, 3),
        "scale": scales.reshape(-1, 3),
        "quat": rotations.reshape(-1, 4),
        "colour": colours[:, :3],
        "opacity": colours[:, 3],
    }


def by_spz_library(tmp_path: Path, file: Path) -> Found:
    package("@adobe/spz")
    found = [np.array(values) for values in json.loads(node(tmp_path, SPZ_LIBRARY, file))]
    places, scales, rotations, alphas, colours, sh = found
    return {
        "mean": places.reshape(-1, 3),
        "scale": np.exp(scales.reshape(-1, 3)),
        "quat": rotations.reshape(-1, 4)[:, [3, 0, 1, 2]],
        "opacity": 1 / (1 + np.exp(-alphas)),
        "colour": 0.5 + SH_C0 * colours.reshape(-1, 3),
        "rest": sh.reshape(-1, 15, 3),
    }


def by_spark(tmp_path: Path, file: Path) -> Found:
    package("@sparkjsdev/spark")
    api = pytest.importorskip("playwright.sync_api")
    if CHROMIUM is None:
        pytest.skip("there is no Chromium")
    served = tmp_path / "served"
    served.mkdir()
    (served / "files").symlink_to(file.parent)
    (served / "index.html").write_text(SPARK)
    for name in ("three", "@sparkjsdev"):
        (served / name).symlink_to(MODULES / name)
    handler = type("Quiet", (SimpleHTTPRequestHandler,), {"log_message": lambda *_: None})
    server = ThreadingHTTPServer(("127.0.0.1", 0), partial(handler, directory=str(served)))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        with api.sync_playwright() as playwright:
            browser = playwright.chromium.launch(executable_path=CHROMIUM, args=["--no-sandbox"])
            page = browser.new_page()
            page.goto(f"http://127.0.0.1:{server.server_port}/index.html")
            page.wait_for_function("window.ready")
            table = np.array(page.evaluate("file => window.read(file)", file.name))
            browser.close()
    finally:
        server.shutdown()
        server.server_close()
    # Spark keeps the axes of each file. Those of .spz files differ from those of a PLY.
    turn = np.array([1, -1, -1]) if file.suffix == ".spz" else np.ones(3)
    return {
        "mean": table[:, :3] * turn,
        "scale": table[:, 3:6],
        "quat": table[:, 6:10] * [1, *turn],
        "opacity": table[:, 10],
        "colour": table[:, 11:],
    }


def by_plyfile(tmp_path: Path, file: Path) -> Found:
    plyfile = pytest.importorskip("plyfile")
    rows = plyfile.PlyData.read(file)["vertex"].data
    table = np.stack([rows[name] for name in rows.dtype.names[:62]], axis=1).astype(np.float64)
    assert not table[:, 3:6].any()
    return {
        "mean": table[:, :3],
        "colour": 0.5 + SH_C0 * table[:, 6:9],
        "rest": table[:, 9:54].reshape(-1, 3, 15).transpose(0, 2, 1),
        "opacity": 1 / (1 + np.exp(-table[:, 54])),
        "scale": np.exp(table[:, 55:58]),
        "quat": table[:, 58:],
    }


# Relative, of scales; absolute, of the rest. Bytes are cut off or rounded; Spark packs what it reads.
SPARK_ROUNDING = {"mean": 4e-3, "scale": 0.08, "quat": 0.03, "opacity": 3e-3, "colour": 3e-3}
BYTES = {"mean": 1e-6, "scale": 1e-5, "quat": 0.01, "opacity": 4e-3, "colour": 4e-3, "rest": 1e-6}
EXACT = dict.fromkeys(("mean", "scale", "quat", "opacity", "colour", "rest"), 2e-6)

READERS: list[tuple[Callable[[Path, Path], Found], str, dict[str, float]]] = [
    (by_splat_transform, "gaussian.ply", EXACT),
    (by_splat_transform, "skewed.ply", EXACT),
    (by_splat_transform, "gaussian.spz", EXACT),
    (by_splat_transform, "version4.spz", EXACT),
    (by_splat_transform, "gaussian.sog", EXACT),
    (by_splat_transform, "skewed.sog", EXACT),
    (by_spz_library, "gaussian.spz", EXACT),
    (by_spz_library, "version4.spz", EXACT),
    (by_splat_transform, "gaussian.splat", EXACT | {"quat": 0.01}),
    (by_gaussian_splats_3d, "gaussian.ply", BYTES),
    (by_gaussian_splats_3d, "skewed.ply", BYTES),
    (by_gaussian_splats_3d, "gaussian.splat", BYTES),
    (by_gsplat, "gaussian.ply", BYTES),
    (by_gsplat, "skewed.ply", BYTES),
    (by_gsplat, "gaussian.splat", BYTES),
    (by_spark, "gaussian.ply", SPARK_ROUNDING),
    (by_spark, "skewed.ply", SPARK_ROUNDING),
    (by_spark, "gaussian.spz", SPARK_ROUNDING),
    (by_spark, "gaussian.sog", SPARK_ROUNDING),
    (by_spark, "gaussian.splat", SPARK_ROUNDING),
    (by_plyfile, "gaussian.ply", EXACT),
    (by_plyfile, "skewed.ply", EXACT),
]


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("files")
    arrays = {name: values.astype(np.float32) for name, values in random_splats(7, N, 3).items()}
    arrays["sh"] *= 0.3
    for name in ("skewed.ply", "skewed.sog"):
        Splats("skew-normal", arrays).save(folder / name)
    gaussians = Splats("gaussian", for_shape(arrays, "gaussian"))
    gaussians.save(folder / "gaussian.ply")
    gaussians.save(folder / "gaussian.splat")
    gaussians.save(folder / "gaussian.spz")
    gaussians.save(folder / "gaussian.sog")
    if find_spec("zstandard") or sys.version_info >= (3, 14):
        gaussians.save(folder / "version4.spz", spz_version=4)
    return folder


@pytest.mark.parametrize(
    ("reader", "name", "tolerances"), READERS, ids=[f"{reader.__name__[3:]}-{name}" for reader, name, _ in READERS]
)
def test_others_find_our_values(
    files: Path, tmp_path: Path, reader: Callable[[Path, Path], Found], name: str, tolerances: dict[str, float]
) -> None:
    if not (files / name).exists():
        pytest.skip("there is no Zstandard")
    ours = Splats.load(files / name)
    found = reader(tmp_path, files / name)
    unit = ours.quat / np.linalg.norm(ours.quat, axis=1, keepdims=True)
    theirs = found["quat"] / np.linalg.norm(found["quat"], axis=1, keepdims=True)
    wanted = {
        "mean": ours.mean,
        "scale": np.exp(ours.log_scale),
        "opacity": 1 / (1 + np.exp(-ours.opacity_logit)),
        "colour": np.clip(0.5 + SH_C0 * ours.sh[:, 0], 0, 1),
        "rest": ours.sh[:, 1:],
    }
    assert np.abs(np.abs(np.sum(unit * theirs, axis=1)) - 1).max() < tolerances["quat"]
    for field in set(found) - {"quat"}:
        values = np.clip(found[field], 0, 1) if field == "colour" else found[field]
        relative = field == "scale"
        np.testing.assert_allclose(
            values,
            wanted[field],
            rtol=tolerances[field] if relative else 0,
            atol=1e-7 if relative else tolerances[field],
            err_msg=field,
        )


def agree(found: Splats, wanted: Splats, tolerances: dict[str, float]) -> None:
    """The splats are the same, in any order."""
    order = [int(np.abs(wanted.mean - mean).sum(axis=1).argmin()) for mean in found.mean]
    assert sorted(order) == list(range(len(wanted)))
    units = [splats.quat / np.linalg.norm(splats.quat, axis=1, keepdims=True) for splats in (found, wanted)]
    assert np.abs(np.sum(units[0] * units[1][order], axis=1)).min() > 1 - tolerances["quat"]
    opacities = [1 / (1 + np.exp(-splats.opacity_logit)) for splats in (found, wanted)]
    np.testing.assert_allclose(opacities[0], opacities[1][order], atol=tolerances["opacity"])
    for field in ("mean", "log_scale", "sh"):
        np.testing.assert_allclose(
            getattr(found, field), getattr(wanted, field)[order], atol=tolerances[field], err_msg=field
        )


# What each format loses.
PACKED = {"mean": 2e-3, "log_scale": 2e-3, "opacity": 3e-3, "quat": 1e-6, "sh": 0.02}
QUANTISED = {"mean": 2e-4, "log_scale": 0.04, "opacity": 3e-3, "quat": 2e-6, "sh": 0.07}
PALETTE = {"mean": 1e-4, "log_scale": 0.02, "opacity": 5e-3, "quat": 1e-4, "sh": 0.3}
NOTHING = dict.fromkeys(PACKED, 1e-6)


@pytest.mark.parametrize(
    ("name", "options", "tolerances"),
    [
        ("back.ply", [], NOTHING),
        ("back.compressed.ply", [], PACKED),
        ("back.sog", ["-g", "cpu"], PALETTE),
        ("back/meta.json", ["-g", "cpu"], PALETTE),
        ("back.spz", ["--spz-version", "3"], QUANTISED),
        ("back.spz", ["--spz-version", "4"], QUANTISED),
    ],
)
def test_we_read_what_splat_transform_writes(
    files: Path, tmp_path: Path, name: str, options: list[str], tolerances: dict[str, float]
) -> None:
    """Our values are those of the model within the format's rounding, and exactly those that its writer reads."""
    if "4" in options:
        pytest.importorskip("zstandard")
    (tmp_path / name).parent.mkdir(exist_ok=True)
    back = Splats.load(transform(files / "gaussian.ply", tmp_path / name, *options))
    again = Splats.load(transform(tmp_path / name, tmp_path / "again.ply"))
    if name.endswith(".spz") and shows_spz_as_stored():
        back = back.with_arrays(flipped(back.arrays, RUB))
    agree(back, Splats.load(files / "gaussian.ply"), tolerances)
    agree(back, again, NOTHING)


@pytest.mark.parametrize("version", [2, 3, 4])
def test_we_read_what_the_library_of_spz_writes(files: Path, tmp_path: Path, version: int) -> None:
    package("@adobe/spz")
    if version == 4:
        pytest.importorskip("zstandard")
    node(tmp_path, SPZ_LIBRARY, files / "gaussian.spz", tmp_path / "back.spz", version)
    rounding = NOTHING | {"mean": 2e-4, "quat": 1e-3 if version == 2 else 1e-6}
    agree(Splats.load(tmp_path / "back.spz"), Splats.load(files / "gaussian.spz"), rounding)


@pytest.mark.parametrize("level", [0, 1, 2])
def test_splat_transform_reads_our_levels(files: Path, tmp_path: Path, level: int) -> None:
    """The levels of a streamed SOG have the splats that we have merged, up to the rounding of a palette."""
    package("@playcanvas/splat-transform")
    if transform_version() < 3:
        pytest.skip("splat-transform reads lod-meta.json since version 3")
    stored = StoredSplats("gaussian", "peak", False, Splats.load(files / "gaussian.ply").arrays)
    levels = write_streamed_sog(tmp_path / "scene" / LOD_META, stored, 3)
    back = transform(tmp_path / "scene" / LOD_META, tmp_path / "back.ply", "-L", str(level))
    found, wanted = Splats.load(back), Splats("gaussian", levels[level].arrays)
    order = [int(np.abs(wanted.mean - mean).sum(axis=1).argmin()) for mean in found.mean]
    assert sorted(order) == list(range(len(wanted)))
    np.testing.assert_allclose(found.mean, wanted.mean[order], atol=2e-3)
    np.testing.assert_allclose(found.sh, wanted.sh[order], atol=0.1)
    # The writer gives rotations a half turn, which no Gaussian shows.
    sizes = np.trace(covariances(wanted), axis1=1, axis2=2)[order]
    different = np.abs(covariances(found) - covariances(wanted)[order]).max(axis=(1, 2))
    assert (different < 0.05 * sizes).all()


def covariances(splats: Splats) -> np.ndarray:
    frame = rotations(splats.quat.astype(np.float64)) * np.exp(splats.log_scale.astype(np.float64))[:, None]
    return frame @ frame.transpose(0, 2, 1)
