"""Our .glb files in other programs: Khronos' validator, splat-transform's writer, PlayCanvas and Babylon.js.

npm install gltf-validator @playcanvas/splat-transform playcanvas @babylonjs/core @babylonjs/loaders

CLSPLAT_NODE_MODULES=$PWD/node_modules pytest tests/splats/formats/test_gltf_peers.py
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import glb_files
import numpy as np
import pytest
from model_arrays import random_model
from node_packages import MODULES, node, package, transform

from clsplat.splats.axes import LUF, flipped
from clsplat.splats.harmonics import SH_C0
from clsplat.splats.quaternions import rotations
from clsplat.splats.shapes import SHAPES
from clsplat.splats.splats import Splats

KHR = "KHR_gaussian_splatting"
N = 30

VALIDATOR = """
import fs from 'fs';
import validator from 'gltf-validator';
const report = await validator.validateBytes(new Uint8Array(fs.readFileSync(process.argv[2])), {maxIssues: 0});
console.log(JSON.stringify(report));
"""
# The engine's reader, without a graphics card. Its package has the reader as a file, but does not export it.
PLAYCANVAS = """
import fs from 'fs';
globalThis.window = globalThis; globalThis.navigator = {userAgent: '', maxTouchPoints: 0};
const [file, modules] = process.argv.slice(2);
const pc = await import('playcanvas');
const reader = 'playcanvas/build/playcanvas/src/framework/parsers/glb/extensions/khr-gaussian-splatting.js';
const {khrGaussianSplatting} = await import(`${modules}/${reader}`);
const data = fs.readFileSync(file);
const length = data.readUInt32LE(12), gltf = JSON.parse(data.subarray(20, 20 + length));
const binary = data.subarray(28 + length);
const views = gltf.bufferViews.map(
  view => new Uint8Array(binary.buffer, binary.byteOffset + (view.byteOffset || 0), view.byteLength));
const canvas = {width: 9, height: 9, addEventListener() {}, removeEventListener() {}, style: {}};
const [[found]] = khrGaussianSplatting.createResources(new pc.NullGraphicsDevice(canvas), gltf, views);
const table = Object.fromEntries(found.gsplatData.elements[0].properties.map(p => [p.name, Array.from(p.storage)]));
console.log(JSON.stringify(table));
"""
BABYLON = """
import fs from 'fs';
import {NullEngine} from '@babylonjs/core/Engines/nullEngine.js';
import {Logger} from '@babylonjs/core/Misc/logger.js';
import {Scene} from '@babylonjs/core/scene.js';
import {SceneLoader} from '@babylonjs/core/Loading/sceneLoader.js';
import {GaussianSplattingMesh} from '@babylonjs/core/Meshes/GaussianSplatting/gaussianSplattingMesh.js';
import '@babylonjs/loaders/glTF/2.0/index.js';
Logger.LogLevels = 0;
globalThis.Worker = class { postMessage() {} terminate() {} };
const given = [], update = GaussianSplattingMesh.prototype.updateDataAsync;
GaussianSplattingMesh.prototype.updateDataAsync = function (data, ...rest) {
  given.push(data);
  return update.call(this, data, ...rest);
};
const data = 'data:model/gltf-binary;base64,' + fs.readFileSync(process.argv[2]).toString('base64');
await SceneLoader.ImportMeshAsync('', '', data, new Scene(new NullEngine()), undefined, '.glb');
process.stdout.write(JSON.stringify(given.map(one => Array.from(new Uint8Array(one)))), () => process.exit(0));
"""


@pytest.fixture(params=["gaussian", "skew-normal", "generalised-exponential"])
def splats(request: pytest.FixtureRequest) -> Splats:
    return Splats(request.param, random_model(SHAPES[request.param], N, 3, sh_degree=3, dead=0))


@pytest.fixture
def file(tmp_path: Path, splats: Splats) -> Path:
    splats.save(tmp_path / "model.glb")
    return tmp_path / "model.glb"


def test_khronos_validator_finds_no_fault(tmp_path: Path, file: Path) -> None:
    """The validator does not know the extension yet, and takes its names of attributes for mistakes.

    So the test gives it the same file with the names of private attributes, which begin with an underscore.
    """
    package("gltf-validator")

    def rename(document: dict[str, Any]) -> None:
        primitive = document["meshes"][0]["primitives"][0]
        primitive["attributes"] = {
            (name if ":" not in name else f"_{name.upper().replace(':', '_')}"): index
            for name, index in primitive["attributes"].items()
        }

    glb_files.rewrite(file, rename)
    report = json.loads(node(tmp_path, VALIDATOR, file))
    issues = [issue for issue in report["issues"]["messages"] if issue["code"] != "UNSUPPORTED_EXTENSION"]
    assert (report["issues"]["numErrors"], report["issues"]["numWarnings"], issues) == (0, 0, [])
    assert report["info"]["totalVertexCount"] == N


def covariances(found: dict[str, np.ndarray]) -> np.ndarray:
    turn = rotations(found[f"{KHR}:ROTATION"][:, [3, 0, 1, 2]].astype(np.float64))
    return np.einsum("nij,nj,nkj->nik", turn, found[f"{KHR}:SCALE"].astype(np.float64) ** 2, turn)


def test_splat_transform_writes_the_same_values(tmp_path: Path, splats: Splats, file: Path) -> None:
    splats.save(tmp_path / "model.ply")
    ours = glb_files.attributes(file)
    theirs = glb_files.attributes(transform(tmp_path / "model.ply", tmp_path / "theirs.glb"))
    assert set(ours) - set(theirs) == {name for name in ours if name.startswith("CLSPLAT")}
    order = [int(np.abs(ours["POSITION"] - place).sum(axis=1).argmin()) for place in theirs["POSITION"]]
    assert sorted(order) == list(range(N))
    # They turn the frame of a splat, and we turn its axes round: the covariances are the same.
    assert np.abs(covariances(ours)[order] - covariances(theirs)).max() < 1e-6
    for name in set(theirs) - {f"{KHR}:ROTATION"}:
        atol = 1 if name == "COLOR_0" else 2e-5
        mine = ours[name][order].astype(np.float64)
        np.testing.assert_allclose(mine, theirs[name], rtol=2e-5, atol=atol, err_msg=name)


def test_playcanvas_reads_the_ellipses(tmp_path: Path, splats: Splats, file: Path) -> None:
    package("playcanvas")
    table = {name: np.array(values) for name, values in json.loads(node(tmp_path, PLAYCANVAS, file, MODULES)).items()}
    arrays = flipped(splats.arrays, LUF)

    def columns(*names: str) -> np.ndarray:
        return np.stack([table[name] for name in names], axis=1)

    mean = columns("x", "y", "z")
    order = [int(np.abs(arrays["mean"] - place).sum(axis=1).argmin()) for place in mean]  # it sorts them
    assert sorted(order) == list(range(N))
    np.testing.assert_allclose(mean, arrays["mean"][order], atol=1e-6)
    scales = np.exp(arrays["log_scale"].astype(np.float64))
    np.testing.assert_allclose(columns("scale_0", "scale_1", "scale_2"), scales[order], rtol=1e-5)
    unit = arrays["quat"] / np.linalg.norm(arrays["quat"], axis=1, keepdims=True)
    dots = np.sum(columns("rot_0", "rot_1", "rot_2", "rot_3") * unit[order], axis=1)
    np.testing.assert_allclose(np.abs(dots), 1, atol=1e-5)
    np.testing.assert_allclose(table["opacity"], 1 / (1 + np.exp(-arrays["opacity_logit"][order])), atol=1e-6)
    np.testing.assert_allclose(columns("f_dc_0", "f_dc_1", "f_dc_2"), arrays["sh"][order, 0], atol=1e-6)
    rest = columns(*(f"f_rest_{i}" for i in range(45))).reshape(-1, 3, 15).transpose(0, 2, 1)
    np.testing.assert_allclose(rest, arrays["sh"][order, 1:], atol=1e-6)


def test_babylon_reads_the_ellipses(tmp_path: Path, splats: Splats, file: Path) -> None:
    package("@babylonjs/loaders")
    (rows,) = json.loads(node(tmp_path, BABYLON, file))
    data = np.array(rows, np.uint8).reshape(N, 32)  # the layout of .splat files
    arrays = flipped(splats.arrays, LUF)
    reals = data[:, :24].copy().view("<f4")
    np.testing.assert_allclose(reals[:, :3], arrays["mean"], atol=1e-6)
    np.testing.assert_allclose(reals[:, 3:], np.exp(arrays["log_scale"]), rtol=1e-5)
    color = np.clip(255 * (0.5 + SH_C0 * arrays["sh"][:, 0]), 0, 255)
    np.testing.assert_allclose(data[:, 24:27], color, atol=0.51)
    opacity = 255 / (1 + np.exp(-arrays["opacity_logit"].astype(np.float64)))
    np.testing.assert_allclose(data[:, 27], opacity, atol=0.51)
    quat = (data[:, 28:].astype(np.float64) - 127.5) / 127.5
    unit = arrays["quat"] / np.linalg.norm(arrays["quat"], axis=1, keepdims=True)
    dots = np.sum(quat / np.linalg.norm(quat, axis=1, keepdims=True) * unit, axis=1)
    np.testing.assert_allclose(np.abs(dots), 1, atol=1e-3)
