"""Streamed SOG (splats/formats/streamed_sog.py): the files by the document, what comes back, and named faults."""

from __future__ import annotations

import errno
import json
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from model_arrays import random_model

from clsplat.errors import InputError, OutputError
from clsplat.files.images import decode_pixels, encode_pixels
from clsplat.splats.formats import streamed_sog
from clsplat.splats.formats.any_file import stored_bytes
from clsplat.splats.formats.sog import read_sog
from clsplat.splats.formats.sog_writer import sog_files
from clsplat.splats.formats.streamed_sog import LOD_META, write_streamed_sog
from clsplat.splats.quaternions import rotations
from clsplat.splats.shapes import GAUSSIAN
from clsplat.splats.splats import Splats
from clsplat.splats.stored import StoredSplats

N = 300


@pytest.fixture(autouse=True)
def small_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leaves and chunks that 300 splats fill."""
    monkeypatch.setattr(streamed_sog, "_LEAF", 64)
    monkeypatch.setattr(streamed_sog, "_CHUNK", 128)


def model(n: int = N) -> StoredSplats:
    return StoredSplats("gaussian", "peak", True, random_model(GAUSSIAN, n, 2, sh_degree=1, dead=0))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "scene" / LOD_META


def nodes(node: dict[str, Any]) -> Iterator[dict[str, Any]]:
    yield node
    for child in node.get("children", []):
        yield from nodes(child)


def test_files_are_those_of_the_format(path: Path) -> None:
    levels = write_streamed_sog(path, model(), 3)
    meta = json.loads(path.read_text())
    assert meta["version"] == 1
    assert meta["lodLevels"] == len(levels) == 3
    assert meta["counts"] == [len(level.arrays["mean"]) for level in levels]
    assert meta["count"] == sum(meta["counts"])
    assert meta["counts"][0] == N
    chunks = [read_sog(path.parent / name) for name in meta["filenames"]]
    assert len(chunks) > 3, "level 0 has several chunks"
    assert all(chunk.antialiased for chunk in chunks)
    whole = list(nodes(meta["tree"]))
    leaves = [node for node in whole if "lods" in node]
    assert all(("lods" in node) != ("children" in node) for node in whole)
    for node in whole:
        for child in node.get("children", []):
            assert (np.array(node["bound"]["min"]) <= child["bound"]["min"]).all()
            assert (np.array(node["bound"]["max"]) >= child["bound"]["max"]).all()
    used: dict[int, list[tuple[int, int]]] = {}
    for leaf in leaves:
        assert len(leaf["errors"]) == 3
        assert leaf["errors"][0] == 0
        assert leaf["errors"] == sorted(leaf["errors"])
        assert leaf["errors"][2] > 0
        for level, run in leaf["lods"].items():
            assert meta["filenames"][run["file"]].startswith(f"{level}_")
            used.setdefault(run["file"], []).append((run["offset"], run["offset"] + run["count"]))
            # The box of the leaf holds its Gaussians.
            arrays = {n: v[run["offset"] : run["offset"] + run["count"]] for n, v in chunks[run["file"]].arrays.items()}
            frame = rotations(arrays["quat"].astype(float)) * np.exp(arrays["log_scale"].astype(float))[:, None]
            reach = 3 * np.sqrt(np.sum(frame**2, axis=2))
            slack = 0.1 * reach.max()
            assert (arrays["mean"] - reach >= np.array(leaf["bound"]["min"]) - slack).all()
            assert (arrays["mean"] + reach <= np.array(leaf["bound"]["max"]) + slack).all()
    for number, chunk in enumerate(chunks):  # the runs cover each chunk, and do not overlap
        ends = sorted(used[number])
        assert ends[0][0] == 0
        assert ends[-1][1] == len(chunk.arrays["mean"])
        assert all(a[1] == b[0] for a, b in pairwise(ends))


def test_the_finest_level_comes_back(path: Path) -> None:
    before = model()
    write_streamed_sog(path, before, 2)
    after = Splats.load(path)
    assert (len(after), after.shape, after.antialiased, after.sh_degree) == (N, "gaussian", True, 1)
    order = [int(np.abs(before.arrays["mean"] - place).sum(axis=1).argmin()) for place in after.mean]
    assert sorted(order) == list(range(N))
    np.testing.assert_allclose(after.mean, before.arrays["mean"][order], atol=2e-3)
    np.testing.assert_allclose(after.sh, before.arrays["sh"][order], atol=0.05)


def test_a_small_model_is_one_leaf_and_stops_at_one_splat(path: Path) -> None:
    levels = write_streamed_sog(path, model(3), 8)
    meta = json.loads(path.read_text())
    assert "lods" in meta["tree"]
    assert len(levels) == meta["lodLevels"] <= 3
    assert meta["counts"][-1] == 1


def test_equal_models_give_equal_files_and_old_chunks_go(path: Path) -> None:
    write_streamed_sog(path, model(), 4)
    first = {file.relative_to(path.parent): file.read_bytes() for file in path.parent.rglob("*") if file.is_file()}
    (path.parent / "mine").mkdir()
    (path.parent / "mine" / "note.txt").write_text("mine")
    write_streamed_sog(path, model(), 4)
    for name, data in first.items():
        assert (path.parent / name).read_bytes() == data, name
    write_streamed_sog(path, model(), 1)
    left = {file.relative_to(path.parent).parts[0] for file in path.parent.rglob("*.webp")}
    assert left == {name for name in {n.parts[0] for n in first} if name.startswith("0_")}
    assert (path.parent / "mine" / "note.txt").exists()


def test_a_folder_that_is_not_a_chunk_of_the_file_is_kept(path: Path) -> None:
    mine = path.parent / "0_0" / "meta.json"
    mine.parent.mkdir(parents=True)
    mine.write_text("mine")
    with pytest.raises(OutputError, match=r"0_0: is not of lod-meta.json, but a chunk would get its name; remove it"):
        write_streamed_sog(path, model(), 2)
    assert mine.read_text() == "mine"
    assert [file.name for file in path.parent.iterdir()] == ["0_0"]


def test_a_disk_that_becomes_full_leaves_the_old_chunks(path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_streamed_sog(path, model(), 4)
    before = {file: file.read_bytes() for file in path.parent.rglob("*") if file.is_file()}
    written = []

    def full(*arguments: Any) -> dict[str, bytes]:
        if len(written) == 2:
            raise OSError(errno.ENOSPC, "No space left on device")
        written.append(sog_files(*arguments))
        return written[-1]

    monkeypatch.setattr(streamed_sog, "sog_files", full)
    with pytest.raises(OutputError, match=r"lod-meta.json: its chunks cannot be written"):
        write_streamed_sog(path, model(200), 4)
    assert {file: file.read_bytes() for file in path.parent.rglob("*") if file.is_file()} == before


def test_an_unusable_splat_is_left_out_alone(path: Path) -> None:
    """The tree counts the splats of a chunk with those that cannot be used."""
    write_streamed_sog(path, model(), 1)
    meta = json.loads(path.read_text())
    chunk = path.parent / meta["filenames"][0]
    name = json.loads(chunk.read_text())["quats"]["files"][0]
    tags = decode_pixels((chunk.parent / name).read_bytes(), name, 1 << 20)
    tags[0, 3, 3] = 7
    (chunk.parent / name).write_bytes(encode_pixels(tags))
    with pytest.warns(UserWarning, match=r"left out 1 of \d+ splats \(quat of splat \d+: norm is 0"):
        assert len(Splats.load(path)) == N - 1


def test_its_bytes_are_those_of_all_its_files(path: Path) -> None:
    write_streamed_sog(path, model(), 2)
    (path.parent / "notes.txt").write_text("not of the scene")
    files = [file for file in path.parent.rglob("*") if file.suffix in (".json", ".webp")]
    assert len(files) > 10
    assert stored_bytes(path) == sum(file.stat().st_size for file in files)
    chunk = next(path.parent.glob("0_*")) / "meta.json"
    assert path.stat().st_size < stored_bytes(chunk) < stored_bytes(path)


def test_an_environment_is_read(path: Path) -> None:
    write_streamed_sog(path, model(), 1)
    meta = json.loads(path.read_text())
    path.write_text(json.dumps(meta | {"environment": "0_0/meta.json"}))
    assert len(Splats.load(path)) > N


Change = Callable[[dict[str, Any]], Any]


def leaf_of(meta: dict[str, Any]) -> dict[str, Any]:
    return next(node for node in nodes(meta["tree"]) if "lods" in node)


FAULTS: dict[str, tuple[Change, str]] = {
    "version": (lambda m: m.update(version=2), "has another version than 1"),
    "no names": (lambda m: m.update(filenames=3), "no list of file names"),
    "outside": (lambda m: m.update(filenames=["../0_0/meta.json"] * 9), "is not a folder with meta.json"),
    "above": (lambda m: m.update(filenames=["../meta.json"] * 9), "is not a folder with meta.json"),
    "rooted": (lambda m: m.update(filenames=["/meta.json"] * 9), "is not a folder with meta.json"),
    "missing": (lambda m: m.update(filenames=["7_7/meta.json"] * 9), "cannot be read"),
    "no tree": (lambda m: m.pop("tree"), "its tree is damaged"),
    "file": (lambda m: leaf_of(m)["lods"]["0"].update(file=99), "a leaf is in file 99"),
    "negative": (lambda m: leaf_of(m)["lods"]["0"].update(offset=-1), "a leaf of its tree is damaged"),
    "count": (lambda m: leaf_of(m)["lods"]["0"].update(count=10**9), "a leaf has splats 0 to 1000000000"),
    "no leaf": (lambda m: m.update(tree={"children": []}), "has no splats"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_faults_are_named(path: Path, name: str) -> None:
    change, message = FAULTS[name]
    write_streamed_sog(path, model(), 1)
    meta = json.loads(path.read_text())
    change(meta)
    path.write_text(json.dumps(meta))
    with pytest.raises(InputError, match=message) as caught:
        Splats.load(path)
    assert "\n" not in str(caught.value)


def test_what_is_refused(path: Path, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="choose 1 to 8"):
        write_streamed_sog(path, model(), 9)
    with pytest.raises(InputError, match="has no splats"):
        Splats("gaussian", random_model(GAUSSIAN, 3, 0)).select([]).save(path)
    with pytest.raises(InputError, match=r"lod-meta\.json files hold Gaussians, not student-t"):
        write_streamed_sog(path, StoredSplats("student-t", "peak", False, {}), 2)
    path.parent.mkdir()
    for text, message in (("[" * 10**5, "is not JSON"), ("[]", "another version")):
        path.write_text(text)
        with pytest.raises(InputError, match=message):
            Splats.load(path)
    with pytest.raises(InputError, match="cannot be read"):
        Splats.load(tmp_path / LOD_META)
    (tmp_path / "file").write_text("x")
    with pytest.raises(OutputError):
        write_streamed_sog(tmp_path / "file" / LOD_META, model(), 1)
