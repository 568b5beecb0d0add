"""Damaged files of a training in blocks: one line that says what to remove, and then the same bits."""

from __future__ import annotations

import json
import re
import shutil
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clsplat.blocks import train as module
from clsplat.blocks.state import BlocksOptions, BlocksState
from clsplat.blocks.train import BlocksModel, partition_scene, train_in_blocks
from clsplat.cluster.training import train_in_folder
from clsplat.errors import InputError
from clsplat.scenes.scene import Scene
from clsplat.splats.splats import Splats
from clsplat.training.config import TrainConfig

CONFIG = TrainConfig(shape="gaussian", iterations=12, cap_max=100, sh_degree=1, densify_interval=5, exposure=True)
TWO = BlocksOptions(2, 1, polish=4)


@pytest.fixture(scope="module")
def model(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, bytes]:
    """A training that was stopped in polish_1, and the file of its model without a stop. Tests must copy the folder."""
    folder, other = tmp_path_factory.mktemp("stopped"), tmp_path_factory.mktemp("whole")

    def stopped(config: TrainConfig, part: Scene, place: Path, *arguments: Any) -> Any:
        def stop(trainer: Any, event: threading.Event) -> None:
            event.set()

        return train_in_folder(config, part, place, *arguments, **({"visit": stop} if place.name == "polish_1" else {}))

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "train_in_folder", stopped)
        with pytest.raises(KeyboardInterrupt):
            train_in_blocks(scene, TWO, CONFIG, output=folder)
    return folder, train_in_blocks(scene, TWO, CONFIG, output=other).path.read_bytes()


def resumed(scene: Scene, folder: Path) -> BlocksModel:
    return train_in_blocks(scene, TWO, CONFIG, output=folder, resume=True)


def edit(folder: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change the values of blocks.json."""
    values = json.loads((folder / "blocks.json").read_text())
    change(values)
    (folder / "blocks.json").write_text(json.dumps(values))


def without_blocks(folder: Path) -> None:
    """Make it a training whose blocks have ended, but not the last of their stage."""
    edit(folder, lambda values: values.pop("blocks"))


def the_remedy(scene: Scene, folder: Path) -> tuple[Path, str]:
    """Return the file that the error of a resumed training names, and what to remove."""
    with pytest.raises(InputError) as caught:
        resumed(scene, folder)
    text = str(caught.value)
    assert "\n" not in text
    return Path(text.split(": ")[0]), text


@pytest.mark.parametrize("damage", ["cut", "empty"])
@pytest.mark.parametrize(
    "file",
    [
        "coarse/point_cloud/iteration_12/point_cloud.ply",
        "block_0/inside.ply",
        "block_0/start.ply",
        "block_1/context.ply",
        "block_1/run/checkpoint.npz",
        "block_1/run/point_cloud/iteration_12/point_cloud.ply",
        "merged.ply",
        "polish_0/checkpoint.npz",
        "polish_0/point_cloud/iteration_2/point_cloud.ply",
        "polish_1/checkpoint.npz",
    ],
)
def test_a_damaged_file_is_removed_and_made_again(
    scene: Scene, model: tuple[Path, bytes], tmp_path: Path, file: str, damage: str
) -> None:
    folder = shutil.copytree(model[0], tmp_path / "m")
    if not file.startswith(("merged", "polish")):
        without_blocks(folder)
    path = folder / "blocks" / file
    path.write_bytes(path.read_bytes()[:700] if damage == "cut" else b"")
    named, text = the_remedy(scene, folder)
    assert named.samefile(path)
    assert "remove this file and resume" in text
    path.unlink()
    assert resumed(scene, folder).path.read_bytes() == model[1]


@pytest.mark.parametrize(
    "file",
    [
        "block_0/start.exposure.json",
        "block_1/run/config.json",
        "block_1/run/point_cloud",
        "block_0/inside.ply",
        "block_0",
        "coarse/point_cloud",
        "coarse/config.json",
        "merged.ply",
        "polish_0/point_cloud",
        "polish_0/config.json",
        "polish_0.exposure.json",
    ],
)
@pytest.mark.parametrize("stage", ["blocks", "polish"])
def test_a_missing_file_is_made_again(
    scene: Scene, model: tuple[Path, bytes], tmp_path: Path, file: str, stage: str
) -> None:
    folder = shutil.copytree(model[0], tmp_path / "m")
    if stage == "blocks":
        without_blocks(folder)
    path = folder / "blocks" / file
    shutil.rmtree(path) if path.is_dir() else path.unlink()
    assert resumed(scene, folder).path.read_bytes() == model[1]


@pytest.mark.parametrize("text", ["{}", "[", '{"config": {}}', ""])
def test_a_run_needs_only_its_checkpoint(scene: Scene, model: tuple[Path, bytes], tmp_path: Path, text: str) -> None:
    folder = shutil.copytree(model[0], tmp_path / "m")
    without_blocks(folder)
    (folder / "blocks/block_1/run/config.json").write_text(text)
    assert resumed(scene, folder).path.read_bytes() == model[1]


@pytest.mark.parametrize("stage", ["coarse", "polish_0"])
@pytest.mark.parametrize("text", ["{", None])
def test_exposures_that_are_gone(
    scene: Scene, model: tuple[Path, bytes], tmp_path: Path, stage: str, text: str | None
) -> None:
    folder = shutil.copytree(model[0], tmp_path / "m")
    file = folder / "blocks" / stage / "exposure.json"
    file.unlink() if text is None else file.write_text(text)
    named, said = the_remedy(scene, folder)
    assert named.resolve() == file.resolve()
    if stage == "coarse":
        assert "start again" in said
    else:
        assert "remove checkpoint.npz beside it and resume" in said
        (file.parent / "checkpoint.npz").unlink()
        assert resumed(scene, folder).path.read_bytes() == model[1]


def test_a_coarse_model_without_a_checkpoint_cannot_be_made_again(
    scene: Scene, model: tuple[Path, bytes], tmp_path: Path
) -> None:
    """Another device would make another one, which would not fit the blocks."""
    folder = shutil.copytree(model[0], tmp_path / "m")
    without_blocks(folder)
    shutil.rmtree(folder / "blocks" / "coarse")
    with pytest.raises(InputError, match="the coarse model is gone: start again"):
        resumed(scene, folder)


def test_a_checkpoint_with_other_splats_around_it(scene: Scene, model: tuple[Path, bytes], tmp_path: Path) -> None:
    folder = shutil.copytree(model[0], tmp_path / "m")
    without_blocks(folder)
    file = folder / "blocks/block_0/context.ply"
    context = Splats.load(file)
    context.with_arrays(context.to_numpy() | {"mean": context.mean + 1}).save(file)
    named, text = the_remedy(scene, folder)
    assert named.samefile(folder / "blocks/block_0/run/checkpoint.npz")
    assert "the context is not that of the checkpoint: remove this file" in text


def test_a_block_of_another_partition(scene: Scene, model: tuple[Path, bytes], tmp_path: Path) -> None:
    folder = shutil.copytree(model[0], tmp_path / "m")
    without_blocks(folder)
    file = folder / "blocks/block_0/inside.ply"
    inside = Splats.load(file)
    inside.select(np.arange(1, len(inside))).save(file)
    named, text = the_remedy(scene, folder)
    assert named.samefile(file.parent)
    assert "remove this folder and resume" in text
    shutil.rmtree(file.parent)
    assert resumed(scene, folder).path.read_bytes() == model[1]


def put(*keys: Any, value: Any) -> Callable[[dict[str, Any]], None]:
    """Return a change of one value of blocks.json."""

    def change(values: Any) -> None:
        for key in keys[:-1]:
            values = values[key]
        values[keys[-1]] = value(values[keys[-1]]) if callable(value) else value

    return change


BLOCK = ("partition", "blocks", 0)
CELLS = ("partition", "cells")


@pytest.mark.parametrize(
    ("key", "change"),
    [
        ("partition", put(*BLOCK, "number", value=99)),
        ("partition", put(*BLOCK, "views", 0, value="nope.jpg")),
        ("partition", put(*BLOCK, "views", value=[1, 2])),
        ("partition", put(*BLOCK, "views", value=[])),
        ("partition", put(*BLOCK, "views", value=lambda views: [*views[1:], views[1]])),
        ("partition", put(*BLOCK, "shares", 0, value="x")),
        ("partition", put(*BLOCK, value=3)),
        ("partition", put(*BLOCK, "splats", value=2)),
        ("partition", lambda values: values["partition"]["blocks"].pop()),
        ("partition", lambda values: values["partition"]["blocks"][0].pop("views")),
        ("partition", put("partition", value=None)),
        ("partition", put(*CELLS, "axes", value=[[1, 2, 3]])),
        ("partition", put(*CELLS, "axes", value=[[1, 2, 3], [1, 2, 3]])),
        ("partition", put(*CELLS, "columns", value=[float("nan")])),
        ("partition", put(*CELLS, "columns", value=[10**400])),
        ("partition", put(*CELLS, "columns", value=lambda columns: [columns[0] + 100])),
        ("partition", put(*CELLS, "rows", value=[1.0, 2.0, 3.0])),
        ("coarse", put("coarse", value=3)),
        ("coarse", put("coarse", "left_out", value="a")),
        ("caps", put("caps", value=[50])),
        ("caps", put("caps", value=[1, 1])),
        ("caps", put("caps", value=["a", "b"])),
    ],
)
def test_a_damaged_value_is_removed(
    scene: Scene, model: tuple[Path, bytes], tmp_path: Path, key: str, change: Callable[[dict[str, Any]], object]
) -> None:
    folder = shutil.copytree(model[0], tmp_path / "m")
    without_blocks(folder)
    edit(folder, change)
    _, text = the_remedy(scene, folder)
    assert re.match(rf'{re.escape(str(folder))}/blocks\.json: damaged \({key}: .*\): remove "{key}" from it', text)
    edit(folder, lambda values: values.pop(key))
    assert resumed(scene, folder).path.read_bytes() == model[1]


@pytest.mark.parametrize(
    "change",
    [
        put("blocks", value=3),
        put("blocks", value=[{}, {}]),
        put("blocks", value=lambda rows: rows[:1]),
        put("blocks", 0, "seconds", value="long"),
    ],
)
def test_damaged_results_of_blocks_are_found_before_the_polish(
    scene: Scene, model: tuple[Path, bytes], tmp_path: Path, change: Callable[[dict[str, Any]], object]
) -> None:
    folder = shutil.copytree(model[0], tmp_path / "m")
    edit(folder, change)
    _, text = the_remedy(scene, folder)
    assert "damaged (blocks: " in text
    assert 'remove "blocks" from it and resume; finished runs are kept' in text
    without_blocks(folder)
    assert resumed(scene, folder).path.read_bytes() == model[1]


def test_a_test_view_is_not_trained_on(scene: Scene, tmp_path: Path) -> None:
    assert scene.test
    partition_scene(scene, TWO, CONFIG, output=tmp_path)
    edit(tmp_path, put(*BLOCK, "views", 0, value=scene.test[0].name))
    with pytest.raises(InputError, match=r"damaged \(partition: block 0"):
        resumed(scene, tmp_path)
    assert BlocksState.stored(tmp_path) is not None
