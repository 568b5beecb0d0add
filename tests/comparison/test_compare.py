"""Comparisons: each run trains the system it names, is done once, and makes a row with mean and spread."""

from __future__ import annotations

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from clsplat.comparison import compare as module
from clsplat.comparison.compare import compare
from clsplat.comparison.measure import curve_iterations, digest
from clsplat.comparison.methods import parse_methods
from clsplat.comparison.runs import Run
from clsplat.comparison.scene_identity import scene_identity
from clsplat.comparison.table import HEAD, MEASURED, Record, cells, markdown, notes, repeats, summarise
from clsplat.errors import InputError, OutputError, TrainingError
from clsplat.evaluation.evaluate import evaluate
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.scene import Scene
from clsplat.splats.splats import Splats
from clsplat.training.config import TrainConfig
from clsplat.training.decisions import decide
from clsplat.training.run import train
from clsplat.training.trainer import Trainer

CAP = 60
SHORT: dict[str, Any] = {"iterations": 20, "sh_degree": 1, "densify_interval": 5}


def done(folder: Path) -> list[Record]:
    return [json.loads(line) for line in (folder / "runs.jsonl").read_text().splitlines()]


@pytest.fixture(scope="session")
def compared(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished comparison. Tests must not write to it."""
    folder = tmp_path_factory.mktemp("compared")
    compare([scene], parse_methods("gaussian,default"), folder, [CAP], [0, 1], SHORT, save_models=True)
    return folder


def test_a_run_is_the_training_it_names(scene: Scene, compared: Path) -> None:
    config = decide(scene, TrainConfig(shape="gaussian", cap_max=CAP, seed=1, **SHORT)).config
    model = train(scene, config)
    measured = evaluate(Renderer(), model.splats, scene.test)
    record, *others = [r for r in done(compared) if TrainConfig.from_json(r["config"]) == config]
    assert [other["psnr"] for other in others] == [record["psnr"]], "the default of a short run"
    assert (record["psnr"], record["ssim"]) == (measured.psnr, measured.ssim)
    assert record["scene"] == scene_identity(scene)
    assert record["splats"] == len(model.splats) <= CAP
    assert record["parameters"] == len(model.splats) * (3 + 4 + 3 + 1 + 12)
    (file,) = (compared / "models").glob(f"yard-gaussian-cap{CAP}-seed1-iterations20-test{len(scene.test)}-*.ply")
    assert record["bytes"] == file.stat().st_size
    assert (Splats.load(file).mean == model.splats.mean).all()
    assert record["finite"]
    assert record["cap_held"]
    assert record["failed"] is None
    assert 0 < record["seconds"] < 60
    assert record["cpu_seconds"] > 0
    assert record["peak_bytes"] > record["device_bytes"] > 0
    assert all(record[key] for key in ("device", "driver", "schedule", "version"))


def test_the_files_have_all_runs(compared: Path) -> None:
    assert [(r["config"]["seed"], r["system"]) for r in done(compared)] == [
        (0, "gaussian"),
        (0, "default"),
        (1, "gaussian"),
        (1, "default"),
    ]
    rows = json.loads((compared / "results.json").read_text())["rows"]
    assert [(row["cap"], row["system"], row["seeds"]) for row in rows] == [
        (CAP, "gaussian", [0, 1]),
        (CAP, "default", [0, 1]),
    ]
    table = (compared / "table.md").read_text().splitlines()
    assert table[0] == f"| {' | '.join(HEAD)} |"
    assert len([line for line in table if line.startswith("| yard 48x36 |")]) == 2


@pytest.fixture
def counted(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, int, int]]:
    """Collect the runs that are trained. A stub replaces the training."""
    trained = []

    def train_and_measure(scene: Scene, config: TrainConfig, *more: object) -> Record:
        trained.append((config.shape, config.cap_max, config.seed))
        return {key: value for key, value in recorded(config, "").items() if key not in ("scene", "system", "config")}

    monkeypatch.setattr(module, "warm_up", lambda *arguments: None)
    monkeypatch.setattr(module, "train_and_measure", train_and_measure)
    return trained


def recorded(config: TrainConfig, system: str, **values: object) -> Record:
    """Return a line of runs.jsonl in the form that training writes."""
    measured = dict.fromkeys(MEASURED, 1.0) | {"psnr": 20.0 + config.seed, "ssim": 0.5, "splats": 10}
    return {
        "scene": {"name": "yard", "width": 8, "height": 6, "train": 3, "test": 1},
        "system": system,
        "config": config.to_json(),
        "failed": None,
        "finite": True,
        "cap_held": True,
        "device": "d",
        "driver": "v",
        "schedule": "1x16x16",
        "version": "0",
        "protocol": {"PSNR": "p", "SSIM": "s"},
        **measured,
        **values,
    }


def test_runs_are_done_once(scene: Scene, counted: list[Any], tmp_path: Path) -> None:
    seen: list[tuple[int, bool]] = []

    def on_run(run: Run, record: Record | None) -> None:
        seen.append((run.number, record is not None))

    systems = parse_methods("gaussian,default")
    compare([scene], systems, tmp_path, [CAP], [0], SHORT, on_run=on_run)
    assert seen == [(1, False), (1, True), (2, False), (2, True)]
    # Another device and other saved files do not make a new run. Another seed, option or system does.
    compare([scene], systems, tmp_path, [CAP], [0, 1], SHORT | {"device": "0:0"}, on_run=on_run)
    compare([scene], parse_methods("gaussian"), tmp_path, [CAP], [0], SHORT | {"opacity_lr": 0.01})
    compare([scene], parse_methods("gaussian:opacity_lr=0.01"), tmp_path, [CAP], [0], SHORT)
    assert [seed for _, _, seed in counted] == [0, 0, 1, 1, 0, 0]
    assert len(done(tmp_path)) == 6


def test_all_systems_caps_and_seeds_are_run_systems_innermost(scene: Scene, counted: list[Any], tmp_path: Path) -> None:
    compare([scene], parse_methods("gaussian,skew-normal"), tmp_path, [9, 5], [1, 0], SHORT)
    expected = [(shape, cap, seed) for cap in (9, 5) for seed in (1, 0) for shape in ("gaussian", "skew-normal")]
    assert counted == expected


def test_each_length_is_run_for_all_systems(scene: Scene, counted: list[Any], tmp_path: Path) -> None:
    """A length replaces the iterations of the common options."""
    systems = parse_methods("gaussian,default")
    records = compare([scene], systems, tmp_path, [CAP], [0], SHORT, lengths=[9, 4])
    expected = [(system, n) for n in (9, 4) for system in ("gaussian", "default")]
    assert [(record["system"], record["config"]["iterations"]) for record in records] == expected
    assert all(record["config"]["sh_degree"] == SHORT["sh_degree"] for record in records)
    compare([scene], systems, tmp_path, [CAP], [0], SHORT, lengths=[4, 9])
    assert len(counted) == 4, "the order of the lengths makes no new run"


def test_an_interrupted_comparison_goes_on(scene: Scene, counted: list[Any], tmp_path: Path) -> None:
    systems = parse_methods("gaussian,default,gaussian:opacity_lr=0.02")

    def interrupt(run: Run, record: Record | None) -> None:
        if run.number == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        compare([scene], systems, tmp_path, [CAP], [0], SHORT, on_run=interrupt)
    assert len(done(tmp_path)) == 2
    assert len((tmp_path / "table.md").read_text().split("| yard ")) == 3
    # After a crash in the middle of a line, that run is repeated and the others are not.
    whole = (tmp_path / "runs.jsonl").read_text()
    (tmp_path / "runs.jsonl").write_text(whole[:-20])
    records = compare([scene], systems, tmp_path, [CAP], [0], SHORT)
    assert len(counted) == 4
    assert [record["system"] for record in records] == ["gaussian", "default", "gaussian:opacity_lr=0.02"]
    compare([scene], systems, tmp_path, [CAP], [0], SHORT)
    assert len(counted) == 4


def test_a_finished_comparison_that_cannot_be_written_is_returned(
    scene: Scene, tmp_path: Path, counted: list[tuple[str, int, int]]
) -> None:
    """As in a folder that is read-only. Root writes there, too, so a folder is in the place of the table."""
    systems = parse_methods("gaussian")
    records = compare([scene], systems, tmp_path, [CAP], [0], SHORT)
    (tmp_path / "table.md").unlink()
    (tmp_path / "table.md").mkdir()
    with pytest.warns(UserWarning, match=r"table\.md: cannot be written .*the table there is not written again"):
        assert compare([scene], systems, tmp_path, [CAP], [0], SHORT) == records
    with pytest.raises(OutputError, match=r"table\.md: cannot be written"):
        compare([scene], systems, tmp_path, [CAP], [1], SHORT)
    assert len(counted) == len(done(tmp_path)) == 2


def test_a_scene_with_the_longest_name_keeps_its_models(scene: Scene, tmp_path: Path) -> None:
    """Names that differ only at the end have two files."""
    long = [replace(scene, name="n" * 254 + end) for end in "ab"]
    compare(long, parse_methods("gaussian"), tmp_path, [CAP], [0], SHORT, save_models=True)
    models = list((tmp_path / "models").iterdir())
    assert len(models) == 2
    assert all(len(Splats.load(model)) > 0 for model in models)


def test_no_model_replaces_that_of_another_run(scene: Scene, tmp_path: Path) -> None:
    """Runs of other lengths, other test views, and photos of other contents have models of their own."""
    other = replace(scene, views=[view for view in scene.views if view != scene.train[0]])
    fewer = replace(scene, test_names=scene.test_names - {scene.test[0].name})
    swapped = replace(scene, test_names=scene.test_names - {scene.test[0].name} | {scene.train[0].name})
    systems, scenes = parse_methods("gaussian"), [scene, other, fewer, swapped]
    compare(scenes, systems, tmp_path, [CAP], [0], SHORT, lengths=[2, 4], save_models=True)
    names = sorted(path.name for path in (tmp_path / "models").iterdir())
    assert len(names) == len(done(tmp_path)) == 8
    for length in (2, 4):
        begin = f"yard-gaussian-cap{CAP}-seed0-iterations{length}-test"
        assert len([name for name in names if name.startswith(f"{begin}{len(scene.test)}-")]) == 3
        assert len([name for name in names if name.startswith(f"{begin}{len(scene.test) - 1}-")]) == 1


def test_a_curve_is_measured_along_the_run(scene: Scene, tmp_path: Path) -> None:
    systems = parse_methods("gaussian")
    compare([scene], systems, tmp_path, [CAP], [0], SHORT)
    (plain,) = done(tmp_path)
    assert plain["curve"] is None
    records = compare([scene], systems, tmp_path, [CAP], [0, 1], SHORT, curve=4)
    assert records == done(tmp_path)
    assert [record["config"]["seed"] for record in records] == [0, 1], "the run without a curve was replaced"
    first = records[0]
    assert (first["digest"], first["psnr"]) == (plain["digest"], plain["psnr"]), "measuring changes nothing"
    assert [point["iteration"] for point in first["curve"]] == list(curve_iterations(20, 4)) == [1, 3, 7, 20]
    last = first["curve"][-1]
    assert (last["psnr"], last["ssim"], last["seconds"]) == (first["psnr"], first["ssim"], first["seconds"])
    seconds = [point["seconds"] for point in first["curve"]]
    assert seconds == sorted(set(seconds))
    compare([scene], systems, tmp_path, [CAP], [0], SHORT)
    assert done(tmp_path) == records, "a curve is not thrown away"


def test_repeats_are_the_same_bits(scene: Scene, tmp_path: Path) -> None:
    records = compare([scene], parse_methods("gaussian"), tmp_path, [CAP], [0, 1], SHORT, repeat=2)
    assert [(r["config"]["seed"], r["repeat"]) for r in records] == [(0, 0), (0, 1), (1, 0)]
    first, again, other = (record["digest"] for record in records)
    assert first == again != other
    (row,) = summarise(records)
    assert row["seeds"] == [0, 1], "repeats do not count in the mean"
    assert "repeated: 1 of 1 runs gave the same splats each time, bit by bit" in notes(records, [row])
    assert len(compare([scene], parse_methods("gaussian"), tmp_path, [CAP], [0, 1], SHORT, repeat=2)) == 3


def test_repeats_that_differ_are_told() -> None:
    records = [
        recorded(TrainConfig(), "a", digest=text, repeat=place, psnr=20.0 + place) for place, text in enumerate("xy")
    ]
    (row,) = repeats(records)
    assert (row["same"], row["spread"], row["runs"]) == (False, 1.0, 2)
    assert any("2 runs differ, PSNR by 1.0000 dB" in line for line in notes(records, summarise(records)))
    assert not repeats([records[0], records[1] | {"device": "other"}]), "bits are promised on one device only"
    assert not repeats([recorded(TrainConfig(), "a")] * 2), "records of before there were digests"


def test_digest_sees_names_shapes_types_and_bits() -> None:
    zeros = np.zeros((2, 3), np.float32)
    arrays = [{"a": zeros}, {"b": zeros}, {"a": zeros.T}, {"a": zeros.astype(np.int32)}, {"a": -zeros}]
    assert len({digest(each) for each in arrays}) == len(arrays)
    assert digest({"a": zeros, "b": zeros}) == digest({"b": zeros.copy(), "a": zeros})


def test_curve_iterations() -> None:
    points = curve_iterations(1000, 12)
    assert (len(points), points[0], points[-1]) == (12, 16, 1000)
    assert max(b / a for a, b in pairwise(points)) < 1.6
    assert curve_iterations(1000, 0) == ()
    assert curve_iterations(1, 12) == (1,)
    assert curve_iterations(1000, 1) == (1000,)


def test_failed_runs_are_told_and_the_comparison_goes_on(
    scene: Scene, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = Trainer.run

    def fail(self: Trainer) -> object:
        if self.config.density.init_opacity == 0.3:
            raise TrainingError("iteration 7: the loss is not finite")
        return run(self)

    monkeypatch.setattr(Trainer, "run", fail)
    records = compare([scene], parse_methods("gaussian:init_opacity=0.3,gaussian"), tmp_path, [30], [0], SHORT)
    assert [record["failed"] for record in records] == ["iteration 7: the loss is not finite", None]
    assert not records[0]["finite"]
    bad, good = summarise(records)
    assert cells(bad)[5] == "failed"
    assert float(cells(good)[5]) > 5
    said = "failed: gaussian:init_opacity=0.3 on yard 48x36 at cap 30, seed 0: iteration 7: the loss is not finite"
    assert said in notes(records, [bad, good])
    assert said in (tmp_path / "table.md").read_text()


def test_bad_input(scene: Scene, counted: list[Any], tmp_path: Path) -> None:
    untested = Scene(scene.name, scene.path, scene.views, scene.points)
    with pytest.raises(InputError, match="no test views to measure on"):
        compare([untested], parse_methods("gaussian"), tmp_path, [CAP], [0])
    with pytest.raises(InputError, match="contradicts"):
        compare([scene], parse_methods("gaussian,3dgs"), tmp_path, [CAP], [0], {"strategy": "mcmc"})
    assert not counted


# --- the table ---------------------------------------------------------------------------------


def test_mean_and_half_spread() -> None:
    records = [recorded(TrainConfig(seed=seed), "a", psnr=psnr) for seed, psnr in enumerate((20.0, 21.0, 23.5))]
    (row,) = summarise(records)
    assert row["psnr"] == {"mean": 21.5, "half_spread": 1.75}
    texts = dict(zip(HEAD, cells(row), strict=True))
    assert (texts["PSNR"], texts["SSIM"], texts["seeds"]) == ("21.50 ± 1.75", "0.5000 ± 0.0000", "3")
    (some,) = summarise([records[0] | {"cpu_seconds": None}, records[1] | {"cpu_seconds": 8.0}])
    assert some["cpu_seconds"]["mean"] == 8.0, "of the runs that measured it"
    (alone,) = summarise(records[:1])
    assert cells(alone)[HEAD.index("PSNR")] == "20.00"


def test_equal_names_with_other_options_are_told_apart() -> None:
    records = [recorded(TrainConfig(dense_size=size, seed=seed), "a") for size in (0.02, 0.03) for seed in (0, 1)]
    records.append(recorded(TrainConfig(dense_size=0.04), "b"))
    records.append(recorded(TrainConfig(dense_size=0.04, cap_max=7), "a"))
    assert [row["system"] for row in summarise(records)] == ["a", "a [dense_size=0.02]", "a [dense_size=0.03]", "b"]
    longer = [recorded(TrainConfig(iterations=n), "a") for n in (10, 20)]
    assert [(row["system"], row["iterations"]) for row in summarise(longer)] == [("a", 10), ("a", 20)]


def test_scenes_keep_their_order_and_caps_rise() -> None:
    small = {"name": "attic", "width": 8, "height": 6, "train": 3, "test": 1}
    records = [recorded(TrainConfig(cap_max=cap), "a") for cap in (9, 5)]
    records += [recorded(TrainConfig(cap_max=5), "a", scene=small)]
    assert [(row["scene"], row["cap"]) for row in summarise(records)] == [
        ("yard 8x6", 5),
        ("yard 8x6", 9),
        ("attic 8x6", 5),
    ]


def test_notes_say_what_is_not_like_for_like() -> None:
    records = [recorded(TrainConfig(), "a"), recorded(TrainConfig(), "b", device="other", cap_held=False)]
    said = notes(records, summarise(records))
    assert any("device: d (v), other (v) (mixed" in line for line in said)
    assert any(line == "schedule: 1x16x16" for line in said)
    assert any(line.startswith("b on yard 8x6") and "more splats than the cap" in line for line in said)
    assert "- schedule: 1x16x16\n" in markdown(records)
