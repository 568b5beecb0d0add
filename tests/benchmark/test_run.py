"""Runs of a benchmark: the training they name, done once, resumed where they stopped, in tables with published ones."""

from __future__ import annotations

import csv
import json
import pickle
import shutil
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from set_folders import as_blender, as_colmap

from clsplat.benchmark.results import result_notes, result_rows, result_tables
from clsplat.benchmark.run import run_benchmark
from clsplat.benchmark.sets import StartCube, benchmark_set
from clsplat.benchmark.start import with_start
from clsplat.cluster.job import Job, MissingFiles
from clsplat.comparison import measure
from clsplat.comparison.planned import PlannedRun
from clsplat.comparison.runs import Run
from clsplat.comparison.table import Record
from clsplat.errors import InputError, OutputError, TrainingError
from clsplat.evaluation.evaluate import evaluate
from clsplat.evaluation.metrics import PROTOCOLS
from clsplat.files.images import write_png
from clsplat.files.stop_signals import forget
from clsplat.rendering.renderer import Renderer
from clsplat.scenes.scene import Points, Scene, load_scene
from clsplat.splats.color import BLACK, WHITE
from clsplat.splats.splats import Splats
from clsplat.training.config import TrainConfig
from clsplat.training.run import train

CAP = 40
SHORT: dict[str, Any] = {"iterations": 12, "sh_degree": 1, "densify_interval": 5}
TANKS = benchmark_set("tanks")


@pytest.fixture(scope="session")
def tanks(capture_folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a fake of Tanks and Temples; tests must not write into it."""
    folder = tmp_path_factory.mktemp("sets") / "tanks"
    for name in ("truck", "train"):
        as_colmap(capture_folder, folder / name)
    return folder


@pytest.fixture(scope="session")
def finished(tanks: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A finished benchmark of both scenes with two systems. Tests must not write into it."""
    folder = tmp_path_factory.mktemp("benchmark")
    run_benchmark("tanks", tanks, "gaussian,default", folder, caps=[CAP], common=SHORT)
    return folder


def done(folder: Path) -> list[Record]:
    return [json.loads(line) for line in (folder / "runs.jsonl").read_text().splitlines()]


def test_a_run_is_the_training_it_names(tanks: Path, finished: Path) -> None:
    config = TrainConfig(shape="gaussian", cap_max=CAP, background=BLACK, **SHORT)
    scene = load_scene(tanks / "truck")
    expected = train(scene, config).splats
    record = done(finished)[0]
    assert (record["scene"]["name"], record["system"]) == ("truck", "gaussian")
    (ply,) = finished.glob("models/truck-gaussian-cap40-seed0-*/point_cloud/iteration_12/point_cloud.ply")
    assert (Splats.load(ply).mean == expected.mean).all()
    measured = evaluate(Renderer(), expected, scene.test, BLACK, PROTOCOLS["3dgs"])
    assert (record["psnr"], record["ssim"]) == (measured.psnr, measured.ssim)
    assert record["splats"] == len(expected)
    assert record["seconds"] > 0
    assert record["protocol"]["name"] == "3dgs"


def test_the_protocol_is_the_default(capture_folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without options a run has the published iterations, background and number of splats, and no note."""
    scene = as_blender(capture_folder, tmp_path / "lego")
    configs: list[TrainConfig] = []
    points: list[Points] = []

    def stop(folder: Path, scene: Scene, config: TrainConfig, *more: object) -> Record:
        configs.append(config)
        points.append(scene.points)
        raise KeyboardInterrupt

    monkeypatch.setattr("clsplat.benchmark.run.train_and_measure_in", stop)
    wanted: list[tuple[str, dict[str, Any]]] = [
        ("default", {}),
        ("default", {"iterations": 7, "background": BLACK}),
        ("3dgs", {}),
        ("3dgs", {"coarse_to_fine": True}),
        ("3dgs:coarse_to_fine=true", {}),
    ]
    for methods, common in wanted:
        with pytest.raises(KeyboardInterrupt):
            run_benchmark("nerf-synthetic", scene, methods, tmp_path / "out", common=common)
    first, second, *presets = configs
    assert (first.iterations, first.background, first.cap_max) == (30_000, WHITE, 325_000)
    assert (second.iterations, second.background, second.cap_max) == (7, BLACK, 325_000)
    assert first.schedule.coarse_to_fine
    assert [config.schedule.coarse_to_fine for config in presets] == [False, True, True], "presets learn at full size"
    assert [len(start) for start in points] == [0, 0, *[100_000] * 3], "presets start in a cube, as 3DGS does"
    xyz = points[2].xyz
    np.testing.assert_allclose([xyz.min(axis=0), xyz.max(axis=0)], [[-1.3] * 3, [1.3] * 3], atol=1e-3)
    assert (points[2].rgb == 128).all()
    again = with_start(load_scene(scene), StartCube(50, 2.0), seed=3).points.xyz
    assert (again == with_start(load_scene(scene), StartCube(50, 2.0), seed=3).points.xyz).all()
    assert (again != with_start(load_scene(scene), StartCube(50, 2.0), seed=4).points.xyz).all()


def test_points_of_a_scene_are_its_start(capture_folder: Path) -> None:
    scene = load_scene(capture_folder)
    assert with_start(scene, StartCube(50, 2.0), seed=0) is scene


def test_a_preset_that_learns_from_small_images_is_not_as_published(tanks: Path, tmp_path: Path) -> None:
    small = "small images in the first half of the run"
    methods = "3dgs,3dgs:coarse_to_fine=true,default"
    records = run_benchmark("tanks", tanks / "truck", methods, tmp_path, caps=[CAP], common=SHORT)
    assert [small in record["differences"] for record in records] == [False, True, False]


def test_finished_runs_are_read(tanks: Path, finished: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("clsplat.benchmark.run.train_and_measure_in", lambda *arguments: pytest.fail("trained again"))
    records = run_benchmark("tanks", tanks, "gaussian,default", finished, caps=[CAP], common=SHORT)
    assert records == done(finished)
    assert [(record["scene"]["name"], record["system"]) for record in records] == [
        ("truck", "gaussian"),
        ("truck", "default"),
        ("train", "gaussian"),
        ("train", "default"),
    ]


def test_an_interrupted_run_is_resumed(tanks: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = run_benchmark("tanks", tanks / "truck", "gaussian", tmp_path / "a", caps=[CAP], common=SHORT)
    unwanted = measure.train

    def stopped(*arguments: Any, visit: Any, **values: Any) -> Any:
        def stop(trainer: Any, event: Any) -> None:
            visit(trainer, event)
            if trainer.iteration == 7:
                event.set()

        return unwanted(*arguments, visit=stop, **values)

    arguments: tuple[Any, ...] = ("tanks", tanks / "truck", "gaussian", tmp_path / "b")
    monkeypatch.setattr(measure, "train", stopped)
    with pytest.raises(KeyboardInterrupt):
        run_benchmark(*arguments, caps=[CAP], common=SHORT)
    assert not (tmp_path / "b" / "tanks.md").exists()
    seen: list[int] = []

    def counted(*arguments: Any, visit: Any, **values: Any) -> Any:
        def count(trainer: Any, event: Any) -> None:
            seen.append(trainer.iteration)
            visit(trainer, event)

        return unwanted(*arguments, visit=count, **values)

    monkeypatch.setattr(measure, "train", counted)
    (record,) = run_benchmark(*arguments, caps=[CAP], common=SHORT)
    assert seen == list(range(8, 13))
    assert (record["digest"], record["psnr"]) == (whole[0]["digest"], whole[0]["psnr"])
    # A run that was finished but not measured, as after a crash: only the measurement is repeated.
    (tmp_path / "b" / "runs.jsonl").write_text("")
    seen.clear()
    (again,) = run_benchmark(*arguments, caps=[CAP], common=SHORT)
    assert seen == []
    assert (again["digest"], again["schedule"]) == (record["digest"], record["schedule"])
    forget()


def test_workers_write_the_files_of_a_benchmark_without_them(tanks: Path, finished: Path, tmp_path: Path) -> None:
    pytest.importorskip("distributed")
    run_benchmark("tanks", tanks, "gaussian,default", tmp_path, caps=[CAP], common=SHORT, cluster="local:1")
    kept = ("scene", "system", "config", "digest", "psnr", "ssim", "splats", "differences", "protocol")
    for row, other in zip(done(tmp_path), done(finished), strict=True):
        assert {key: row[key] for key in kept} == {key: other[key] for key in kept}
    files = {path.relative_to(finished) for path in finished.rglob("*")}
    assert {path.relative_to(tmp_path) for path in tmp_path.rglob("*")} == files


def test_a_worker_trains_on_the_photos_and_points_of_the_program(
    tanks: Path, finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A worker on another machine reads the scene by its absolute path, and refuses other files there."""
    shutil.copytree(tanks / "truck", tmp_path / "here" / "truck")
    monkeypatch.chdir(tmp_path)
    jobs: list[Job] = []

    def keep(plan: Iterable[PlannedRun], *more: object) -> None:
        jobs.extend(each.job() for each in plan)
        raise KeyboardInterrupt

    monkeypatch.setattr("clsplat.benchmark.run.do_runs", keep)
    for photos in (None, 3):
        with pytest.raises(KeyboardInterrupt):
            run_benchmark("tanks", "here", "gaussian", "out", caps=[CAP], common=SHORT, photos=photos)
    monkeypatch.chdir("/")
    whole, few = (pickle.loads(pickle.dumps(job)).arguments[0] for job in jobs)
    assert whole.folder.is_absolute()
    expected = load_scene(tanks / "truck")
    assert whole.load().names == expected.names
    assert (whole.load().points.xyz == expected.points.xyz).all()
    assert len(few.load().train) == 3
    assert 0 < len(few.load().points) < len(expected.points)
    photo = tmp_path / "here" / "truck" / "images" / expected.names[0]
    write_png(photo, np.zeros(expected.views[0].image.shape, np.uint8))
    for job in (whole, few):
        with pytest.raises(MissingFiles, match=f"{photo.name} is another one here"):
            job.load()


def test_other_options_are_another_run(tanks: Path, tmp_path: Path) -> None:
    arguments: tuple[Any, ...] = ("tanks", tanks / "truck", "gaussian", tmp_path)
    run_benchmark(*arguments, caps=[CAP], common=SHORT)
    records = run_benchmark(*arguments, caps=[CAP], common=SHORT | {"iterations": 14})
    assert [record["config"]["iterations"] for record in records] == [12, 14]
    assert len(list((tmp_path / "models").iterdir())) == 2, "the longer run does not continue the shorter one"


def test_a_damaged_checkpoint_is_named(tanks: Path, tmp_path: Path) -> None:
    arguments: tuple[Any, ...] = ("tanks", tanks / "truck", "gaussian", tmp_path)
    run_benchmark(*arguments, caps=[CAP], common=SHORT)
    (tmp_path / "runs.jsonl").write_text("")
    (checkpoint,) = tmp_path.glob("models/*/checkpoint.npz")
    checkpoint.write_bytes(b"no checkpoint")
    with pytest.raises(InputError, match=r"truck-gaussian.*: the run cannot be resumed .*: delete this folder"):
        run_benchmark(*arguments, caps=[CAP], common=SHORT)


def test_tables_have_published_figures_beside(finished: Path) -> None:
    records = done(finished)
    tables = result_tables(TANKS, records)
    assert [table.title for table in tables] == [
        "truck (48x36 px, 2 test views)",
        "train (48x36 px, 2 test views)",
        "PSNR of 2 of 2 scenes, and means",
    ]
    truck = tables[0]
    ours = dict(zip(truck.head, truck.rows[0], strict=True))
    assert ours["system"] == "clsplat gaussian"
    assert ours["PSNR"] == f"{records[0]['psnr']:.2f}"
    assert "not the published length (30000 iterations)" in ours["source or protocol"]
    assert "48x36 px, not 979x546" in ours["source or protocol"]
    assert ("3DGS", "25.19", "", "", "", "30000", "", "Kerbl et al. 2023") in truck.rows
    assert ("3DGS-MCMC", "26.11", "0.89", "0.14", "", "30000", "", "Kheradmand et al. 2024") in truck.rows
    means = {(row[0], row[1]): row for row in tables[2].rows}
    assert means["3DGS", "30000"][2:5] == ("25.19", "21.10", "23.14")
    first, _, second, _ = records
    assert means["clsplat gaussian", "12"][4] == f"{(first['psnr'] + second['psnr']) / 2:.2f}"
    assert list(means)[:2] == [("clsplat gaussian", "12"), ("clsplat default", "12")]


def test_files_have_the_same_rows(finished: Path) -> None:
    rows = result_rows(TANKS, done(finished))
    assert json.loads((finished / "tanks.json").read_text()) == rows
    with (finished / "tanks.csv").open() as stream:
        read = list(csv.DictReader(stream))
    assert [(row["scene"], row["kind"], row["system"]) for row in read] == [
        (row["scene"], row["kind"], row["system"]) for row in rows
    ]
    assert float(read[0]["psnr"]) == rows[0]["psnr"]
    text = (finished / "tanks.md").read_text()
    assert text.startswith("# Tanks and Temples\n\n## truck (48x36 px, 2 test views)\n\n| system | PSNR |")
    for note in result_notes(TANKS, done(finished)):
        assert f"- {note}\n" in text


def test_notes_name_the_traps(finished: Path) -> None:
    notes = "\n".join(result_notes(TANKS, done(finished)))
    for part in (
        "differs from the published protocol: truck, clsplat gaussian: 48x36 px, not 979x546",
        "every 8th of the sorted names; the last iteration is measured, and nothing is chosen on test views",
        "LPIPS is not measured",
        "wider than 1600 pixels",
        "zero padding",
        "at most 40 splats, not 2600000",
    ):
        assert part in notes
    assert "of the 2 scenes" not in notes
    assert "1 of the 2 scenes: published means" in "\n".join(result_notes(TANKS, done(finished)[:1]))
    assert result_notes(TANKS, []) == []


def test_published_means_stand_beside_all_scenes_only(finished: Path) -> None:
    """A mean of eight scenes is not a figure to compare with the mean of two."""
    chosen = benchmark_set("nerf-synthetic")
    record = done(finished)[0]
    every = [
        record | {"scene": record["scene"] | {"name": name, "set": chosen.name, "images": None}}
        for name in chosen.scenes
    ]
    systems = [row[0] for row in result_tables(chosen, every)[-1].rows]
    assert "Deformable Beta" in systems
    (beta,) = [row for row in result_tables(chosen, every)[-1].rows if row[0] == "Deformable Beta"]
    assert beta[-1] == "Liu et al. 2025; checkpoint chosen on the test views"
    assert "Deformable Beta" not in [row[0] for row in result_tables(chosen, every[:2])[-1].rows]
    ubs = next(row for row in result_tables(chosen, every)[-1].rows if row[0] == "UBS")
    assert (ubs[2], ubs[3], ubs[10]) == ("36.72", "", ""), "no mean of some of the scenes"


def test_seeds_have_their_spread(finished: Path) -> None:
    record = done(finished)[0]
    other = json.loads(json.dumps(record)) | {"psnr": record["psnr"] + 1}
    other["config"]["seed"] = 1
    (row, *_) = result_rows(TANKS, [record, other])
    assert (row["seeds"], row["psnr_half_spread"]) == (2, pytest.approx(0.5))
    assert result_tables(TANKS, [record, other])[0].rows[0][1] == f"{record['psnr'] + 0.5:.2f} ± 0.50"


def test_a_failed_run_does_not_end_the_others(tanks: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = measure.train

    def failing(scene: Any, *arguments: Any, **values: Any) -> Any:
        if scene.name == "truck":
            raise TrainingError("the loss is not finite")
        return whole(scene, *arguments, **values)

    monkeypatch.setattr(measure, "train", failing)
    records = run_benchmark("tanks", tanks, "gaussian", tmp_path, caps=[CAP], common=SHORT)
    assert [record["failed"] for record in records] == ["the loss is not finite", None]
    truck, train_, means = result_tables(TANKS, records)
    assert truck.rows[0][1] == "failed"
    assert train_.rows[0][1] != "failed"
    assert means.rows[0][2] == means.rows[0][4] == ""
    assert any("failed: gaussian on truck 48x36" in note for note in result_notes(TANKS, records))


def test_lpips_is_measured_later_without_training(tanks: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    class Fake:
        def __init__(self, unit_range: bool = False) -> None:
            assert unit_range, "3DGS's script passes images in 0..1"

        def __call__(self, *images: object) -> float:
            return 0.25

        def describe(self) -> str:
            return "fake"

    arguments: tuple[Any, ...] = ("tanks", tanks / "truck", "gaussian", tmp_path)
    (first,) = run_benchmark(*arguments, caps=[CAP], common=SHORT)
    assert first["lpips"] is None
    monkeypatch.setattr("clsplat.benchmark.job.Lpips", Fake)
    (second,) = run_benchmark(*arguments, caps=[CAP], common=SHORT, lpips=True)
    assert (second["lpips"], second["digest"], second["seconds"]) == (0.25, first["digest"], first["seconds"])
    assert result_tables(TANKS, [second])[0].rows[0][3] == "0.2500"
    assert "LPIPS: fake" in result_notes(TANKS, [second])
    seen: list[Run] = []
    run_benchmark(*arguments, caps=[CAP], common=SHORT, lpips=True, on_run=lambda run, record: seen.append(run))
    assert seen == []


def test_folders_of_others_are_refused(tanks: Path, tmp_path: Path) -> None:
    (tmp_path / "tanks.csv").write_text("mine")
    with pytest.raises(OutputError, match=r"tanks.csv: exists already, but no runs.jsonl beside it"):
        run_benchmark("tanks", tanks, output=tmp_path)
    assert (tmp_path / "tanks.csv").read_text() == "mine"
    with pytest.raises(InputError, match="unknown benchmark"):
        run_benchmark("lego", tanks, output=tmp_path)


def test_few_photos_of_each_scene(capture_folder: Path, tmp_path: Path) -> None:
    as_colmap(capture_folder, tmp_path / "sets" / "fern", "images_8")
    out = tmp_path / "out"
    records = run_benchmark("llff", tmp_path / "sets", "gaussian", out, photos=3, caps=[CAP], common=SHORT)
    (record,) = records
    assert (record["scene"]["set"], record["scene"]["train"], record["scene"]["images"]) == ("llff-3", 3, "images_8")
    config = json.loads(next(out.glob("models/*/config.json")).read_text())
    assert len(json.loads(next(out.glob("models/*/cameras.json")).read_text())) == 3 + record["scene"]["test"]
    assert config["scene"]["photos"].keys() >= {"view_001.png"}
    text = (out / "llff-3.md").read_text()
    assert text.startswith("# LLFF with 3 training views\n")
    assert "not the published length (10000 iterations)" in text
    assert "TensoRF" not in text, "figures with all views"
    again = run_benchmark("llff", tmp_path / "sets", "gaussian", out, photos=3, caps=[CAP], common=SHORT)
    assert [entry["seconds"] for entry in again] == [record["seconds"]]
