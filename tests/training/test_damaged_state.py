"""Damaged files of a run: the error is one line that names the file, never a traceback."""

from __future__ import annotations

import json
import pickle
import tracemalloc
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fuzz_readers import make_checkpoint, make_model, read_checkpoint, read_model_folder

from clsplat.errors import InputError
from clsplat.files.json_file import read_object
from clsplat.training.checkpoint import Checkpoint
from clsplat.training.config import TrainConfig


def rewritten(path: Path, **changes: Any) -> None:
    """Write the checkpoint with changed arrays or changed values in its `meta`. None removes a value."""
    with np.load(path) as stored:
        arrays = {name: stored[name] for name in stored.files}
    meta = json.loads(arrays["meta"].tobytes())
    for name, value in changes.items():
        place = arrays if name in arrays else meta
        place[name] = value
        if value is None:
            del place[name]
    if changes.get("meta", 1) is not None:
        arrays["meta"] = np.frombuffer(json.dumps(meta).encode(), np.uint8)
    np.savez(path, **arrays)


@pytest.mark.parametrize(
    "changes",
    [
        {"queue": None},
        {"queue": [0, "one"]},
        {"queue": [True]},
        {"iteration": -1},
        {"iteration": 2.5},
        {"seconds": "long"},
        {"seconds": float("nan")},
        {"n_first": 0},
        {"reached": {"sh_degree": 9, "downscale": 1}},
        {"reached": {"sh_degree": 1, "downscale": 0}},
        {"reached": {"sh_degree": 1}},
        {"reached": [1, 2]},
        {"rng": {}},
        {"rng": {"bit_generator": "MT19937"}},
        {"version": "2\n2"},
        {"meta": None},
        {"signals": None},
        {"signals": np.ones(3)},
        {"splats.mean": np.ones((5, 3))},
        {"splats.mean": np.array(["x"] * 6)},
        {"splats.mean": None},
        {"optimizer.m.mean": np.float32(1)},
        {"config": {"iterations": "many"}},
        {"config": [1]},
        {"config": {"colour": 1}},
    ],
    ids=str,
)
def test_checkpoints_of_something_else(tmp_path: Path, changes: dict[str, Any]) -> None:
    make_checkpoint(tmp_path)
    read_checkpoint(tmp_path)
    rewritten(tmp_path / "checkpoint.npz", **changes)
    with pytest.raises(InputError) as caught:
        read_checkpoint(tmp_path)
    assert "\n" not in str(caught.value)
    if "config" not in changes:
        with pytest.raises(InputError, match=r"checkpoint\.npz: "):
            Checkpoint.load(tmp_path / "checkpoint.npz")


def test_checkpoints_in_odd_zip_files(tmp_path: Path) -> None:
    """zipfile has an exception for each: an encrypted file, a later version, a damaged stream of LZMA, no archive."""
    make_checkpoint(tmp_path)
    path = tmp_path / "checkpoint.npz"
    sound = path.read_bytes()
    entry = sound.index(b"PK\x01\x02")  # the central directory: version at 6, flags at 8
    for offset, value in ((8, 1), (6, 192)):
        path.write_bytes(sound[: entry + offset] + bytes([value]) + sound[entry + offset + 1 :])
        with pytest.raises(InputError, match=r"checkpoint\.npz: not a readable checkpoint"):
            Checkpoint.load(path)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_LZMA) as archive:
        archive.writestr("meta.npy", bytes(5000))
    data = path.read_bytes()
    path.write_bytes(data[:50] + b"\xff" * 20 + data[70:])
    with pytest.raises(InputError, match=r"checkpoint\.npz: not a readable checkpoint"):
        Checkpoint.load(path)
    path.write_bytes(pickle.dumps({"a": 1}))
    with pytest.raises(InputError, match=r"not a readable checkpoint \(no archive of NumPy\)"):
        Checkpoint.load(path)


@pytest.mark.parametrize(
    ("values", "said"),
    [
        ({"iterations": "many"}, "iterations is the text 'many'; expected a whole number"),
        ({"iterations": 2.5}, "expected a whole number"),
        ({"iterations": True}, "iterations is true"),
        ({"lambda_dssim": float("inf")}, "expected a finite number"),
        ({"background": [0, 0]}, "expected a list"),
        ({"save_iterations": 3}, "expected a list"),
        ({"save_iterations": ["a"]}, "expected a list"),
        ({"visible_adam": 1}, "expected true or false"),
        ({"device": 3}, "or null"),
        ({"iterations": None}, "iterations is null"),
        ([], "config: is a list"),
    ],
)
def test_options_of_another_kind_are_named(values: Any, said: str) -> None:
    with pytest.raises(InputError, match=said):
        TrainConfig.from_json(values)


def test_options_come_back() -> None:
    for config in (TrainConfig(), TrainConfig(strategy="mcmc", save_iterations=(3, 4), device="cpu", skew_lr=0.1)):
        assert TrainConfig.from_json(json.loads(json.dumps(config.to_json()))) == config
    assert TrainConfig.from_json({"init_scale": None, "skew_lr": None}) == TrainConfig()


@pytest.mark.parametrize(
    ("config", "said"),
    [
        ("[" * 100_000, "is not JSON"),
        ('{"config": {"background": [0, 0, NaN]}}', "background"),
        ('{"config": {"background": [0, 0, 2]}}', "from 0 to 1"),
        ('{"scene": {"test_names": [3]}}', "expected a list of names"),
    ],
)
def test_model_folders(tmp_path: Path, config: str, said: str) -> None:
    make_model(tmp_path)
    read_model_folder(tmp_path)
    (tmp_path / "config.json").write_text(config)
    with pytest.raises(InputError, match=said):
        read_model_folder(tmp_path)


def test_json_that_is_no_object(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text("[1]")
    with pytest.raises(InputError, match="expected a JSON object"):
        read_object(tmp_path / "a.json")


def test_a_checkpoint_is_not_held_in_memory(tmp_path: Path) -> None:
    """Its arrays are read one at a time: otherwise it would double the memory of a run that goes on."""
    make_checkpoint(tmp_path)
    path = tmp_path / "checkpoint.npz"
    with np.load(path) as stored:
        arrays = {name: stored[name] for name in stored.files}
    n, many = len(arrays["splats.mean"]), 20_000
    for name, array in arrays.items():
        if name.startswith(("splats.", "optimizer.")) and len(array) == n:
            arrays[name] = np.resize(array, (many, *array.shape[1:]))
    arrays["signals"] = np.resize(arrays["signals"], (len(arrays["signals"]), many))
    np.savez(path, **arrays)
    tracemalloc.start()
    try:
        loaded = Checkpoint.load(path)
        taken = tracemalloc.get_traced_memory()[0]
    finally:
        tracemalloc.stop()
    assert taken < path.stat().st_size / 3
    for name, array in loaded.splats.items():
        np.testing.assert_array_equal(array, arrays[f"splats.{name}"])


@pytest.mark.parametrize("damage", ["one shorter", "longer", "other fields", "no count", "count of 0"])
def test_a_damaged_average_is_found(tmp_path: Path, damage: str) -> None:
    make_checkpoint(tmp_path)
    path = tmp_path / "checkpoint.npz"
    with np.load(path) as stored:
        arrays = {name: stored[name] for name in stored.files}
    mean = {name.replace("splats.", "average."): array for name, array in arrays.items() if name.startswith("splats.")}
    mean["average.count"] = np.array([2])
    np.savez(path, **arrays, **mean)
    assert Checkpoint.load(path).average["count"] == [2]
    if damage == "one shorter":
        mean["average.mean"] = mean["average.mean"][1:]
    elif damage == "longer":
        mean = {name: array if name == "average.count" else np.repeat(array, 2, axis=0) for name, array in mean.items()}
    elif damage == "other fields":
        del mean["average.quat"]
    elif damage == "no count":
        del mean["average.count"]
    else:
        mean["average.count"] = np.array([0])
    np.savez(path, **arrays, **mean)
    with pytest.raises(InputError, match="not a readable checkpoint"):
        Checkpoint.load(path)
