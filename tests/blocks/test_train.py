"""Trainings in blocks: nothing twice, the same bits on workers and after an interruption, one line for mistakes."""

from __future__ import annotations

import json
import os
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from small_scene import with_points_elsewhere

from clsplat.blocks import train as module
from clsplat.blocks.cells import Cells, make_cells
from clsplat.blocks.job import CONTEXT, START, BlockJob
from clsplat.blocks.options import block_config
from clsplat.blocks.partition import Partition, make_partition, surroundings
from clsplat.blocks.state import BlocksOptions, BlocksState
from clsplat.blocks.targets import BlockTargets
from clsplat.blocks.train import PICTURE, BlocksModel, partition_scene, train_in_blocks
from clsplat.compression.rules import BudgetOptions
from clsplat.compression.search import train_budget
from clsplat.errors import ClsplatError, InputError, OutputError
from clsplat.models.resume import resume
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.scene import Scene
from clsplat.scenes.view import StoredView, View
from clsplat.splats.splats import Splats
from clsplat.splats.transform import joined
from clsplat.training.config import TrainConfig
from clsplat.training.exposure_file import read_exposures
from clsplat.training.folder import ModelFolder
from clsplat.training.log import Progress
from clsplat.training.presets import PRESETS, with_preset
from clsplat.training.run import train

CONFIG = TrainConfig(shape="skew-normal", iterations=20, cap_max=120, sh_degree=1, densify_interval=5)
TWO = BlocksOptions(2, 1, polish=8)


@pytest.fixture(scope="module")
def finished(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> BlocksModel:
    """A finished training in two blocks. Tests must not write into its folder."""
    return train_in_blocks(scene, TWO, CONFIG, output=tmp_path_factory.mktemp("blocks") / "model")


@pytest.fixture(scope="module")
def coarse(scene: Scene) -> Splats:
    return train(scene, TrainConfig(shape="skew-normal", iterations=40, cap_max=100, sh_degree=1)).splats


def test_a_partition_says_what_the_photos_show(scene: Scene, coarse: Splats) -> None:
    renderer = Renderer()
    found = make_partition(scene, coarse, renderer, 2, 2)
    assert sum(block.splats for block in found.blocks) == len(coarse)
    assert sum(block.points for block in found.blocks) == len(scene.points.xyz)
    names = {view.name for view in scene.train}
    cell = found.cells.of(coarse.mean)
    for block, around in zip(found.blocks, surroundings(scene, coarse, renderer, found), strict=True):
        assert set(block.views) <= names
        assert list(block.shares) == sorted(block.shares, reverse=True)
        assert (cell[around] != block.number).all()
    again = Partition.from_json(json.loads(json.dumps(found.to_json())))
    assert again.blocks == found.blocks
    assert (again.cells.of(coarse.mean) == cell).all()


def test_a_photo_that_shows_a_block_is_among_its_views(scene: Scene, coarse: Splats) -> None:
    """A photo belongs to the block if its pixels change without it."""
    renderer = Renderer()
    found = make_partition(scene, coarse, renderer, 2, 1)
    for block in found.blocks:
        others = coarse.select(np.flatnonzero(found.cells.of(coarse.mean) != block.number))
        for view in scene.train:
            alpha = [renderer.render(splats, view.camera).alpha.mean() for splats in (coarse, others)]
            assert alpha[0] - alpha[1] < 0.02 or view.name in block.views


def undecodable() -> View:
    raise InputError("a photo is decoded")


def test_a_partition_decodes_only_photos_with_a_mask(scene: Scene, coarse: Splats) -> None:
    views: list[View] = [StoredView(v.name, v.camera, undecodable, may_hide_pixels=False) for v in scene.views]
    renderer, closed = Renderer(), replace(scene, views=views)
    found, same = (make_partition(each, coarse, renderer, 2, 2) for each in (scene, closed))
    assert found.to_json() == same.to_json()
    around = [surroundings(each, coarse, renderer, found) for each in (scene, closed)]
    assert all((a == b).all() for a, b in zip(*around, strict=True))
    masked = scene.views.index(scene.train[0])
    views[masked] = StoredView(views[masked].name, views[masked].camera, undecodable, may_hide_pixels=True)
    with (
        pytest.warns(UserWarning, match="1 of 8 photos are not looked at: a photo is decoded"),
        pytest.raises(InputError, match="a photo or its mask cannot be read any more"),
    ):
        make_partition(replace(scene, views=views), coarse, renderer, 2, 2)


def test_pixels_that_a_mask_hides_are_not_filled(scene: Scene, coarse: Splats) -> None:
    """A single block fills a photo as far as the model is opaque where the mask shows it."""
    renderer, first = Renderer(), scene.train[0]
    mask = np.zeros((first.camera.height, first.camera.width), bool)
    mask[:, first.camera.width // 3 :] = True
    views = [replace(view, mask=mask) if view is first else view for view in scene.views]
    (block,) = make_partition(replace(scene, views=views), coarse, renderer, 1, 1).blocks
    alpha = {view.name: renderer.render(coarse, view.camera).alpha for view in scene.train}
    alpha[first.name] = alpha[first.name] * mask
    shares = dict(zip(block.views, block.shares, strict=True))
    assert shares == pytest.approx({name: alpha[name].mean() for name in shares}, abs=1e-4)
    assert first.name in shares


def test_small_photos_are_decoded_once(scene: Scene, tmp_path: Path) -> None:
    decoded: list[str] = []

    def stored(view: View) -> View:
        return StoredView(view.name, view.camera, lambda: decoded.append(view.name) or view)

    train_in_blocks(replace(scene, views=[stored(view) for view in scene.views]), TWO, CONFIG, output=tmp_path)
    assert sorted(decoded) == sorted(view.name for view in scene.train)


def test_points_that_do_not_fit_the_photos_are_in_no_block(scene: Scene, tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="the points do not fit the poses") as warned:
        found = partition_scene(with_points_elsewhere(scene), TWO, CONFIG, output=tmp_path)
    assert len(warned) == 1
    assert not any(block.points for block in found.blocks)


@pytest.mark.parametrize("kind", ["blocks", "budget"])
def test_points_are_looked_at_once_for_all_runs(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    """What a block learns is not what the photos show, so points that fit could be left out."""
    looked: list[int] = []

    def fit(views: object, points: object) -> None:
        looked.append(1)

    monkeypatch.setattr("clsplat.training.point_fit.point_fit", fit)
    if kind == "blocks":
        train_in_blocks(scene, TWO, CONFIG, output=tmp_path)
    else:
        train_budget(scene, CONFIG, BudgetOptions(1.0), output=tmp_path)
    assert len(looked) == 1


def test_the_model_has_all_splats_of_all_blocks(finished: BlocksModel, scene: Scene) -> None:
    report = finished.report
    assert len(finished.splats) == sum(row["splats"] for row in report["blocks"]) <= CONFIG.cap_max
    assert [row["number"] for row in report["blocks"]] == [0, 1]
    assert all(row["splats"] <= CONFIG.cap_max // 2 for row in report["blocks"])
    assert report["final"]["splats"] == len(finished.splats)


@pytest.mark.parametrize("preset", PRESETS)
def test_blocks_of_every_preset(scene: Scene, tmp_path: Path, preset: str) -> None:
    """Also of those whose penalties, opacity resets or SGHMC a block cannot have."""
    options = with_preset(preset, {"iterations": 6, "cap_max": 80, "sh_degree": 1})
    found = train_in_blocks(scene, BlocksOptions(2, 1, polish=2), TrainConfig(**options), output=tmp_path)
    assert 0 < len(found.splats) <= 80


@pytest.mark.parametrize("kind", ["budget", "blocks"])
def test_an_unfinished_training_is_replaced_only_if_asked(scene: Scene, tmp_path: Path, kind: str) -> None:
    (tmp_path / kind / "run").mkdir(parents=True)
    (tmp_path / f"{kind}.json").write_text("{}")
    with pytest.raises(OutputError, match="already holds a model"):
        train(scene, CONFIG, output=tmp_path)
    with pytest.raises(OutputError, match="already holds a model"):
        train_in_blocks(scene, TWO, CONFIG, output=tmp_path)
    with pytest.raises(OutputError, match="already holds a model"):
        train_budget(scene, CONFIG, output=tmp_path)
    assert (tmp_path / kind / "run").is_dir()


@pytest.mark.parametrize("kind", ["run", "blocks", "budget"])
def test_a_model_of_another_run_stays_that_ends_meanwhile(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: str
) -> None:
    """The folder is looked at under its lock, and the lock stays until the training ends."""
    fcntl = pytest.importorskip("fcntl")
    folder, free = tmp_path / "m", []

    def other_run(*_: object) -> None:
        opened = os.open(folder, os.O_RDONLY)
        try:
            fcntl.flock(opened, fcntl.LOCK_EX | fcntl.LOCK_NB)
            free.append(True)
        except BlockingIOError:
            free.append(False)
        finally:
            os.close(opened)
        raise RuntimeError("far enough")

    module = {"run": "training.run", "blocks": "blocks.train", "budget": "compression.search"}[kind]
    monkeypatch.setattr(f"clsplat.{module}.decide", other_run)
    start: Callable[..., object] = {
        "run": lambda: train(scene, CONFIG, output=folder),
        "blocks": lambda: train_in_blocks(scene, TWO, CONFIG, output=folder),
        "budget": lambda: train_budget(scene, CONFIG, output=folder),
    }[kind]
    with pytest.raises(RuntimeError, match="far enough"):
        start()
    assert free == [False]
    prepare = ModelFolder.prepare

    def ended(self: ModelFolder) -> None:
        prepare(self)
        self.write_config({})

    monkeypatch.setattr(ModelFolder, "prepare", ended)
    with pytest.raises(OutputError, match="already holds a model"):
        start()


def test_splats_that_move_over_a_border_stay(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """No other block shows what they show. What is around a block is not among its splats."""
    moved = []

    def far_away(job: BlockJob, scene: Scene, folder: Path, *arguments: Any) -> dict[str, Any]:
        start, context = Splats.load(job.folder / START), Splats.load(job.folder / CONTEXT)
        moved.append(start.with_arrays(start.to_numpy() | {"mean": 1000 - 3 * start.mean}))
        ModelFolder(folder).save(joined([moved[-1], context]), CONFIG.iterations)
        return {"splats": len(start), "context": len(context)}

    monkeypatch.setattr(module, "train_block", far_away)
    found = train_in_blocks(scene, BlocksOptions(2, 1, polish=0), CONFIG, output=tmp_path)
    assert len(moved) == 2
    assert (found.splats.mean == np.concatenate([part.mean for part in moved])).all()


def test_the_folder_is_that_of_a_run(finished: BlocksModel, scene: Scene) -> None:
    folder = ModelFolder(finished.path.parents[2])
    assert {path.name for path in folder.path.iterdir()} == {
        *("config.json", "cameras.json", "blocks.json", PICTURE, "point_cloud"),
    }
    assert folder.latest_ply() == (finished.path, CONFIG.iterations + 8)
    assert (Splats.load(finished.path).mean == finished.splats.mean).all()
    assert folder.read_config()["scene"]["test_names"] == sorted(scene.test_names)
    assert "<svg" in (folder.path / PICTURE).read_text()


def test_workers_make_the_same_model(finished: BlocksModel, scene: Scene, tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    found = train_in_blocks(scene, TWO, CONFIG, output=tmp_path, cluster="local:1")
    assert found.path.read_bytes() == finished.path.read_bytes()


@pytest.mark.parametrize("moment", ["coarse", "block", "polish"])
def test_an_interrupted_training_goes_on(
    finished: BlocksModel, scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, moment: str
) -> None:
    """With the same bits, and without doing finished stages again."""
    stop_in_run(monkeypatch, {"coarse": 0, "block": 2, "polish": 3}[moment])
    with pytest.raises(KeyboardInterrupt):
        train_in_blocks(scene, TWO, CONFIG, output=tmp_path)
    monkeypatch.undo()
    found = resume(tmp_path)
    assert isinstance(found, BlocksModel)
    assert found.path.read_bytes() == finished.path.read_bytes()


def test_the_parts_of_a_block_stay_when_a_training_goes_on(
    finished: BlocksModel, scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another device may see other splats around a block, but the checkpoint has those of the first one."""

    def killed(*arguments: Any) -> Any:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("clsplat.blocks.job.train_in_folder", killed)
        with pytest.raises(KeyboardInterrupt):
            train_in_blocks(scene, TWO, CONFIG, output=tmp_path)
    parts = {file: file.read_bytes() for file in tmp_path.glob("blocks/block_*/*.ply")}
    assert len(parts) == 6
    monkeypatch.setattr(module, "surroundings", killed)
    found = resume(tmp_path)
    assert isinstance(found, BlocksModel)
    assert {file: file.read_bytes() for file in tmp_path.glob("blocks/block_*/*.ply")} in ({}, parts)
    assert found.path.read_bytes() == finished.path.read_bytes()


def stop_in_run(patch: pytest.MonkeyPatch, number: int) -> None:
    """Interrupt a run of a training in its third iteration. number : of the run, 0 for the coarse one."""
    original, count = module.train_in_folder, iter(range(100))

    def interrupted(*arguments: Any, **named: Any) -> Any:
        def stop(trainer: Any, event: threading.Event) -> None:
            if trainer.iteration == 2:
                event.set()

        return original(*arguments, **named, **({"visit": stop} if next(count) == number else {}))

    patch.setattr(module, "train_in_folder", interrupted)
    patch.setattr("clsplat.blocks.job.train_in_folder", lambda *a: interrupted(*a[:5]))


@pytest.mark.parametrize(
    ("number", "kept"), [(2, ["20 of 20", "2 of 20"]), (4, ["4 of 4", "2 of 4"])], ids=["block 1", "polish_1"]
)
def test_a_folder_may_be_renamed_before_its_training_goes_on(
    finished: BlocksModel,
    scene: Scene,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    number: int,
    kept: list[str],
) -> None:
    """Runs keep what they have done, although the files of their first splats have other paths now."""
    told: list[str] = []
    stop_in_run(monkeypatch, number)
    with pytest.raises(KeyboardInterrupt):
        train_in_blocks(scene, TWO, CONFIG, output=tmp_path / "old")
    monkeypatch.undo()
    (tmp_path / "old").rename(tmp_path / "new")
    found = resume(tmp_path / "new", progress=lambda report: told.append(report.message.split(";")[0]))
    assert isinstance(found, BlocksModel)
    assert [text for text in told if text.startswith("resumed")] == [f"resumed at iteration {part}" for part in kept]
    assert not any("block_" in text or "anew" in text for text in told)
    assert found.path.read_bytes() == finished.path.read_bytes()


def test_a_run_with_other_options_does_not_begin_anew_in_silence(
    finished: BlocksModel, scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[str] = []
    stop_in_run(monkeypatch, 2)
    with pytest.raises(KeyboardInterrupt):
        train_in_blocks(scene, TWO, CONFIG, output=tmp_path)
    monkeypatch.undo()
    monkeypatch.setattr(module, "block_config", lambda *a: block_config(*a).replace(lambda_dssim=0.3))
    train_in_blocks(scene, TWO, CONFIG, lambda at: told.append(at.message), output=tmp_path, resume=True)
    (first, second) = (text for text in told if "begins anew" in text)
    assert "block_0/run/checkpoint.npz: is of a run with other options" in first
    assert "block_1/run" in second


@pytest.mark.parametrize("polish", [1, 3])
def test_an_odd_polish_has_its_iterations(
    finished: BlocksModel, scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, polish: int
) -> None:
    runs = []
    original = module.train_in_folder

    def counted(config: TrainConfig, *arguments: Any, **named: Any) -> Any:
        runs.append(config.iterations)
        return original(config, *arguments, **named)

    monkeypatch.setattr(module, "train_in_folder", counted)
    train_in_blocks(scene, BlocksOptions(2, 1, polish), CONFIG, output=tmp_path / "new")
    assert sum(runs[1:]) == polish, "after the coarse run"
    assert all(runs)


def test_new_points_do_not_change_what_a_block_learns(
    finished: BlocksModel, scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The picture that it learns from is that of the coarse model, although its run begins with more splats."""
    pictured, begun = [], []

    def targets(part: Scene, make: Callable[[], BlockTargets]) -> Scene:
        pictured.append(len(make().inside))
        return part

    def run(config: TrainConfig, *arguments: Any) -> Any:
        begun.append(len(Splats.load(config.start.init)))
        raise KeyboardInterrupt

    monkeypatch.setattr("clsplat.blocks.job.with_block_targets", targets)
    monkeypatch.setattr("clsplat.blocks.job.train_in_folder", run)
    with pytest.raises(KeyboardInterrupt):
        train_in_blocks(scene, TWO, CONFIG, output=tmp_path)
    assert pictured == [finished.report["partition"]["blocks"][0]["splats"]]
    assert begun[0] > pictured[0]


def test_a_partition_is_where_a_training_goes_on(finished: BlocksModel, scene: Scene, tmp_path: Path) -> None:
    found = partition_scene(scene, TWO, CONFIG, output=tmp_path)
    assert found.to_json() == finished.report["partition"]
    stored = BlocksState.stored(tmp_path)
    assert stored is not None
    assert stored[1] == TWO
    whole = train_in_blocks(scene, TWO, CONFIG, output=tmp_path, resume=True)
    assert whole.path.read_bytes() == finished.path.read_bytes()


def test_a_block_that_no_photo_shows_stays_as_it_is(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def without_views(*arguments: Any) -> Partition:
        found = make_partition(*arguments)
        first, *others = found.to_json()["blocks"]
        return Partition.from_json(found.to_json() | {"blocks": [first | {"views": [], "shares": []}, *others]})

    monkeypatch.setattr(module, "make_partition", without_views)
    found = train_in_blocks(scene, BlocksOptions(2, 1, polish=0), CONFIG, output=tmp_path)
    assert [row["number"] for row in found.report["blocks"]] == [1]
    cells = Partition.from_json(found.report["partition"]).cells
    first = found.report["partition"]["blocks"][0]
    n = first["splats"]
    assert (cells.of(found.splats.mean[:n]) == 0).all()
    assert len(found.splats) == n + found.report["blocks"][0]["splats"]


def test_what_cannot_be_resumed_or_replaced(finished: BlocksModel, scene: Scene, tmp_path: Path) -> None:
    folder = finished.path.parents[2]
    with pytest.raises(OutputError, match="already holds a model: replace it, continue it or choose another folder"):
        train_in_blocks(scene, TWO, CONFIG, output=folder)
    with pytest.raises(InputError, match="finished: nothing to resume"):
        BlocksState.stored(folder)
    with pytest.raises(InputError, match="blocks\\.json"):
        train_in_blocks(scene, TWO, CONFIG, output=tmp_path / "new", resume=True)
    partition_scene(scene, TWO, CONFIG, output=tmp_path)
    with pytest.raises(InputError, match="--resume with blocks=3x1, but the training was started with blocks=2x1"):
        train_in_blocks(scene, BlocksOptions(3, 1, 8), CONFIG, output=tmp_path, resume=True)
    (tmp_path / "blocks.json").write_text('{"config": {}, "options": {}, "scene": {}}')
    with pytest.raises(InputError, match=r"blocks\.json: damaged"):
        BlocksState.stored(tmp_path)
    train(scene, CONFIG.replace(iterations=2), output=tmp_path, overwrite=True)
    assert not (tmp_path / "blocks").exists()
    assert BlocksState.stored(tmp_path) is None


@pytest.mark.parametrize("polish", [0, 8])
def test_exposures_are_those_of_all_blocks(scene: Scene, tmp_path: Path, polish: int) -> None:
    """Blocks take them from the coarse run and leave them as they are. The polish learns on."""
    seen: dict[str, dict[str, Any]] = {}

    def keep(folder: Path) -> None:
        for stage in ("coarse", "block_0/run", "block_1/run"):
            seen[stage] = read_exposures(folder / "blocks" / stage / "exposure.json")

    original = BlocksState.end
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(BlocksState, "end", lambda state: (keep(state.path.parent), original(state)))
        found = train_in_blocks(
            scene, BlocksOptions(2, 1, polish), CONFIG.replace(exposure=True, iterations=40), output=tmp_path
        )
    coarse = seen["coarse"]
    assert any(not np.allclose(one, np.eye(3, 4), atol=1e-3) for one in coarse.values())
    for stage in ("block_0/run", "block_1/run"):
        assert seen[stage]
        for name, one in seen[stage].items():
            np.testing.assert_array_equal(one, coarse[name])
    last = read_exposures(found.path.parents[2] / "exposure.json")
    assert set(last) == {view.name for view in scene.train}
    assert polish == 0 or any(not np.array_equal(last[name], coarse[name]) for name in coarse)
    assert all(polish or np.array_equal(last[name], coarse[name]) for name in coarse)
    assert all(np.abs(last[name] - coarse[name]).max() < 0.1 for name in coarse), "the polish does not begin anew"


@pytest.mark.parametrize("cluster", ["tcp://127.0.0.1:9", "local:2"])
def test_a_missing_cluster_is_said_at_once(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, cluster: str
) -> None:
    def missing() -> None:
        raise InputError("a cluster needs dask.distributed")

    monkeypatch.setattr("clsplat.cluster.pool.CONNECT_SECONDS", 1)
    if cluster == "local:2":
        monkeypatch.setattr("clsplat.cluster.pool.distributed", missing)
    with pytest.raises(ClsplatError, match=r"no scheduler answers|dask\.distributed"):
        train_in_blocks(scene, TWO, CONFIG, output=tmp_path / "m", cluster=cluster)
    with pytest.raises(ClsplatError, match=r"no scheduler answers|dask\.distributed"):
        train_budget(scene, CONFIG, output=tmp_path / "m", cluster=cluster)
    assert not (tmp_path / "m").exists()


@pytest.mark.parametrize("options", [{"validate": True}, {"init": "model.ply"}])
def test_options_that_blocks_cannot_have(scene: Scene, tmp_path: Path, options: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=f"^{next(iter(options))}.*leave --"):
        train_in_blocks(scene, TWO, TrainConfig(**options), output=tmp_path)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ((2, 2, 1.5), "polish of blocks: 1.5"),
        ((2, 2, -3), "polish of blocks: -3"),
        ((2, -1), "rows of blocks: -1"),
        ((2.0, 2), "columns of blocks: 2.0"),
        ((0, 2), "columns of blocks: 0"),
        ((1000, 1), "columns of blocks: 1000; give a whole number, 1 to 64"),
        ((1, 1), "at least two"),
    ],
)
def test_blocks_that_cannot_be(values: tuple[Any, ...], message: str) -> None:
    with pytest.raises(InputError, match=message):
        BlocksOptions(*values)


def test_options_that_blocks_cannot_have_are_refused_before_the_first_stage(scene: Scene, tmp_path: Path) -> None:
    for config, message in (
        (CONFIG.replace(device="cpu/2"), "device cpu/2: blocks share runs, not photos"),
        (CONFIG.replace(cap_max=1), "less than a splat for each of 2 blocks"),
    ):
        with pytest.raises(InputError, match=message):
            partition_scene(scene, TWO, config, output=tmp_path / "model")
    assert not (tmp_path / "model").exists()


def test_too_many_workers_are_refused_before_the_first_stage(scene: Scene, tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    with pytest.raises(InputError, match="start fewer"):
        train_in_blocks(scene, TWO, CONFIG, output=tmp_path / "model", cluster="local:999")
    assert not (tmp_path / "model").exists()


def test_blocks_that_no_photo_shows_leave_their_share_of_the_cap_to_the_others(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[str] = []
    partition_scene(scene, TWO, CONFIG, output=tmp_path)
    file = tmp_path / "blocks.json"
    values = json.loads(file.read_text())
    unseen = values["partition"]["blocks"][1]
    unseen |= {"views": [], "shares": []}
    file.write_text(json.dumps(values))
    found = train_in_blocks(scene, TWO, CONFIG, lambda at: told.append(at.message), output=tmp_path, resume=True)
    assert any(f"1 blocks with at most {120 - unseen['splats']} splats" in text for text in told), "it keeps its own"
    assert len(found.splats) <= 120


def test_the_cap_is_that_of_the_whole_model(scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also if one cell has nearly all splats of the coarse model, more than an equal share of the cap."""

    def uneven(places: Any, weights: Any, cameras: Any, columns: int, rows: int) -> Cells:
        equal = make_cells(places, weights, cameras, columns, rows)
        along = np.sort(equal.axes[0] @ np.asarray(places, float).T)
        return Cells(equal.axes, along[[1, 2, 3, 4, 5]], equal.rows)

    monkeypatch.setattr("clsplat.blocks.partition.make_cells", uneven)
    told: list[str] = []
    options = BlocksOptions(6, 1, polish=0)
    found = train_in_blocks(scene, options, CONFIG, lambda at: told.append(at.message), output=tmp_path)
    most = max(block["splats"] for block in found.report["partition"]["blocks"])
    assert most > 120 // 6
    assert any(f"blocks with at most {most} splats" in text for text in told)
    assert len(found.splats) <= 120
    assert all(row["splats"] <= cap for row, cap in zip(found.report["blocks"], found.report["caps"], strict=True))


def test_a_training_of_an_earlier_version_keeps_its_caps(
    finished: BlocksModel, scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It has not stored them. Its blocks have equal caps, but for those with more splats of the coarse model."""
    monkeypatch.setattr(module, "shares_of_cap", lambda cap, counts: [cap // len(counts)] * len(counts))
    stop_in_run(monkeypatch, 2)
    with pytest.raises(KeyboardInterrupt):
        train_in_blocks(scene, TWO, CONFIG, output=tmp_path)
    monkeypatch.undo()
    file = tmp_path / "blocks.json"
    values = json.loads(file.read_text())
    assert values.pop("caps") == [60, 60]
    file.write_text(json.dumps(values))
    monkeypatch.setattr(module, "shares_of_cap", lambda cap, counts: [1] * len(counts))
    told: list[str] = []
    found = train_in_blocks(scene, TWO, CONFIG, lambda at: told.append(at.message), output=tmp_path, resume=True)
    assert not any("anew" in text for text in told)
    assert found.path.read_bytes() == finished.path.read_bytes()


def test_photos_that_the_coarse_run_leaves_out_are_in_no_later_stage(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    gone = scene.train[2].name
    monkeypatch.setattr("clsplat.training.outliers.FEWEST_VIEWS", 1)
    monkeypatch.setattr("clsplat.training.outliers.MOST_WORK", 1.0)
    monkeypatch.setattr("clsplat.training.outliers.outliers", lambda measured, near: frozenset({2}))
    found = train_in_blocks(scene, TWO, CONFIG, output=tmp_path)
    assert found.report["coarse"]["left_out"] == [gone]
    blocks = found.report["partition"]["blocks"]
    assert all(gone not in block["views"] for block in blocks)
    assert len(set().union(*(block["views"] for block in blocks))) > 3
    assert all(not row["left_out"] for row in found.report["blocks"]), "blocks do not look"
    recorded = json.loads((tmp_path / "config.json").read_text())["scene"]["photos"]
    assert gone in recorded, "the record has all photos of the scene"


def test_options_that_only_the_coarse_run_has_are_named(scene: Scene, tmp_path: Path) -> None:
    with pytest.warns(UserWarning, match="^noise_lr, strategy: only the coarse run has these values"):
        partition_scene(scene, TWO, CONFIG.replace(strategy="mcmc", noise_lr=5.0), output=tmp_path)


def test_a_block_reports_its_own_splats(scene: Scene, tmp_path: Path) -> None:
    """Not those around it, which do not change."""
    heard: list[Progress] = []
    train_in_blocks(scene, TWO, CONFIG, heard.append, output=tmp_path)
    of_blocks = [report.n_splats for report in heard if report.phase == "step 3 of 4" and not report.message]
    assert of_blocks
    assert max(of_blocks) <= CONFIG.cap_max // 2
